"""Paths for the tracker: published, checked against scans, ended early; and standstill without disarming."""

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
class Followed:
    """Path that the tracker follows."""

    message: Path
    path: PosePath
    """Content of ``message``."""
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
        self.followed: Followed | None = None

    @property
    def driving(self) -> bool:
        """Whether the tracker is on its way along what is followed."""
        report = None if self.followed is None else self.followed.report(self._in.tracker.latest)
        return report is not None and report.outcome is Reason.DRIVING

    @property
    def displaced(self) -> bool:
        """Whether another source's path is followed."""
        return self.followed is not None and self._in.path.latest is not self.followed.message

    def follow(self, path: PosePath, name: str, before: float = 0.0) -> None:
        """Have a path driven.

        Args:
            path: of the base.
            name: of it; a number is added.
            before: metres driven already on the route that it is part of.
        """
        self._publish(path, name, before)

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
            path = followed.path
            kept = kept_poses(path.travelled, report.along, rest, path.stops)
            self._publish(path.part(kept.start, kept.stop), name, driven, halts=halts)
        else:
            ahead = np.array([[0.0, 0.0, 0.0], [standstill_path, 0.0, 0.0]])
            self._publish(PosePath(placed(ahead, pose_of(odometry)), np.ones(2)), name, driven, halts=halts)

    def halt(self, name: str) -> None:
        """Brake, and follow nothing."""
        self.brake(name, halts=True)
        self.followed = None

    def end_other(self, name: str) -> None:
        """Let a path that another source published, as the configured one, end as soon as the tracker can brake."""
        path = self._in.path.latest
        if path is not None and not path.halts and (self.followed is None or path is not self.followed.message):
            with contextlib.suppress(InputError):  # the tracker has refused it, too
                self.followed = Followed(path, PosePath.of(path))
                self.halt(name)

    def stand_still(self) -> None:
        """Ask the gate for standstill, so that the truck stays armed while nothing is driven."""
        gate, now = self._in.gate.latest, self._clock.now()
        if self.driving or gate is None or not gate.mode.active:
            return
        requests = self._out.planner_request
        # 0.25: lease of the request to stand still, s
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
    """The truck's pose, then the path's poses from ``along`` to ``along + reach``, one every few centimetres.

    Args:
        path: of the base.
        along: where the truck is, m.
        reach: m.
        pose: the truck's own.
    """
    poses, travelled = path.poses, path.travelled
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
