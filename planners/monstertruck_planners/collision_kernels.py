"""Exact tests of a footprint against an occupancy grid, behind ``collision.DistanceField``. Loads numba.

An occupied cell is its whole square. Distances between cell centres bound the true ones from below and above; only what
these bounds leave open is tested cell by cell (separating axes of rectangle and square; distance of disc and square).
"""

from math import ceil, cos, floor, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.route.motion import advance

HALF_DIAGONAL = sqrt(0.5)


class FieldData(NamedTuple):
    """A grid with a ring of occupied cells around it."""

    distance: NDArray[np.float32]
    """Distance between the centres of each cell and the nearest occupied cell, m."""
    occupied: NDArray[np.bool_]
    resolution: float
    x: float
    y: float
    cos: float
    sin: float
    """Pose of the outer corner of the ringed grid's cell (0, 0)."""
    unseen_distance: NDArray[np.float32]
    unseen: NDArray[np.bool_]
    """Like ``distance`` and ``occupied``, for ground closed to reversing; empty arrays if there is none."""


class FootprintData(NamedTuple):
    """A footprint: discs on the x axis, and the rectangle they cover (half sizes 0: the discs are the footprint)."""

    discs: Array
    """Centres, m."""
    radius: float
    half_length: float
    half_width: float
    centre: float
    """Of the rectangle, m."""
    inscribed: float
    """Radius of the circle round the pose inside the footprint, m."""
    reach: float
    """Maximum distance of a disc's centre from the pose, m."""


@njit(cache=True)
def _disc_hits(field: FieldData, px: float, py: float, radius: float) -> bool:
    """Whether a disc at (px, py), in cells, radius in cells, overlaps an occupied square."""
    rows, columns = field.occupied.shape
    r0, r1 = max(floor(py - radius), 0), min(floor(py + radius), rows - 1)
    c0, c1 = max(floor(px - radius), 0), min(floor(px + radius), columns - 1)
    limit = radius * radius
    for r in range(r0, r1 + 1):
        dy = max(r - py, py - r - 1.0, 0.0)
        for c in range(c0, c1 + 1):
            if field.occupied[r, c]:
                dx = max(c - px, px - c - 1.0, 0.0)
                if dx * dx + dy * dy < limit:
                    return True
    return False


@njit(cache=True)
def _rectangle_hits(
    field: FieldData, px: float, py: float, c: float, s: float, half_length: float, half_width: float
) -> bool:
    """Whether a rectangle round (px, py), all in cells, along (c, s), overlaps an occupied square."""
    rows, columns = field.occupied.shape
    ac, as_ = abs(c), abs(s)
    span_x, span_y = half_length * ac + half_width * as_, half_length * as_ + half_width * ac
    lean = 0.5 * (ac + as_)
    r0, r1 = max(floor(py - span_y), 0), min(ceil(py + span_y) - 1, rows - 1)
    c0, c1 = max(floor(px - span_x), 0), min(ceil(px + span_x) - 1, columns - 1)
    for row in range(r0, r1 + 1):
        dy = row + 0.5 - py
        for column in range(c0, c1 + 1):
            if field.occupied[row, column]:
                dx = column + 0.5 - px
                if abs(dx * c + dy * s) < half_length + lean and abs(dy * c - dx * s) < half_width + lean:
                    return True
    return False


@njit(cache=True)
def safe_distance(field: FieldData, footprint: FootprintData, margin: float, x: float, y: float, yaw: float) -> float:
    """Distance every part of the footprint may move without collision, m; 0 if it is free but close, -1 if not free.

    Args:
        field: the grid.
        footprint: the footprint.
        margin: to keep on all sides, m.
        x: of the pose, in the grid's parent frame, m.
        y: the same.
        yaw: rad.
    """
    res = field.resolution
    dx, dy = x - field.x, y - field.y
    px, py = (dx * field.cos + dy * field.sin) / res, (dy * field.cos - dx * field.sin) / res
    rows, columns = field.occupied.shape
    if not (0.0 <= px < columns and 0.0 <= py < rows):
        return -1.0
    if field.distance[int(py), int(px)] + res * (HALF_DIAGONAL - 0.5) < footprint.inscribed + margin:
        return -1.0
    c, s = cos(yaw), sin(yaw)
    c, s = c * field.cos + s * field.sin, s * field.cos - c * field.sin
    least = 1e9
    for i in range(len(footprint.discs)):
        qx, qy = px + footprint.discs[i] / res * c, py + footprint.discs[i] / res * s
        if not (0.0 <= qx < columns and 0.0 <= qy < rows):
            return -1.0
        column, row = int(qx), int(qy)
        off = sqrt((qx - column - 0.5) ** 2 + (qy - row - 0.5) ** 2)
        bound = field.distance[row, column] - res * (off + HALF_DIAGONAL) - footprint.radius - margin
        if bound < least:
            least = bound
            if bound <= 0.0 and footprint.half_length > 0.0:
                break
        if (
            bound <= 0.0
            and footprint.half_length <= 0.0
            and _disc_hits(field, qx, qy, (footprint.radius + margin) / res)
        ):
            return -1.0
    if least > 0.0:
        return float(least)
    if footprint.half_length <= 0.0:
        return 0.0
    qx, qy = px + footprint.centre / res * c, py + footprint.centre / res * s
    hit = _rectangle_hits(
        field, qx, qy, c, s, (footprint.half_length + margin) / res, (footprint.half_width + margin) / res
    )
    return -1.0 if hit else 0.0


@njit(cache=True)
def unseen_distance(field: FieldData, footprint: FootprintData, x: float, y: float, yaw: float) -> float:
    """Like ``safe_distance``, to ground closed to reversing: cells whose middle the footprint would cover."""
    if field.unseen.size == 0:
        return 1e9
    ground = FieldData(
        field.unseen_distance, field.unseen, field.resolution, field.x, field.y, field.cos, field.sin,
        field.unseen_distance, field.unseen,
    )  # fmt: skip
    return safe_distance(ground, footprint, -HALF_DIAGONAL * field.resolution, x, y, yaw)


@njit(cache=True)
def free_poses(field: FieldData, footprint: FootprintData, margin: float, poses: Array) -> NDArray[np.bool_]:
    """Whether each pose (m, 3) is free."""
    result = np.empty(len(poses), np.bool_)
    for i in range(len(poses)):
        result[i] = safe_distance(field, footprint, margin, poses[i, 0], poses[i, 1], poses[i, 2]) >= 0.0
    return result


@njit(cache=True)
def segment_free(
    field: FieldData, footprint: FootprintData, margin: float, step: float,
    x: float, y: float, yaw: float, length: float, curvature: float, sideslip: float,
) -> bool:  # fmt: skip
    """Whether a motion segment (signed length, curvature, sideslip) is free all the way, its end included.

    Backward it must not cover ground that nothing may reverse onto.

    The test advances as far as the safe distance allows, and by ``step`` metres at least (a quarter of it with
    sideslip, where corners leave gaps between two poses).
    """
    total = abs(length)
    sign = 1.0 if length > 0.0 else -1.0
    if sideslip != 0.0:
        step *= 0.25
    pace = 1.0 + abs(curvature) * footprint.reach
    travelled = 0.0
    while True:
        px, py, pyaw = advance(x, y, yaw, sign * travelled, curvature, sideslip)
        safe = safe_distance(field, footprint, margin, px, py, pyaw)
        if safe >= 0.0 and sign < 0.0:
            safe = min(safe, unseen_distance(field, footprint, px, py, pyaw))
        if safe < 0.0:
            return False
        if travelled >= total:
            return True
        travelled = min(travelled + max(step, safe / pace), total)
