"""Exact ray casting and footprint contact on an occupancy grid, compiled.

The walk visits every cell a ray crosses, in order (Amanatides and Woo, "A Fast Voxel Traversal Algorithm for
Ray Tracing", 1987), so a range is the distance to the boundary of the first occupied cell, not a multiple of
the cell size.
"""

from math import cos, floor, inf, sin, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@njit(cache=True)
def _walk(
    occupied: NDArray[np.bool_], resolution: float, x: float, y: float, dx: float, dy: float, reach: float
) -> float:
    """Distance from (x, y), relative to the grid's corner, along the unit vector (dx, dy); inf beyond ``reach``."""
    rows, columns = occupied.shape
    column, row = floor(x / resolution), floor(y / resolution)
    step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    per_x = resolution / abs(dx) if dx != 0.0 else inf
    per_y = resolution / abs(dy) if dy != 0.0 else inf
    next_x = ((column + (dx > 0)) * resolution - x) / dx if dx != 0.0 else inf
    next_y = ((row + (dy > 0)) * resolution - y) / dy if dy != 0.0 else inf
    travelled = 0.0
    while travelled <= reach:
        if 0 <= row < rows and 0 <= column < columns:
            if occupied[row, column]:
                return travelled
        elif (
            (column < 0 and dx <= 0)
            or (column >= columns and dx >= 0)
            or (row < 0 and dy <= 0)
            or (row >= rows and dy >= 0)
        ):
            return inf
        if next_x < next_y:
            travelled = next_x
            next_x += per_x
            column += step_x
        else:
            travelled = next_y
            next_y += per_y
            row += step_y
    return inf


@njit(cache=True)
def _to_disc(x: float, y: float, dx: float, dy: float, disc: FloatArray) -> float:
    cx, cy = disc[0] - x, disc[1] - y
    along = cx * dx + cy * dy
    root = disc[2] ** 2 - (cx * cx + cy * cy - along * along)
    if root < 0.0 or along + sqrt(root) < 0.0:
        return inf
    return float(max(0.0, along - sqrt(root)))


@njit(cache=True)
def _to_segment(x: float, y: float, dx: float, dy: float, segment: FloatArray) -> float:
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
    occupied: NDArray[np.bool_],
    resolution: float,
    origin_x: float,
    origin_y: float,
    xs: FloatArray,
    ys: FloatArray,
    angles: FloatArray,
    reach: float,
    discs: FloatArray,
    segments: FloatArray,
) -> FloatArray:
    """Distance of the first thing each ray meets, m; inf if nothing is within ``reach``.

    Args:
        occupied: (rows, columns), row 0 lowest y; outside the grid is free.
        resolution: cell side, m.
        origin_x: x of the grid's lower left corner in the map frame, m.
        origin_y: y of the same corner, m.
        xs: (n,) ray origins in the map frame, m: one per ray, so that a sensor may move during its sweep.
        ys: (n,) as ``xs``.
        angles: (n,) ray directions in the map frame, rad.
        reach: greatest distance looked at, m.
        discs: (k, 3) of x, y, radius in the map frame, m.
        segments: (m, 4) of x0, y0, x1, y1 in the map frame, m.

    Returns:
        (n,) float64; 0 where a ray starts inside an occupied cell or a disc.
    """
    ranges = np.empty(len(angles))
    for i in range(len(angles)):
        x, y, dx, dy = xs[i], ys[i], cos(angles[i]), sin(angles[i])
        best = _walk(occupied, resolution, x - origin_x, y - origin_y, dx, dy, reach)
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
    """Sum over occupied cells of how deep a rectangle reaches into each, m; 0 if it touches none.

    Args:
        occupied: (rows, columns), row 0 lowest y.
        resolution: cell side, m.
        x: centre of the rectangle, m, relative to the grid's lower left corner.
        y: as ``x``.
        yaw: direction of its length, rad.
        length: m.
        width: m.
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
