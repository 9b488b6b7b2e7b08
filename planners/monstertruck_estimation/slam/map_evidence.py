"""Evidence of a saved grid for and against a pose: beams that end on its walls, cross them, or end in its free space.

The overlap of surfaces says only what fits. A room that looks like another one fits as well, but its beams pass where
the map has walls, and end where the map is free (negative information: Thrun, Burgard, Fox, Probabilistic Robotics,
section 7.1).
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import transform
from monstertruck_runtime.map_files import FREE, OCCUPIED, WorldMap


@dataclass(frozen=True, slots=True)
class Evidence:
    """Counts of beams; they add up."""

    agreeing: int = 0
    """End at a wall."""
    against: int = 0
    """Cross a wall, or end in free space."""
    unknown: int = 0
    """End where the map knows nothing."""

    def __add__(self, other: Self) -> "Evidence":
        return Evidence(self.agreeing + other.agreeing, self.against + other.against, self.unknown + other.unknown)

    @property
    def contradiction(self) -> float:
        """Share of the beams that the map can check which contradict the pose, 0..1; 0 if it can check none."""
        judged = self.agreeing + self.against
        return self.against / judged if judged else 0.0


class EvidenceGrid:
    """A saved grid with the distance of every cell from the nearest wall.

    Args:
        grid: the map.
    """

    def __init__(self, grid: WorldMap) -> None:
        self._grid = grid
        walls = grid.cells == OCCUPIED
        far = distance_transform_edt(~walls) if walls.any() else np.full(walls.shape, np.inf)
        self._far = np.asarray(far, np.float32) * np.float32(grid.resolution)

    def judge(self, pose: Array, points: Array, mount: Array) -> Evidence:
        """Evidence of one scan.

        Args:
            pose: shape (3,), base in map, m and rad.
            points: shape (n, 2), ends of beams in base, m.
            mount: shape (2,), the sensor in base, m.
        """
        kinds = self._kinds(pose, points, mount)
        return Evidence(*np.bincount(kinds, minlength=3).tolist())

    def judged(self, pose: Array, points: Array, mount: Array) -> NDArray[np.bool_]:
        """Which beams the map can check, shape (n,): all but those that end where it knows nothing.

        Arguments are those of ``judge``.
        """
        return np.asarray(self._kinds(pose, points, mount) != UNJUDGED)

    def _kinds(self, pose: Array, points: Array, mount: Array) -> NDArray[np.int64]:
        grid = self._grid
        sensor = transform(pose, mount[None])[0]
        ends = transform(pose, points)
        return np.asarray(_judged(grid.cells, self._far, grid.resolution, np.array(grid.origin), sensor, ends))


AGREEING, AGAINST, UNJUDGED = range(3)


@njit(cache=True)
def _judged(cells, far, resolution, origin, sensor, points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    kinds = np.full(points.shape[0], UNJUDGED, np.int64)
    rows, columns = cells.shape
    x0, y0 = (sensor[0] - origin[0]) / resolution, (sensor[1] - origin[1]) / resolution
    for i in range(points.shape[0]):
        dx, dy = (points[i, 0] - sensor[0]) / resolution, (points[i, 1] - sensor[1]) / resolution
        reach = math.hypot(dx, dy)
        tolerance = 0.15  # distance of a beam's end from a wall within which both agree, m
        allowed = tolerance + 0.03 * reach * resolution  # added to that per metre of range, for the error of the yaw
        crossed = False
        for k in range(int(2 * (reach - allowed / resolution))):
            share = k / (2 * reach)
            column, row = math.floor(x0 + share * dx), math.floor(y0 + share * dy)
            if 0 <= column < columns and 0 <= row < rows and cells[row, column] == OCCUPIED:
                crossed = True
                break
        column, row = math.floor(x0 + dx), math.floor(y0 + dy)
        inside = 0 <= column < columns and 0 <= row < rows
        if inside and not crossed and far[row, column] < allowed:
            kinds[i] = AGREEING
        elif crossed or (inside and cells[row, column] == FREE):
            kinds[i] = AGAINST
    return kinds
