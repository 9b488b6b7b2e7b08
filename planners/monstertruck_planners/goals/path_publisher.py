"""Paths for the tracker: published, checked against scans, ended early; and standstill without disarming."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, placed, poses_relative
from monstertruck_planners.collision import Footprint, first_contact
from monstertruck_planners.goals.exchange import PlanAnswer, pose_of
from monstertruck_planners.track.segments import stops
from monstertruck_runtime.clock import Clock
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

SOURCE: Final = ServiceName.GOALS.value
AT_REST: Final = 0.01
"""Speed of a truck at rest, m/s."""


@dataclass(frozen=True, slots=True)
class GoalInputs:
    """What the goal service reads."""

    goals: Mailbox[GoalRequest]
    controls: Mailbox[GoalControl]
    gate: Subscription[GateState]
    pose: Subscription[Odometry]
    """In the paths' frame."""
    tracker: Subscription[TrackerState]
    path: Subscription[Path]
    scan: Subscription[LaserScan] | None
    grid: Subscription[Grid] | None
    """None = the configured map."""
    ground: Subscription[Ground] | None = None
    behaviour: Subscription[BehaviourState] | None = None
    slam: Subscription[SlamHealth] | None = None
    seen: Subscription[Grid] | None = None


@dataclass(frozen=True, slots=True)
class GoalOutputs:
    """What it writes."""

    path: Publisher[Path]
    planner_request: Publisher[DriveRequest]
    state: Publisher[GoalState]
    events: EventSink


@dataclass(frozen=True)
class FollowedPath:
    """The path the tracker was given."""

    message: Path
    poses: Array
    """Shape (n, 3): of the base."""
    travelled: Array
    """Shape (n,), metres from its start."""
    before: float = 0.0
    """Metres driven on the paths that it was deformed from."""

    def report(self, newest: TrackerState | None) -> TrackerState | None:
        """What the tracker says of it; None while that speaks of another path."""
        return newest if newest is not None and newest.path == self.message.name else None

    def along(self, newest: TrackerState | None) -> float:
        """Metres driven on it."""
        report = self.report(newest)
        return 0.0 if report is None else report.along


class PathPublisher:
    """Publishes paths and remembers the one that is followed.

    Args:
        clock: time.
        inputs: topics read.
        outputs: topics written.
        deceleration: with which the tracker brakes, m/s^2.
    """

    def __init__(self, clock: Clock, inputs: GoalInputs, outputs: GoalOutputs, deceleration: float) -> None:
        self._clock, self._in, self._out, self._deceleration = clock, inputs, outputs, deceleration
        self._paths = 0
        self.followed: FollowedPath | None = None

    @property
    def driving(self) -> bool:
        """Whether the tracker is on its way along what is followed."""
        report = None if self.followed is None else self.followed.report(self._in.tracker.latest)
        return report is not None and report.outcome is Reason.DRIVING

    @property
    def displaced(self) -> bool:
        """Whether another source's path is followed."""
        return self.followed is not None and self._in.path.latest is not self.followed.message

    def follow(self, answer: PlanAnswer, name: str, before: float = 0.0) -> None:
        """Have a path driven.

        Args:
            answer: the path.
            name: of it; a number is added.
            before: metres driven already on the route that it is part of.
        """
        assert answer.poses is not None
        assert answer.directions is not None
        steering = answer.steering if len(answer.steering) == len(answer.poses) else ()
        self._publish(answer.poses, answer.directions, steering, name, before, answer.clearance)

    def brake(self, name: str, *, halts: bool = False) -> None:
        """Let what is followed end as soon as the tracker can brake; of a truck at rest, where it stands.

        Args:
            name: of the path that is left.
            halts: see ``Path``.
        """
        odometry, followed = self._in.pose.latest, self.followed
        if odometry is None or followed is None:
            return
        speed, report = abs(odometry.twist.vx), followed.report(self._in.tracker.latest)
        driven = followed.before + followed.along(report)
        standstill_path = 0.01  # length of a path that leads nowhere, m
        if speed > AT_REST and report is not None:
            rest = speed * speed / (2 * self._deceleration) + standstill_path
            path = followed.message
            at_rest = stops(path.directions[1:], path.steering[1:])
            kept = kept_poses(followed.travelled, report.along, rest, np.flatnonzero(at_rest) + 1)
            poses, directions = followed.poses[kept], path.directions[kept]
            steering, clearance = path.steering[kept], path.clearance[kept]
            self._publish(poses, directions, steering, name, driven, clearance, halts=halts)
        else:
            ahead = np.array([[0.0, 0.0, 0.0], [standstill_path, 0.0, 0.0]])
            self._publish(placed(ahead, pose_of(odometry)), np.ones(2), (), name, driven, halts=halts)

    def halt(self, name: str) -> None:
        """Brake, and follow nothing."""
        self.brake(name, halts=True)
        self.followed = None

    def end_other(self, name: str) -> None:
        """Let a path that another source published, as the configured one, end as soon as the tracker can brake."""
        path = self._in.path.latest
        if path is not None and not path.halts and (self.followed is None or path is not self.followed.message):
            self.followed = _followed(path)
            self.halt(name)

    def stand_still(self) -> None:
        """Ask the gate for standstill, so that the truck stays armed while nothing is driven."""
        gate, now = self._in.gate.latest, self._clock.now()
        if self.driving or gate is None or not gate.mode.active:
            return
        requests = self._out.planner_request
        # 0.25: lease of the request to stand still, s
        requests.put(planner_request(requests.next_seq(), gate, now, SOURCE, 0.25, speed=0.0, front=0.0, rear=0.0))

    def _publish(
        self,
        poses: Array,
        directions: Array,
        steering: tuple[Any, ...],
        name: str,
        before: float,
        clearance: Array | None = None,
        *,
        halts: bool = False,
    ) -> None:
        now, odometry = self._clock.now(), self._in.pose.latest
        assert odometry is not None
        self._paths += 1
        message = Path(
            stamp=now,
            received=now,
            seq=self._out.path.next_seq(),
            frame=odometry.frame,
            poses=np.ascontiguousarray(poses).ravel(),
            directions=np.array(directions),
            steering=steering,
            clearance=np.zeros(0) if clearance is None else np.array(clearance),
            halts=halts,
            name=f"{name}.{self._paths}",
        )
        self.followed = _followed(message, before)
        self._out.path.put(message)


