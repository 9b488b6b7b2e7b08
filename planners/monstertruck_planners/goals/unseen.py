"""Ground that no sensor has seen, and which motions backwards of a route would cover it. For workers.

The gate stops the robot in reverse before ground that it does not remember as seen. What a route reveals on its way
counts as seen: the beams of the lidar at every pose before, up to the obstacles of the map, and the ground under the
body. Ground that the gate has seen ceases to count: a route must come to it before.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, placed, points_placed, points_relative
from monstertruck_planners.collision import DistanceField, Footprint, rectangle_distance
from monstertruck_planners.goals.exchange import SeenGround
from monstertruck_planners.pose_path import PosePath

SOON: Final = 5.0
"""Time before a route begins, s."""
PACE: Final = 0.1
"""Mean speed along a route by which it is estimated when it comes to some ground, m/s."""
SHOWN: Final = 0.6
"""Share of the ground that has to be visible from such a place."""
BESIDE: Final = 0.03
"""Ground this near to a body counts as under it, m; as by the gate."""


@dataclass(frozen=True)
class Unseen:
    """Ground around a robot that no sensor has seen, or that soon ceases to count as seen.

    Args:
        places: centres of its cells in the map's frame, shape (n, 2), m.
        left: time for which each counts as seen, shape (n,), s; 0 = not seen.
        lidar: pose of the lidar in base, m, m, rad.
        field: least and greatest bearing that it measures, rad.
        reach: its range, m.
        footprint: of the robot.
    """

    places: Array
    left: Array
    lidar: Pose2
    field: tuple[float, float]
    reach: float
    footprint: Footprint

    def near(self, pose: Pose2) -> Array:
        """Places that count as unseen now, in base at ``pose``, shape (n, 2), m."""
        return points_relative(self.places[self.left < SOON], pose)

    def met(self, path: PosePath, obstacles: DistanceField) -> Array:
        """Unseen places at and near the first pose at which a path backs onto one; shape (k, 2), m; empty if none.

        Args:
            path: of the base.
            obstacles: of the map, which block the lidar's view.
        """
        places, left = self.places, self.left
        if not (path.directions < 0).any():
            return np.empty((0, 2))
        stood = rectangle_distance(self.footprint, path.poses[:1], places)[0] < BESIDE
        places, left, looked = places[~stood], left[~stood], -math.inf
        last = int(np.flatnonzero(path.directions < 0)[-1])
        steps = np.diff(path.poses, axis=0, prepend=path.poses[:1])
        travelled = np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))
        changed = travelled + np.cumsum(np.abs(steps[:, 2]))
        on_path = zip(path.poses[: last + 1], path.directions, travelled, changed, strict=False)
        for pose, direction, along, change in on_path:
            gaps = rectangle_distance(self.footprint, pose[None], places)[0]
            unseen = left < SOON + along / PACE
            if direction < 0 and (unseen & (gaps < -self.footprint.padding)).any():
                # 0.6: unseen ground within this distance of what a route would cover in reverse is closed to the next
                # one, m: a truck's length, as a route beside it is no better
                return np.asarray(places[unseen & (gaps < 0.6)])
            known = gaps < (BESIDE if direction > 0 else 0.0)
            # 0.1: distance (m) and turn (rad) together between two poses from which a route looks round
            if change - looked >= 0.1:
                looked = change
                known |= self._visible(places, pose, obstacles)
            places, left = places[~known], left[~known]
        return np.empty((0, 2))

    def lookouts(self, places: Array, obstacles: DistanceField, margin: float) -> Array:
        """Poses of base from which most of some places can be seen, shape (k, 3), m, m, rad.

        Args:
            places: shape (n, 2), m.
            obstacles: of the map.
            margin: kept to them, m.
        """
        directions = 12  # directions in which they lie, and into which the robot faces there
        around = np.arange(directions) * (math.tau / directions)
        x, y = places.mean(axis=0).tolist()
        # (0.7, 1.1, 1.5): distances from unseen ground at which places to look at it are tried, m
        poses = np.array(
            [(x + r * math.cos(a), y + r * math.sin(a), yaw) for r in (0.7, 1.1, 1.5) for a in around for yaw in around]
        )
        poses = poses[obstacles.free(self.footprint, poses, margin)]
        shown = [self._visible(places, pose, obstacles).mean() >= SHOWN for pose in poses]
        return np.asarray(poses[np.array(shown, np.bool_)])

    def _visible(self, places: Array, pose: Array, obstacles: DistanceField) -> NDArray[np.bool_]:
        """Which places the lidar sees from a pose of base."""
        (lidar,) = placed(np.array([self.lidar]), (pose[0], pose[1], pose[2]))
        x, y = points_relative(places, (lidar[0], lidar[1], lidar[2])).T
        bearing, far = np.arctan2(y, x), np.hypot(x, y)
        visible = (bearing >= self.field[0]) & (bearing <= self.field[1]) & (far < self.reach)
        steps = max(math.ceil(float(far[visible].max(initial=0.0)) / obstacles.resolution), 1)
        shares = (np.arange(steps) + 1.0) / steps
        on_line = lidar[:2] + shares[None, :, None] * (places[visible] - lidar[:2])[:, None, :]
        visible[visible] = (obstacles.lookup(on_line) > obstacles.resolution * math.sqrt(0.5)).all(axis=1)
        return np.asarray(visible)


def unseen_around(seen: SeenGround, keep: float, lidar: Pose2, footprint: Footprint) -> Unseen:
    """Ground of a survey that counts as unseen now or soon.

    Args:
        seen: the survey, and where it was made.
        keep: age up to which ground counts as seen, s.
        lidar: pose of the lidar in base, m, m, rad.
        footprint: of the robot.
    """
    grid = seen.grid
    ages = grid.cells.reshape(grid.height, grid.width)
    rows, columns = np.nonzero(ages != 0)
    centres = np.column_stack((columns + 0.5, rows + 0.5)) * grid.resolution
    there = points_placed(points_placed(centres, (grid.origin.x, grid.origin.y, grid.origin.yaw)), seen.pose)
    age = ages[rows, columns].astype(float)
    left = np.where(age < 0, 0.0, keep * (1.0 - age / 100))
    return Unseen(there, left, lidar, seen.field, seen.reach, footprint)
