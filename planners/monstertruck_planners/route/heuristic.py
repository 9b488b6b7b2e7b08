"""Heuristics of the searches: cost to go on a coarse grid, and length of the obstacle-free motion. Loads numba.

The first one is the shortest way round the obstacles for a point. A coarse cell is open if any cell inside it may hold
the middle of the footprint; near obstacles a metre costs more, because the vehicle is no point. Every cell knows the
next one, which the analytic expansions follow.

The second one is the length of the best motion without obstacles (Reeds-Shepp, with translations), tabulated around
the goal in turning radii, so that one table serves every radius.
"""

from functools import lru_cache
from math import cos, floor, inf, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import FieldData
from monstertruck_planners.route.reeds_shepp import COST, MAX_SEGMENTS, connect

UNIT = 100
"""Cost of a step to the next column or row in the open."""

UNREACHED = 2**30
BUCKETS = 1024
"""More than the greatest cost of a step."""

NEIGHBOURS = np.array([[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]], dtype=np.int64)
"""Column and row of each neighbour, counter-clockwise."""

MAX_CELL_COST = 7.0
"""Greatest cost of a cell as a factor on UNIT: keeps within the buckets."""

COARSE_CELL = 0.1
"""Cells are joined up to about this size, m."""

TABLE_REACH = 4.0
"""Half size of the Reeds-Shepp table, turning radii."""

TABLE_SPACING = 0.25
TABLE_HEADINGS = 36


EVERYWHERE: NDArray[np.bool_] = np.zeros((0, 0), np.bool_)
"""For ``dijkstra``: the whole grid."""


class CostToGo(NamedTuple):
    """Shortest ways to the goal over the ringed grid of a field."""

    cost: NDArray[np.int32]
    """In 1/UNIT cells; UNREACHED where no way is known."""
    step: NDArray[np.int8]
    """Index of the next neighbour on the way, -1 at the goal."""
    cell_cost: NDArray[np.int16]
    """Cost of a straight step into the cell, 0 = closed."""
    cell: float
    """Size, m."""


@njit(cache=True)
def cell_costs(
    field: FieldData, extra_cost: NDArray[np.float32], factor: int, closed: float, side: float, wide: float
) -> NDArray[np.int16]:
    """Cost of a straight step into each coarse cell.

    Args:
        field: the fine grid.
        extra_cost: of a metre in each of its cells, see ``search.CostLayer``.
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
                    if extra_cost.size > 0:
                        extra = min(extra, extra_cost[r, c])
            if best < closed:
                continue
            cost = 4.0
            if best >= side:
                cost = 1.0 + 0.5 * max(wide - float(best), 0.0) / (wide - side)
            if extra_cost.size > 0:
                cost *= 1.0 + extra
            result[row, column] = int(UNIT * min(cost, MAX_CELL_COST))
    return result


@njit(cache=True)
def dijkstra(
    cell_cost: NDArray[np.int16], allowed: NDArray[np.bool_], goal_row: int, goal_column: int, stop: int, overrun: float
) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    """Dijkstra's search with buckets (Dial) from the goal's cell.

    Args:
        cell_cost: see ``CostToGo``.
        allowed: the cells to stay in, or EVERYWHERE.
        goal_row: where the search begins.
        goal_column: the same.
        stop: flat index of a cell; -1 for none. The search ends at ``overrun`` times its cost, and some cells.
        overrun: see above.

    Returns:
        Cost and next step of every cell.
    """
    rows, columns = cell_cost.shape
    fenced = allowed.size > 0
    cost = np.full((rows, columns), UNREACHED, np.int32)
    step = np.full((rows, columns), -1, np.int8)
    head = np.full(BUCKETS, -1, np.int32)
    most = 8 * rows * columns + 1
    following, cell_of = np.empty(most, np.int32), np.empty(most, np.int32)
    used, waiting = 1, 1
    cost[goal_row, goal_column] = 0
    cell_of[0], following[0], head[0] = goal_row * columns + goal_column, -1, 0
    level, limit = 0, UNREACHED
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
            limit = min(limit, int(overrun * level) + 40 * UNIT)
        here = int(cell_cost[row, column])
        for k in range(8):
            r, c = row + NEIGHBOURS[k, 1], column + NEIGHBOURS[k, 0]
            if not (0 <= r < rows and 0 <= c < columns) or cell_cost[r, c] == 0 or (fenced and not allowed[r, c]):
                continue
            there = int(cell_cost[r, c])
            step_cost = there + here if here > 0 else 2 * there
            if k & 1:
                if cell_cost[row, c] == 0 or cell_cost[r, column] == 0:
                    continue
                step_cost = step_cost * 141 // 200
            else:
                step_cost //= 2
            if level + step_cost < cost[r, c]:
                cost[r, c] = level + step_cost
                step[r, c] = (k + 4) & 7
                cell_of[used], following[used] = r * columns + c, head[(level + step_cost) % BUCKETS]
                head[(level + step_cost) % BUCKETS] = used
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
def cell_ahead(step: NDArray[np.int8], row: int, column: int, length: float) -> tuple[int, int]:
    """Cell reached after ``length`` cells along the way to the goal, or the goal's."""
    while length > 0.0:
        k = step[row, column]
        if k < 0:
            break
        row += NEIGHBOURS[k, 1]
        column += NEIGHBOURS[k, 0]
        length -= 1.4142135623730951 if k & 1 else 1.0
    return row, column


