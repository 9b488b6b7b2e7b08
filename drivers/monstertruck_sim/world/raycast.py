"""Exact ray casting and footprint contact on an occupancy grid, compiled with numba.

A range is the distance to the boundary of the first occupied cell, not a multiple of the cell size. A ray skips the
empty square around its cell, whose size is the grid's ``clearance``: it visits a subset of the cells visited by a
cell-by-cell walk (Amanatides and Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing", 1987), so the range is the
same.
"""

from math import cos, floor, inf, sin, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array

Clearance = NDArray[np.uint8]


@njit(cache=True)
def clearance(occupied: NDArray[np.bool_]) -> Clearance:
    """Return each cell's distance to the nearest occupied cell (Chebyshev, in cells), at most 255.

    Uses two passes, each from one corner over the neighbours already visited.

    Args:
        occupied: (rows, columns).

    Returns:
        (rows, columns), uint8; cells outside the grid count as free.
    """
    rows, columns = occupied.shape
    clear = np.empty((rows, columns), np.uint8)
    for row in range(rows):
        for column in range(columns):
            least = 0 if occupied[row, column] else 255  # distances are counted up to this
            if row > 0:
                for near in range(max(0, column - 1), min(columns, column + 2)):
                    least = min(least, clear[row - 1, near] + 1)
            if column > 0:
                least = min(least, clear[row, column - 1] + 1)
            clear[row, column] = least
    for row in range(rows - 1, -1, -1):
        for column in range(columns - 1, -1, -1):
            least = int(clear[row, column])
            if row < rows - 1:
                for near in range(max(0, column - 1), min(columns, column + 2)):
                    least = min(least, clear[row + 1, near] + 1)
            if column < columns - 1:
                least = min(least, clear[row, column + 1] + 1)
            clear[row, column] = least
    return clear


@njit(cache=True)
def _entry(x: float, direction: float, cells: int) -> float:
    """Distance along a ray at which it enters the range 0 to ``cells`` on one axis; inf if it never does."""
    if 0.0 <= x < cells:
        return 0.0
    if direction == 0.0 or (x < 0.0) != (direction > 0.0):
        return inf
    return (-x if x < 0.0 else cells - x) / direction


@njit(cache=True)
def _walk(clear: Clearance, x: float, y: float, dx: float, dy: float, reach: float) -> float:
    """Distance along (dx, dy) from (x, y) to the first occupied cell, in cells; inf beyond ``reach``."""
    rows, columns = clear.shape
    along = max(_entry(x, dx, columns), _entry(y, dy, rows))
    if along > reach:
        return inf
    column, row = floor(x + along * dx), floor(y + along * dy)
    if along > 0.0:  # on the grid's edge, apart from rounding
        column, row = min(max(column, 0), columns - 1), min(max(row, 0), rows - 1)
    step_x, step_y = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    near_x, near_y = (0 if dx > 0.0 else 1), (0 if dy > 0.0 else 1)
    per_x, per_y = (1.0 / dx if dx != 0.0 else inf), (1.0 / dy if dy != 0.0 else inf)
    while along <= reach:
        free = int(clear[row, column])
        if free == 0:
            return along
        out_x = (column + near_x + step_x * free - x) * per_x if dx != 0.0 else inf
        out_y = (row + near_y + step_y * free - y) * per_y if dy != 0.0 else inf
        if out_x < out_y:
            along = out_x
            column += step_x * free
            row = min(max(floor(y + along * dy), row - free + 1), row + free - 1)
        else:
            along = out_y
            row += step_y * free
            column = min(max(floor(x + along * dx), column - free + 1), column + free - 1)
        if row < 0 or row >= rows or column < 0 or column >= columns:
            return inf
    return inf


@njit(cache=True)
def _to_disc(x: float, y: float, dx: float, dy: float, disc: Array) -> float:
    cx, cy = disc[0] - x, disc[1] - y
    along = cx * dx + cy * dy
    root = disc[2] ** 2 - (cx * cx + cy * cy - along * along)
    if root < 0.0 or along + sqrt(root) < 0.0:
        return inf
    return float(max(0.0, along - sqrt(root)))


