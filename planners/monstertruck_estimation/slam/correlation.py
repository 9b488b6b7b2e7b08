"""Coarse registration by exhaustive correlation with a likelihood grid, made fast by branch and bound.

Every level of the grid holds the maximum over squares of 2^level cells, so that a block of translations is bounded by
one look-up per point (Hess, Kohler, Rapp, Andor 2016; Olson 2009). The search returns the true maximum in its window.
A submap, merged from several keyframes, carries the pyramids of the merged cloud.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_estimation.slam.budget import Pieces, Work, finished
from monstertruck_estimation.slam.registration import Cloud
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import rotation

Pyramid = NDArray[np.uint8]
Blocks = NDArray[np.int32]

RESOLUTION: Final = 0.05
"""Edge of a cell, m."""
LONGEST_ELEMENT: Final = 0.5
"""Maximum half length of a drawn element (m)."""
WORK: Final = 400_000
"""Default maximum number of evaluated blocks."""
PIECE: Final = 2e6
"""Number of look-ups per piece of a search: 4 to 6 ms."""


@dataclass(frozen=True, slots=True)
class LikelihoodGrid:
    """Pyramid of the likelihoods (0..255) that a cell holds a surface."""

    levels: Pyramid
    """Shape (levels, rows, columns): level k is the maximum over squares of 2^k cells right and up."""
    origin: tuple[float, float]
    """Corner of the cell (0, 0), m."""

    @classmethod
    def of(cls, cloud: Cloud, levels: int) -> "LikelihoodGrid":
        """Return the likelihood of the surfaces of ``cloud``, which is not empty.

        Every element is drawn with its length: drawn as dots, far samples of a wall would match themselves best without
        any motion.
        """
        points = cloud.points
        margin = math.ceil(LONGEST_ELEMENT / RESOLUTION) + 5  # cells round the outermost points
        pad = (1 << (levels - 1)) + margin
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
    """Best score of a clearly different pose in the window; 0 if none scores nearly as well."""
    unseen: float = 0.0
    """Upper bound of a rival's score after a search that ended early; otherwise 0."""


def look_ups(points: Array, window: tuple[float, float], levels: int) -> float:
    """Return the number of look-ups at the coarsest level for ``points``, shape (n, 2), in ``window`` (m, rad)."""
    block = RESOLUTION * min(1 << (levels - 1), max(math.ceil(2 * window[0] / RESOLUTION), 1))
    return 2 * window[1] / RESOLUTION * _lever(points) * (2 * window[0] / block + 1) ** 2 * len(points)


@dataclass(frozen=True, slots=True)
class RivalSearch:
    """Required result about the best pose that is clearly different from the best of all."""

    apart: float
    """Minimum distance from the best pose, m; also as an arc at the typical range."""
    least: float = 0.8
    """Minimum score of a rival, as a fraction of the best score."""
    enough: float = math.inf
    """Fraction of the best score above which a rival's exact score is irrelevant."""


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
    """Search at once; see ``correlation``. ``apart`` is the same as in a ``RivalSearch``; 0: no search for rivals."""
    rival = RivalSearch(apart) if apart > 0 else None
    return finished(correlation(grid, points, guess, window, deviation, least, rival, work))