def _followed(path: Path, before: float = 0.0) -> FollowedPath:
    poses = path.poses.reshape(-1, 3)
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    return FollowedPath(path, poses, np.concatenate(([0.0], np.cumsum(steps))), before)


def poses_ahead(poses: Array, travelled: Array, along: float, reach: float, pose: Pose2) -> Array:
    """The truck's pose, then the path's poses from ``along`` to ``along + reach``, one every few centimetres.

    Args:
        poses: shape (n, 3), of the base.
        travelled: shape (n,), metres from the path's start.
        along: where the truck is, m.
        reach: m.
        pose: the truck's own.
    """
    first, last = np.searchsorted(travelled, (along, along + reach), side="right")
    chosen = poses[first : last + 1]
    check_step = 0.05  # metres between two poses of a path check
    if len(chosen) > 2:
        length = max(travelled[min(last, len(poses) - 1)] - along, check_step)
        spacing = max(round(check_step * (len(chosen) - 1) / length), 1)
        chosen = np.vstack((chosen[:-1:spacing], chosen[-1]))
    return np.vstack((np.array(pose), chosen))


def path_blocked(footprint: Footprint, poses: Array, points: Array, at: Pose2) -> bool:
    """Whether the footprint driven along ``poses`` (m, 3) comes upon a point of a scan.

    Args:
        footprint: the truck.
        poses: in the map's frame, the truck's own first.
        points: shape (n, 2), returns in the base frame.
        at: pose of the base in the map's frame.
    """
    return first_contact(footprint, poses_relative(poses, at), points) is not None


def kept_poses(travelled: Array, along: float, rest: float, cusps: NDArray[np.intp]) -> slice:
    """Poses of a path that are kept if it is to end ``rest`` metres behind ``along``; two at least.

    None before that: a path may come back over its beginning, and that is not to be driven again. Nor any behind the
    next cusp: the truck comes to rest there anyway.

    Args:
        travelled: shape (n,), metres from the path's start.
        along: where the truck is, m.
        rest: m.
        cusps: shape (k,), indices of the poses at which it comes to rest.
    """
    first = min(max(int(np.searchsorted(travelled, along, side="right")) - 1, 0), len(travelled) - 2)
    end = max(int(np.searchsorted(travelled, along + rest)), first + 1)
    return slice(first, min([end, *cusps[cusps > first].tolist()]) + 1)