@njit(cache=True)
def _to_segment(x: float, y: float, dx: float, dy: float, segment: Array) -> float:
    ex, ey = segment[2] - segment[0], segment[3] - segment[1]
    px, py = segment[0] - x, segment[1] - y
    cross = dx * ey - dy * ex
    if cross == 0.0:
        return inf
    distance = (px * ey - py * ex) / cross
    part = (px * dy - py * dx) / cross
    return distance if distance >= 0.0 and 0.0 <= part <= 1.0 else inf


@njit(cache=True)
def cast_rays(
    clear: Clearance,
    resolution: float,
    origin_x: float,
    origin_y: float,
    xs: Array,
    ys: Array,
    angles: Array,
    reach: float,
    discs: Array,
    segments: Array,
) -> Array:
    """Return the distance to the first hit of each ray (m); inf without a hit within ``reach``.

    Args:
        clear: ``clearance`` of the grid, (rows, columns), row 0 at the lowest y; cells outside the grid count as free.
        resolution: cell side (m).
        origin_x: x of the grid's lower left corner in the map frame (m).
        origin_y: y of the grid's lower left corner in the map frame (m).
        xs: (n,) x of the ray origins in the map frame (m); one per ray, because a sensor may move during its sweep.
        ys: (n,) y of the ray origins (m).
        angles: (n,) ray directions in the map frame (rad).
        reach: maximum distance (m).
        discs: (k, 3) of x, y, radius in the map frame (m).
        segments: (m, 4) of x0, y0, x1, y1 in the map frame (m).

    Returns:
        (n,) float64; 0 where a ray starts inside an occupied cell or a disc.
    """
    ranges = np.empty(len(angles))
    per_metre = 1.0 / resolution
    cells = reach * per_metre
    for i in range(len(angles)):
        x, y, dx, dy = xs[i], ys[i], cos(angles[i]), sin(angles[i])
        best = _walk(clear, (x - origin_x) * per_metre, (y - origin_y) * per_metre, dx, dy, cells) * resolution
        for disc in discs:
            best = min(best, _to_disc(x, y, dx, dy, disc))
        for segment in segments:
            best = min(best, _to_segment(x, y, dx, dy, segment))
        ranges[i] = best if best <= reach else inf
    return ranges


@njit(cache=True)
def grid_penetration(
    occupied: NDArray[np.bool_], resolution: float, x: float, y: float, yaw: float, length: float, width: float
) -> float:
    """Return the sum of a rectangle's overlap depths over all occupied cells (m); 0 without contact.

    Args:
        occupied: (rows, columns), row 0 lowest y.
        resolution: cell side (m).
        x: x of the rectangle's centre relative to the grid's lower left corner (m).
        y: as ``x``.
        yaw: direction of the rectangle's length (rad).
        length: length of the rectangle (m).
        width: width of the rectangle (m).
    """
    rows, columns = occupied.shape
    c, s = cos(yaw), sin(yaw)
    half_x = (abs(c) * length + abs(s) * width) / 2
    half_y = (abs(s) * length + abs(c) * width) / 2
    cell_half = (abs(c) + abs(s)) * resolution / 2
    total = 0.0
    first_row, last_row = floor((y - half_y) / resolution), floor((y + half_y) / resolution)
    first_column, last_column = floor((x - half_x) / resolution), floor((x + half_x) / resolution)
    for row in range(max(0, first_row), min(rows, last_row + 1)):
        for column in range(max(0, first_column), min(columns, last_column + 1)):
            if not occupied[row, column]:
                continue
            dx, dy = (column + 0.5) * resolution - x, (row + 0.5) * resolution - y
            in_axes = min(half_x + resolution / 2 - abs(dx), half_y + resolution / 2 - abs(dy))
            in_body = min(length / 2 + cell_half - abs(c * dx + s * dy), width / 2 + cell_half - abs(c * dy - s * dx))
            total += max(0.0, min(in_axes, in_body))
    return total
