"""Tracker service: reads poses and a path, and sends drive requests to the gate."""

import asyncio
import functools
import math
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from monstertruck_estimation.body_tilt import BodyAcceleration
from monstertruck_estimation.ground.terrain import TerrainEstimator
from monstertruck_kinematics.chassis import Freedom
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.se2 import Pose2, poses_relative
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint, ScanPoints, clearance_to_points, points_near
from monstertruck_planners.track.axle_report import SteeringReport
from monstertruck_planners.track.axle_report import report as steering_report
from monstertruck_planners.track.catalog import AnyTracker, build_tracker
from monstertruck_planners.track.path_tracker import Command, TruckState
from monstertruck_planners.track.segments import PathProgress, SegmentedPath
from monstertruck_runtime.actors.actor import Actor
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription, Value
from monstertruck_runtime.requests import planner_request
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import AxleResponse, Path, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import Attitude, LaserScan
from monstertruck_schemas.state import GateMode, GateState, Odometry
from monstertruck_schemas.topics import COMPASS, ODOMETRY, SCAN

SOURCE: Final = ServiceName.TRACKER.value
"""Source of the drive requests."""


UNSEEN_AFTER: Final = SECOND
"""Maximum waiting time before unseen ground (ns), then the path is abandoned: waiting cannot reveal that ground."""
STUCK_AFTER: Final = 1.0
"""Commanded distance without progress of a stuck truck (m)."""


@dataclass(frozen=True, slots=True)
class TrackSetup:
    """Settings of the tracking step."""

    config: AnyTracker
    steering: FourWheelSteering
    footprint: Footprint
    lidar: Pose2
    """Pose of the lidar in base."""
    located: bool = False
    """Whether poses are measured rather than computed from the requests."""
    freedom: Freedom | None = "both"
    """Angles that the axles can take; None for unsteered axles."""


class Newest(NamedTuple):
    """Latest message of each input; None before the first, or if the robot lacks the input."""

    pose: Odometry | None = None
    """Pose of base in the paths' frame."""
    path: Path | None = None
    gate: GateState | None = None
    scan: LaserScan | None = None
    """Scan that slows the truck down in narrow places."""
    attitude: Attitude | None = None
    """Attitude that slows the truck down on slopes and rough ground."""


@dataclass(frozen=True, slots=True)
class StepEvent:
    """An event of the step."""

    reason: Reason
    severity: Severity
    text: str
    values: dict[str, Value]


@dataclass(slots=True)
class TrackOutput:
    """Result of one step."""

    command: Command | None = None
    """Command; None to send no request."""
    drive: bool = False
    """Whether the command is sent to the gate."""
    frame: str = ""
    path: str = ""
    along: float = 0.0
    """Distance travelled along the path (m)."""
    length: float = 0.0
    """Length of the whole path (m)."""
    axles: AxleResponse | None = None
    steering: SteeringReport | None = None
    events: tuple[StepEvent, ...] = ()


@dataclass(slots=True)
class _ProgressChecker:
    """Detector of a truck that is commanded to move but does not; needs a pose from more than its wheels."""

    place: tuple[float, float] = (math.inf, math.inf)
    """Position at the last progress (m)."""
    along: float = -math.inf
    """Position along the path at the last progress (m); short moves back and forth add up there."""
    asked: float = 0.0
    """Distance commanded by the gate since then (m)."""
    looked: int = 0
    """Time of the last check (ns)."""

    def stuck(self, now: int, place: tuple[float, float], along: float, gate: GateState | None) -> bool:
        """Whether the truck is stuck (latched); ``gate`` is None while the tracker does not drive."""
        if self.asked >= STUCK_AFTER:
            return True
        progress = 0.2  # minimum motion of progress, in space or along the path, m
        if along - self.along > progress or math.dist(place, self.place) > progress:
            self.place, self.along, self.asked = place, along, 0.0
        elif gate is not None and gate.twist is not None:
            self.asked += math.hypot(gate.twist.vx, gate.twist.vy) * (now - self.looked) / SECOND
        self.looked = now
        return self.asked >= STUCK_AFTER


