"""Local obstacle grid: a window that moves with the truck and is filled by the lidar. Loads numba.

It is an occupancy grid of which the newest scan decides: its cells are free (-1), unknown (0) or occupied (1).
"""

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import binary_dilation

from monstertruck_estimation.slam.grid import trace
from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DistanceField
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Schema

_NEWEST_DECIDES = (2, -2, 1)
"""Steps of a hit and of a pass, and the limit: one scan changes any cell to either."""


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
        self._odds: NDArray[np.int16] = np.zeros((count, count), np.int16)
        self._marks: NDArray[np.uint16] = np.zeros((count, count), np.uint16)
        self._mark = 0
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
        corner, count = np.array(self.corner), len(self._odds)
        start, beams = (np.array(sensor) - corner) / res, (ends - np.array(sensor)) / res
        lengths = np.hypot(beams[:, 0], beams[:, 1])
        if not ((start >= 0) & (start < count)).all():
            return
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = np.where(beams > 0, (count - start) / beams, -start / beams)
        inside = np.where(beams == 0, np.inf, inside).min(axis=1)
        near = hit & (lengths <= self.config.mark / res) & (inside > 1.0)
        share = np.minimum(inside, self.config.clear / res / np.maximum(lengths, 1e-9))
        tips = start + beams * np.where(near, 1.0, np.minimum(share, 1.0))[:, None]
        cells = np.clip(np.floor(np.vstack((start, tips[near], tips[~near]))), 0, count - 1).astype(np.int32)
        self._mark = self._mark % np.iinfo(np.uint16).max + 1
        if self._mark == 1:
            self._marks[:] = 0
        odds, marks = self._odds.reshape(-1), self._marks.reshape(-1)
        trace(odds, marks, count, cells, np.zeros(2, np.int64), self._mark, _NEWEST_DECIDES, np.count_nonzero(near))

    @property
    def cells(self) -> NDArray[np.bool_]:
        """Where something was seen, shape (rows, columns), row 0 at the lowest y."""
        return np.asarray(self._odds > 0)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which cells were seen, of the same shape."""
        return np.asarray(self._odds != 0)

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
        count = len(self._odds)
        corner = tuple(math.floor(v / self.config.resolution) - count // 2 for v in base)
        if self._corner is not None and corner != self._corner:
            columns, rows = corner[0] - self._corner[0], corner[1] - self._corner[1]
            self._odds = _moved(self._odds, rows, columns)
        self._corner = (corner[0], corner[1])


def _moved(cells: NDArray[np.int16], rows: int, columns: int) -> NDArray[np.int16]:
    """Cells of a window moved up by rows and right by columns."""
    count = len(cells)
    fresh = np.zeros_like(cells)
    if abs(columns) < count and abs(rows) < count:
        old = cells[max(rows, 0) : count + min(rows, 0), max(columns, 0) : count + min(columns, 0)]
        r, c = max(-rows, 0), max(-columns, 0)
        fresh[r : r + old.shape[0], c : c + old.shape[1]] = old
    return fresh
