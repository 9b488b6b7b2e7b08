"""Check against other robots: the swept footprint against outlines at their published poses.

A lidar does not look behind the robot, and its earlier view of that ground is old: another robot may have arrived
since. The outlines of the robots in section ``peers`` are obstacles outside the lidar's field of view, or all around a
robot without a lidar. Each outline is predicted from the latest pose and twist up to now and over the next second. The
clearance grows with the standard deviations of both poses. An outline whose latest pose is older than ``FRESH`` stays
in place for 30 s. Such a robot may be anywhere (``unknown``), as may a robot whose pose is less certain than
``UNSURE``.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import integrate, placed, points_relative
from monstertruck_planners.collision import Footprint, UnitTwist, free_distance, on_body
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message, Pose2D, Twist2D
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Odometry, Peer, Peers
from monstertruck_schemas.topics import PEERS, POSE, Topic
from monstertruckd.gate.approach import Approach, comfortable_speed, reach, stopping
from monstertruckd.gate.checks import Check, GateView, PaceLimit, Tick
from monstertruckd.gate.config import InForce
from monstertruckd.gate.motion import AHEAD, Course
from monstertruckd.gate.obstacles import ObstacleGuard
from monstertruckd.gate.sonars import SonarGuard

FRESH: Final = 0.5
"""Maximum age of a pose, s: at 0.2 m/s a robot travels 0.1 m meanwhile."""
UNSURE: Final = 0.3
"""Standard deviation above which a relative position is unknown, m; the clearance grows no further."""

Place = tuple[float, float, float]
Seen = Callable[[Array], NDArray[np.bool_]]
"""Function that returns whether a sensor sees each point (n, 2) in base (m)."""


class PeerGuard:
    """Sweeps the footprint along a motion against other robots.

    Args:
        limits: limits in force.
        footprint: the body's outline.
        outlines: outlines of the other robots by name.
    """

    def __init__(self, limits: InForce, footprint: Footprint, outlines: Mapping[str, Footprint]) -> None:
        self._limits = limits
        self._footprint = footprint
        self._edges = {name: _edges(body) for name, body in outlines.items()}
        self._own: Odometry | None = None
        self._heard: dict[str, Peer] = {}

    def observe_pose(self, pose: Odometry) -> None:
        """Process the latest pose of this robot in the map."""
        self._own = pose

    def observe(self, peers: Peers) -> None:
        """Process the latest poses of the other robots."""
        self._heard = {peer.robot: peer for peer in peers.peers if peer.robot in self._edges}

    def unknown(self, now: int) -> bool:
        """Whether another robot may be anywhere: its pose or this robot's pose is missing, stale or too uncertain."""
        if (own := self._fresh(now)) is None:
            return True
        return any(
            (peer := self._heard.get(name)) is None or _age(peer.heard, now) > FRESH or _deviation(own, peer) > UNSURE
            for name in self._edges
        )

    def free_distance(self, twists: Iterable[UnitTwist], reach: float, now: int, seen: Seen | None) -> float:
        """Distance the footprint can travel (m); +inf if no other robot is known to be within reach.

        Args:
            twists: motions of the base; the shortest of their distances is returned.
            reach: distance swept (m).
            now: current time (ns).
            seen: lidar's field of view, where the scan covers the outlines; None without a lidar.
        """
        free = math.inf
        if (own := self._fresh(now)) is None:
            return free
        twists, place = tuple(twists), _moved(own.pose, own.twist, _age(own.stamp, now))
        deviations = 2.0  # number of standard deviations of the relative position added to the clearance
        for peer in self._heard.values():
            unsure = deviations * min(_deviation(own, peer), UNSURE)
            clearance = self._limits.config.obstacle.side_clearance + unsure
            points = self._outline(peer, place, now, reach, clearance)
            if seen is not None:
                points = points[~seen(points)]
            if len(points):
                step = 0.02  # distance between the poses of a sweep, m
                swept = (free_distance(self._footprint, twist, points, reach, step, clearance) for twist in twists)
                free = min([free, *swept])
        return free

    def _fresh(self, now: int) -> Odometry | None:
        """Pose of this robot; None if it is too old."""
        return None if self._own is None or _age(self._own.stamp, now) > FRESH else self._own

    def _outline(self, peer: Peer, own: Place, now: int, reach: float, clearance: float) -> Array:
        """Current and predicted outlines of another robot in the base frame (m), shape (n, 2); empty if far away."""
        edges, age = self._edges[peer.robot], _age(peer.heard, now)
        pose, twist = peer.pose, peer.twist
        horizon = (0.0, 0.5, 1.0)  # prediction times for the motion of another robot, s
        times = (0.0,) if age > FRESH else tuple(age + later for later in horizon)
        radius, ahead = float(np.hypot(edges[:, 0], edges[:, 1]).max()), math.hypot(twist.vx, twist.vy) * times[-1]
        near = reach + self._footprint.circumscribed_radius + clearance
        found = [np.empty((0, 2))]
        # Time that the last outline of a silent robot stays an obstacle, as points of earlier scans do, s.
        kept = 30.0
        if age > kept or math.dist((pose.x, pose.y), own[:2]) > near + radius + ahead:
            return found[0]
        for number, time in enumerate(times):
            at = _moved(pose, twist, time)
            outline = placed(np.column_stack((edges, np.zeros(len(edges)))), at)[:, :2]
            outline = points_relative(outline, own)
            if number and on_body(self._footprint, outline, clearance).any():
                break  # predicted contact with this robot, which may have left by then
            found.append(outline)
        return np.concatenate(found)


