"""The second heuristic: length of the best motion without obstacles, tabulated round the goal, compiled.

Everything is in turning radii; one table serves every radius. The left and the right half mirror each other.
"""

from functools import lru_cache
from math import cos, floor, inf, pi, sin, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.route.crab_words import MOST_ROWS, connect
from monstertruck_planners.route.reeds_shepp_words import COST

FloatArray = NDArray[np.float64]

REACH = 4.0
"""Half size of the table, turning radii."""
SPACING = 0.25
HEADINGS = 36


@njit(cache=True)
def _fill(crab: float) -> NDArray[np.float32]:
    across = round(2 * REACH / SPACING) + 1
    table = np.empty((across, (across + 1) // 2, HEADINGS), np.float32)
    start, goal = np.zeros(3), np.zeros(3)
    rows, best, scratch = np.empty((MOST_ROWS, 3)), np.full(8, inf), np.empty((4, 3))
    weights = np.array([1.0, 0.0, 1.0])
    for i in range(across):
        for j in range((across + 1) // 2):
            for k in range(HEADINGS):
                goal[0], goal[1], goal[2] = i * SPACING - REACH, j * SPACING, 2 * pi * k / HEADINGS
                connect(start, goal, 1.0, crab, weights, rows, best, scratch)
                table[i, j, k] = best[COST]
    return table


@lru_cache(maxsize=8)
def turning_table(crab: float) -> NDArray[np.float32]:
    """Lengths from the origin, shape (x from -REACH, y from 0, heading from 0)."""
    return np.asarray(_fill(crab))


@njit(cache=True)
def turning_bound(table: NDArray[np.float32], radius: float, x: float, y: float, yaw: float, goal: FloatArray) -> float:
    """Length in metres from a pose to the goal, at the nearest entry; the straight distance beyond the table."""
    dx, dy = (x - goal[0]) / radius, (y - goal[1]) / radius
    # The way back is as long: look from the goal.
    c, s = cos(goal[2]), sin(goal[2])
    px, py, turn = dx * c + dy * s, dy * c - dx * s, yaw - goal[2]
    if abs(px) > REACH or abs(py) > REACH:
        return radius * sqrt(px * px + py * py)
    if py < 0.0:
        py, turn = -py, -turn
    k = floor(turn / (2 * pi) * HEADINGS + 0.5) % HEADINGS
    return radius * float(table[int((px + REACH) / SPACING + 0.5), int(py / SPACING + 0.5), k])
