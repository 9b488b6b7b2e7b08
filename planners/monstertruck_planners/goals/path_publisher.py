"""Publish paths for the tracker, check them against scans, end them early, and request standstill without disarming."""

import contextlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, placed, poses_relative
from monstertruck_planners.collision import Footprint, first_contact
from monstertruck_planners.goals.exchange import pose_of
from monstertruck_planners.pose_path import PosePath
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink, Publisher, Subscription
from monstertruck_runtime.requests import planner_request
from monstertruck_schemas.health import SlamHealth
from monstertruck_schemas.plan import BehaviourState, GoalState, Path, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, GoalControl, GoalRequest
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import GateState, Grid, Ground, Odometry
from monstertruck_schemas.zones import Zones

SOURCE: Final = ServiceName.GOALS.value
AT_REST: Final = 0.01
"""Maximum speed of a truck at rest (m/s)."""


@dataclass(frozen=True, slots=True)
class GoalInputs:
    """Inputs of the goal service."""

    goals: Mailbox[GoalRequest]
    controls: Mailbox[GoalControl]
    gate: Subscription[GateState]
    pose: Subscription[Odometry]
    """Pose in the frame of the paths."""
    tracker: Subscription[TrackerState]
    path: Subscription[Path]
    scan: Subscription[LaserScan] | None
    grid: Subscription[Grid] | None
    """Map topic; None for the configured map."""
    ground: Subscription[Ground] | None = None
    behaviour: Subscription[BehaviourState] | None = None
    slam: Subscription[SlamHealth] | None = None
    seen: Subscription[Grid] | None = None
    zones: Subscription[Zones] | None = None


@dataclass(frozen=True, slots=True)
class GoalOutputs:
    """Outputs of the goal service."""

    path: Publisher[Path]
    planner_request: Publisher[DriveRequest]
    state: Publisher[GoalState]
    events: EventSink


@dataclass(frozen=True)
class Followed:
    """Path followed by the tracker."""

    message: Path
    path: PosePath
    """Decoded ``message``."""
    before: float = 0.0
    """Distance travelled on the paths from before its deformation (m)."""

    def report(self, newest: TrackerState | None) -> TrackerState | None:
        """Return the tracker report on this path; None while the tracker reports on another path."""
        return newest if newest is not None and newest.path == self.message.name else None

    def along(self, newest: TrackerState | None) -> float:
        """Return the distance travelled on this path (m)."""
        report = self.report(newest)
        return 0.0 if report is None else report.along


