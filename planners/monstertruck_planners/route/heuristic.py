"""Heuristics of the searches: cost-to-go on a coarse grid, and length of the obstacle-free motion. Loads numba.

The first heuristic is the shortest path of a point around the obstacles. A coarse cell is open if any cell inside it
may hold the centre of the footprint; distance near obstacles costs more, because the vehicle is not a point. Every cell
stores its successor, which the analytic expansions follow.

The second heuristic is the length of the best motion without obstacles (Reeds-Shepp, with translations), tabulated
around the goal in turning radii, so that one table serves every radius.
"""

from functools import lru_cache
from math import cos, floor, inf, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import FieldData
from monstertruck_planners.distance_kernels import Box
from monstertruck_planners.route.reeds_shepp import COST, MAX_SEGMENTS, connect
from monstertruck_planners.route.search import CostLayer, clearance_cost, extra_cost

UNIT = 100
"""Cost of a step to the next column or row in open space."""

UNREACHED = 2**30

NEIGHBOURS = np.array([[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]], dtype=np.int64)
"""Column and row of each neighbour, counter-clockwise."""


TABLE_REACH = 4.0
"""Half size of the Reeds-Shepp table (turning radii)."""


OVERRUN = 1.3
"""Cost-to-go is computed for cells if the path over them costs at most this factor times the shortest."""


USED, WAITING, LEVEL, LIMIT = 0, 1, 2, 3
"""Fields of a search state: entries used, entries waiting, current estimate, maximum estimate considered."""


class CostToGo(NamedTuple):
    """Shortest paths to the goal over the ringed grid of a field.

    A* from the goal to the start that resumes whenever the cost of an unvisited cell is requested: in open space it
    visits few cells around the shortest path. Its open list is a bucket queue (Dial). Source: D. Silver, "Cooperative
    pathfinding", 2005 (reverse resumable A*).
    """

    cost: NDArray[np.int32]
    """Cost in 1/UNIT cells, see ``cost_at``; UNREACHED where no path is known."""
    step: NDArray[np.int8]
    """Index of the next neighbour on the path, -1 at the goal."""
    cell_cost: NDArray[np.int16]
    """Cost of a straight step into the cell; 0 for a closed cell."""
    cell: float
    """Cell size (m)."""
    start: tuple[int, int]
    """Target row and column of the estimates."""
    least: int
    """Minimum cost of a straight step; 0: no estimates, all directions are searched equally."""
    head: NDArray[np.int32]
    """Latest entry of each bucket, -1 if empty."""
    following: NDArray[np.int32]
    """Next entry in the bucket."""
    cell_of: NDArray[np.int32]
    """Flat index of each entry's cell."""
    state: NDArray[np.int64]
    """See ``USED``."""


class CellRule(NamedTuple):
    """Cost of coarse cells for a vehicle, by distance to obstacles."""

    factor: int
    """Fine cells per coarse cell in each direction."""
    closed: float
    """Distance below which no pose can be free (m): cost 0."""
    side: float
    """Distance below which only the footprint's ends may be (m): cost four times UNIT."""
    wide: float
    """Distance above which the cost is UNIT (m); it rises to 1.5 UNIT at ``side``."""


@njit(cache=True)
def fill_cell_costs(
    distance: NDArray[np.float32], layer: CostLayer, rule: CellRule, box: Box, result: NDArray[np.int16]
) -> None:
    """Cost of a straight step into each coarse cell.

    Args:
        distance: distance of the fine grid with its ring, m.
        layer: layer of extra costs.
        rule: cost rule.
        box: coarse cells to write.
        result: costs in the shape of the coarse grid, 0 for closed cells; written in place.
    """
    rows, columns = distance.shape
    factor = rule.factor
    for row in range(box[0], box[2]):
        for column in range(box[1], box[3]):
            best, extra = np.float32(0.0), np.inf
            for r in range(row * factor, min((row + 1) * factor, rows)):
                for c in range(column * factor, min((column + 1) * factor, columns)):
                    best = max(best, distance[r, c])
                    if layer.terrain.size > 0:
                        extra = min(extra, extra_cost(distance, layer, r, c))
            result[row, column] = 0
            if best < rule.closed:
                continue
            if layer.terrain.size == 0:
                extra = clearance_cost(layer, float(best))
            cost = 4.0
            if best >= rule.side:
                cost = 1.0 + 0.5 * max(rule.wide - float(best), 0.0) / (rule.wide - rule.side)
            # 7.0: maximum cost of a cell as a factor on UNIT, within the range of the buckets
            result[row, column] = int(UNIT * min(cost * (1.0 + extra), 7.0))


