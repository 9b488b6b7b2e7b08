"""Length of the shortest way to the goal round the obstacles, for a point, on a coarse grid, compiled.

The first of the two heuristics, and the guide of the search: every cell also knows its next one. A coarse cell is open
if any cell inside it may hold the middle of the footprint; near obstacles a metre counts more: the truck is no point.
"""

from functools import lru_cache
from math import cos, floor, inf, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import FieldData
from monstertruck_planners.route.reeds_shepp import COST, MOST_ROWS, connect

UNIT = 100
"""Cost of a step to the next column or row in the open."""

FAR = 2**30
BUCKETS = 1024
"""More than the cost of the dearest step."""

STEPS = np.array([[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]], dtype=np.int64)
"""Column and row of each neighbour, counter-clockwise."""

DEAREST = 7.0
"""Greatest cost of a step, in those in the open: keeps within the buckets."""

COARSE = 0.1
"""Cells are joined up to about this size, m."""


class ToGo(NamedTuple):
    """Ways to the goal over the ringed grid of a field."""

    cost: NDArray[np.int32]
    """In 1/UNIT cells; FAR where no way is known."""
    step: NDArray[np.int8]
    """Index of the neighbour that is next, -1 at the goal."""
    toll: NDArray[np.int16]
    """Cost of a straight step into the cell, 0 = closed."""
    cell: float
    """Size, m."""


@njit(cache=True)
def tolls(
    field: FieldData, price: NDArray[np.float32], factor: int, closed: float, side: float, wide: float
) -> NDArray[np.int16]:
    """Cost of a straight step into each coarse cell.

    Args:
        field: the fine grid.
        price: extra cost of a metre in each of its cells, see ``pricing.Layer``.
        factor: fine cells per coarse one, each way.
        closed: nearer to obstacles than this no pose can be free, m: 0.
        side: nearer than this only the footprint's ends may be, m: four times UNIT.
        wide: from here on UNIT, half as much more at ``side``, m.
    """
    rows, columns = field.distance.shape
    height, width = (rows + factor - 1) // factor, (columns + factor - 1) // factor
    result = np.zeros((height, width), np.int16)
    for row in range(height):
        for column in range(width):
            best, extra = np.float32(0.0), np.inf
            for r in range(row * factor, min((row + 1) * factor, rows)):
                for c in range(column * factor, min((column + 1) * factor, columns)):
                    best = max(best, field.distance[r, c])
                    if price.size > 0:
                        extra = min(extra, price[r, c])
            if best < closed:
                continue
            toll = 4.0
            if best >= side:
                toll = 1.0 + 0.5 * max(wide - float(best), 0.0) / (wide - side)
            if price.size > 0:
                toll *= 1.0 + extra
            result[row, column] = int(UNIT * min(toll, DEAREST))
    return result


@njit(cache=True)
def spread(
    toll: NDArray[np.int16], allowed: NDArray[np.bool_], seed_row: int, seed_column: int, stop: int, stretch: float
) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    """Dijkstra with buckets (Dial) from one cell.

    Args:
        toll: see ``ToGo``.
        allowed: shape (0, 0) for the whole grid, or where to stay.
        seed_row: the goal's cell.
        seed_column: the same.
        stop: flat index of a cell; -1 for none. The flood ends at ``stretch`` times its cost, and some cells.
        stretch: see above.

    Returns:
        Cost and next step of every cell.
    """
    rows, columns = toll.shape
    fenced = allowed.size > 0
    cost = np.full((rows, columns), FAR, np.int32)
    step = np.full((rows, columns), -1, np.int8)
    head = np.full(BUCKETS, -1, np.int32)
    most = 8 * rows * columns + 1
    following, cell_of = np.empty(most, np.int32), np.empty(most, np.int32)
    used, waiting = 1, 1
    cost[seed_row, seed_column] = 0
    cell_of[0], following[0], head[0] = seed_row * columns + seed_column, -1, 0
    level, limit = 0, FAR
    while waiting > 0 and level <= limit:
        bucket = level % BUCKETS
        entry = head[bucket]
        if entry < 0:
            level += 1
            continue
        head[bucket] = following[entry]
        waiting -= 1
        flat = cell_of[entry]
        row, column = flat // columns, flat % columns
        if cost[row, column] != level:
            continue
        if flat == stop:
            limit = min(limit, int(stretch * level) + 40 * UNIT)
        for k in range(8):
            r, c = row + STEPS[k, 1], column + STEPS[k, 0]
            if not (0 <= r < rows and 0 <= c < columns) or toll[r, c] == 0 or (fenced and not allowed[r, c]):
                continue
            price = int(toll[r, c]) + int(toll[row, column]) if toll[row, column] > 0 else 2 * int(toll[r, c])
            if k & 1:
                if toll[row, c] == 0 or toll[r, column] == 0:
                    continue
                price = price * 141 // 200
            else:
                price //= 2
            if level + price < cost[r, c]:
                cost[r, c] = level + price
                step[r, c] = (k + 4) & 7
                cell_of[used], following[used] = r * columns + c, head[(level + price) % BUCKETS]
                head[(level + price) % BUCKETS] = used
                used += 1
                waiting += 1
    return cost, step