class PathPublisher:
    """Publishes paths and keeps the followed one.

    Args:
        clock: time source.
        inputs: input topics.
        outputs: output topics.
        deceleration: braking deceleration of the tracker (m/s^2).
    """

    def __init__(self, clock: Clock, inputs: GoalInputs, outputs: GoalOutputs, deceleration: float) -> None:
        self._clock, self._in, self._out, self._deceleration = clock, inputs, outputs, deceleration
        self._paths = 0
        self.followed: Followed | None = None
        self._halt: Path | None = None
        """Path of the latest halt."""

    @property
    def driving(self) -> bool:
        """Whether the tracker is driving along the followed path."""
        report = None if self.followed is None else self.followed.report(self._in.tracker.latest)
        return report is not None and report.outcome is Reason.DRIVING

    @property
    def displaced(self) -> bool:
        """Whether the tracker follows the path of another source."""
        return self.followed is not None and self._in.path.latest is not self.followed.message

    @property
    def rest(self) -> Pose2 | None:
        """Pose at which the truck comes to rest on the path of ``halt``; None if it does not brake there."""
        odometry = self._in.pose.latest
        if self._halt is None or self._in.path.latest is not self._halt:
            return None
        if odometry is None or abs(odometry.twist.vx) <= AT_REST:
            return None
        x, y, yaw = self._halt.poses[-3:].tolist()
        return x, y, yaw

    def follow(self, path: PosePath, name: str, before: float = 0.0) -> None:
        """Publish a path for the tracker to drive.

        Args:
            path: path of the base.
            name: name of the path; a number is appended.
            before: distance already travelled on its route (m).
        """
        self._publish(path, name, before)

    def brake(self, name: str, *, halts: bool = False) -> None:
        """End the followed path as soon as the tracker can brake, or in place if the truck is at rest.

        Args:
            name: name of the remaining path.
            halts: see ``Path``.
        """
        odometry, followed = self._in.pose.latest, self.followed
        if odometry is None or followed is None:
            return
        speed, report = abs(odometry.twist.vx), followed.report(self._in.tracker.latest)
        driven = followed.before + followed.along(report)
        standstill_path = 0.01  # length of a path for standing still (m)
        if speed > AT_REST and report is not None:
            rest = speed * speed / (2 * self._deceleration) + standstill_path
            path = followed.path
            kept = kept_poses(path.travelled, report.along, rest, path.stops)
            self._publish(path.part(kept.start, kept.stop), name, driven, halts=halts)
        else:
            ahead = np.array([[0.0, 0.0, 0.0], [standstill_path, 0.0, 0.0]])
            self._publish(PosePath(placed(ahead, pose_of(odometry)), np.ones(2)), name, driven, halts=halts)

    def halt(self, name: str) -> None:
        """Brake and stop following a path."""
        self.brake(name, halts=True)
        if self.followed is not None and self.followed.message.halts:
            self._halt = self.followed.message
        self.followed = None

    def end_other(self, name: str) -> None:
        """End a path of another source, such as the configured one, as soon as the tracker can brake."""
        path = self._in.path.latest
        if path is not None and not path.halts and (self.followed is None or path is not self.followed.message):
            with contextlib.suppress(InputError):  # the tracker has refused it, too
                self.followed = Followed(path, PosePath.of(path))
                self.halt(name)

    def stand_still(self) -> None:
        """Request standstill from the gate, so that the truck stays armed while it follows no path."""
        gate, now = self._in.gate.latest, self._clock.now()
        if self.driving or gate is None or not gate.mode.active:
            return
        requests = self._out.planner_request
        # 0.25: lease of the standstill request (s)
        requests.put(planner_request(requests.next_seq(), gate, now, SOURCE, 0.25, speed=0.0, front=0.0, rear=0.0))

    def _publish(self, path: PosePath, name: str, before: float, *, halts: bool = False) -> None:
        now, odometry = self._clock.now(), self._in.pose.latest
        assert odometry is not None
        self._paths += 1
        message = Path(
            stamp=now,
            received=now,
            seq=self._out.path.next_seq(),
            frame=odometry.frame,
            poses=np.ascontiguousarray(path.poses).ravel(),
            directions=np.array(path.directions),
            steering=path.steering,
            clearance=np.zeros(0) if path.clearance is None else np.array(path.clearance),
            speeds=np.zeros(0) if path.speeds is None else np.array(path.speeds),
            halts=halts,
            name=f"{name}.{self._paths}",
        )
        self.followed = Followed(message, path, before)
        self._out.path.put(message)


def poses_ahead(path: PosePath, along: float, reach: float, pose: Pose2) -> Array:
    """Return the pose of the truck and the path poses from ``along`` to ``along + reach``, a few centimetres apart.

    Args:
        path: path of the base.
        along: position of the truck along the path (m).
        reach: length to return (m).
        pose: pose of the truck.
    """
    poses, travelled = path.poses, path.travelled
    first, last = np.searchsorted(travelled, (along, along + reach), side="right")
    chosen = poses[first : last + 1]
    check_step = 0.05  # spacing of the poses of a path check (m)
    if len(chosen) > 2:
        length = max(travelled[min(last, len(poses) - 1)] - along, check_step)
        spacing = max(round(check_step * (len(chosen) - 1) / length), 1)
        chosen = np.vstack((chosen[:-1:spacing], chosen[-1]))
    return np.vstack((np.array(pose), chosen))


def path_blocked(footprint: Footprint, poses: Array, points: Array, at: Pose2) -> bool:
    """Whether the footprint touches a point of a scan when driven along ``poses``, shape (m, 3).

    Args:
        footprint: footprint of the truck.
        poses: poses in the map frame, starting with the pose of the truck.
        points: returns in the base frame, shape (n, 2).
        at: pose of the base in the map frame.
    """
    return first_contact(footprint, poses_relative(poses, at), points) is not None


def kept_poses(travelled: Array, along: float, rest: float, cusps: NDArray[np.intp]) -> slice:
    """Return the poses to keep if a path is to end ``rest`` (m) after ``along``; at least two.

    Earlier poses are dropped: a path may pass its start again, which must not be driven twice. Poses after the next
    cusp are dropped too: the truck comes to rest there anyway.

    Args:
        travelled: distance from the start of the path (m), shape (n,).
        along: position of the truck along the path (m).
        rest: remaining length (m).
        cusps: indices of the poses where the truck comes to rest, shape (k,).
    """
    first = min(max(int(np.searchsorted(travelled, along, side="right")) - 1, 0), len(travelled) - 2)
    end = max(int(np.searchsorted(travelled, along + rest)), first + 1)
    return slice(first, min([end, *cusps[cusps > first].tolist()]) + 1)