def cost_to_go(
    cell_cost: NDArray[np.int16], cell: float, goal: tuple[int, int], start: tuple[int, int],
    least: int = UNIT, overrun: float = OVERRUN,
) -> CostToGo:  # fmt: skip
    """Find paths from the start, and from cells around its path, to the goal; both are cells of the grid.

    Args:
        cell_cost: see ``CostToGo``.
        cell: cell size (m).
        goal: row and column.
        start: row and column.
        least: see ``CostToGo``.
        overrun: see ``OVERRUN``; inf for all cells.
    """
    rows, columns = cell_cost.shape
    most = 8 * rows * columns + 1
    # Upper bound of an estimate's growth per step: the maximum step cost plus the cost of a step in open space.
    buckets = 2048
    to_go = CostToGo(
        np.full((rows, columns), UNREACHED, np.int32), np.full((rows, columns), -1, np.int8), cell_cost, cell, start,
        least, np.full(buckets, -1, np.int32), np.empty(most, np.int32), np.empty(most, np.int32),
        np.array([1, 1, 0, UNREACHED]),
    )  # fmt: skip
    to_go.cost[goal] = 0
    to_go.state[LEVEL] = _estimate(to_go, *goal)
    bucket = int(to_go.state[LEVEL]) % buckets
    to_go.cell_of[0], to_go.following[0], to_go.head[bucket] = goal[0] * columns + goal[1], -1, 0
    shortest = cost_at(to_go, *start)
    if shortest < UNREACHED and overrun < inf:
        to_go.state[LIMIT] = int(overrun * shortest) + 80 * UNIT  # added to that, in cells
    return to_go


@njit(cache=True)
def _estimate(to_go: CostToGo, row: int, column: int) -> int:
    """Return the minimum cost from a cell to the start, without obstacles."""
    across, along = abs(column - to_go.start[1]), abs(row - to_go.start[0])
    few, many = min(across, along), max(across, along)
    return to_go.least * (many - few) + to_go.least * 141 // 100 * few


@njit(cache=True)
def cost_at(to_go: CostToGo, row: int, column: int) -> int:
    """Return the cost from a cell to the goal, in 1/UNIT cells; UNREACHED without a known path."""
    if to_go.cell_cost[row, column] == 0 and to_go.cost[row, column] > 0:
        return UNREACHED
    while to_go.cost[row, column] + _estimate(to_go, row, column) > to_go.state[LEVEL]:
        if to_go.state[WAITING] == 0 or to_go.state[LEVEL] >= to_go.state[LIMIT]:
            break
        _settle_level(to_go)
    return int(to_go.cost[row, column])


@njit(cache=True)
def complete(to_go: CostToGo) -> None:
    """Visit all cells up to the limit."""
    while to_go.state[WAITING] > 0 and to_go.state[LEVEL] < to_go.state[LIMIT]:
        _settle_level(to_go)


@njit(cache=True)
def _settle_level(to_go: CostToGo) -> None:
    """Expand all paths with the current estimate, then continue with the next."""
    rows, columns = to_go.cell_cost.shape
    cost, step, cell_cost, state = to_go.cost, to_go.step, to_go.cell_cost, to_go.state
    level = state[LEVEL]
    buckets = len(to_go.head)
    bucket = level % buckets
    used, waiting = state[USED], state[WAITING]
    while to_go.head[bucket] >= 0:
        entry = to_go.head[bucket]
        to_go.head[bucket] = to_go.following[entry]
        waiting -= 1
        flat = to_go.cell_of[entry]
        row, column = flat // columns, flat % columns
        known = cost[row, column]
        if known + _estimate(to_go, row, column) != level:
            continue
        here = int(cell_cost[row, column])
        for k in range(8):
            r, c = row + NEIGHBOURS[k, 1], column + NEIGHBOURS[k, 0]
            if not (0 <= r < rows and 0 <= c < columns) or cell_cost[r, c] == 0:
                continue
            there = int(cell_cost[r, c])
            step_cost = there + here if here > 0 else 2 * there
            if k & 1:
                if cell_cost[row, c] == 0 or cell_cost[r, column] == 0:
                    continue
                step_cost = step_cost * 141 // 200
            else:
                step_cost //= 2
            if known + step_cost < cost[r, c]:
                cost[r, c] = known + step_cost
                step[r, c] = (k + 4) & 7
                into = (known + step_cost + _estimate(to_go, r, c)) % buckets
                to_go.cell_of[used], to_go.following[used] = r * columns + c, to_go.head[into]
                to_go.head[into] = used
                used += 1
                waiting += 1
    state[USED], state[WAITING], state[LEVEL] = used, waiting, level + 1


