"""The study's arena as we estimate it: walls with two acute and two obtuse corners and a gap.

A rhombus: the path of the robot's centre, 0.35 m from the walls, is 48 m long. The gap of 0.4 m leads into a recess.
Walls are given in the order of a clockwise lap, so that the inside is on their right.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit

from monstertruck_kinematics.elementary import Array

OFFSET: Final = 0.35
"""Distance of the robot's middle from the wall, m."""
PATH: Final = 48.0
"""Length of the offset path, m."""
GAP: Final = 0.4
"""m."""
DEPTH: Final = 1.5
"""Depth of the recess behind the gap, m: its walls are the ends of the two walls and a back."""


class Arena(NamedTuple):
    """Walls (n, 4) of x0, y0, x1, y1; corners (k, 2) in clockwise order without the gap, m."""

    walls: Array
    corners: Array
    angles: tuple[float, ...]
    """Inner angle of every corner, rad."""
    gap: Array
    """(2, 2): ends of the gap."""


def start_rule(first: int, second: int) -> tuple[float, str]:
    """Return the study's start from the last digits of two numbers: heading (rad), and the side of the wall.

    The heading is the sum modulo pi; an even sum is a clockwise lap, with the wall on the left.
    """
    total = first + second
    return total % math.pi, "right" if total % 2 else "left"


def study(acute: float = math.radians(70.0)) -> Arena:
    """Return a parallelogram with two corners of ``acute``, and two of its supplement (110 degrees)."""
    shape = _parallelogram(1.0, acute)
    size = (PATH + _shrink(shape)) / _perimeter(shape)
    return _walled(shape * size)


def drawn(seed: int) -> Arena:
    """Return an arena of four or five walls with corners of 50 to 130 degrees, a door of 0.8 to 1 m, and a pillar."""
    rng = np.random.default_rng([seed, 22])
    while True:
        count = int(rng.integers(4, 6))
        angles = np.radians(rng.uniform(50.0, 130.0, count))
        angles += (math.pi * (count - 2) - angles.sum()) / count
        if angles.min() < math.radians(50) or angles.max() > math.radians(130):
            continue
        # Clockwise: every corner turns right by pi less its inner angle.
        headings = math.pi / 2 - np.concatenate([[0.0], np.cumsum(math.pi - angles[:-1])])
        ways = np.column_stack([np.cos(headings), np.sin(headings)])
        lengths = rng.uniform(4.0, 8.0, count - 2)
        rest = -(ways[:-2] * lengths[:, None]).sum(axis=0)
        last = np.linalg.solve(ways[-2:].T, rest)
        sides = np.concatenate([lengths, last])
        if sides.min() < 3.0 or sides.max() > 12.0:
            continue
        corners = np.concatenate([[(0.0, 0.0)], np.cumsum(ways[:-1] * sides[:-1, None], axis=0)])
        corners -= corners.mean(axis=0)
        if _least(corners, np.zeros(2)) < 1.5:
            continue
        return _furnished(corners, rng)


def _furnished(corners: Array, rng: np.random.Generator) -> Arena:
    """Return walls with a door, and a square pillar that leaves room along all walls and around the start."""
    ends, door = np.roll(corners, -1, axis=0), int(rng.integers(len(corners)))
    walls = [(*a, *b) for i, (a, b) in enumerate(zip(corners, ends, strict=True)) if i != door]
    a, b = corners[door], ends[door]
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    out, width = np.array([-along[1], along[0]]), float(rng.uniform(0.8, 1.0))
    first = a + along * float(rng.uniform(1.0, length - 1.0 - width))
    second = first + along * width
    back = first + DEPTH * out, second + DEPTH * out
    walls += [(*a, *first), (*second, *b), (*first, *back[0]), (*back[0], *back[1]), (*back[1], *second)]
    low, high = corners.min(axis=0), corners.max(axis=0)
    for _ in range(200):
        middle, half = rng.uniform(low, high), float(rng.uniform(0.1, 0.2))
        if _least(corners, middle) > 0.85 + half * math.sqrt(2) and float(np.linalg.norm(middle)) > 1.2:
            turned = float(rng.uniform(0.0, math.pi / 2))
            square = middle + half * math.sqrt(2) * np.array([
                (math.cos(turned + k * math.pi / 2), math.sin(turned + k * math.pi / 2)) for k in range(4)
            ])  # fmt: skip
            walls += [(*p, *q) for p, q in zip(square, np.roll(square, -1, axis=0), strict=True)]
            break
    return Arena(np.array(walls), corners, _angles(corners), np.array([first, second]))


def _least(corners: Array, point: Array) -> float:
    """Return the minimum distance of an inside point from the lines of the walls, m; negative outside."""
    along = np.roll(corners, -1, axis=0) - corners
    along /= np.linalg.norm(along, axis=1)[:, None]
    return float((along[:, 1] * (point - corners)[:, 0] - along[:, 0] * (point - corners)[:, 1]).min())


def _parallelogram(ratio: float, acute: float) -> Array:
    along = np.array([math.cos(acute), math.sin(acute)])
    aside = np.array([ratio, 0.0])
    corners = np.array([(0.0, 0.0), along, along + aside, aside])
    return corners - corners.mean(axis=0)


def _perimeter(corners: Array) -> float:
    return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum())


def _shrink(corners: Array) -> float:
    """Return the walls' length minus the offset path's, m: 2 OFFSET / tan(half the inner angle) per corner."""
    return sum(2 * OFFSET / math.tan(angle / 2) for angle in _angles(corners))


def _angles(corners: Array) -> tuple[float, ...]:
    before, after = np.roll(corners, 1, axis=0) - corners, np.roll(corners, -1, axis=0) - corners
    cosines = (before * after).sum(axis=1) / (np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1))
    return tuple(np.arccos(cosines).tolist())


def _walled(corners: Array) -> Arena:
    """Return walls with the gap in the last wall, a third of its length before its end."""
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
    """Return ranges along rays to the nearest wall, m; inf beyond ``reach``; a ``Caster`` once its walls are bound."""
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


@njit(cache=True)
def blocked(walls: Array, x: float, y: float, yaw: float, length: float = 0.32, width: float = 0.30) -> bool:
    """Whether any wall overlaps the footprint at a pose (Liang-Barsky clipping)."""
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
