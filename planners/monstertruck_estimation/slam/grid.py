"""Occupancy grid by the beam model: log odds of every cell in a growing area, with changes published as tiles.

Inverse sensor model with constant log odds for the end of a beam and for the passed cells (Thrun, Burgard, Fox:
Probabilistic Robotics, table 9.2). A scan changes each cell once, and an end outweighs passes: otherwise walls at a
grazing angle, and everything near the sensor, would be counted dozens of times.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import GridConfig
from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.worker_io import UNKNOWN, GridPatch, ScanInput
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, between, interpolate, transform
from monstertruck_runtime.clock import SECOND

Cells = NDArray[np.int8]

TILE: Final = 64
"""Cells per edge of a tile; the grid's bounds are whole tiles."""
SCALE: Final = 256.0
"""Steps of the stored log odds per unit."""
NONE: Final = np.empty((0, 2))
"""Empty array of points."""


class OccupancyGrid:
    """Log odds of a growing area.

    Args:
        config: cells and sensor model.
    """

    def __init__(self, config: GridConfig | None = None) -> None:
        self.config = config = config or GridConfig()
        self._hit, self._miss = _steps(config.hit), _steps(config.miss)
        self._limit = _steps(config.limit)
        self._percent = _percentages(self._limit)
        self._published: dict[tuple[int, int], Cells] = {}
        self._redrawn = False
        self.clear()

    def clear(self) -> None:
        """Clear the grid; ``changes`` still compares with the published one."""
        self._corner = np.zeros(2, np.int64)
        self._odds = np.zeros((0, 0), np.int16)
        self._marks = np.zeros((0, 0), np.uint16)
        self._mark = 0
        self._touched: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None
        self._redrawn = True

    def add(self, sensor: Array, points: Array, passed: Array = NONE) -> None:
        """Integrate one scan.

        Args:
            sensor: start of the beams in map, shape (2,) (m).
            points: ends of the beams in map, shape (n, 2) (m); all finite.
            passed: free ends of beams without an echo in map, shape (k, 2) (m); all finite.
        """
        if not len(points) and not len(passed):
            return
        beams = np.vstack((points, passed)) if len(passed) else points
        ends, low, high = _cells(beams, sensor, 1.0 / self.config.resolution)
        self._cover(low, high)
        self._touch(low, high)
        self._mark += 1
        if self._mark > np.iinfo(np.uint16).max:
            self._marks[:] = 0
            self._mark = 1
        trace(
            self._odds.ravel(),
            self._marks.ravel(),
            self._odds.shape[1],
            ends,
            self._corner,
            self._mark,
            (self._hit, self._miss, self._limit),
            len(points),
        )

    def patch(self) -> GridPatch:
        """Return the whole grid without unknown margins; it has no cells before the first scan."""
        cells = self._percent[self._odds + self._limit]
        rows, columns = np.flatnonzero((cells != UNKNOWN).any(axis=1)), np.flatnonzero((cells != UNKNOWN).any(axis=0))
        if not len(rows):
            return GridPatch(np.zeros((0, 0), np.int8), (0.0, 0.0), self.config.resolution)
        cells = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        corner = self._corner + np.array((columns[0], rows[0]))
        return GridPatch(np.ascontiguousarray(cells), self._metres(corner), self.config.resolution)

    def changes(self) -> list[GridPatch]:
        """Return the tiles that changed since the last call, ordered by row and column."""
        result = []
        known = self._published if self._redrawn else ()
        for key in sorted({*known, *self._candidates()}):
            cells, before = self._tile(key), self._published.get(key)
            if before is not None and np.array_equal(cells, before):
                continue
            if before is None and (cells == UNKNOWN).all():
                continue
            self._published[key] = cells
            row, column = key
            result.append(GridPatch(cells, self._metres(np.array((column, row)) * TILE), self.config.resolution))
        self._touched, self._redrawn = None, False
        return result

    def _candidates(self) -> Iterator[tuple[int, int]]:
        if self._touched is None:
            return
        (x0, y0), (x1, y1) = (edge // TILE for edge in self._touched)
        yield from ((row, column) for row in range(y0, y1 + 1) for column in range(x0, x1 + 1))

    def _tile(self, key: tuple[int, int]) -> Cells:
        row, column = key[0] * TILE - self._corner[1], key[1] * TILE - self._corner[0]
        rows, columns = self._odds.shape
        if not (0 <= row < rows and 0 <= column < columns):
            return np.full((TILE, TILE), UNKNOWN, np.int8)
        return self._percent[self._odds[row : row + TILE, column : column + TILE] + self._limit]

    def _metres(self, corner: NDArray[np.int64]) -> tuple[float, float]:
        return float(corner[0] * self.config.resolution), float(corner[1] * self.config.resolution)

    def _touch(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        if self._touched is not None:
            low, high = np.minimum(low, self._touched[0]), np.maximum(high, self._touched[1])
        self._touched = low, high

    def _cover(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        """Grow by whole tiles to include the cells ``low`` and ``high``."""
        size = np.array(self._odds.shape[::-1])
        end = self._corner + size
        if size.all():
            if (low >= self._corner).all() and (high < end).all():
                return
            low, high = np.minimum(low, self._corner), np.maximum(high, end - 1)
        corner = low // TILE * TILE
        shape = ((high // TILE + 1) * TILE - corner)[::-1]
        odds, marks = np.zeros(shape, np.int16), np.zeros(shape, np.uint16)
        if size.all():
            column, row = self._corner - corner
            inside = np.s_[row : row + size[1], column : column + size[0]]
            odds[inside], marks[inside] = self._odds, self._marks
        self._corner, self._odds, self._marks = corner, odds, marks


def _steps(probability: float) -> int:
    return round(SCALE * math.log(probability / (1 - probability)))


def _percentages(limit: int) -> Cells:
    """Return a table of occupancy (%) by log odds + ``limit``; log odds of exactly zero are unknown."""
    odds = np.arange(-limit, limit + 1) / SCALE
    percent = np.round(100.0 / (1.0 + np.exp(-odds))).astype(np.int8)
    percent[limit] = UNKNOWN
    return percent


@njit(cache=True)
def _cells(points, sensor, scale):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Return the cells of the sensor (row 0) and of the ends as (column, row), and their bounds."""
    n = points.shape[0]
    ends = np.empty((n + 1, 2), np.int32)
    low, high = np.empty(2, np.int64), np.empty(2, np.int64)
    for axis in range(2):
        first = np.int32(math.floor(sensor[axis] * scale))
        ends[0, axis] = first
        least, most = first, first
        for i in range(n):
            cell = np.int32(math.floor(points[i, axis] * scale))
            ends[i + 1, axis] = cell
            least, most = min(least, cell), max(most, cell)
        low[axis], high[axis] = least, most
    return ends, low, high


@njit(cache=True)
def trace(odds, marks, stride, ends, corner, mark, model, hits):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN201
    """Add one scan to a grid: first the ends of the beams, then the passed cells, each cell once.

    Args:
        odds: log odds of the cells, int16, flat.
        marks: number of the last scan that changed each cell, uint16, flat.
        stride: number of cells per row.
        ends: cells (column, row) of the sensor and of every beam's end, int32, shape (n + 1, 2); all inside the grid.
        corner: (column, row) of the first cell.
        mark: number of this scan.
        model: log odds added by an end and by a pass (negative), and their limit.
        hits: number of leading beams with an echo; the others only pass.
    """
    hit, miss, limit = model
    x0, y0 = ends[0, 0] - corner[0], ends[0, 1] - corner[1]
    n = ends.shape[0]
    for i in range(1, hits + 1):
        at = (ends[i, 1] - corner[1]) * stride + ends[i, 0] - corner[0]
        if marks[at] != mark:
            marks[at] = mark
            odds[at] = min(odds[at] + hit, limit)
    fraction_bits = 16  # number of fractional bits along a beam
    half = 1 << (fraction_bits - 1)
    for i in range(1, n):
        if i > 1 and ends[i, 0] == ends[i - 1, 0] and ends[i, 1] == ends[i - 1, 1]:
            continue
        dx, dy = ends[i, 0] - corner[0] - x0, ends[i, 1] - corner[1] - y0
        across, along = abs(dx) >= abs(dy), max(abs(dx), abs(dy))
        if along == 0:
            continue
        # One cell of the longer axis per step, the shorter one in fixed point: no branch except for the mark.
        if across:
            step, side, slope = (1 if dx > 0 else -1), stride, (dy << fraction_bits) // along
        else:
            step, side, slope = (stride if dy > 0 else -stride), 1, (dx << fraction_bits) // along
        at, part = y0 * stride + x0, half
        for _ in range(along):
            cell = at + (part >> fraction_bits) * side
            if marks[cell] != mark:
                marks[cell] = mark
                odds[cell] = max(odds[cell] + miss, -limit)
            at += step
            part += slope


def outline(length: float, width: float, step: float) -> Array:
    """Return points of a rectangle around the origin, shape (n, 2), at most ``step`` apart (m)."""
    x, y = length / 2, width / 2
    corners = np.array([(x, y), (-x, y), (-x, -y), (x, -y), (x, y)])
    sides = [
        a + (b - a) * np.arange(count := math.ceil(math.dist(a, b) / step))[:, None] / count
        for a, b in itertools.pairwise(corners)
    ]
    return np.vstack(sides)


def passed_ends(inputs: ScanInput, reach: float) -> Array:
    """Return the ends in base, shape (k, 2) (m), of beams without an echo, at ``reach`` or the sensor's maximum range.

    Only a level scan has any: a tilted beam passes at another height than the other scans.
    """
    level = 0.02  # maximum slope of the scan plane for beams without an echo: 0.1 m over 5 m
    if inputs.slopes is not None and max(map(abs, inputs.slopes)) > level:
        return NONE
    beams = np.flatnonzero(np.isposinf(inputs.ranges))
    x, y, yaw = inputs.mount
    angles, far = yaw + inputs.start_angle + inputs.angle_increment * beams, min(reach, inputs.range_max)
    return np.column_stack((x + far * np.cos(angles), y + far * np.sin(angles)))


MILLIMETRES: Final = 1000.0
PAGE_POINTS: Final = 1 << 16
"""Number of points per page, 256 kB."""


class PointPages:
    """Points of many scans in pages that are never freed, which prevents fragmentation of the heap."""

    def __init__(self) -> None:
        self._pages: list[NDArray[np.int16]] = []
        self._page, self._row = 0, 0
        self._places: list[tuple[int, int, int]] = []
        """Page, first row and number of rows of each scan."""

    def append(self, points: NDArray[np.int16]) -> None:
        """Store a scan, shape (n, 2)."""
        while self._page < len(self._pages) and self._row + len(points) > len(self._pages[self._page]):
            self._page, self._row = self._page + 1, 0
        if self._page == len(self._pages):
            self._pages.append(np.empty((max(PAGE_POINTS, len(points)), 2), np.int16))
        first, self._row = self._row, self._row + len(points)
        self._pages[self._page][first : self._row] = points
        self._places.append((self._page, first, len(points)))

    def keep(self, chosen: Iterable[int]) -> None:
        """Drop all but the ``chosen`` scans (rising numbers) and compact the pages."""
        kept = [self._places[index] for index in chosen]
        self._page, self._row, self._places = 0, 0, []
        for page, first, count in kept:  # never behind its source, so no row is overwritten before it has moved
            self.append(self._pages[page][first : first + count])

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> NDArray[np.int16]:
        page, first, count = self._places[index]
        return self._pages[page][first : first + count]


class GridBuilder:
    """Occupancy grid of stored scans, rebuilt when optimisation moves their poses.

    The ground under the robot is free: its outline is stored as ends of beams without an echo.

    Args:
        config: settings of the grid and of the scans to integrate.
        body: length and width of the robot (m); None if unknown.
    """

    def __init__(self, config: GridConfig, body: tuple[float, float] | None = None) -> None:
        self.grid = OccupancyGrid(config)
        self._config, self._body = config, body
        self._outline = NONE if body is None else outline(*body, config.resolution / 2)
        self._stamps: list[int] = []
        self._poses: list[Array] = []
        self._points = PointPages()
        self._returns: list[int] = []
        """Number of each scan's points that are echoes; the others end beams without an echo."""
        self._mounts: list[Pose2] = []
        self._lidars: list[int] = []
        """Number of each scan's lidar."""

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, scan: Scan, stamp: int, pose: Array, mount: Pose2, passed: Array = NONE, lidar: int = 0) -> bool:
        """Integrate a scan if the robot has moved far enough since the last one of its lidar; return whether it did so.

        Args:
            scan: points in base.
            stamp: stamp (ns), later than earlier ones of the same lidar.
            pose: base in map, shape (3,).
            mount: planar pose of the sensor in base.
            passed: ends in base of beams without an echo, shape (k, 2), see ``passed_ends``.
            lidar: number of the lidar.
        """
        if not len(scan) or not self._due(stamp, pose, lidar):
            return False
        longest_point = 32.7  # limit of points stored as 16-bit millimetres, m
        near, far = (ends[np.abs(ends).max(axis=1) < longest_point] for ends in (scan.points, passed))
        self._stamps.append(stamp)
        self._poses.append(np.array(pose))
        self._points.append(np.round(np.vstack((near, far)) * MILLIMETRES).astype(np.int16))
        self._returns.append(len(near))
        self._mounts.append(mount)
        self._lidars.append(lidar)
        self._draw(len(self._stamps) - 1)
        if len(self._stamps) > self._config.remembered:
            self._prune()
        return True

    def update_poses(self, stamps: NDArray[np.int64], poses: Array) -> bool:
        """Rebuild the grid if the trajectory has moved the stored scans; return whether it did so.

        Args:
            stamps: rising stamps (ns), shape (n,); poses between them are interpolated.
            poses: base in map, shape (n, 3).
        """
        if not self._stamps or not len(stamps):
            return False
        now = interpolate(stamps.astype(np.float64), poses, np.array(self._stamps, np.float64))
        off = between(np.array(self._poses), now)
        redraw_motion = (0.5, 0.01)  # minimum move of a pose (cells, rad) that rebuilds the grid
        if (np.hypot(off[:, 0], off[:, 1]) < redraw_motion[0] * self._config.resolution).all() and (
            np.abs(off[:, 2]) < redraw_motion[1]
        ).all():
            return False
        self._poses = list(now)
        self._redraw()
        return True

    def keep_marked(self, stamps: NDArray[np.int64], kept: NDArray[np.bool_]) -> None:
        """Rebuild the grid from the scans that the trajectory marks.

        Args:
            stamps: rising stamps (ns), shape (n,).
            kept: marks, shape (n,).
        """
        at = np.minimum(np.searchsorted(stamps, self._stamps), len(stamps) - 1)
        self._keep(np.flatnonzero(kept[at]).tolist())
        self._redraw()

    def _redraw(self) -> None:
        self.grid.clear()
        for i in range(len(self._stamps)):
            self._draw(i)

    def _due(self, stamp: int, pose: Array, lidar: int) -> bool:
        last = next((i for i in reversed(range(len(self))) if self._lidars[i] == lidar), None)
        if last is None:
            return True
        config, off = self._config, between(self._poses[last], pose)
        return bool(
            np.hypot(off[0], off[1]) >= config.spacing
            or abs(off[2]) >= config.turn
            or stamp - self._stamps[last] >= config.pause * SECOND
        )

    def _draw(self, i: int) -> None:
        mount, pose = self._mounts[i], self._poses[i]
        points, returns = transform(pose, self._points[i] / MILLIMETRES), self._returns[i]
        passed = points[returns:]
        if self._body is not None and all(abs(m) < side / 2 for m, side in zip(mount, self._body, strict=False)):
            passed = np.vstack((passed, transform(pose, self._outline)))
        self.grid.add(transform(pose, np.array([mount[:2]]))[0], points[:returns], passed)

    def _prune(self) -> None:
        """Drop every second scan of each lidar, except in the latest quarter."""
        recent, counts = 3 * len(self) // 4, Counter[int]()
        kept = []
        for i, lidar in enumerate(self._lidars):
            if counts[lidar] % 2 == 0 or i >= recent:
                kept.append(i)
            counts[lidar] += 1
        self._keep(kept)

    def _keep(self, kept: list[int]) -> None:
        self._stamps = [self._stamps[i] for i in kept]
        self._poses = [self._poses[i] for i in kept]
        self._mounts = [self._mounts[i] for i in kept]
        self._lidars = [self._lidars[i] for i in kept]
        self._returns = [self._returns[i] for i in kept]
        self._points.keep(kept)
