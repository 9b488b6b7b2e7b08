"""Local obstacle grid: a window that moves with the truck and is filled by the lidar. Loads numba."""

import math
from typing import Annotated

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import binary_dilation

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DistanceField
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Schema


class WindowConfig(Schema):
    """The obstacle window."""

    size: Annotated[float, Field(gt=0)] = 4.0
    """Side, m."""
    resolution: Annotated[float, Field(gt=0)] = 0.04
    """Metres per cell."""
    mark: Annotated[float, Field(gt=0)] = 3.0
    """Returns up to this distance mark obstacles, m."""
    clear: Annotated[float, Field(gt=0)] = 4.0
    """Beams clear cells up to this distance, m."""
    thickness: Annotated[float, Field(ge=0)] = 0.12
    """Depth of obstacles where the cells behind them have never been seen, m."""


class Window:
    """Obstacles around the truck, in a grid whose axes are those of the frame.

    Cells never seen are free unless they lie just behind an obstacle; cells out of sight keep their last state.

    Args:
        config: size and resolution.
    """

    def __init__(self, config: WindowConfig | None = None) -> None:
        self.config = config or WindowConfig()
        count = round(self.config.size / self.config.resolution)
        self.cells: NDArray[np.bool_] = np.zeros((count, count), np.bool_)
        self.seen: NDArray[np.bool_] = np.zeros((count, count), np.bool_)
        self._corner: tuple[int, int] | None = None

    def add_scan(
        self, sensor: tuple[float, float], base: tuple[float, float], ends: Array, hit: NDArray[np.bool_]
    ) -> None:
        """Add a scan.

        Args:
            sensor: x, y of the lidar, m.
            base: x, y of the truck, the new middle of the window, m.
            ends: shape (n, 2): where each beam ended, m.
            hit: shape (n,): whether it hit something there.

        Raises:
            InputError: shapes that do not fit.
        """
        if ends.ndim != 2 or ends.shape[1] != 2 or hit.shape != (len(ends),):
            raise InputError(f"scan of {ends.shape} ends, {hit.shape} hits: expected (n, 2) and (n,)")
        self._move(base)
        res = self.config.resolution
        corner = np.array(self.corner)
        start = (np.array(sensor) - corner) / res
        _mark(self.cells, self.seen, start, (ends - corner) / res, hit, self.config.mark / res, self.config.clear / res)

    @property
    def corner(self) -> tuple[float, float]:
        """Of cell (0, 0), m."""
        column, row = self._corner or (0, 0)
        return column * self.config.resolution, row * self.config.resolution

    def field(self, known: DistanceField | None = None) -> DistanceField:
        """Distances in the window.

        Args:
            known: obstacles of the map, added to those seen; outside the map nothing is added.
        """
        x, y = self.corner
        res = self.config.resolution
        occupied = self.cells
        layers = round(self.config.thickness / res)
        if layers and occupied.any():
            occupied = occupied | (binary_dilation(occupied, iterations=layers) & ~self.seen)
        if known is not None:
            rows, columns = occupied.shape
            px, py = np.meshgrid(x + (np.arange(columns) + 0.5) * res, y + (np.arange(rows) + 0.5) * res)
            middles = np.stack((px, py), axis=-1)
            near = known.lookup(middles) < 0.5 * max(res, known.resolution)
            occupied = occupied | (near & known.inside(middles))
        return DistanceField(occupied, res, (x, y, 0.0))

    def _move(self, base: tuple[float, float]) -> None:
        count = len(self.cells)
        corner = tuple(math.floor(v / self.config.resolution) - count // 2 for v in base)
        if self._corner is not None and corner != self._corner:
            columns, rows = corner[0] - self._corner[0], corner[1] - self._corner[1]
            self.cells, self.seen = _moved(self.cells, rows, columns), _moved(self.seen, rows, columns)
        self._corner = (corner[0], corner[1])


def _moved(cells: NDArray[np.bool_], rows: int, columns: int) -> NDArray[np.bool_]:
    """Cells of a window moved up by rows and right by columns."""
    count = len(cells)
    fresh = np.zeros_like(cells)
    if abs(columns) < count and abs(rows) < count:
        old = cells[max(rows, 0) : count + min(rows, 0), max(columns, 0) : count + min(columns, 0)]
        r, c = max(-rows, 0), max(-columns, 0)
        fresh[r : r + old.shape[0], c : c + old.shape[1]] = old
    return fresh


@njit(cache=True)
def _mark(
    cells: NDArray[np.bool_],
    seen: NDArray[np.bool_],
    start: Array,
    ends: Array,
    hit: NDArray[np.bool_],
    mark: float,
    clear: float,
) -> None:
    """Clear the cells along all beams, then mark those they hit; lengths in cells."""
    rows, columns = cells.shape
    for i in range(len(ends)):
        dx, dy = ends[i, 0] - start[0], ends[i, 1] - start[1]
        length = math.sqrt(dx * dx + dy * dy)
        if length < 1e-9:
            continue
        far = min(length - (1.0 if hit[i] else 0.0), clear)
        steps = int(2.0 * far)
        for k in range(steps):
            share = 0.5 * k / length
            c, r = math.floor(start[0] + dx * share), math.floor(start[1] + dy * share)
            if not (0 <= r < rows and 0 <= c < columns):
                break
            cells[r, c] = False
            seen[r, c] = True
    for i in range(len(ends)):
        c, r = math.floor(ends[i, 0]), math.floor(ends[i, 1])
        near = (ends[i, 0] - start[0]) ** 2 + (ends[i, 1] - start[1]) ** 2 <= mark * mark
        if hit[i] and near and 0 <= r < rows and 0 <= c < columns:
            cells[r, c] = True
            seen[r, c] = True
