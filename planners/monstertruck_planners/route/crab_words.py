"""Reeds-Shepp words and, for trucks that can crab, words with translations beside the heading, compiled.

Added to the 48 words: arc, translation at the full crab angle, arc, each of them forward or backward; arc and
translation in either order, the translation at any angle the truck can take, or else a zigzag of two at the full one.
All lengths in turning radii unless metres are named.
"""

from math import atan2, cos, inf, pi, sin, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.route.reeds_shepp_words import COST, SLACK, relative, solve, spell

FloatArray = NDArray[np.float64]

MOST_ROWS = 5


@njit(cache=True)
def _wrap(angle: float) -> float:
    while angle > pi:
        angle -= 2 * pi
    while angle <= -pi:
        angle += 2 * pi
    return angle


@njit(cache=True)
def _try(
    word: FloatArray, count: int, mirror: float, weights: FloatArray, best: FloatArray, rows: FloatArray, kept: int
) -> int:
    """Take the word (its rows not yet mirrored) if it is the cheapest so far; returns the number of rows kept."""
    cost, before = 0.0, 0.0
    for i in range(count):
        length = word[i, 0]
        if abs(length) <= SLACK:
            continue
        weight = 1.0 if length > 0.0 else weights[0]
        if word[i, 2] != 0.0:
            weight *= weights[2]
        cost += abs(length) * weight
        if length * before < 0.0:
            cost += weights[1]
        before = length
    if cost >= best[COST] - SLACK:
        return kept
    best[COST] = cost
    kept = 0
    for i in range(count):
        if abs(word[i, 0]) > SLACK:
            rows[kept, 0], rows[kept, 1], rows[kept, 2] = word[i, 0], mirror * word[i, 1], mirror * word[i, 2]
            kept += 1
    return kept


@njit(cache=True)
def _put(word: FloatArray, i: int, length: float, curvature: float, sideslip: float) -> None:
    word[i, 0], word[i, 1], word[i, 2] = length, curvature, sideslip


@njit(cache=True)
def _arc_crab_arc(
    x: float, y: float, phi: float, crab: float, mirror: float, weights: FloatArray,
    word: FloatArray, best: FloatArray, rows: FloatArray, kept: int,
) -> int:  # fmt: skip
    """Left arc, translation, left or right arc; the translation leads from one turning circle to the other."""
    xi, eta = x - sin(phi), y - 1.0 + cos(phi)
    r, a = sqrt(xi * xi + eta * eta), atan2(eta, xi)
    xi2, eta2 = x + sin(phi), y - 1.0 - cos(phi)
    a2 = atan2(eta2, xi2)
    for k in range(4):
        slip = crab if k & 1 else -crab
        sign = 1.0 if k & 2 else -1.0
        t = _wrap(a + (0.0 if sign > 0.0 else pi) - slip)
        _put(word, 0, t, 1.0, 0.0)
        _put(word, 1, sign * r, 0.0, slip)
        _put(word, 2, _wrap(phi - t), 1.0, 0.0)
        kept = _try(word, 3, mirror, weights, best, rows, kept)
        # In the frame turned by t the centres differ by (u cos, u sin - 2).
        root = 4.0 * sin(slip) ** 2 + xi2 * xi2 + eta2 * eta2 - 4.0
        if root < 0.0:
            continue
        u = 2.0 * sin(slip) + sign * sqrt(root)
        t = _wrap(a2 - atan2(u * sin(slip) - 2.0, u * cos(slip)))
        _put(word, 0, t, 1.0, 0.0)
        _put(word, 1, u, 0.0, slip)
        _put(word, 2, _wrap(t - phi), -1.0, 0.0)
        kept = _try(word, 3, mirror, weights, best, rows, kept)
    return kept


