"""Motions as rows (signed length m, curvature 1/m, sideslip rad) of a reference point, integrated exactly, compiled.

The point travels ``length`` (negative: backward) along a path of constant curvature, at ``sideslip`` from the heading.
"""

from math import ceil, cos, sin

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@njit(cache=True)
def advance(
    x: float, y: float, yaw: float, length: float, curvature: float, sideslip: float
) -> tuple[float, float, float]:
    """Pose after ``length`` metres of one row."""
    half = 0.5 * curvature * length
    chord = length if abs(half) < 1e-7 else length * sin(half) / half
    course = yaw + sideslip + half
    return x + chord * cos(course), y + chord * sin(course), yaw + 2.0 * half


@njit(cache=True)
def along(pose: FloatArray, row: FloatArray, travelled: float) -> FloatArray:
    """Pose (3,) reached from ``pose`` after ``travelled`` metres (not below 0) of the row."""
    length = travelled if row[0] > 0.0 else -travelled
    x, y, yaw = advance(pose[0], pose[1], pose[2], length, row[1], row[2])
    return np.array([x, y, yaw])


@njit(cache=True)
def ends(start: FloatArray, rows: FloatArray) -> FloatArray:
    """Pose before the first row and after each, shape (n + 1, 3)."""
    poses = np.empty((len(rows) + 1, 3))
    x, y, yaw = start[0], start[1], start[2]
    poses[0, 0], poses[0, 1], poses[0, 2] = x, y, yaw
    for i in range(len(rows)):
        x, y, yaw = advance(x, y, yaw, rows[i, 0], rows[i, 1], rows[i, 2])
        poses[i + 1, 0], poses[i + 1, 1], poses[i + 1, 2] = x, y, yaw
    return poses


@njit(cache=True)
def sample(start: FloatArray, rows: FloatArray, step: float) -> tuple[FloatArray, NDArray[np.int64]]:
    """Poses at most ``step`` metres apart, the ends of all rows among them.

    Returns:
        Shape (m, 4): x, y, yaw and metres travelled; and shape (m,), the row that leads to each pose (0 for the first).
    """
    total = 1
    for i in range(len(rows)):
        total += max(ceil(abs(rows[i, 0]) / step - 1e-9), 1)
    poses, index = np.empty((total, 4)), np.empty(total, np.int64)
    x, y, yaw, travelled = start[0], start[1], start[2], 0.0
    poses[0, 0], poses[0, 1], poses[0, 2], poses[0, 3], index[0] = x, y, yaw, 0.0, 0
    k = 1
    for i in range(len(rows)):
        length, curvature, sideslip = rows[i, 0], rows[i, 1], rows[i, 2]
        count = max(ceil(abs(length) / step - 1e-9), 1)
        for j in range(1, count + 1):
            share = length * j / count
            px, py, pyaw = advance(x, y, yaw, share, curvature, sideslip)
            poses[k, 0], poses[k, 1], poses[k, 2], poses[k, 3], index[k] = px, py, pyaw, travelled + abs(share), i
            k += 1
        x, y, yaw = poses[k - 1, 0], poses[k - 1, 1], poses[k - 1, 2]
        travelled += abs(length)
    return poses, index
