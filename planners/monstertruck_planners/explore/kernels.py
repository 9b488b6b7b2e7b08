"""Visibility in a partly unknown map. Loads numba."""

from math import cos, floor, sin

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import OCCUPIED


@njit(cache=True)
def sees(cells: NDArray[np.int8], x: float, y: float, to_x: float, to_y: float) -> bool:
    """Whether the line between two places (cells) is free of obstacles; unknown cells are treated as free."""
    dx, dy = to_x - x, to_y - y
    steps = int(max(abs(dx), abs(dy)) * 1.5) + 1
    rows, columns = cells.shape
    for i in range(steps):
        row, column = floor(y + dy * i / steps), floor(x + dx * i / steps)
        if not (0 <= row < rows and 0 <= column < columns):
            return True
        if cells[row, column] >= OCCUPIED:
            return False
    return True


@njit(cache=True)
def far_from_obstacles(
    cells: NDArray[np.int8], rows: NDArray[np.int64], columns: NDArray[np.int64], least: float
) -> NDArray[np.bool_]:
    """Whether the centre of each cell is at least ``least`` (cells) from all obstacle centres, shape (n,)."""
    result = np.ones(len(rows), np.bool_)
    around = int(least)
    for k in range(len(rows)):
        for row in range(max(rows[k] - around, 0), min(rows[k] + around + 1, cells.shape[0])):
            for column in range(max(columns[k] - around, 0), min(columns[k] + around + 1, cells.shape[1])):
                away = (row - rows[k]) ** 2 + (column - columns[k]) ** 2
                if cells[row, column] >= OCCUPIED and away < least * least:
                    result[k] = False
    return result


@njit(cache=True)
def new_area(
    cells: NDArray[np.int8], x: float, y: float, heading: float, view: float, reach: float, depth: float, beams: int
) -> float:
    """Unknown area that a scan would show (cells): up to known obstacles, and ``depth`` into unknown ground.

    Args:
        cells: map.
        x: x of the sensor (cells).
        y: y of the sensor (cells).
        heading: heading of the sensor (rad).
        view: angle of view (rad).
        reach: range (cells).
        depth: maximum depth into unknown ground (cells).
        beams: number of simulated beams.
    """
    rows, columns = cells.shape
    width = view / beams
    area = 0.0
    for i in range(beams):
        angle = heading - view / 2 + (i + 0.5) * width
        c, s = cos(angle), sin(angle)
        unknown, along = 0.0, 0.5
        while along < reach and unknown < depth:
            row, column = floor(y + along * s), floor(x + along * c)
            value = -1
            if 0 <= row < rows and 0 <= column < columns:
                value = cells[row, column]
            if value >= OCCUPIED:
                break
            if value < 0:
                area += along * width
                unknown += 1.0
            along += 1.0
    return area


@njit(cache=True)
def new_areas(
    cells: NDArray[np.int8], places: Array, view: float, reach: float, depth: float, beams: int
) -> Array:  # fmt: skip
    """``new_area`` at each place (x, y, heading; cells and rad), shape (n, 3); result of shape (n,)."""
    result = np.empty(len(places))
    for i in range(len(places)):
        result[i] = new_area(cells, places[i, 0], places[i, 1], places[i, 2], view, reach, depth, beams)
    return result


@njit(cache=True)
def shares_seen(cells: NDArray[np.int8], places: Array, points: Array, reach: float) -> Array:
    """Fraction of the points (m, 2) visible from each place (n, 2) within ``reach``, all in cells."""
    result = np.empty(len(places))
    for i in range(len(places)):
        count = 0
        for j in range(len(points)):
            dx, dy = points[j, 0] - places[i, 0], points[j, 1] - places[i, 1]
            if dx * dx + dy * dy <= reach * reach and sees(
                cells, places[i, 0], places[i, 1], points[j, 0], points[j, 1]
            ):
                count += 1
        result[i] = count / max(len(points), 1)
    return result
