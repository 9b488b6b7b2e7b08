"""Closes gaps into which the footprint fits in no heading, though a circle inside it does. Compiled.

``distance_to_go`` sees the truck as a point with a radius, so it leads the search into slits. Looking at every cell and
heading of a map would take longer than the search: only cells on the ways that matter are looked at.
"""

from math import ceil, pi

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.collision_kernels import BodyData, FieldData, room
from monstertruck_planners.route.heuristic import FAR, STEPS

IntArray = NDArray[np.int64]
HEADINGS = 72
"""Looked at in half a turn."""

STRIDE = 29
"""Between two headings tried in turn: neighbours fit or do not fit alike."""

SAMPLE = 0.0125
"""Between two places looked at, m; middles and borders of the grid's cells are among them."""


@njit(cache=True)
def fits(field: FieldData, body: BodyData, margin: float, x: float, y: float) -> bool:
    """Whether the footprint is free at a place in any heading."""
    whole = 1 if abs(body.centre) < 1e-9 and abs(body.discs.sum()) < 1e-9 else 2
    count = whole * HEADINGS
    for k in range(count):  # noqa: SIM110 - compiled
        if room(field, body, margin, x, y, (k * STRIDE % count) * pi / HEADINGS) >= 0.0:
            return True
    return False


@njit(cache=True)
def _fits_in(field: FieldData, body: BodyData, margin: float, row: int, column: int, factor: int, wide: float) -> bool:
    """Whether the footprint fits anywhere in a coarse cell."""
    rows, columns = field.distance.shape
    least = body.inscribed + margin
    last_row, last_column = min((row + 1) * factor, rows), min((column + 1) * factor, columns)
    for r in range(row * factor, last_row):
        for c in range(column * factor, last_column):
            if field.distance[r, c] >= wide:
                return True
    pieces = 2 * ceil(0.5 * field.resolution / SAMPLE)
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
                if fits(field, body, margin, x, y):
                    return True
    return False


@njit(cache=True)
def close_slits(
    field: FieldData, body: BodyData, margin: float, toll: NDArray[np.int16], factor: int, wide: float,
    lane: NDArray[np.bool_], looked: NDArray[np.bool_],
) -> int:  # fmt: skip
    """Close the coarse cells of a lane in which the footprint fits nowhere.

    Args:
        field: the fine grid.
        body: the footprint.
        margin: to keep, m.
        toll: of the coarse cells, 0 = closed, see ``distance_to_go.tolls``; changed in place.
        factor: fine cells per coarse one, each way.
        wide: cells further than this from obstacles are taken to be open, m.
        lane: coarse cells to be looked at.
        looked: those that have been; changed in place.

    Returns:
        Number of cells closed.
    """
    closed = 0
    rows, columns = toll.shape
    for row in range(rows):
        for column in range(columns):
            if not lane[row, column] or looked[row, column]:
                continue
            looked[row, column] = True
            if toll[row, column] > 0 and not _fits_in(field, body, margin, row, column, factor, wide):
                toll[row, column] = 0
                closed += 1
    return closed


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