class TrackingStep:
    """Control step that follows the latest path with the configured tracker.

    Arming after the end of a path restarts the path; after a stop before its end the truck continues. Disarming ends a
    path that ``halts``, because the truck may be elsewhere when it is armed again. Once a path has ended or is lost, or
    the truck is stuck, the step requests standstill, then nothing.

    Args:
        setup: settings of the tracker and the truck.
        points: converter of scans to points in base, if shared with other users.

    Raises:
        InputError: the tracker cannot be built.
    """

    def __init__(self, setup: TrackSetup, points: ScanPoints | None = None) -> None:
        self._config = setup.config
        self._path_tracker = build_tracker(setup.config, setup.steering)
        self._path_tracker.limit_learning(setup.freedom)
        self._footprint = setup.footprint
        self._points = points or ScanPoints(setup.lidar)
        self._located = setup.located
        self._near = setup.footprint.circumscribed_radius + setup.config.slow_clearance
        self._terrain = TerrainEstimator(2.0)  # time constant of the roughness that slows the truck down, s
        self._acceleration = BodyAcceleration()
        self._seen: tuple[LaserScan, SegmentedPath] | None = None
        self._clearance_ahead = math.inf
        """Clearance ahead on that path in that scan (m)."""
        self._followed: Path | None = None
        self._path: SegmentedPath | None = None
        self._progress = PathProgress()
        self._begun: tuple[float, float, float] | None = None
        """Pose when the truck joined the path; None if it must join again."""
        self._outcome = Reason.DRIVING
        self._progress_checker = _ProgressChecker()
        self._unseen: int | None = None
        """Time since which the gate has stopped the truck before unseen ground (ns)."""
        self._reported = Reason.DRIVING
        """Outcome of the latest event since the path arrived or the truck was armed."""
        self._active = False
        self._contradicted = False
        """Whether the response differed from the configured one at the last step."""
        self._steering_report = SteeringReport("", agrees=True, axles=())
        self._compared = 0.0
        """Distance covered by the report (m)."""
        self._differs: Severity | None = None
        """Severity of the reported steering difference; None if none was reported."""
        self._events: list[StepEvent] = []

    def step(self, now: int, newest: Newest) -> TrackOutput:
        """Run one control step at ``now`` (ns)."""
        *_, output = self.parts(now, newest)
        assert output is not None
        return output

    def parts(self, now: int, newest: Newest) -> Iterator[TrackOutput | None]:
        """Run the step in parts so that the event loop can run in between; yield None after all but the last part.

        The last part yields the output. There is more than one part only when a long path arrives.
        """
        pose, path, gate = newest.pose, newest.path, newest.gate
        if pose is None or path is None or gate is None or now - pose.received > ODOMETRY.fresh_for() * SECOND:
            yield TrackOutput()
            return
        # 3 * 500: array length (3 numbers per pose) above which a path is prepared in several event loop iterations
        long = len(path.poses) > 3 * 500
        if self._choose_path(path, pose, armed=gate.mode.active) and long:
            yield None
        if self._path is None:
            yield TrackOutput(events=self._drain())
            return
        if self._path_tracker.prepare(self._path, self._progress) and long:
            yield None
        yield self._control(self._path, pose, gate, newest, now)

    def _control(self, path: SegmentedPath, pose: Odometry, gate: GateState, newest: Newest, now: int) -> TrackOutput:
        at = (pose.pose.x, pose.pose.y, pose.pose.yaw)
        clearance = self._clearance(newest.scan, path, pose, now)
        self._acceleration.observe(pose)
        tilt, roughness = self._terrain_at(newest.attitude, now)
        obeyed = gate.mode is GateMode.DRIVING and gate.holder == SOURCE
        heading = _heading(newest.attitude, now)
        state = TruckState(at, pose.twist.vx, clearance, tilt, roughness, obeyed, heading, self._located)
        try:
            command = self._path_tracker.control(state, path, self._progress, now / SECOND)
        except KinematicsError as error:
            self._path = None
            text = f"path {path.name!r} cannot be driven from {state.pose}: {error}"
            self._report(Reason.BAD_INPUT, Severity.WARNING, text)
            return TrackOutput(events=self._drain())
        along = path.along(command.progress)
        stuck = self._progress_checker.stuck(now, at[:2], along, gate if obeyed else None)
        if stuck and command.outcome is Reason.DRIVING:
            command.speed, command.outcome = 0.0, Reason.STUCK
        text = ""
        if self._before_unseen(now, gate, driving=obeyed and command.outcome is Reason.DRIVING):
            reached = path.length - along <= self._config.goal_tolerance
            command.speed, command.outcome = 0.0, Reason.GOAL_REACHED if reached else Reason.UNSEEN_STOP
            text = (
                ""
                if reached
                else f"path {path.name!r} leads onto ground that no sensor has seen, from {at[0]:.2f}, {at[1]:.2f}"
            )
        if command.outcome is Reason.PATH_LOST:
            text = self._lost(path, command.progress, at)
        if active := gate.mode.active:
            self._progress = command.progress
        self._outcome = command.outcome
        if command.outcome is not self._reported and (self._active or command.outcome is not Reason.DRIVING):
            self._reported = command.outcome
            severity = Severity.INFO if command.outcome in (Reason.DRIVING, Reason.GOAL_REACHED) else Severity.WARNING
            self._report(command.outcome, severity, text, path=path.name, cross_track=command.cross_track)
        axles, steering = self._axles(), self._steering()
        # 0.01: speed of a truck at rest, m/s
        drive = active and (command.outcome is Reason.DRIVING or abs(pose.twist.vx) > 0.01)
        return TrackOutput(command, drive, path.frame, path.name, along, path.length, axles, steering, self._drain())

    def _lost(self, path: SegmentedPath, progress: PathProgress, at: tuple[float, float, float]) -> str:
        """Return a text with the positions of the robot and of the nearest part of its path."""
        x, y = path.runs[progress.run].at(progress.s).point
        return (
            f"path {path.name!r} is {math.dist((x, y), at[:2]):.2f} m from the robot, which is at {at[0]:.2f}, "
            f"{at[1]:.2f} m in {path.frame}; the nearest point of the path is {x:.2f}, {y:.2f} m, and the tracker "
            f"follows within {self._config.lost_distance:g} m"
        )

    def _before_unseen(self, now: int, gate: GateState, *, driving: bool) -> bool:
        """Whether the gate has stopped the truck before unseen ground for some time; latched until armed again."""
        if self._outcome is Reason.UNSEEN_STOP:
            return True
        if not driving or Reason.UNSEEN_STOP not in gate.reasons:
            self._unseen = None
            return False
        self._unseen = self._unseen or now
        return now - self._unseen >= UNSEEN_AFTER

    def _axles(self) -> AxleResponse:
        """Return the measured response of the axles; report a difference from the configured one."""
        tracker = self._path_tracker
        estimate, configured = tracker.estimator.estimate, tracker.configured
        axles = AxleResponse(
            dead_time=tracker.response.dead_time,
            lag=tracker.response.lag,
            delay=estimate.response.total,
            deviation=estimate.deviation,
            samples=estimate.samples,
        )
        if configured is not None and tracker.contradicted is not self._contradicted:
            self._contradicted = tracker.contradicted
            reason, severity = Reason.RESPONSE_AGREES, Severity.INFO
            if self._contradicted:
                reason, severity = Reason.RESPONSE_DIFFERS, Severity.WARNING
            values = axles.model_dump()
            text = f"measured dead time plus lag is {axles.delay:.3f} s, configured {configured.total:.3f} s"
            self._report(reason, severity, text, configured=configured.total, **values)
        return axles

    def _steering(self) -> SteeringReport:
        """Compare the steering with its calibration; report the start and end of a difference, and its part."""
        estimator = self._path_tracker.axle_errors
        if estimator.metres == self._compared:
            return self._steering_report
        self._compared = estimator.metres
        found = self._steering_report = steering_report(estimator, self._path_tracker.geometry.wheelbase)
        values = {f"{row.axle}_{name}": getattr(row, name) for row in found.axles for name in ("gain", "trim", "slip")}
        servo = any(row.servo_differs for row in found.axles)
        if found.text and (self._differs is None or (servo and self._differs is Severity.INFO)):
            self._differs = Severity.WARNING if servo else Severity.INFO
            self._report(Reason.STEERING_DIFFERS, self._differs, found.text, **values)
        elif found.agrees and self._differs is not None:
            self._differs = None
            self._report(Reason.STEERING_AGREES, Severity.INFO, "", **values)
        return found

    def _choose_path(self, path: Path, pose: Odometry, *, armed: bool) -> bool:
        """Join a new path, or rejoin the current one; return whether it did. Until armed the truck may be moved."""
        idle, self._active = not self._active, armed
        if armed and idle:
            self._path_tracker.reset()
            self._reported = Reason.DRIVING
        elif not armed and not idle:
            self._begun = None
        if path.halts and self._followed is not None and path.name == self._followed.name:
            self._followed = path  # withdrawn
        if path.halts and not armed:
            self._followed, self._path = path, None
            return False
        here = (pose.pose.x, pose.pose.y, pose.pose.yaw)
        if path is self._followed:
            again = idle and (armed or self._moved(here))
            if self._path is None or not again or not self._to_begin():
                return False
        else:
            self._reported = Reason.DRIVING
        self._followed, self._path, self._outcome, self._begun = path, None, Reason.DRIVING, here
        self._progress_checker, self._unseen = _ProgressChecker(), None
        try:
            if path.frame != pose.frame:
                msg = f"path {path.name!r} is in frame {path.frame!r}: expected {pose.frame!r}"
                raise InputError(msg)
            self._path = SegmentedPath(path, here, self._config.beyond)
            self._progress = self._path.start
        except InputError as error:
            self._report(Reason.BAD_INPUT, Severity.WARNING, str(error))
        return True

    def _to_begin(self) -> bool:
        """Whether the path has ended or has not started yet."""
        return self._outcome is not Reason.DRIVING or (self._path is not None and self._progress == self._path.start)

    def _moved(self, here: tuple[float, float, float]) -> bool:
        """Whether the truck has been moved since it joined the path."""
        if self._begun is None:
            return True
        x, y, yaw = self._begun
        # 0.01: a disarmed truck that was moved by more than this joins its path again, m
        # 0.02: the same for a turn, rad
        return math.hypot(here[0] - x, here[1] - y) > 0.01 or abs(math.remainder(here[2] - yaw, math.tau)) > 0.02

    def _clearance(self, scan: LaserScan | None, path: SegmentedPath, pose: Odometry, now: int) -> float:
        """Return the minimum clearance of the poses ahead in the latest scan; +inf if nothing near slows the truck."""
        if scan is None or now - scan.received > SCAN.fresh_for() * SECOND:
            return math.inf
        if self._seen is None or self._seen[0] is not scan or self._seen[1] is not path:
            self._seen, self._clearance_ahead = (scan, path), self._measure_clearance(scan, path, pose)
        return self._clearance_ahead

    def _measure_clearance(self, scan: LaserScan, path: SegmentedPath, pose: Odometry) -> float:
        ahead = path.ahead(self._progress, self._config.reach, 8)  # number of poses ahead whose clearance is checked
        poses = poses_relative(ahead, (pose.pose.x, pose.pose.y, pose.pose.yaw))
        near = points_near(self._points.of(scan), poses, self._near)
        return float(clearance_to_points(self._footprint, poses, near).min())

    def _terrain_at(self, attitude: Attitude | None, now: int) -> tuple[float, float]:
        """Return tilt and roughness (rad); 0 if they are not measured."""
        if attitude is None or now - attitude.received > COMPASS.fresh_for() * SECOND:
            return 0.0, 0.0
        if attitude.tilt_valid:
            self._terrain.add(attitude.stamp / SECOND, *self._acceleration.tilt(attitude))
        return self._terrain.tilt, self._terrain.roughness

    def _report(self, reason: Reason, severity: Severity, text: str = "", **values: Value) -> None:
        self._events.append(StepEvent(reason, severity, text, values))

    def _drain(self) -> tuple[StepEvent, ...]:
        if not self._events:
            return ()
        events, self._events = tuple(self._events), []
        return events