class PeerCheck(Check):
    """Keeps the swept footprint clear of other robots; in a lidar's field of view, the lidar's scan covers them.

    Args:
        view: read access to the gate's state.
        outlines: outlines of the other robots by name.
        lidar: guard of the lidar; None without a lidar.
        sonars: guard of the sonars; None without sonars.
    """

    reasons = (Reason.OBSTACLE_STOP, Reason.OBSTACLE_SLOW, Reason.PEER_UNKNOWN)
    reads = (PEERS, POSE)

    def __init__(
        self,
        view: GateView,
        outlines: Mapping[str, Footprint],
        lidar: ObstacleGuard | None,
        sonars: SonarGuard | None,
    ) -> None:
        super().__init__(view)
        self._guard = PeerGuard(view.limits, view.footprint, outlines)
        self._lidar = lidar
        self._sonars = sonars
        self._approach = Approach(view)

    @property
    def urgent(self) -> bool:
        """See ``Check.urgent``."""
        return self._approach.emergency

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Process this robot's pose in the map, the common frame of all poses, and the poses of the other robots."""
        if isinstance(seen, Odometry) and topic is POSE:
            self._guard.observe_pose(seen)
        elif isinstance(seen, Peers):
            self._guard.observe(seen)

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Sweep along the motions."""
        if courses is None:
            self._approach.forget()
        elif courses:
            yield from self._along(now, courses)

    def _along(self, now: int, courses: Sequence[Course]) -> Iterator[PaceLimit]:
        config = self.view.config
        lidar = self._lidar if self.view.samples.scan_fresh(now) else None
        delay = config.reaction + (0.0 if self._sonars is None else self._sonars.delay(now))
        far = reach(config, delay)
        if lidar is not None:
            delay, far = lidar.delay(now), lidar.reach
        twists, slow = [twist for twist, _ in courses], config.obstacle.unseen_speed
        looked = self._sonars is not None or lidar is not None
        if self._guard.unknown(now) and any(
            pace > slow and not (looked and twist[0] >= AHEAD) for twist, pace in courses
        ):
            yield PaceLimit(Reason.PEER_UNKNOWN, slow)
        seen = None if lidar is None else lidar.looks_at
        free = self._guard.free_distance(twists, far, now, seen)
        allowed = comfortable_speed(free - config.obstacle.ahead, delay, config.obstacle.deceleration)
        yield from self._approach.limits(free, allowed, max(pace for _, pace in courses))
        self._approach.judge(now, twists, lambda speed: free < stopping(speed, delay, config.deceleration))

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Free distance."""
        if reason is Reason.OBSTACLE_STOP:
            yield self._approach.free_distance(None)


def _age(stamp: int, now: int) -> float:
    """Age of a stamp (s); 0 for a stamp in the future."""
    return max(now - stamp, 0) / SECOND


def _deviation(own: Odometry, peer: Peer) -> float:
    """Standard deviation of the relative position (m), assuming independent errors of the two poses."""
    return math.hypot(own.position_deviation, peer.deviation)


def _moved(pose: Pose2D, twist: Twist2D, seconds: float) -> Place:
    """Pose after ``seconds`` (s) of a constant twist (m, m, rad)."""
    return integrate((pose.x, pose.y, pose.yaw), twist.vx, twist.vy, twist.wz, seconds)


def _edges(body: Footprint) -> Array:
    """Points along the outline of a body in its base frame (m), shape (n, 2)."""
    spacing = 0.03  # distance between the points of an outline, m
    along, across = (math.ceil(2 * half / spacing) + 1 for half in (body.half_length, body.half_width))
    return body.edge_points(along, across)