def correlation(
    grid: LikelihoodGrid,
    points: Array,
    guess: Array,
    window: tuple[float, float],
    deviation: tuple[float, float],
    least: float,
    rival: RivalSearch | None = None,
    work: float = math.inf,
) -> Pieces[Peak | None]:
    """Search the best pose of ``points`` in the grid, in pieces.

    Args:
        grid: likelihood of surfaces.
        points: shape (n, 2), in the moving frame, m.
        guess: shape (3,); centre of the window.
        window: half width of the translation (m) and of the yaw (rad).
        deviation: standard deviation of the guess (m, rad), which breaks ties.
        least: poses with a lower score are ignored.
        rival: search for a rival, too.
        work: maximum number of blocks evaluated by the search, and again by the search for a rival.
    """
    if not len(points):
        return None
    lever = _lever(points)
    step = RESOLUTION / lever
    half = math.ceil(window[1] / step)
    turns = np.arange(-half, half + 1, dtype=np.float64) * step
    cells = math.ceil(window[0] / RESOLUTION)
    offsets = _rotated(points, guess, turns, grid.origin[0], grid.origin[1])
    doubt = 0.002  # penalty per squared standard deviation from the guess, as a fraction of the score
    penalty = (doubt * (RESOLUTION / deviation[0]) ** 2, doubt / deviation[1] ** 2)
    top = _top(len(grid.levels), cells)
    at_once = max(int(PIECE / (_per_axis(cells, top) ** 2 * len(points))), 1)
    parts = []
    for first in range(0, len(turns), at_once):
        yield float(_per_axis(cells, top) ** 2 * len(points) * len(turns[first : first + at_once]))
        parts.append(_coarsest(grid.levels[top], offsets, turns, first, at_once, top, cells, *penalty, least))
    blocks, bounds = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    order = np.argsort(-bounds, kind="stable")
    place = grid.levels, offsets, turns, cells, *penalty, blocks[order], bounds[order]
    nowhere = (10**9, 10.0**9, 10.0**9, -1.0, -1.0)
    best = yield from _searched(place, least, math.inf, nowhere, work)
    if best.turn < 0:
        return None
    other = None
    if rival is not None:
        zone = (best.turn, best.x, best.y, rival.apart / RESOLUTION, rival.apart / lever / step)
        other = yield from _searched(place, rival.least * best.score, rival.enough * best.score, zone, work)
    pose = guess + np.array((best.x * RESOLUTION, best.y * RESOLUTION, turns[best.turn]))
    if other is None:
        return Peak(pose, best.score, 0.0)
    return Peak(pose, best.score, other.score if other.turn >= 0 else 0.0, other.left)


_Place = tuple[Pyramid, Blocks, Array, int, float, float, Blocks, Array]
"""Arguments of ``_search`` that define the searched window."""
_Zone = tuple[int, float, float, float, float]
"""Arguments of ``_search`` that define the excluded zone: turn, x and y of its centre, and its half sizes in cells and
turns.
"""


@dataclass(frozen=True, slots=True)
class _SearchEnd:
    score: float
    turn: int
    """Index; -1 if nothing was found."""
    x: int
    y: int
    left: float
    """Upper bound of the score of a pose not evaluated; 0 after a complete search."""


def _searched(place: _Place, least: float, enough: float, zone: _Zone, work: float) -> Pieces[_SearchEnd]:
    """Search best-first, in pieces."""
    count = place[1].shape[1]
    state: _State = (least, -1, 0, 0, 0, 0, np.empty(1024), np.empty((1024, 4), np.int32))
    left = work
    while True:
        most = int(min(PIECE / count, left))
        yield float(most * count)
        state, bound, done = _search(*place, *zone, enough, most, state)
        left -= most
        best, turn, x, y = state[:4]
        if done or left <= 0:
            return _SearchEnd(float(best) if turn >= 0 else 0.0, turn, x, y, 0.0 if done else float(bound))


def _lever(points: Array) -> float:
    """Return the typical range of ``points``, m: their displacement per radian of yaw."""
    return float(np.clip(np.percentile(np.hypot(points[:, 0], points[:, 1]), 80), 1.0, 12.0))