def _heading(attitude: Attitude | None, now: int) -> tuple[float, float] | None:
    """Return time (s) and heading (rad, counter-clockwise) of the latest compass reading, if valid and fresh."""
    if attitude is None or attitude.heading_disturbed or now - attitude.received > COMPASS.fresh_for() * SECOND:
        return None
    return attitude.stamp / SECOND, -attitude.heading


@dataclass(frozen=True, slots=True)
class TrackInput:
    """Input of one control step at ``now`` (ns): messages received since the last step, by input."""

    now: int
    news: dict[str, Any]
    setup: TrackSetup | None = None
    """Setup; present in the first step, also after a restart."""


class TrackingWorker:
    """Tracking step in an actor: keeps the latest messages."""

    def __init__(self) -> None:
        self._step: TrackingStep | None = None
        self._newest = Newest()

    def step(self, inputs: TrackInput) -> TrackOutput:
        """Do one control step.

        Raises:
            InputError: no setup came first, or the tracker cannot be built.
        """
        if inputs.setup is not None:
            self._step, self._newest = TrackingStep(inputs.setup), Newest()
        if self._step is None:
            raise InputError("tracking: expected a setup message first")
        self._newest = self._newest._replace(**inputs.news)
        return self._step.step(inputs.now, self._newest)


