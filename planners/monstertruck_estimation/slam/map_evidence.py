"""Evidence of a saved grid for or against a pose: beams that end on walls, cross them, or end in free space.

The overlap of surfaces only shows what fits. A similar-looking room fits as well, but the robot's beams then pass
through walls of the map, and end in its free space (negative information: Thrun, Burgard, Fox, Probabilistic Robotics,
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
    """Additive counts of beams."""

    agreeing: int = 0
    """Beams that end at a wall."""
    against: int = 0
    """Beams that cross a wall, or end in free space."""
    unknown: int = 0
    """Beams that end in unknown cells."""

    def __add__(self, other: Self) -> "Evidence":
        return Evidence(self.agreeing + other.agreeing, self.against + other.against, self.unknown + other.unknown)

    @property
    def contradiction(self) -> float:
        """Share of contradicting beams among those that the map can check, 0..1; 0 if there are none."""
        judged = self.agreeing + self.against
        return self.against / judged if judged else 0.0


class EvidenceGrid:
    """Saved grid with the distance of every cell to the nearest wall.

    Args:
        grid: saved grid.
    """

    def __init__(self, grid: WorldMap) -> None:
        self._grid = grid
        walls = grid.cells == OCCUPIED
        far = distance_transform_edt(~walls) if walls.any() else np.full(walls.shape, np.inf)
        self._far = np.asarray(far, np.float32) * np.float32(grid.resolution)

    def judge(self, pose: Array, points: Array, mount: Array) -> Evidence:
        """Return the evidence of one scan.

        Args:
            pose: base in map, shape (3,) (m, rad).
            points: ends of the beams in base, shape (n, 2) (m).
            mount: position of the sensor in base, shape (2,) (m).
        """
        kinds = self._kinds(pose, points, mount)
        return Evidence(*np.bincount(kinds, minlength=3).tolist())

    def judged(self, pose: Array, points: Array, mount: Array) -> NDArray[np.bool_]:
        """Tell which beams the map can check, shape (n,): all but those that end in unknown cells.

        The arguments are those of ``judge``.
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
        tolerance = 0.15  # maximum distance between a beam's end and a wall that agree, m
        allowed = tolerance + 0.03 * reach * resolution  # increase per metre of range, for the error of the yaw
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
