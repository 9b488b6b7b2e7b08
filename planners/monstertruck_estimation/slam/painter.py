"""Draws the grid from scans, and draws it anew when a loop closure has moved where they were taken."""

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.exchange import Vector
from monstertruck_estimation.slam.grid import OccupancyGrid
from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.se2 import between, interpolate, transform
from monstertruck_estimation.slam.settings import GridConfig
from monstertruck_runtime.clock import SECOND

Array = NDArray[np.float64]

MILLIMETRES: Final = 1000.0
PAGE: Final = 1 << 16
"""Points of a page, 256 kB."""
FARTHEST: Final = 32.7
"""Points are kept as 16-bit millimetres, m."""
MOVED: Final = (0.5, 0.01)
"""Poses that moved by less (cells, rad) are not worth drawing anew."""


class Pages:
    """Points of many scans in pages that are never given back: scans that come and go leave no holes in the heap."""

    def __init__(self) -> None:
        self._pages: list[NDArray[np.int16]] = []
        self._page, self._row = 0, 0
        self._places: list[tuple[int, int, int]] = []
        """Page, first row and number of rows of each scan."""

    def append(self, points: NDArray[np.int16]) -> None:
        """Remember a scan, shape (n, 2)."""
        while self._page < len(self._pages) and self._row + len(points) > len(self._pages[self._page]):
            self._page, self._row = self._page + 1, 0
        if self._page == len(self._pages):
            self._pages.append(np.empty((max(PAGE, len(points)), 2), np.int16))
        first, self._row = self._row, self._row + len(points)
        self._pages[self._page][first : self._row] = points
        self._places.append((self._page, first, len(points)))

    def keep(self, chosen: Iterable[int]) -> None:
        """Forget all but the ``chosen`` scans, which rise; they move together."""
        kept = [self._places[index] for index in chosen]
        self._page, self._row, self._places = 0, 0, []
        for page, first, count in kept:  # never behind its own place, so nothing is overwritten before it has moved
            self.append(self._pages[page][first : first + count])

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> NDArray[np.int16]:
        page, first, count = self._places[index]
        return self._pages[page][first : first + count]


class Painter:
    """Grid of the scans it was given and still remembers.

    Args:
        config: grid, and which scans join it.
    """

    def __init__(self, config: GridConfig) -> None:
        self.grid = OccupancyGrid(config)
        self._config = config
        self._stamps: list[int] = []
        self._poses: list[Array] = []
        self._points = Pages()
        self._mounts: list[Vector] = []

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, scan: Scan, stamp: int, pose: Array, mount: Vector) -> bool:
        """Take a scan in if it is due; tells whether it was.

        Args:
            scan: points in base.
            stamp: ns, later than those before.
            pose: shape (3,), base in map.
            mount: planar pose of the sensor in base.
        """
        if not len(scan) or not self._due(stamp, pose):
            return False
        near = scan.points[np.abs(scan.points).max(axis=1) < FARTHEST]
        self._stamps.append(stamp)
        self._poses.append(np.array(pose))
        self._points.append(np.round(near * MILLIMETRES).astype(np.int16))
        self._mounts.append(mount)
        self._draw(len(self._stamps) - 1)
        if len(self._stamps) > self._config.remembered:
            self._thin()
        return True

    def follow(self, stamps: NDArray[np.int64], poses: Array) -> bool:
        """Draw anew if the trajectory puts remembered scans elsewhere; tells whether it did.

        Args:
            stamps: shape (n,), ns, rising; between them the way is taken as straight.
            poses: shape (n, 3), base in map.
        """
        if not self._stamps or not len(stamps):
            return False
        now = interpolate(stamps.astype(np.float64), poses, np.array(self._stamps, np.float64))
        off = between(np.array(self._poses), now)
        if (np.hypot(off[:, 0], off[:, 1]) < MOVED[0] * self._config.resolution).all() and (
            np.abs(off[:, 2]) < MOVED[1]
        ).all():
            return False
        self._poses = list(now)
        self.grid.clear()
        for i in range(len(self._stamps)):
            self._draw(i)
        return True

    def _due(self, stamp: int, pose: Array) -> bool:
        if not self._stamps:
            return True
        config, off = self._config, between(self._poses[-1], pose)
        return bool(
            np.hypot(off[0], off[1]) >= config.spacing
            or abs(off[2]) >= config.turn
            or stamp - self._stamps[-1] >= config.pause * SECOND
        )

    def _draw(self, i: int) -> None:
        sensor = transform(self._poses[i], np.array([self._mounts[i][:2]]))[0]
        self.grid.add(sensor, transform(self._poses[i], self._points[i] / MILLIMETRES))

    def _thin(self) -> None:
        """Forget every other scan but the newest quarter."""
        count = len(self._stamps)
        kept = [i for i in range(count) if i % 2 == 0 or i >= 3 * count // 4]
        self._stamps = [self._stamps[i] for i in kept]
        self._poses = [self._poses[i] for i in kept]
        self._mounts = [self._mounts[i] for i in kept]
        self._points.keep(kept)
