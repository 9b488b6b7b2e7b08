"""Other robots by what they say of themselves: the swept footprint against their outlines.

A lidar does not look behind the robot, and what it saw there is old: another robot may have come since. Of robots that
are heard (section ``peers``) the outline counts where the lidar does not look, all around for robots with sonars: where
it was heard, and where its own motion takes it within ``HORIZON``. Silent ones stay where they were for ``KEPT``.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array, integrate
from monstertruck_planners.collision import Footprint, first_contact, on_body, placed, points_relative, swept_poses
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.state import Odometry, Peers
from monstertruckd.gate.config import GateConfig

HORIZON: Final = (0.0, 0.5, 1.0)
"""Seconds for which another robot goes on as it was heard to."""
KEPT: Final = 30.0
"""Seconds for which the place of a silent one counts, as remembered points do."""
SPACING: Final = 0.03
"""Between the points of an outline, m."""
STEP: Final = 0.02
"""Between the poses of a sweep, m."""

Way = tuple[float, float, float]


class PeerGuard:
    """Sweeps the footprint along a motion against other robots.

    Args:
        config: the gate's limits.
        footprint: the body's outline.
        outlines: of the others by name.
        seen: which of the points (n, 2) in base, m, lie where the lidar looks.
    """

    def __init__(
        self,
        config: GateConfig,
        footprint: Footprint,
        outlines: Mapping[str, Footprint],
        seen: Callable[[Array], NDArray[np.bool_]],
    ) -> None:
        self._config = config
        self._footprint = footprint
        self._edges = {name: _edges(body) for name, body in outlines.items()}
        self._seen = seen
        self._pose: tuple[float, float, float] | None = None
        self._peers: Peers | None = None

    def configure(self, config: GateConfig) -> None:
        """Take other limits, between two ticks."""
        self._config = config

    def observe_pose(self, pose: Odometry) -> None:
        """Take the robot's own newest pose in the map."""
        self._pose = (pose.pose.x, pose.pose.y, pose.pose.yaw)

    def observe(self, peers: Peers) -> None:
        """Take what was heard of the others."""
        self._peers = peers

    def free_distance(self, ways: Iterable[Way], reach: float, now: int) -> float:
        """Distance the footprint can travel, m; +inf if nobody is within reach.

        Args:
            ways: twists per metre of pace, m/m, m/m, rad/m; the shortest distance of all counts.
            reach: distance swept, m.
            now: ns.
        """
        points = self._points(now, reach)
        if not len(points):
            return math.inf
        return min((self._swept(way, reach, points) for way in ways), default=math.inf)

    def _swept(self, way: Way, reach: float, points: Array) -> float:
        corner = math.hypot(way[0], way[1]) + abs(way[2]) * self._footprint.circumscribed_radius
        distances = np.linspace(0.0, reach, max(2, math.ceil(reach * max(corner, 1.0) / STEP) + 1))
        clearance = self._config.obstacle.side_clearance
        contact = first_contact(self._footprint, swept_poses(way, distances), points, clearance)
        return math.inf if contact is None else float(distances[contact - 1])

    def _points(self, now: int, reach: float) -> Array:
        """Points of the outlines that are near, in base, shape (n, 2), m."""
        found = [np.empty((0, 2))]
        if self._pose is None or self._peers is None:
            return found[0]
        near = reach + self._footprint.circumscribed_radius
        for peer in self._peers.peers:
            edges, age = self._edges.get(peer.robot), (now - peer.heard) / SECOND
            if edges is None or age > KEPT:
                continue
            pose, twist = peer.pose, peer.twist
            largest = near + float(np.hypot(edges[:, 0], edges[:, 1]).max())
            if math.dist((pose.x, pose.y), self._pose[:2]) > largest + math.hypot(twist.vx, twist.vy) * HORIZON[-1]:
                continue
            for later in HORIZON:
                at = integrate((pose.x, pose.y, pose.yaw), twist.vx, twist.vy, twist.wz, later)
                outline = placed(np.column_stack((edges, np.zeros(len(edges)))), at)[:, :2]
                outline = points_relative(outline, self._pose)
                if later and on_body(self._footprint, outline, self._config.obstacle.side_clearance).any():
                    break  # it comes to this robot, which may have left by then
                found.append(outline)
        points = np.concatenate(found)
        return points[~self._seen(points)] if len(points) else points


def _edges(body: Footprint) -> Array:
    """Points along the outline of a body in its base, shape (n, 2), m."""
    half_length, half_width = body.half_length, body.half_width
    along = np.linspace(-half_length, half_length, math.ceil(2 * half_length / SPACING) + 1)
    across = np.linspace(-half_width, half_width, math.ceil(2 * half_width / SPACING) + 1)
    ends, sides = np.full(len(across), half_length), np.full(len(along), half_width)
    x = np.concatenate((along, along, ends, -ends)) + body.offset
    return np.column_stack((x, np.concatenate((sides, -sides, across, across))))
