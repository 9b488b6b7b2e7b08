"""The tracker as a service: poses and a path in, drive requests to the gate out."""

import asyncio
import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from monstertruck_kinematics.errors import KinematicsError
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint, ScanPoints, clearance_to_points, points_near
from monstertruck_planners.track.api import Command, TruckState
from monstertruck_planners.track.catalog import build_tracker
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.ground import Ground
from monstertruck_planners.track.line import Line, Progress
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_runtime.schedule import Schedule
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import Path, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.sensor import Attitude, LaserScan
from monstertruck_schemas.state import GateState, Odometry
from monstertruck_schemas.topics import COMPASS, ODOMETRY, SCAN

"""Modes of the gate in which the tracker asks for motion."""

LOOKS: Final = 8
"""Poses ahead whose clearance counts."""

LONG: Final = 3 * 500
"""Numbers of a path (x, y, yaw) from which on it is taken in within several turns of the loop."""

AT_REST: Final = 0.01
"""Speed of a truck at rest, m/s."""

MOVED: Final = 0.01
"""A truck not armed and moved by more than this may begin its path elsewhere, m."""
TURNED: Final = 0.02
"""Or turned by more than this, rad."""


class TrackerService:
    """Follows ``plan/path`` by the configured tracker.

    Starts the path over whenever the truck is armed anew after the path's end; after a stop on the way it goes on.
    Once the path has ended or is lost it asks for standstill, then falls silent.

    Args:
        config: of the tracker.
        clock: time.
        steering: the truck's geometry.
        footprint: its outline.
        points: of scans, in base.
        pose: pose of base in the paths' frame.
        path: what to follow.
        gate: state of the gate, with the nonce.
        scan: slows down in narrow places; None = does not.
        attitude: slows down on slopes and rough ground; None = does not.
        drive: ``plan/drive``.
        tracker: ``plan/tracker``.
        events: where events go.
    """

    name = "tracker"

    def __init__(
        self,
        config: TrackerConfig,
        clock: Clock,
        *,
        steering: FourWheelSteering,
        footprint: Footprint,
        points: ScanPoints,
        pose: Subscription[Odometry],
        path: Subscription[Path],
        gate: Subscription[GateState],
        scan: Subscription[LaserScan] | None,
        attitude: Subscription[Attitude] | None = None,
        drive: Publisher[DriveRequest],
        tracker: Publisher[TrackerState],
        events: EventSink,
    ) -> None:
        self._config = config
        self._clock = clock
        self._law = build_tracker(config, steering)
        self._footprint = footprint
        self._points = points
        self._near = footprint.circumscribed_radius + config.slow_clearance
        self._pose = pose
        self._path = path
        self._gate = gate
        self._scan = scan
        self._attitude = attitude
        self._ground = Ground()
        self._drive = drive
        self._tracker = tracker
        self._events = events
        self._seen: tuple[LaserScan, Line] | None = None
        self._room = math.inf
        """Clearance ahead on that line, in that scan."""
        self._followed: Path | None = None
        self._line: Line | None = None
        self._progress = Progress()
        self._begun: tuple[float, float, float] | None = None
        """Pose the line was begun from; None for one that may have to be begun anew."""
        self._outcome = Reason.DRIVING
        self._told = Reason.DRIVING
        """Outcome of the newest event since the path came or the truck was armed."""
        self._active = False

    async def run(self, ready: Ready) -> None:
        """Track until cancelled."""
        ready()
        schedule = Schedule(self._clock, self._config.rate)
        while True:
            await schedule.next()
            for _ in self._parts(self._clock.now()):
                await asyncio.sleep(0)

    def _parts(self, now: int) -> Iterator[None]:
        """A control step, in parts between which the loop may turn: a long path takes its time when it comes."""
        pose, path, gate = self._pose.latest, self._path.latest, self._gate.latest
        if pose is None or path is None or gate is None or now - pose.received > ODOMETRY.fresh_for() * SECOND:
            return  # silent: its lease runs out
        if self._choose_line(path, pose, armed=gate.mode.active) and len(path.poses) > LONG:
            yield
        if self._line is None:
            return
        if self._law.prepare(self._line, self._progress) and len(path.poses) > LONG:
            yield
        at = (pose.pose.x, pose.pose.y, pose.pose.yaw)
        state = TruckState(at, pose.twist.vx, self._clearance(pose, now), *self._feel(now))
        try:
            command = self._law.control(state, self._line, self._progress, now / SECOND)
        except KinematicsError as error:
            self._line = None
            text = f"path {path.name!r} cannot be driven from {state.pose}: {error}"
            self._events(Reason.BAD_INPUT, Severity.WARNING, self.name, text)
            return
        if gate.mode.active:
            self._progress = command.progress
            if command.outcome is Reason.DRIVING or abs(pose.twist.vx) > AT_REST:
                self._ask(command, gate, now)
        self._tell(command, self._line, now)

    def _choose_line(self, path: Path, pose: Odometry, *, armed: bool) -> bool:
        """Take a new path, or start the present one over: until armed it may still begin anywhere; whether it did."""
        idle, self._active = not self._active, armed
        if armed and idle:
            self._law.reset()
            self._told = Reason.DRIVING
        elif not armed and not idle:
            self._begun = None
        here = (pose.pose.x, pose.pose.y, pose.pose.yaw)
        if path is self._followed:
            again = idle and (armed or self._moved(here))
            if self._line is None or not again or not self._to_begin():
                return False
        else:
            self._told = Reason.DRIVING
        self._followed, self._line, self._outcome, self._begun = path, None, Reason.DRIVING, here
        try:
            if path.frame != pose.frame:
                msg = f"path {path.name!r} is in frame {path.frame!r}: expected {pose.frame!r}"
                raise InputError(msg)
            self._line = Line(path, here, self._config.beyond)
            self._progress = self._line.start
        except InputError as error:
            self._events(Reason.BAD_INPUT, Severity.WARNING, self.name, str(error))
        return True

    def _to_begin(self) -> bool:
        """Whether the path has ended or not yet begun."""
        return self._outcome is not Reason.DRIVING or self._at_start()

    def _moved(self, here: tuple[float, float, float]) -> bool:
        """Whether the truck stands elsewhere than where the line was begun, so far as it matters."""
        if self._begun is None:
            return True
        x, y, yaw = self._begun
        return math.hypot(here[0] - x, here[1] - y) > MOVED or abs(math.remainder(here[2] - yaw, math.tau)) > TURNED

    def _at_start(self) -> bool:
        return self._line is not None and self._progress == self._line.start

    def _clearance(self, pose: Odometry, now: int) -> float:
        """Least clearance of the poses ahead on the path, in the newest scan; +inf if nothing near slows the truck."""
        scan, line = None if self._scan is None else self._scan.latest, self._line
        if scan is None or line is None or now - scan.received > SCAN.fresh_for() * SECOND:
            return math.inf
        if self._seen is None or self._seen[0] is not scan or self._seen[1] is not line:
            self._seen, self._room = (scan, line), self._measure_room(scan, line, pose)
        return self._room

    def _measure_room(self, scan: LaserScan, line: Line, pose: Odometry) -> float:
        ahead = line.ahead(self._progress, self._config.reach, LOOKS)
        c, s = math.cos(pose.pose.yaw), math.sin(pose.pose.yaw)
        dx, dy = ahead[:, 0] - pose.pose.x, ahead[:, 1] - pose.pose.y
        poses = np.column_stack((c * dx + s * dy, c * dy - s * dx, ahead[:, 2] - pose.pose.yaw))
        near = points_near(self._points.of(scan), poses, self._near)
        return float(clearance_to_points(self._footprint, poses, near).min())

    def _feel(self, now: int) -> tuple[float, float]:
        """Tilt and roughness, rad; 0 if nobody measures them now."""
        attitude = None if self._attitude is None else self._attitude.latest
        if attitude is None or now - attitude.received > COMPASS.fresh_for() * SECOND:
            return 0.0, 0.0
        if attitude.tilt_valid:
            self._ground.add(attitude.stamp / SECOND, attitude.roll, attitude.pitch)
        return self._ground.tilt, self._ground.roughness

    def _ask(self, command: Command, gate: GateState, now: int) -> None:
        self._drive.put(
            DriveRequest(
                stamp=now,
                received=now,
                seq=self._drive.next_seq(),
                source=self.name,
                role=Role.TRACKER,
                lease=self._config.lease,
                nonce=gate.nonce,
                gate_stamp=gate.stamp,
                speed=command.speed,
                front=command.front,
                rear=command.rear,
            )
        )

    def _tell(self, command: Command, line: Line, now: int) -> None:
        self._outcome = command.outcome
        if command.outcome is not self._told and (self._active or command.outcome is not Reason.DRIVING):
            self._told = command.outcome
            severity = Severity.WARNING if command.outcome is Reason.PATH_LOST else Severity.INFO
            self._events(command.outcome, severity, self.name, path=line.name, cross_track=command.cross_track)
        self._tracker.put(
            TrackerState(
                stamp=now,
                received=now,
                seq=self._tracker.next_seq(),
                frame=line.frame,
                path=line.name,
                cross_track=command.cross_track,
                heading_error=command.heading_error,
                along=line.along(command.progress),
                length=line.length,
                outcome=command.outcome,
            )
        )