@njit(cache=True)
def _stamp(grid: Pyramid, points: Array, normals: Array, extents: Array, x0: float, y0: float) -> None:
    for i in range(points.shape[0]):
        half = min(extents[i], LONGEST_ELEMENT)
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
    # Standard deviation of the likelihood around a surface, m: cell size, noise and half a step of the search.
    smear = 0.08
    for k in range(2 * half + 1):
        dx = (cx - half + k + 0.5 - px) * RESOLUTION
        along[k] = math.exp(-0.5 * dx * dx / (smear * smear))
    for gy in range(cy - half, cy + half + 1):
        dy = (gy + 0.5 - py) * RESOLUTION
        across = 255 * math.exp(-0.5 * dy * dy / (smear * smear))
        for k in range(2 * half + 1):
            value = np.uint8(across * along[k])
            grid[gy, cx - half + k] = max(grid[gy, cx - half + k], value)


def _pool(source: Pyramid, target: Pyramid, step: int) -> None:
    """Compute the maximum of each cell and those ``step`` further right, up, and both; the edges are continued."""
    right = source.copy()
    np.maximum(source[:, :-step], source[:, step:], out=right[:, :-step])
    np.maximum(source[:, -step:], source[:, -1:], out=right[:, -step:])
    np.maximum(right[:-step], right[step:], out=target[:-step])
    np.maximum(right[-step:], right[-1:], out=target[-step:])


@njit(cache=True)
def _rotated(points: Array, guess: Array, turns: Array, x0: float, y0: float) -> Blocks:
    """Return the cells of the points at the guess, for every turn: shape (turns, points, 2)."""
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
def _bound(level: Pyramid, offsets: Blocks, ix: int, iy: int, least: float) -> float:
    """Return an upper bound of a block's scores; any number below ``least`` if it cannot reach that."""
    rows, columns = level.shape
    count = offsets.shape[0]
    total, missed = np.int64(0), np.int64(0)
    most = int(255.0 * count * (1.0 - least)) + 255
    for i in range(count):
        x, y = offsets[i, 0] + ix, offsets[i, 1] + iy
        if 0 <= x < columns and 0 <= y < rows:
            value = np.int64(level[y, x])
            total += value
            missed += 255 - value
        else:
            missed += 255
        if missed > most:
            break
    return float(total / (255.0 * count))


def _top(levels: int, cells: int) -> int:
    """Return the level of the blocks with which a search begins."""
    top = levels - 1
    while top > 0 and (1 << top) > 2 * cells:
        top -= 1
    return top


def _per_axis(cells: int, top: int) -> int:
    """Return the number of blocks of level ``top`` along each axis of a window."""
    return (2 * cells + (1 << top)) // (1 << top)


@njit(cache=True)
def _least_square(low: int, width: int) -> int:
    """Return the minimum square of the integers low .. low + width - 1."""
    high = low + width - 1
    if low > 0:
        return low * low
    if high < 0:
        return high * high
    return 0


@njit(cache=True)
def _coarsest(
    level: Pyramid, offsets: Blocks, turns: Array, first: int, most: int, top: int, cells: int, by_cell: float,
    by_turn: float, least: float,
) -> tuple[Blocks, Array]:  # fmt: skip
    """Return blocks (turn index, x, y, level) of the coarsest level for ``most`` turns from ``first``, with bounds."""
    width = 1 << top
    per_axis = (2 * cells + width) // width
    last = min(first + most, turns.size)
    count = (last - first) * per_axis * per_axis
    bounds = np.empty(count)
    blocks = np.empty((count, 4), np.int32)
    n = 0
    for k in range(first, last):
        for by in range(per_axis):
            for bx in range(per_axis):
                ix, iy = -cells + bx * width, -cells + by * width
                doubt = by_turn * turns[k] ** 2
                doubt += by_cell * (_least_square(ix, width) + _least_square(iy, width))
                bounds[n] = _bound(level, offsets[k], ix, iy, least + doubt) - doubt
                blocks[n, 0], blocks[n, 1], blocks[n, 2], blocks[n, 3] = k, ix, iy, top
                n += 1
    return blocks, bounds


_State = tuple[float, int, int, int, int, int, Array, Blocks]
"""State of a search: best score, its turn index, x and y, taken coarsest blocks, and the heap of the rest."""