@njit(cache=True)
def cells_to_goal(step: NDArray[np.int8], row: int, column: int) -> NDArray[np.int64]:
    """All cells (row, column) from one to the goal, shape (n, 2)."""
    cells = np.empty((step.size, 2), np.int64)
    used = 0
    while True:
        cells[used, 0], cells[used, 1] = row, column
        used += 1
        k = step[row, column]
        if k < 0 or used == len(cells):
            return cells[:used].copy()
        row += NEIGHBOURS[k, 1]
        column += NEIGHBOURS[k, 0]


@njit(cache=True)
def _fill_table(crab: float) -> NDArray[np.float32]:
    across = round(2 * TABLE_REACH / TABLE_SPACING) + 1
    table = np.empty((across, (across + 1) // 2, TABLE_HEADINGS), np.float32)
    start, goal = np.zeros(3), np.zeros(3)
    segments, best, scratch = np.empty((MAX_SEGMENTS, 3)), np.full(8, inf), np.empty((4, 3))
    weights = np.array([1.0, 0.0, 1.0])
    for i in range(across):
        for j in range((across + 1) // 2):
            for k in range(TABLE_HEADINGS):
                goal[0], goal[1] = i * TABLE_SPACING - TABLE_REACH, j * TABLE_SPACING
                goal[2] = 2 * pi * k / TABLE_HEADINGS
                connect(start, goal, 1.0, crab, weights, segments, best, scratch)
                table[i, j, k] = best[COST]
    return table


@lru_cache(maxsize=8)
def reeds_shepp_table(crab: float) -> NDArray[np.float32]:
    """Lengths from the origin in turning radii, shape (x from -TABLE_REACH, y from 0, heading from 0).

    The half of negative y is its mirror image.
    """
    return np.asarray(_fill_table(crab))


@njit(cache=True)
def _reeds_shepp_length(
    table: NDArray[np.float32], radius: float, x: float, y: float, yaw: float, goal: Array
) -> float:
    """Length in metres from a pose to the goal, at the nearest entry; the straight distance beyond the table."""
    dx, dy = (x - goal[0]) / radius, (y - goal[1]) / radius
    # The way back is as long: seen from the goal.
    c, s = cos(goal[2]), sin(goal[2])
    px, py, turn = dx * c + dy * s, dy * c - dx * s, yaw - goal[2]
    if abs(px) > TABLE_REACH or abs(py) > TABLE_REACH:
        return radius * sqrt(px * px + py * py)
    if py < 0.0:
        py, turn = -py, -turn
    k = floor(turn / (2 * pi) * TABLE_HEADINGS + 0.5) % TABLE_HEADINGS
    return radius * float(table[int((px + TABLE_REACH) / TABLE_SPACING + 0.5), int(py / TABLE_SPACING + 0.5), k])


@njit(cache=True)
def heuristic_cost(
    field: FieldData, to_go: CostToGo, table: NDArray[np.float32], radius: float, goal: Array,
    x: float, y: float, yaw: float,
) -> float:  # fmt: skip
    """The greater of both heuristics, m; inf where no way to the goal is known."""
    row, column = cell_at(field, to_go.cell, x, y)
    rows, columns = to_go.cost.shape
    if not (0 <= row < rows and 0 <= column < columns) or to_go.cost[row, column] >= UNREACHED:
        return inf
    grid_cost = to_go.cost[row, column] * to_go.cell / UNIT
    return float(max(grid_cost, _reeds_shepp_length(table, radius, x, y, yaw, goal)))
