"""The arena of the study's kind: walls with two acute and two obtuse corners and a gap, our estimate.

A rhombus: the path of the robot's middle, 0.35 m from the walls, is 48 m long. The gap of 0.4 m leads into a recess.
Walls are given in the order of a clockwise lap, so that the inside is on their right.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit

from monstertruck_kinematics.elementary import Array

OFFSET: Final = 0.35
"""Of the robot's middle from the wall, m."""
PATH: Final = 48.0
"""Length of the offset path, m."""
GAP: Final = 0.4
"""m."""
DEPTH: Final = 1.5
"""Of the recess behind the gap, m: its walls are the ends of the two walls and a back."""


class Arena(NamedTuple):
    """Walls (n, 4) of x0, y0, x1, y1; corners (k, 2) in clockwise order without the gap, m."""

    walls: Array
    corners: Array
    angles: tuple[float, ...]
    """Inner angle of every corner, rad."""
    gap: Array
    """(2, 2): ends of the gap."""


def study(acute: float = math.radians(70.0)) -> Arena:
    """A parallelogram: two corners of ``acute``, two of its supplement (110 degrees)."""
    shape = _parallelogram(1.0, acute)
    size = (PATH + _shrink(shape)) / _perimeter(shape)
    return _walled(shape * size)


def _parallelogram(ratio: float, acute: float) -> Array:
    along = np.array([math.cos(acute), math.sin(acute)])
    aside = np.array([ratio, 0.0])
    corners = np.array([(0.0, 0.0), along, along + aside, aside])
    return corners - corners.mean(axis=0)


def _perimeter(corners: Array) -> float:
    return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum())


def _shrink(corners: Array) -> float:
    """By how much the offset path is shorter than the walls, m: 2 OFFSET / tan(half the inner angle) a corner."""
    return sum(2 * OFFSET / math.tan(angle / 2) for angle in _angles(corners))


def _angles(corners: Array) -> tuple[float, ...]:
    before, after = np.roll(corners, 1, axis=0) - corners, np.roll(corners, -1, axis=0) - corners
    cosines = (before * after).sum(axis=1) / (np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1))
    return tuple(np.arccos(cosines).tolist())


def _walled(corners: Array) -> Arena:
    """The gap is in the last wall, a third of its length before its end."""
    ends = np.roll(corners, -1, axis=0)
    walls = [(*a, *b) for a, b in zip(corners[:-1], ends[:-1], strict=True)]
    a, b = corners[-1], ends[-1]
    along = (b - a) / np.linalg.norm(b - a)
    out = np.array([-along[1], along[0]])  # the inside is on the right
    first = a + (b - a) * 0.6
    second = first + GAP * along
    back = first + DEPTH * out, second + DEPTH * out
    walls += [(*a, *first), (*second, *b), (*first, *back[0]), (*back[0], *back[1]), (*back[1], *second)]
    return Arena(np.array(walls), corners, _angles(corners), np.array([first, second]))


@njit(cache=True)
def rays(walls: Array, xs: Array, ys: Array, angles: Array, reach: float) -> Array:
    """Ranges along rays to the nearest wall, m; inf beyond ``reach``; a ``Caster`` once its walls are bound."""
    ranges = np.full(len(angles), np.inf)
    for i in range(len(angles)):
        dx, dy = math.cos(angles[i]), math.sin(angles[i])
        for wall in walls:
            ex, ey = wall[2] - wall[0], wall[3] - wall[1]
            px, py = wall[0] - xs[i], wall[1] - ys[i]
            cross = dx * ey - dy * ex
            if abs(cross) < 1e-12:
                continue
            along, part = (px * ey - py * ex) / cross, (px * dy - py * dx) / cross
            if along >= 0.0 and 0.0 <= part <= 1.0 and along < ranges[i]:
                ranges[i] = along
        if ranges[i] > reach:
            ranges[i] = np.inf
    return ranges


def distance(walls: Array, x: float, y: float) -> Array:
    """(n,) distances of a point from each wall, m."""
    a, e = walls[:, :2], walls[:, 2:] - walls[:, :2]
    part = np.clip(((np.array([x, y]) - a) * e).sum(axis=1) / (e * e).sum(axis=1), 0.0, 1.0)
    nearest = a + part[:, None] * e
    found: Array = np.hypot(nearest[:, 0] - x, nearest[:, 1] - y)
    return found


@njit(cache=True)
def blocked(walls: Array, x: float, y: float, yaw: float, length: float = 0.32, width: float = 0.30) -> bool:
    """Whether any wall reaches into the footprint at a pose (Liang and Barsky's clipping)."""
    c, s = math.cos(yaw), math.sin(yaw)
    for wall in walls:
        ax, ay = c * (wall[0] - x) + s * (wall[1] - y), c * (wall[1] - y) - s * (wall[0] - x)
        bx, by = c * (wall[2] - x) + s * (wall[3] - y), c * (wall[3] - y) - s * (wall[2] - x)
        enter, leave = 0.0, 1.0
        for start, way, half in ((ax, bx - ax, length / 2), (ay, by - ay, width / 2)):
            if abs(way) < 1e-12:
                if abs(start) > half:
                    leave = -1.0
                continue
            one, two = (-half - start) / way, (half - start) / way
            enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
        if enter <= leave:
            return True
    return False
