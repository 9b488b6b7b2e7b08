"""Coarse registration by exhaustive correlation with a likelihood grid, made fast by branch and bound.

Every level of the grid holds the maximum over squares of 2^level cells, so that a block of translations is bounded by
one look-up per point (Hess, Kohler, Rapp, Andor 2016; Olson 2009). The search returns the true maximum in its window.
A submap, merged from several keyframes, carries the pyramids of its own cloud.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_estimation.slam.budget import CELL, DRAWN
from monstertruck_estimation.slam.registration import Cloud
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import rotation

Pyramid = NDArray[np.uint8]
Blocks = NDArray[np.int32]

RESOLUTION: Final = 0.05
"""Edge of a cell, m."""
LONGEST: Final = 0.5
"""An element is drawn to this half length at most, m."""
MARGIN: Final = math.ceil(LONGEST / RESOLUTION) + 5
"""Cells round the outermost points."""
SMEAR: Final = 0.08
"""Standard deviation of the likelihood round a surface, m: cell size, noise and half a step of the search."""
DOUBT: Final = 0.002
"""Penalty of a squared standard deviation from the guess, as share of the score."""
WORK: Final = 400_000
"""Blocks evaluated, unless the caller says otherwise."""


@dataclass(frozen=True, slots=True)
class LikelihoodGrid:
    """Pyramid of likelihoods, 0..255, of finding a surface in a cell."""

    levels: Pyramid
    """Shape (levels, rows, columns): level k is the maximum over squares of 2^k cells up and right of the cell."""
    origin: tuple[float, float]
    """Corner of the cell (0, 0), m."""

    @classmethod
    def of(cls, cloud: Cloud, levels: int) -> "LikelihoodGrid":
        """Likelihood of the surfaces of ``cloud``, which is not empty.

        Every element is drawn as long as it is: drawn as dots, far samples of a wall would match themselves best
        without any motion.
        """
        points = cloud.points
        pad = (1 << (levels - 1)) + MARGIN
        low = np.floor(points.min(axis=0) / RESOLUTION).astype(np.int64) - pad
        high = np.floor(points.max(axis=0) / RESOLUTION).astype(np.int64) + pad
        columns, rows = (high - low + 1).tolist()
        origin = (float(low[0] * RESOLUTION), float(low[1] * RESOLUTION))
        grid = np.zeros((levels, rows, columns), np.uint8)
        _stamp(grid[0], points, cloud.normals, cloud.extents, origin[0], origin[1])
        for level in range(1, levels):
            _pool(grid[level - 1], grid[level], 1 << (level - 1))
        return cls(grid, origin)


@dataclass(frozen=True, slots=True)
class Peak:
    """Best pose of a correlation."""

    pose: Array
    """Shape (3,), m and rad."""
    score: float
    """Mean likelihood of the points there, 0..1."""
    rival: float
    """Best score of a clearly different pose in the window; 0 if none came near."""
    unseen: float = 0.0
    """Greatest score a better rival may have, as the search for it has ended early; 0 if it has not."""


def look_ups(points: Array, window: tuple[float, float], levels: int) -> float:
    """Look-ups of the coarsest level when ``points``, shape (n, 2), are searched for in ``window`` (m, rad)."""
    block = RESOLUTION * min(1 << (levels - 1), max(math.ceil(2 * window[0] / RESOLUTION), 1))
    return 2 * window[1] / RESOLUTION * _lever(points) * (2 * window[0] / block + 1) ** 2 * len(points)


def correlate(
    grid: LikelihoodGrid,
    points: Array,
    guess: Array,
    window: tuple[float, float],
    deviation: tuple[float, float],
    least: float,
    apart: float = 0.0,
    work: int = WORK,
) -> Peak | None:
    """Best pose of ``points`` in the grid.

    Args:
        grid: where the surfaces are.
        points: shape (n, 2), in the moving frame, m.
        guess: shape (3,); middle of the window.
        window: half width of the translation (m) and of the yaw (rad).
        deviation: standard deviation of the guess (m, rad), which breaks ties (``DOUBT``).
        least: poses scoring less are no result.
        apart: a rival is at least this far (m; or that arc at the typical range) from the best; 0: do not look.
        work: blocks evaluated before the search ends with what it has.
    """
    if not len(points):
        return None
    lever = _lever(points)
    step = RESOLUTION / lever
    half = math.ceil(window[1] / step)
    turns = np.arange(-half, half + 1, dtype=np.float64) * step
    cells = math.ceil(window[0] / RESOLUTION)
    offsets = _rotated(points, guess, turns, grid.origin[0], grid.origin[1])
    penalty = (DOUBT * (RESOLUTION / deviation[0]) ** 2, DOUBT / deviation[1] ** 2)
    zone = (10**9, 10**9, 10**9, -1.0, -1.0)
    blocks, bounds = _coarsest(grid.levels, offsets, turns, cells, *penalty)
    place = offsets, turns, cells, *penalty, blocks, bounds
    score, k, ix, iy, _ = _search(grid.levels, *place, least, work, *zone)
    if k < 0:
        return None
    rival = unseen = 0.0
    if apart > 0:
        zone = (k, ix, iy, apart / RESOLUTION, apart / lever / step)
        best, *_, unseen = _search(grid.levels, *place, 0.8 * score, work, *zone)
        rival = max(best, 0.0)
    pose = guess + np.array((ix * RESOLUTION, iy * RESOLUTION, turns[k]))
    return Peak(pose, float(score), float(rival), float(unseen))


def _lever(points: Array) -> float:
    """Typical range of ``points``, m: a yaw moves them by so much per radian."""
    return float(np.clip(np.percentile(np.hypot(points[:, 0], points[:, 1]), 80), 1.0, 12.0))


@njit(cache=True)
def _stamp(grid: Pyramid, points: Array, normals: Array, extents: Array, x0: float, y0: float) -> None:
    for i in range(points.shape[0]):
        half = min(extents[i], LONGEST)
        steps = int(half / RESOLUTION)
        for k in range(-steps, steps + 1):
            px = (points[i, 0] - normals[i, 1] * k * RESOLUTION - x0) / RESOLUTION
            py = (points[i, 1] + normals[i, 0] * k * RESOLUTION - y0) / RESOLUTION
            _dot(grid, px, py)


@njit(cache=True)
def _dot(grid: Pyramid, px: float, py: float) -> None:
    half = 4
    cx, cy = int(px), int(py)
    # The exponential of a sum is a product: one factor per column and one per row.
    along = np.empty(2 * half + 1)
    for k in range(2 * half + 1):
        dx = (cx - half + k + 0.5 - px) * RESOLUTION
        along[k] = math.exp(-0.5 * dx * dx / (SMEAR * SMEAR))
    for gy in range(cy - half, cy + half + 1):
        dy = (gy + 0.5 - py) * RESOLUTION
        across = 255 * math.exp(-0.5 * dy * dy / (SMEAR * SMEAR))
        for k in range(2 * half + 1):
            value = np.uint8(across * along[k])
            grid[gy, cx - half + k] = max(grid[gy, cx - half + k], value)


def _pool(source: Pyramid, target: Pyramid, step: int) -> None:
    """Maximum of each cell and those ``step`` further right, up, and both; the last row and column continue outside."""
    right = source.copy()
    np.maximum(source[:, :-step], source[:, step:], out=right[:, :-step])
    np.maximum(source[:, -step:], source[:, -1:], out=right[:, -step:])
    np.maximum(right[:-step], right[step:], out=target[:-step])
    np.maximum(right[-step:], right[-1:], out=target[-step:])


@njit(cache=True)
def _rotated(points: Array, guess: Array, turns: Array, x0: float, y0: float) -> Blocks:
    """Cells of the points at the guess, for every turn: shape (turns, points, 2)."""
    result = np.empty((turns.size, points.shape[0], 2), np.int32)
    for k in range(turns.size):
        c, s = math.cos(guess[2] + turns[k]), math.sin(guess[2] + turns[k])
        for i in range(points.shape[0]):
            x = guess[0] + c * points[i, 0] - s * points[i, 1]
            y = guess[1] + s * points[i, 0] + c * points[i, 1]
            result[k, i, 0] = math.floor((x - x0) / RESOLUTION)
            result[k, i, 1] = math.floor((y - y0) / RESOLUTION)
    return result


@njit(cache=True)
def _bound(level: Pyramid, offsets: Blocks, ix: int, iy: int) -> float:
    rows, columns = level.shape
    total = 0
    for i in range(offsets.shape[0]):
        x, y = offsets[i, 0] + ix, offsets[i, 1] + iy
        if 0 <= x < columns and 0 <= y < rows:
            total += level[y, x]
    return float(total / (255.0 * offsets.shape[0]))


@njit(cache=True)
def _least_square(low: int, width: int) -> int:
    """Least square of the whole numbers low .. low + width - 1."""
    high = low + width - 1
    if low > 0:
        return low * low
    if high < 0:
        return high * high
    return 0


@njit(cache=True)
def _coarsest(
    levels: Pyramid, offsets: Blocks, turns: Array, cells: int, by_cell: float, by_turn: float
) -> tuple[Blocks, Array]:
    """Blocks of the coarsest level (turn index, x, y, level), the greatest bound first, and their bounds."""
    top = levels.shape[0] - 1
    while top > 0 and (1 << top) > 2 * cells:
        top -= 1
    width = 1 << top
    per_axis = (2 * cells + width) // width
    count = turns.size * per_axis * per_axis
    bounds = np.empty(count)
    blocks = np.empty((count, 4), np.int32)
    n = 0
    for k in range(turns.size):
        for by in range(per_axis):
            for bx in range(per_axis):
                ix, iy = -cells + bx * width, -cells + by * width
                doubt = by_turn * turns[k] ** 2
                doubt += by_cell * (_least_square(ix, width) + _least_square(iy, width))
                bounds[n] = _bound(levels[top], offsets[k], ix, iy) - doubt
                blocks[n, 0], blocks[n, 1], blocks[n, 2], blocks[n, 3] = k, ix, iy, top
                n += 1
    order = np.argsort(-bounds, kind="mergesort")
    return blocks[order], bounds[order]


@njit(cache=True)
def _search(
    levels: Pyramid, offsets: Blocks, turns: Array, cells: int, by_cell: float, by_turn: float, blocks: Blocks,
    bounds: Array, least: float, most: int, shut_k: int, shut_x: float, shut_y: float, shut_cells: float,
    shut_turns: float,
) -> tuple[float, int, int, int, float]:  # fmt: skip
    """Best-first branch and bound: score, turn index, x cells, y cells, and what a pose not evaluated may score.

    The turn index is -1 if nothing reached ``least``. The search begins with the sorted ``blocks`` of the coarsest
    level, and ends early when more than ``most`` below it were evaluated. The block of the greatest bound is next,
    whatever its size: depth first, a search that ends early would have seen one corner of a great window, and not the
    place that fits.
    Poses within ``shut_cells`` and ``shut_turns`` of (shut_x, shut_y, shut_k) do not count.
    """
    best, best_k, best_x, best_y = least, -1, 0, 0
    work, taken = 0, 0
    # Blocks below the coarsest level wait in a heap.
    keys, heap, size = np.empty(1024), np.empty((1024, 4), np.int32), 0
    while work <= most:
        if size and (taken == bounds.size or keys[0] >= bounds[taken]):
            bound, block = keys[0], heap[0]
            k, x, y, level = block[0], block[1], block[2], block[3]
            size -= 1
            _sink(keys, heap, size)
        elif taken < bounds.size:
            bound, block = bounds[taken], blocks[taken]
            k, x, y, level = block[0], block[1], block[2], block[3]
            taken += 1
        else:
            break
        if bound <= best:
            break
        if level == 0:
            near = math.hypot(x - shut_x, y - shut_y) <= shut_cells and abs(k - shut_k) <= shut_turns
            if not near and abs(x) <= cells and abs(y) <= cells:
                best, best_k, best_x, best_y = bound, k, x, y
            continue
        half = 1 << (level - 1)
        for q in range(4):
            cx, cy = x + (q & 1) * half, y + (q >> 1) * half
            doubt = by_turn * turns[k] ** 2
            doubt += by_cell * (_least_square(cx, half) + _least_square(cy, half))
            bound = _bound(levels[level - 1], offsets[k], cx, cy) - doubt
            work += 1
            if bound <= best:
                continue
            if size == keys.size:
                keys, heap = np.concatenate((keys, np.empty(size))), np.concatenate((heap, np.empty_like(heap)))
            _float(keys, heap, size, bound, k, cx, cy, level - 1)
            size += 1
    left = 0.0
    if work > most:
        left = max(keys[0] if size else 0.0, bounds[taken] if taken < bounds.size else 0.0)
    return best if best_k >= 0 else 0.0, best_k, best_x, best_y, left


@njit(cache=True)
def _float(keys: Array, heap: Blocks, at: int, bound: float, k: int, x: int, y: int, level: int) -> None:
    """Add a block to the heap at its end, ``at``."""
    while at:
        above = (at - 1) // 2
        if keys[above] >= bound:
            break
        keys[at], heap[at] = keys[above], heap[above]
        at = above
    keys[at] = bound
    heap[at, 0], heap[at, 1], heap[at, 2], heap[at, 3] = k, x, y, level


@njit(cache=True)
def _sink(keys: Array, heap: Blocks, size: int) -> None:
    """Put the last block, ``size``, in the place of the first, which was taken."""
    bound = keys[size]
    at = 0
    while 2 * at + 1 < size:
        below = 2 * at + 1
        if below + 1 < size and keys[below + 1] > keys[below]:
            below += 1
        if keys[below] <= bound:
            break
        keys[at], heap[at] = keys[below], heap[below]
        at = below
    keys[at], heap[at] = bound, heap[size]


MERGE_CELL: Final = 0.05
"""Elements within a square of this edge that face the same way become one, m."""


@dataclass
class Submap:
    """A cloud and, when requested, its likelihood pyramids."""

    cloud: Cloud
    _grids: dict[int, LikelihoodGrid] = field(default_factory=dict)

    def grid_cost(self, levels: int) -> float:
        """Work of making that grid; 0 once it is made."""
        if levels in self._grids:
            return 0.0
        edges = (self.cloud.points.max(axis=0) - self.cloud.points.min(axis=0)) / RESOLUTION + (2 << (levels - 1))
        return DRAWN * len(self.cloud.points) + CELL * levels * float(edges.prod())

    def grid(self, levels: int) -> LikelihoodGrid:
        """Likelihood pyramid of at least this many levels."""
        known = self._grids.get(levels)
        if known is None:
            known = self._grids[levels] = LikelihoodGrid.of(self.cloud, levels)
        return known


def merged(scans: Sequence[Scan], poses: Array) -> Scan:
    """Elements of all ``scans`` at ``poses`` (shape (n, 3)), averaged where they are the same piece of surface."""
    points, normals, variances, extents = [], [], [], []
    for scan, pose in zip(scans, poses, strict=True):
        turn = rotation(pose[2]).T
        points.append(scan.points @ turn + pose[:2])
        normals.append(scan.normals @ turn)
        variances.append(scan.variances)
        extents.append(scan.extents)
    every = np.concatenate(points), np.concatenate(normals), np.concatenate(variances), np.concatenate(extents)
    # Cell and octant of the normal identify the piece of surface.
    cells = np.floor(every[0] / MERGE_CELL).astype(np.int64)
    facing = np.floor(np.arctan2(every[1][:, 1], every[1][:, 0]) / (np.pi / 4) + 0.5).astype(np.int64) % 8
    lone = (every[2][:, 0] == every[2][:, 1]).astype(np.int64)
    cells -= cells.min(axis=0) if len(cells) else 0
    keys = (
        ((cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]) * 8 + facing) * 2 + lone if len(cells) else cells[:, 0]
    )
    order = np.argsort(keys, kind="stable")
    return Scan(*_average(*every, keys[order], order))


@njit(cache=True)
def _average(
    points: Array, normals: Array, variances: Array, extents: Array, keys: NDArray[np.int64], order: NDArray[np.int64]
) -> tuple[Array, Array, Array, Array]:
    """Means of runs of equal keys; points are weighted by how well they lie on their surface."""
    n = keys.size
    runs = 0
    for i in range(n):
        if i == 0 or keys[i] != keys[i - 1]:
            runs += 1
    p, m, v = np.zeros((runs, 2)), np.zeros((runs, 2)), np.zeros((runs, 2))
    e = np.zeros(runs)
    r, total = -1, 0.0
    for i in range(n + 1):
        if i == n or i == 0 or keys[i] != keys[i - 1]:
            if r >= 0:
                length = max(np.hypot(m[r, 0], m[r, 1]), 1e-12)
                for c in range(2):
                    p[r, c] /= total
                    v[r, c] /= total
                    m[r, c] /= length
            if i == n:
                break
            r += 1
            total = 0.0
        k = order[i]
        w = 1.0 / variances[k, 0]
        for c in range(2):
            p[r, c] += w * points[k, c]
            m[r, c] += w * normals[k, c]
            v[r, c] += w * variances[k, c]
        e[r] = max(e[r], extents[k])
        total += w
    return p, m, v, e