@njit(cache=True)
def cell_at(field: FieldData, cell: float, x: float, y: float) -> tuple[int, int]:
    """Return the (row, column) of the coarse cell at a point, also outside the grid."""
    dx, dy = x - field.x, y - field.y
    return (
        int(np.floor((dy * field.cos - dx * field.sin) / cell)),
        int(np.floor((dx * field.cos + dy * field.sin) / cell)),
    )


@njit(cache=True)
def cell_ahead(step: NDArray[np.int8], row: int, column: int, length: float) -> tuple[int, int]:
    """Return the cell after ``length`` cells along the path to the goal, or the goal cell."""
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
    """Return all cells (row, column) from a cell to the goal, shape (n, 2)."""
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
    across, headings = 33, 36
    spacing = 2 * TABLE_REACH / (across - 1)
    table = np.empty((across, (across + 1) // 2, headings), np.float32)
    start, goal = np.zeros(3), np.zeros(3)
    segments, best, scratch = np.empty((MAX_SEGMENTS, 3)), np.full(8, inf), np.empty((4, 3))
    weights = np.array([1.0, 0.0, 1.0])
    for i in range(across):
        for j in range((across + 1) // 2):
            for k in range(headings):
                goal[0], goal[1] = i * spacing - TABLE_REACH, j * spacing
                goal[2] = 2 * pi * k / headings
                connect(start, goal, 1.0, crab, weights, segments, best, scratch)
                table[i, j, k] = best[COST]
    return table


@lru_cache(maxsize=8)
def reeds_shepp_table(crab: float) -> NDArray[np.float32]:
    """Return the lengths from the origin in turning radii, shape (x from -TABLE_REACH, y from 0, heading from 0).

    The half with negative y is its mirror image.
    """
    return np.asarray(_fill_table(crab))


@njit(cache=True)
def _reeds_shepp_length(
    table: NDArray[np.float32], radius: float, x: float, y: float, yaw: float, goal: Array
) -> float:
    """Return the length from a pose to the goal (m), at the nearest entry; the straight distance beyond the table."""
    dx, dy = (x - goal[0]) / radius, (y - goal[1]) / radius
    # The reverse path has the same length, so look up the pose from the goal.
    c, s = cos(goal[2]), sin(goal[2])
    px, py, turn = dx * c + dy * s, dy * c - dx * s, yaw - goal[2]
    if abs(px) > TABLE_REACH or abs(py) > TABLE_REACH:
        return radius * sqrt(px * px + py * py)
    if py < 0.0:
        py, turn = -py, -turn
    spacing, headings = 2 * TABLE_REACH / (table.shape[0] - 1), table.shape[2]
    k = floor(turn / (2 * pi) * headings + 0.5) % headings
    return radius * float(table[int((px + TABLE_REACH) / spacing + 0.5), int(py / spacing + 0.5), k])


@njit(cache=True)
def heuristic_cost(
    field: FieldData, to_go: CostToGo, table: NDArray[np.float32], radius: float, goal: Array,
    x: float, y: float, yaw: float,
) -> float:  # fmt: skip
    """Return the maximum of both heuristics (m); inf without a known path to the goal."""
    row, column = cell_at(field, to_go.cell, x, y)
    rows, columns = to_go.cost.shape
    if not (0 <= row < rows and 0 <= column < columns):
        return inf
    cells = cost_at(to_go, row, column)
    if cells >= UNREACHED:
        return inf
    grid_cost = cells * to_go.cell / UNIT
    return float(max(grid_cost, _reeds_shepp_length(table, radius, x, y, yaw, goal)))
