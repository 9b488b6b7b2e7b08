"""Out of the margin: the shortest motion from a pose too near to something to one that keeps the margin. Compiled.

A truck that came nearer to an obstacle than planned stands where no path may begin. What it may do is go away from
there: one motion, on which no part of it comes nearer to anything than it is.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.collision_kernels import BodyData, FieldData, room
from monstertruck_planners.local.bubbles import Cover, clearance
from monstertruck_planners.route.motion_rows import advance

FloatArray = NDArray[np.float64]

STEP = 0.01
"""Between two looks, m."""

FURTHEST = 0.3
"""Longest way out, m."""

DEEPEST = -0.05
"""A truck that overlaps an obstacle by more does not stand beside it but in it, m."""

SLACK = 2e-3
"""Clearances are told apart by more than this, m."""


@njit(cache=True)
def loosen(
    field: FieldData, body: BodyData, cover: Cover, pose: FloatArray, moves: FloatArray, margin: float
) -> FloatArray:
    """Shortest motion out of the margin.

    Args:
        field: obstacles.
        body: footprint, for the margin.
        cover: the same, for clearances, see ``band.cover_of``.
        pose: shape (3,), where the truck stands.
        moves: shape (n, 3): motion rows that it may drive; their signs count, their lengths do not. Of equally
            long ways out the first one is taken.
        margin: wanted at the end, m.

    Returns:
        A motion row, shape (1, 3), or none, shape (0, 3).
    """
    least = clearance(field, cover, pose[0], pose[1], pose[2])
    best, shortest = -1, FURTHEST + STEP
    if least >= DEEPEST:
        for i in range(len(moves)):
            sign = 1.0 if moves[i, 0] > 0.0 else -1.0
            known, travelled = least, STEP
            while travelled < shortest - 0.5 * STEP:
                x, y, yaw = advance(pose[0], pose[1], pose[2], sign * travelled, moves[i, 1], moves[i, 2])
                here = clearance(field, cover, x, y, yaw)
                if here < known - SLACK:
                    break
                known = max(known, here)
                if room(field, body, margin, x, y, yaw) >= 0.0:
                    best, shortest = i, travelled
                    break
                travelled += STEP
    result = np.empty((1 if best >= 0 else 0, 3))
    if best >= 0:
        result[0, 0] = shortest if moves[best, 0] > 0.0 else -shortest
        result[0, 1], result[0, 2] = moves[best, 1], moves[best, 2]
    return result
