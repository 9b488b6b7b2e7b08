"""Ground that no sensor has seen, and the reverse motions of a route that would cover it. For workers.

When reversing, the gate stops the robot before ground that it does not remember as seen. Ground that a route reveals is
treated as seen: the ground under the body, and the lidar beams at every earlier pose, up to the obstacles of the map.
The gate forgets seen ground after a time; a route must reach it before then.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, placed, points_placed, points_relative
from monstertruck_planners.collision import DistanceField, Footprint, beyond, rectangle_distance
from monstertruck_planners.goals.exchange import SeenGround
from monstertruck_planners.pose_path import PosePath

SOON: Final = 5.0
"""Assumed time until a route begins (s)."""
BESIDE: Final = 0.03
"""Ground within this distance of the body is treated as under it, and a reverse motion ends this far before unseen
ground (m), as in the gate."""


@dataclass(frozen=True)
class Unseen:
    """Ground around a robot that is unseen or that the gate will soon forget.

    Args:
        places: cell centres in the map frame (m), shape (n, 2).
        left: remaining time as seen ground (s), shape (n,); 0 if not seen.
        lidar: pose of the lidar in base (m, m, rad).
        field: minimum and maximum bearing of the lidar (rad).
        reach: range of the lidar (m).
        footprint: footprint of the robot.
    """

    places: Array
    left: Array
    lidar: Pose2
    field: tuple[float, float]
    reach: float
    footprint: Footprint

    def near(self, pose: Pose2) -> Array:
        """Return the places treated as unseen now, in base at ``pose`` (m), shape (n, 2)."""
        return points_relative(self.places[self.left < SOON], pose)

    def met(self, path: PosePath, obstacles: DistanceField) -> Array:
        """Return the unseen places at and near the first pose that backs onto one (m), shape (k, 2); empty if none.

        Args:
            path: path of the base.
            obstacles: map obstacles, which block the view of the lidar.
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
            # Mean speed along a route (m/s), used to estimate its time of arrival at a place.
            unseen = left < SOON + along / 0.1
            along_body, beside_body = beyond(self.footprint, pose[None], places[unseen])
            covered = (along_body < BESIDE) & (beside_body < 0.0)
            if direction < 0 and covered.any():
                # 0.6: unseen ground within this distance (m) of the reverse motion is closed to the next route: one
                # truck length, since a route next to it would not be better
                return np.asarray(places[unseen & (gaps < 0.6)])
            known = gaps < (BESIDE if direction > 0 else 0.0)
            # 0.1: sum of distance (m) and turn (rad) between evaluations of the lidar view
            if change - looked >= 0.1:
                looked = change
                known |= self._visible(places, pose, obstacles)
            places, left = places[~known], left[~known]
        return np.empty((0, 2))

    def lookouts(self, places: Array, obstacles: DistanceField, margin: float) -> Array:
        """Return poses of base with a view of most of the places (m, m, rad), shape (k, 3).

        Args:
            places: places to see (m), shape (n, 2).
            obstacles: map obstacles.
            margin: clearance from the obstacles (m).
        """
        directions = 12  # number of directions for the positions, and for the headings there
        around = np.arange(directions) * (math.tau / directions)
        x, y = places.mean(axis=0).tolist()
        # (0.7, 1.1, 1.5): distances of tried viewpoints from the unseen ground (m)
        poses = np.array(
            [(x + r * math.cos(a), y + r * math.sin(a), yaw) for r in (0.7, 1.1, 1.5) for a in around for yaw in around]
        )
        poses = poses[obstacles.free(self.footprint, poses, margin)]
        # Fraction of the ground that must be visible from a viewpoint.
        shown = [self._visible(places, pose, obstacles).mean() >= 0.6 for pose in poses]
        return np.asarray(poses[np.array(shown, np.bool_)])

    def _visible(self, places: Array, pose: Array, obstacles: DistanceField) -> NDArray[np.bool_]:
        """Return which places the lidar sees from a pose of base."""
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
    """Return the ground of a survey that is unseen now or will soon be.

    Args:
        seen: survey and its pose.
        keep: maximum age of seen ground (s).
        lidar: pose of the lidar in base (m, m, rad).
        footprint: footprint of the robot.
    """
    grid = seen.grid
    ages = grid.cells.reshape(grid.height, grid.width)
    rows, columns = np.nonzero(ages != 0)
    centres = np.column_stack((columns + 0.5, rows + 0.5)) * grid.resolution
    there = points_placed(points_placed(centres, (grid.origin.x, grid.origin.y, grid.origin.yaw)), seen.pose)
    age = ages[rows, columns].astype(float)
    left = np.where(age < 0, 0.0, keep * (1.0 - age / 100))
    return Unseen(there, left, lidar, seen.field, seen.reach, footprint)
