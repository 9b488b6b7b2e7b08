"""Other ways round the obstacles than the shortest one, found on the coarse grid, compiled.

With the cost to the goal and from the start of every cell their sum is the cost of the shortest way over that cell. The
cheapest cell far from all ways known so far leads to a new one.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.route.distance_to_go import FAR, STEPS

IntArray = NDArray[np.int64]


@njit(cache=True)
def brush(mask: NDArray[np.bool_], row: int, column: int, radius: float) -> None:
    """Mark the cells round one."""
    rows, columns = mask.shape
    span = int(radius)
    for r in range(max(row - span, 0), min(row + span + 1, rows)):
        for c in range(max(column - span, 0), min(column + span + 1, columns)):
            if (r - row) ** 2 + (c - column) ** 2 <= radius * radius:
                mask[r, c] = True


@njit(cache=True)
def brush_way(mask: NDArray[np.bool_], step: NDArray[np.int8], row: int, column: int, radius: float) -> None:
    """Mark the cells round the way from one to where ``step`` ends."""
    while True:
        brush(mask, row, column, radius)
        k = step[row, column]
        if k < 0:
            return
        row += STEPS[k, 1]
        column += STEPS[k, 0]


@njit(cache=True)
def cheapest_new(
    to_goal: NDArray[np.int32], from_start: NDArray[np.int32], known: NDArray[np.bool_], limit: int
) -> int:
    """Flat index of the unknown cell with the cheapest way over it; -1 if none costs at most ``limit``."""
    best, where = limit + 1, -1
    rows, columns = known.shape
    for row in range(rows):
        for column in range(columns):
            if known[row, column] or to_goal[row, column] >= FAR or from_start[row, column] >= FAR:
                continue
            cost = to_goal[row, column] + from_start[row, column]
            if cost < best:
                best, where = cost, row * columns + column
    return where
