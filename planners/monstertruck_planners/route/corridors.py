"""Corridors on the coarse grid: gaps too narrow for the footprint, and alternative paths. Loads numba.

The cost to go treats the vehicle as a point with a radius. It therefore leads the search into gaps wide enough for a
circle inside the footprint, but not for the footprint. Checking every cell and heading of a map would take longer than
the search, so only cells on the paths in question are checked.

Alternatives to the shortest path (other homotopy classes) come from the sum of the costs to the goal and from the
start, which is the cost of the shortest path over a cell. The cheapest cell far from all known paths leads to a new
one.
"""

from math import ceil, pi

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.collision_kernels import FieldData, FootprintData, safe_distance
from monstertruck_planners.route.heuristic import NEIGHBOURS, UNREACHED


@njit(cache=True)
def footprint_fits(field: FieldData, footprint: FootprintData, margin: float, x: float, y: float) -> bool:
    """Whether the footprint is free at a position in any heading."""
    symmetric = abs(footprint.centre) < 1e-9 and abs(footprint.discs.sum()) < 1e-9
    headings = 72  # headings over half a turn
    count = (1 if symmetric else 2) * headings
    for k in range(count):
        # 29: step between headings tried in sequence: neighbouring headings mostly give the same result
        if safe_distance(field, footprint, margin, x, y, (k * 29 % count) * pi / headings) >= 0.0:
            return True
    return False


@njit(cache=True)
def _fits_in_cell(
    field: FieldData, footprint: FootprintData, margin: float, row: int, column: int, factor: int, wide: float
) -> bool:
    """Whether the footprint fits anywhere in a coarse cell."""
    rows, columns = field.distance.shape
    least = footprint.inscribed + margin
    last_row, last_column = min((row + 1) * factor, rows), min((column + 1) * factor, columns)
    for r in range(row * factor, last_row):
        for c in range(column * factor, last_column):
            if field.distance[r, c] >= wide:
                return True
    # 0.0125: distance between two positions checked, m; middles and borders of the grid's cells are among them
    pieces = 2 * ceil(0.5 * field.resolution / 0.0125)
    places = pieces + 1
    for r in range(row * factor, last_row):
        for c in range(column * factor, last_column):
            if field.distance[r, c] < least:
                continue
            for k in range(places * places):
                along = (c + k % places / pieces) * field.resolution
                across = (r + k // places / pieces) * field.resolution
                x = field.x + along * field.cos - across * field.sin
                y = field.y + along * field.sin + across * field.cos
                if footprint_fits(field, footprint, margin, x, y):
                    return True
    return False


@njit(cache=True)
def close_narrow_gaps(
    field: FieldData, footprint: FootprintData, margin: float, cell_cost: NDArray[np.int16], factor: int, wide: float,
    step: NDArray[np.int8], row: int, column: int, radius: float, checked: NDArray[np.bool_],
) -> int:  # fmt: skip
    """Close the coarse cells around a path that are too narrow for the footprint.

    Args:
        field: the fine grid.
        footprint: footprint of the vehicle.
        margin: required clearance (m).
        cell_cost: costs of the coarse cells, 0 for closed cells, see ``heuristic.cell_costs``; changed in place.
        factor: fine cells per coarse cell in each direction.
        wide: distance to obstacles beyond which cells are considered open (m).
        step: see ``CostToGo``.
        row: row of the cell where the path begins.
        column: column of the path's first cell.
        radius: radius around the path in which cells are checked (cells).
        checked: mask of checked cells; changed in place.

    Returns:
        Number of closed cells.
    """
    closed = 0
    rows, columns = cell_cost.shape
    span = int(radius)
    while True:
        for r in range(max(row - span, 0), min(row + span + 1, rows)):
            for c in range(max(column - span, 0), min(column + span + 1, columns)):
                if checked[r, c] or (r - row) ** 2 + (c - column) ** 2 > radius * radius:
                    continue
                checked[r, c] = True
                if cell_cost[r, c] > 0 and not _fits_in_cell(field, footprint, margin, r, c, factor, wide):
                    cell_cost[r, c] = 0
                    closed += 1
        k = step[row, column]
        if k < 0:
            return closed
        row += NEIGHBOURS[k, 1]
        column += NEIGHBOURS[k, 0]


@njit(cache=True)
def _mark_disc(mask: NDArray[np.bool_], row: int, column: int, radius: float) -> None:
    """Mark the cells around a cell."""
    rows, columns = mask.shape
    span = int(radius)
    for r in range(max(row - span, 0), min(row + span + 1, rows)):
        for c in range(max(column - span, 0), min(column + span + 1, columns)):
            if (r - row) ** 2 + (c - column) ** 2 <= radius * radius:
                mask[r, c] = True


@njit(cache=True)
def mark_corridor(mask: NDArray[np.bool_], step: NDArray[np.int8], row: int, column: int, radius: float) -> None:
    """Mark the cells within ``radius`` cells of the path from a cell along ``step``."""
    while True:
        _mark_disc(mask, row, column, radius)
        k = step[row, column]
        if k < 0:
            return
        row += NEIGHBOURS[k, 1]
        column += NEIGHBOURS[k, 0]


@njit(cache=True)
def cheapest_unmarked(
    to_goal: NDArray[np.int32], from_start: NDArray[np.int32], marked: NDArray[np.bool_], limit: int
) -> int:
    """Return the flat index of the unmarked cell with the cheapest path over it; -1 if none costs at most ``limit``."""
    best, where = limit + 1, -1
    rows, columns = marked.shape
    for row in range(rows):
        for column in range(columns):
            if marked[row, column] or to_goal[row, column] >= UNREACHED or from_start[row, column] >= UNREACHED:
                continue
            cost = to_goal[row, column] + from_start[row, column]
            if cost < best:
                best, where = cost, row * columns + column
    return where