class TrackerService:
    """Service that follows ``plan/path`` with one tracking step per period.

    Args:
        setup: settings of the tracker and the truck.
        clock: clock.
        inputs: subscriptions by the names of ``Newest``.
        drive: publisher of ``plan/drive``.
        tracker: publisher of ``plan/tracker``.
        events: sink of events.
        actor: actor that computes the steps; None: the event loop computes them.
        points: converter of scans to points in base, shared within the event loop.

    Raises:
        InputError: the tracker cannot be built.
    """

    name = SOURCE

    def __init__(
        self,
        setup: TrackSetup,
        clock: Clock,
        *,
        inputs: Mapping[str, Subscription[Any]],
        drive: Publisher[DriveRequest],
        tracker: Publisher[TrackerState],
        events: EventSink,
        actor: Actor | None = None,
        points: ScanPoints | None = None,
    ) -> None:
        self._setup, self._clock = setup, clock
        self._inputs = [inputs.get(name) for name in Newest._fields]
        self._drive, self._tracker, self._events = drive, tracker, events
        self._actor = actor
        self._step = TrackingStep(setup, points) if actor is None else None
        self._sent: Newest | None = None
        """Messages sent to the actor; None before its first step."""

    async def run(self, ready: Ready) -> None:
        """Track until cancelled.

        Raises:
            WorkerError: the actor failed or was late; the next session starts with a new one.
        """
        if self._actor is None:
            await self._serve(ready, self._step_here)
            return
        async with self._actor as actor:
            await actor.start()
            self._sent = None
            await self._serve(ready, functools.partial(self._step_by, actor))

    async def _serve(self, ready: Ready, step: Callable[[int, Newest], Awaitable[None]]) -> None:
        ready()
        schedule = Schedule(self._clock, self._setup.config.rate)
        while True:
            await schedule.next()
            newest = Newest(*[None if box is None else box.latest for box in self._inputs])
            await step(self._clock.now(), newest)

    async def _step_here(self, now: int, newest: Newest) -> None:
        assert self._step is not None
        for output in self._step.parts(now, newest):
            if output is None:
                await asyncio.sleep(0)
            else:
                self._publish(now, newest.gate, output)

    async def _step_by(self, actor: Actor, now: int, newest: Newest) -> None:
        sent = self._sent or Newest()
        news = {name: new for name, new, old in zip(Newest._fields, newest, sent, strict=True) if new is not old}
        output: TrackOutput = await actor.step(TrackInput(now, news, self._setup if self._sent is None else None))
        self._sent = newest
        self._publish(now, newest.gate, output)

    def _publish(self, now: int, gate: GateState | None, output: TrackOutput) -> None:
        command = output.command
        if command is not None and gate is not None and output.drive:
            seq, lease = self._drive.next_seq(), self._setup.config.lease
            motion = {"speed": command.speed, "front": command.front, "rear": command.rear}
            self._drive.put(planner_request(seq, gate, now, self.name, lease, **motion))
        for event in output.events:
            self._events(event.reason, event.severity, self.name, event.text, **event.values)
        if command is not None:
            self._tracker.put(
                TrackerState(
                    stamp=now,
                    received=now,
                    seq=self._tracker.next_seq(),
                    frame=output.frame,
                    path=output.path,
                    cross_track=command.cross_track,
                    heading_error=command.heading_error,
                    along=output.along,
                    length=output.length,
                    outcome=command.outcome,
                    axles=output.axles,
                    steering=() if output.steering is None else output.steering.axles,
                    steering_differs="" if output.steering is None else output.steering.text,
                )
            )