@njit(cache=True)
def _search(
    levels: Pyramid, offsets: Blocks, turns: Array, cells: int, by_cell: float, by_turn: float, blocks: Blocks,
    bounds: Array, shut_k: int, shut_x: float, shut_y: float, shut_cells: float, shut_turns: float, enough: float,
    most: int, state: _State,
) -> tuple[_State, float, bool]:  # fmt: skip
    """Search by best-first branch and bound; return the state, the bound of unevaluated poses, and whether it is done.

    The turn index is -1 if no pose reached the initial ``best``. The search begins with the sorted ``blocks`` of the
    coarsest level, and pauses after evaluating more than ``most`` blocks below it. The block with the largest bound is
    next, whatever its size: an interrupted depth-first search would have seen one corner of a large window instead of
    the place that fits. Poses within ``shut_cells`` and ``shut_turns`` of (shut_x, shut_y, shut_k) are excluded. A pose
    that scores more than ``enough`` ends the search.
    """
    best, best_k, best_x, best_y, taken, size, keys, heap = state
    work, done = 0, False
    # Blocks below the coarsest level wait in a heap.
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
            done = True
            break
        if bound <= best or best > enough:
            done = True
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
            bound = _bound(levels[level - 1], offsets[k], cx, cy, best + doubt) - doubt
            work += 1
            if bound <= best:
                continue
            if size == keys.size:
                keys, heap = np.concatenate((keys, np.empty(size))), np.concatenate((heap, np.empty_like(heap)))
            _float(keys, heap, size, bound, k, cx, cy, level - 1)
            size += 1
    left = max(keys[0] if size else 0.0, bounds[taken] if taken < bounds.size else 0.0)
    return (best, best_k, best_x, best_y, taken, size, keys, heap), left, done


@njit(cache=True)
def _float(keys: Array, heap: Blocks, at: int, bound: float, k: int, x: int, y: int, level: int) -> None:
    """Add a block to the end of the heap, ``at``, and restore the heap."""
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
    """Move the last block, ``size``, to the place of the first, which was removed, and restore the heap."""
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


@dataclass
class Submap:
    """A cloud and, on request, its likelihood pyramids."""

    cloud: Cloud
    _grids: dict[int, LikelihoodGrid] = field(default_factory=dict)

    def grid_cost(self, levels: int) -> float:
        """Return the work of making that grid; 0 once it exists."""
        if levels in self._grids:
            return 0.0
        edges = (self.cloud.points.max(axis=0) - self.cloud.points.min(axis=0)) / RESOLUTION + (2 << (levels - 1))
        return Work.DRAWN * len(self.cloud.points) + Work.CELL * levels * float(edges.prod())

    def grid(self, levels: int) -> LikelihoodGrid:
        """Return a likelihood pyramid of at least this many levels."""
        known = self._grids.get(levels)
        if known is None:
            known = self._grids[levels] = LikelihoodGrid.of(self.cloud, levels)
        return known


def merged(scans: Sequence[Scan], poses: Array) -> Scan:
    """Return the elements of all ``scans`` at ``poses`` (shape (n, 3)), averaged on the same piece of surface."""
    points, normals, variances, extents = [], [], [], []
    for scan, pose in zip(scans, poses, strict=True):
        turn = rotation(pose[2]).T
        points.append(scan.points @ turn + pose[:2])
        normals.append(scan.normals @ turn)
        variances.append(scan.variances)
        extents.append(scan.extents)
    every = np.concatenate(points), np.concatenate(normals), np.concatenate(variances), np.concatenate(extents)
    merge_cell = 0.05  # edge of the squares within which elements with the same orientation are merged, m
    # Cell and octant of the normal identify the piece of surface.
    cells = np.floor(every[0] / merge_cell).astype(np.int64)
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
    """Return the means of runs of equal keys; points are weighted by how well they lie on their surface."""
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
