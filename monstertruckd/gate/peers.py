"""Other robots by what they say of themselves: the swept footprint against their outlines.

A lidar does not look behind the robot, and what it saw there is old: another robot may have come since. Of robots that
are heard (section ``peers``) the outline counts where the lidar does not look, all around for robots without one: where
its own motion has taken it since it was heard, and takes it within ``HORIZON``. The clearance grows by how unsure both
poses are. A pose older than ``FRESH`` tells where a robot was, not where it is: the outline stays there for ``KEPT``,
and the robot may be anywhere (``unknown``), as one may whose place is not known to ``UNSURE``.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array, integrate
from monstertruck_planners.collision import Footprint, first_contact, on_body, placed, points_relative, swept_poses
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.state import Odometry, Peer, Peers
from monstertruckd.gate.config import GateConfig

HORIZON: Final = (0.0, 0.5, 1.0)
"""Seconds for which another robot goes on as it was heard to."""
FRESH: Final = 0.5
"""Age up to which a pose tells where a robot is, s: further on, at 0.2 m/s, it may be 0.1 m from where it is looked
for."""
KEPT: Final = 30.0
"""Seconds for which the place of a silent one counts, as remembered points do."""
DEVIATIONS: Final = 2.0
"""Standard deviations of where two robots are to each other that are added to the clearance."""
UNSURE: Final = 0.3
"""Standard deviation from which poses tell no place, m; the clearance grows no further."""
SPACING: Final = 0.03
"""Between the points of an outline, m."""
STEP: Final = 0.02
"""Between the poses of a sweep, m."""

Way = tuple[float, float, float]
Place = tuple[float, float, float]
Seen = Callable[[Array], NDArray[np.bool_]]
"""Which of the points (n, 2) in base, m, a sensor sees."""


class PeerGuard:
    """Sweeps the footprint along a motion against other robots.

    Args:
        config: the gate's limits.
        footprint: the body's outline.
        outlines: of the others by name.
    """

    def __init__(self, config: GateConfig, footprint: Footprint, outlines: Mapping[str, Footprint]) -> None:
        self._config = config
        self._footprint = footprint
        self._edges = {name: _edges(body) for name, body in outlines.items()}
        self._own: Odometry | None = None
        self._heard: dict[str, Peer] = {}

    def configure(self, config: GateConfig) -> None:
        """Take other limits, between two ticks."""
        self._config = config

    def observe_pose(self, pose: Odometry) -> None:
        """Take the robot's own newest pose in the map."""
        self._own = pose

    def observe(self, peers: Peers) -> None:
        """Take what was heard of the others."""
        self._heard = {peer.robot: peer for peer in peers.peers if peer.robot in self._edges}

    def unknown(self, now: int) -> bool:
        """Whether another robot may be anywhere: silent, never heard, or one of both does not know its place."""
        if (own := self._fresh(now)) is None:
            return True
        return any(
            (peer := self._heard.get(name)) is None or _age(peer.heard, now) > FRESH or _deviation(own, peer) > UNSURE
            for name in self._edges
        )

    def free_distance(self, ways: Iterable[Way], reach: float, now: int, seen: Seen | None) -> float:
        """Distance the footprint can travel, m; +inf if nobody is known to be within reach.

        Args:
            ways: twists per metre of pace, m/m, m/m, rad/m; the shortest distance of all counts.
            reach: distance swept, m.
            now: ns.
            seen: what the lidar sees, where nobody counts; None = nothing.
        """
        free = math.inf
        if (own := self._fresh(now)) is None:
            return free
        ways, place = tuple(ways), _moved(own.pose, own.twist, _age(own.stamp, now))
        for peer in self._heard.values():
            unsure = DEVIATIONS * min(_deviation(own, peer), UNSURE)
            clearance = self._config.obstacle.side_clearance + unsure
            points = self._outline(peer, place, now, reach, clearance)
            if seen is not None:
                points = points[~seen(points)]
            if len(points):
                free = min([free, *(self._swept(way, reach, points, clearance) for way in ways)])
        return free

    def _fresh(self, now: int) -> Odometry | None:
        """The robot's own pose, if it tells where the robot is."""
        return None if self._own is None or _age(self._own.stamp, now) > FRESH else self._own

    def _swept(self, way: Way, reach: float, points: Array, clearance: float) -> float:
        corner = math.hypot(way[0], way[1]) + abs(way[2]) * self._footprint.circumscribed_radius
        distances = np.linspace(0.0, reach, max(2, math.ceil(reach * max(corner, 1.0) / STEP) + 1))
        contact = first_contact(self._footprint, swept_poses(way, distances), points, clearance)
        return math.inf if contact is None else float(distances[contact - 1])

    def _outline(self, peer: Peer, own: Place, now: int, reach: float, clearance: float) -> Array:
        """Points of another robot's outline where it is and goes, in base, shape (n, 2), m; none if it is far away."""
        edges, age = self._edges[peer.robot], _age(peer.heard, now)
        pose, twist = peer.pose, peer.twist
        times = (0.0,) if age > FRESH else tuple(age + later for later in HORIZON)
        radius, way = float(np.hypot(edges[:, 0], edges[:, 1]).max()), math.hypot(twist.vx, twist.vy) * times[-1]
        near = reach + self._footprint.circumscribed_radius + clearance
        found = [np.empty((0, 2))]
        if age > KEPT or math.dist((pose.x, pose.y), own[:2]) > near + radius + way:
            return found[0]
        for number, time in enumerate(times):
            at = _moved(pose, twist, time)
            outline = placed(np.column_stack((edges, np.zeros(len(edges)))), at)[:, :2]
            outline = points_relative(outline, own)
            if number and on_body(self._footprint, outline, clearance).any():
                break  # it comes to this robot, which may have left by then
            found.append(outline)
        return np.concatenate(found)


def _age(stamp: int, now: int) -> float:
    """S; 0 for what is stamped ahead."""
    return max(now - stamp, 0) / SECOND


def _deviation(own: Odometry, peer: Peer) -> float:
    """Standard deviation of where another robot is to this one, m: both are unsure of the map alone."""
    return math.hypot(own.position_deviation, peer.deviation)


def _moved(pose: Pose2D, twist: Twist2D, seconds: float) -> Place:
    """Where a steady motion leads from a pose, m, m, rad."""
    return integrate((pose.x, pose.y, pose.yaw), twist.vx, twist.vy, twist.wz, seconds)


def _edges(body: Footprint) -> Array:
    """Points along the outline of a body in its base, shape (n, 2), m."""
    half_length, half_width = body.half_length, body.half_width
    along = np.linspace(-half_length, half_length, math.ceil(2 * half_length / SPACING) + 1)
    across = np.linspace(-half_width, half_width, math.ceil(2 * half_width / SPACING) + 1)
    ends, sides = np.full(len(across), half_length), np.full(len(along), half_width)
    x = np.concatenate((along, along, ends, -ends)) + body.offset
    return np.column_stack((x, np.concatenate((sides, -sides, across, across))))