@njit(cache=True)
def _translate(word: FloatArray, first: int, x: float, y: float, crab: float) -> int:
    """Rows of the shortest translation by (x, y), from index ``first`` on; returns their number."""
    r = sqrt(x * x + y * y)
    angle = atan2(y, x)
    if abs(angle) <= crab:
        _put(word, first, r, 0.0, angle)
        return 1
    angle = atan2(-y, -x)
    if abs(angle) <= crab:
        _put(word, first, -r, 0.0, angle)
        return 1
    along, aside = x / cos(crab), y / sin(crab)
    _put(word, first, 0.5 * (along + aside), 0.0, crab)
    _put(word, first + 1, 0.5 * (along - aside), 0.0, -crab)
    return 2


@njit(cache=True)
def _arc_and_crab(
    x: float, y: float, phi: float, crab: float, mirror: float, weights: FloatArray,
    word: FloatArray, best: FloatArray, rows: FloatArray, kept: int,
) -> int:  # fmt: skip
    """Left arc and translation in both orders."""
    px, py = x - sin(phi), y - 1.0 + cos(phi)
    c, s = cos(phi), sin(phi)
    _put(word, 0, phi, 1.0, 0.0)
    count = _translate(word, 1, px * c + py * s, py * c - px * s, crab)
    kept = _try(word, 1 + count, mirror, weights, best, rows, kept)
    count = _translate(word, 0, px, py, crab)
    _put(word, count, phi, 1.0, 0.0)
    return _try(word, count + 1, mirror, weights, best, rows, kept)


@njit(cache=True)
def connect(
    start: FloatArray, goal: FloatArray, radius: float, crab: float, weights: FloatArray,
    rows: FloatArray, best: FloatArray, scratch: FloatArray,
) -> int:  # fmt: skip
    """Cheapest motion from one pose to another.

    Args:
        start: x, y (m), yaw (rad).
        goal: the same.
        radius: turning radius, m.
        crab: largest angle of a translation, rad; 0 for none.
        weights: cost per metre backward and of a change of direction (in radii), factor on translations.
        rows: shape (5, 3), gets the motion: signed length m, curvature 1/m, sideslip rad.
        best: shape (8,), gets the cost in radii as its first field.
        scratch: shape (4, 3).

    Returns:
        Number of rows.
    """
    x, y, phi = relative(start, goal, radius)
    pieces = scratch.reshape(12)[:5]
    solve(x, y, phi, weights, best, pieces)
    kept = spell(best, radius, rows, pieces)
    if crab <= 0.0:
        return kept
    own = kept
    kept = -1
    for k in range(2):
        mirror = 1.0 if k == 0 else -1.0
        kept = _arc_crab_arc(x, mirror * y, mirror * phi, crab, mirror, weights, scratch, best, rows, kept)
        kept = _arc_and_crab(x, mirror * y, mirror * phi, crab, mirror, weights, scratch, best, rows, kept)
    if kept < 0:
        return own
    for i in range(kept):
        rows[i, 0] *= radius
        rows[i, 1] /= radius
    return kept


@njit(cache=True)
def distances(starts: FloatArray, goals: FloatArray, radius: float, crab: float, weights: FloatArray) -> FloatArray:
    """Cost in metres of the cheapest motion of every pair."""
    result = np.empty(len(starts))
    rows, best, scratch = np.empty((MOST_ROWS, 3)), np.full(8, inf), np.empty((4, 3))
    for i in range(len(starts)):
        connect(starts[i], goals[i], radius, crab, weights, rows, best, scratch)
        result[i] = best[COST] * radius
    return result


@njit(cache=True)
def rows_between(start: FloatArray, goal: FloatArray, radius: float, crab: float, weights: FloatArray) -> FloatArray:
    """Rows of the cheapest motion, shape (n, 3)."""
    rows, best, scratch = np.empty((MOST_ROWS, 3)), np.full(8, inf), np.empty((4, 3))
    return rows[: connect(start, goal, radius, crab, weights, rows, best, scratch)]