@njit(cache=True)
def cell_at(field: FieldData, cell: float, x: float, y: float) -> tuple[int, int]:
    """(row, column) of the coarse cell at a point; outside the grid too."""
    dx, dy = x - field.x, y - field.y
    return (
        int(np.floor((dy * field.cos - dx * field.sin) / cell)),
        int(np.floor((dx * field.cos + dy * field.sin) / cell)),
    )


@njit(cache=True)
def walk(step: NDArray[np.int8], row: int, column: int, length: float) -> tuple[int, int]:
    """Cell reached after ``length`` cells along the way to the goal, or the goal's."""
    while length > 0.0:
        k = step[row, column]
        if k < 0:
            break
        row += STEPS[k, 1]
        column += STEPS[k, 0]
        length -= 1.4142135623730951 if k & 1 else 1.0
    return row, column


@njit(cache=True)
def cells_on_way(step: NDArray[np.int8], row: int, column: int) -> NDArray[np.int64]:
    """All cells (row, column) from one to the goal, shape (n, 2)."""
    cells = np.empty((step.size, 2), np.int64)
    used = 0
    while True:
        cells[used, 0], cells[used, 1] = row, column
        used += 1
        k = step[row, column]
        if k < 0 or used == len(cells):
            return cells[:used].copy()
        row += STEPS[k, 1]
        column += STEPS[k, 0]


TABLE_REACH = 4.0
"""Half size of the table, turning radii."""
TABLE_SPACING = 0.25
TABLE_HEADINGS = 36


@njit(cache=True)
def _fill(crab: float) -> NDArray[np.float32]:
    across = round(2 * TABLE_REACH / TABLE_SPACING) + 1
    table = np.empty((across, (across + 1) // 2, TABLE_HEADINGS), np.float32)
    start, goal = np.zeros(3), np.zeros(3)
    rows, best, scratch = np.empty((MOST_ROWS, 3)), np.full(8, inf), np.empty((4, 3))
    weights = np.array([1.0, 0.0, 1.0])
    for i in range(across):
        for j in range((across + 1) // 2):
            for k in range(TABLE_HEADINGS):
                goal[0], goal[1], goal[2] = (
                    i * TABLE_SPACING - TABLE_REACH,
                    j * TABLE_SPACING,
                    2 * pi * k / TABLE_HEADINGS,
                )
                connect(start, goal, 1.0, crab, weights, rows, best, scratch)
                table[i, j, k] = best[COST]
    return table


@lru_cache(maxsize=8)
def turning_table(crab: float) -> NDArray[np.float32]:
    """Lengths from the origin, shape (x from -TABLE_REACH, y from 0, heading from 0)."""
    return np.asarray(_fill(crab))


@njit(cache=True)
def turning_bound(table: NDArray[np.float32], radius: float, x: float, y: float, yaw: float, goal: Array) -> float:
    """Length in metres from a pose to the goal, at the nearest entry; the straight distance beyond the table."""
    dx, dy = (x - goal[0]) / radius, (y - goal[1]) / radius
    # The way back is as long: look from the goal.
    c, s = cos(goal[2]), sin(goal[2])
    px, py, turn = dx * c + dy * s, dy * c - dx * s, yaw - goal[2]
    if abs(px) > TABLE_REACH or abs(py) > TABLE_REACH:
        return radius * sqrt(px * px + py * py)
    if py < 0.0:
        py, turn = -py, -turn
    k = floor(turn / (2 * pi) * TABLE_HEADINGS + 0.5) % TABLE_HEADINGS
    return radius * float(table[int((px + TABLE_REACH) / TABLE_SPACING + 0.5), int(py / TABLE_SPACING + 0.5), k])


@njit(cache=True)
def estimate(
    field: FieldData, go: ToGo, table: NDArray[np.float32], radius: float, goal: Array, x: float, y: float, yaw: float
) -> float:
    """The greater of both heuristics, m; inf off the known ways."""
    row, column = cell_at(field, go.cell, x, y)
    if not (0 <= row < go.cost.shape[0] and 0 <= column < go.cost.shape[1]) or go.cost[row, column] >= FAR:
        return inf
    return float(max(go.cost[row, column] * go.cell / UNIT, turning_bound(table, radius, x, y, yaw, goal)))
