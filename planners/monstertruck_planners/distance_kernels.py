"""Exact distance transform of a grid, whole and around changes. Loads numba.

Distances in whole cells along each column come first; along each row the lower envelope of the parabolas over these
gives the squared Euclidean ones. Source: P. F. Felzenszwalb, D. P. Huttenlocher, "Distance transforms of sampled
functions", Theory of Computing 8, 2012.
"""

from math import sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array

Box = tuple[int, int, int, int]
"""First row, first column, and the row and column after the last."""


@njit(cache=True)
def _envelope(heights: Array, count: int, places: NDArray[np.int64], borders: Array) -> int:
    """Compute the lower envelope of the parabolas (x - places[k])^2 + heights[places[k]]; return their number.

    Args:
        heights: shape (count,); inf for no parabola.
        count: number of heights.
        places: shape (count,), receives the positions of the parabolas on the envelope.
        borders: shape (count,), receives the start of the range in which each parabola is the lowest.
    """
    used = 0
    for q in range(count):
        height = heights[q]
        if height == np.inf:
            continue
        border = -np.inf
        while used > 0:
            p = places[used - 1]
            border = (height + q * q - heights[p] - p * p) / (2.0 * (q - p))
            if border > borders[used - 1]:
                break
            used -= 1
            border = -np.inf
        places[used], borders[used] = q, border
        used += 1
    return used


@njit(cache=True)
def fill_distances(
    occupied: NDArray[np.bool_], resolution: float, context: Box, box: Box, out: NDArray[np.float32]
) -> float:
    """Write the distances from the centres of a box's cells to the centre of the nearest occupied cell.

    Args:
        occupied: the grid.
        resolution: m.
        context: box of the cells that are considered; others count as free.
        box: box to fill, within the context.
        out: array with the grid's shape; the box is written, m.

    Returns:
        The largest distance, in cells.
    """
    top, left, bottom, right = context
    width = right - left
    above = np.full((box[2] - box[0], width), np.inf)
    since = np.full(width, np.inf)
    for row in range(top, box[2]):
        for k in range(width):
            since[k] = 0.0 if occupied[row, left + k] else since[k] + 1.0
        if row >= box[0]:
            above[row - box[0]] = since
    since[:] = np.inf
    for row in range(bottom - 1, box[0] - 1, -1):
        for k in range(width):
            since[k] = 0.0 if occupied[row, left + k] else since[k] + 1.0
        if row < box[2]:
            for k in range(width):
                nearest = min(above[row - box[0], k], since[k])
                above[row - box[0], k] = nearest * nearest
    greatest = 0.0
    places, borders = np.empty(width, np.int64), np.empty(width)
    for row in range(box[0], box[2]):
        heights = above[row - box[0]]
        used = _envelope(heights, width, places, borders)
        i = 0
        for column in range(box[1], box[3]):
            x = column - left
            if used == 0:
                out[row, column] = np.inf
                greatest = np.inf
                continue
            while i + 1 < used and borders[i + 1] < x:
                i += 1
            squared = heights[places[i]] + (x - places[i]) ** 2
            out[row, column] = sqrt(squared) * resolution
            greatest = max(greatest, squared)
    return sqrt(greatest)


@njit(cache=True)
def _greatest(distance: NDArray[np.float32], box: Box) -> float:
    greatest = np.float32(0.0)
    for row in range(box[0], box[2]):
        for column in range(box[1], box[3]):
            greatest = max(greatest, distance[row, column])
    return float(greatest)


@njit(cache=True)
def _greatest_at_edge(distance: NDArray[np.float32], box: Box) -> float:
    """Return the largest distance in the outermost cells of a box, except at sides on the edge of the grid."""
    rows, columns = distance.shape
    greatest = np.float32(0.0)
    for row in range(box[0], box[2]):
        whole = (row == box[0] and row > 0) or (row == box[2] - 1 and row < rows - 1)
        for column in range(box[1], box[3]):
            edge = whole or (column == box[1] and column > 0) or (column == box[3] - 1 and column < columns - 1)
            if edge:
                greatest = max(greatest, distance[row, column])
    return float(greatest)


@njit(cache=True)
def _grown(box: Box, cells: int, rows: int, columns: int) -> Box:
    return (max(box[0] - cells, 0), max(box[1] - cells, 0), min(box[2] + cells, rows), min(box[3] + cells, columns))


@njit(cache=True)
def update_distances(
    distance: NDArray[np.float32], occupied: NDArray[np.bool_], resolution: float, changed: Box
) -> Box:
    """Update distances after cells of a box have changed.

    The distance of a cell is unchanged if the cell was at least as far from the box as from its nearest obstacle.
    Distances of two cells differ by at most the distance between the cells. If the condition holds all around a larger
    box, it therefore holds everywhere beyond that box.

    Args:
        distance: distances before the change, m; updated in place.
        occupied: cells after the change.
        resolution: m.
        changed: box of the changed cells.

    Returns:
        The box in which distances were recomputed.
    """
    rows, columns = occupied.shape
    reach = 8
    while True:
        box = _grown(changed, reach, rows, columns)
        if _greatest_at_edge(distance, box) < (reach - 1.5) * resolution:
            break
        reach *= 2
    margin = int(_greatest(distance, box) / resolution) + 2
    while True:
        context = _grown(box, margin, rows, columns)
        greatest = fill_distances(occupied, resolution, context, box, distance)
        whole = context[2] - context[0] == rows and context[3] - context[1] == columns
        if greatest <= margin or whole:
            return box
        margin *= 2
