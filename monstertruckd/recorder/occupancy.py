"""Growing raster of lidar scans: the number of hits and passes per cell."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array


@dataclass(frozen=True, slots=True)
class Area:
    """Axis-aligned rectangle (m)."""

    x0: float
    y0: float
    x1: float
    y1: float


class OccupancyRaster:
    """Counts, per cell, the scans that hit it and the scans that passed through it.

    Args:
        cell: cell size (m).
    """

    def __init__(self, cell: float = 0.05) -> None:
        self.cell = cell
        self._corner = np.zeros(2, dtype=np.int64)
        self._hits = np.zeros((0, 0), dtype=np.uint16)
        self._passes = np.zeros((0, 0), dtype=np.uint16)

    @property
    def area(self) -> Area:
        """Area covered by the raster."""
        low = self._corner * self.cell
        rows, columns = self._hits.shape
        return Area(float(low[0]), float(low[1]), float(low[0] + columns * self.cell), float(low[1] + rows * self.cell))

    def add(self, origin: Array, points: Array) -> None:
        """Add a scan.

        Args:
            origin: position of the sensor in the map frame (m), shape (2,).
            points: end points of the beams in the map frame (m), shape (n, 2).
        """
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) == 0:
            return
        ends = self._cells(points)
        seen = self._cells(_beams(origin, points, self.cell / 2))
        self._cover(ends, self._cells(origin))  # no beam leaves the rectangle around them
        hit = np.zeros(self._hits.shape, dtype=bool)
        hit[tuple((ends - self._corner).T[::-1])] = True
        through = np.zeros(self._hits.shape, dtype=bool)
        through[tuple((seen - self._corner).T[::-1])] = True
        self._hits += hit
        self._passes += through & ~hit

    def occupancy(self) -> Array:
        """Return the fraction of hits, shape (rows, columns), row 0 at the lowest y; NaN for unseen cells."""
        total = self._hits.astype(np.float64) + self._passes
        with np.errstate(invalid="ignore"):
            return self._hits / total

    def _cells(self, points: Array) -> NDArray[np.int64]:
        return np.floor(points / self.cell).astype(np.int64)

    def _cover(self, ends: NDArray[np.int64], origin: NDArray[np.int64]) -> None:
        """Grow the raster until it contains the beams' end points and origin."""
        columns, rows = ends.T
        low = np.minimum((columns.min(), rows.min()), origin)
        high = np.maximum((columns.max(), rows.max()), origin) + 1
        size = np.array(self._hits.shape[::-1])
        if size.any():
            if (low >= self._corner).all() and (high <= self._corner + size).all():
                return
            low, high = np.minimum(low, self._corner), np.maximum(high, self._corner + size)
        grow = 32  # cells of margin added at a time, so that growing is rare
        corner, shape = low - grow, high - low + 2 * grow
        shift = self._corner - corner
        for name in ("_hits", "_passes"):
            old = getattr(self, name)
            grown = np.zeros(shape[::-1], dtype=old.dtype)
            grown[shift[1] : shift[1] + old.shape[0], shift[0] : shift[0] + old.shape[1]] = old
            setattr(self, name, grown)
        self._corner = corner


def _beams(origin: Array, points: Array, step: float) -> Array:
    """Return points every ``step`` along each beam except the last step, shape (m, 2)."""
    beams = points - origin
    lengths = np.hypot(beams[:, 0], beams[:, 1])
    counts = np.floor(lengths / step).astype(np.int64)
    beam = np.repeat(np.arange(len(points)), counts)
    nth = np.arange(len(beam)) - np.repeat(np.cumsum(counts) - counts, counts)
    along = nth * step / lengths[beam]
    sampled: Array = origin + beams[beam] * along[:, None]
    return sampled
