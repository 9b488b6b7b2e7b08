"""The 48 Reeds-Shepp words, compiled.

Source: J. A. Reeds and L. A. Shepp, "Optimal paths for a car that goes both forwards and backwards", Pacific Journal of
Mathematics 145(2), 1990, section 8. Lengths are in turning radii, the start is the origin, L and R are arcs of radius
1, S is a straight line. A formula solves one pattern; driving backward (``flip``), mirrored left for right (``mirror``)
and the reversed order (``backward``) give the others.
"""

from math import acos, asin, atan2, ceil, cos, floor, inf, pi, sin, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SLACK = 1e-10
"""Rounding allowed where a formula asks for a sign."""

LSL, LSR, LRL, LRLR_SAME, LRLR_CUSP, LRSL, LRSR, LRSLR = range(8)

TURNS = np.array(
    [
        [1, 0, 1, 0, 0],
        [1, 0, -1, 0, 0],
        [1, -1, 1, 0, 0],
        [1, -1, 1, -1, 0],
        [1, -1, 1, -1, 0],
        [1, -1, 0, 1, 0],
        [1, -1, 0, -1, 0],
        [1, -1, 0, 1, -1],
    ],
    dtype=np.float64,
)
"""Curvature of each piece of a pattern."""

PIECES = np.array([3, 3, 3, 4, 4, 4, 4, 5], dtype=np.int64)

COST, PATTERN, FLIP, MIRROR, BACKWARD, T, U, V = range(8)
"""Fields of a solution: cost, pattern, three symmetries (1 or -1), three lengths."""


@njit(cache=True)
def _up(angle: float) -> float:
    """Angle in (-pi, pi], a rounding error above -pi counting as pi."""
    return float(angle - 2 * pi * ceil((angle - pi - SLACK) / (2 * pi)))


@njit(cache=True)
def _down(angle: float) -> float:
    """Angle in [-pi, pi), a rounding error below pi counting as -pi."""
    return float(angle - 2 * pi * floor((angle + pi + SLACK) / (2 * pi)))


@njit(cache=True)
def _lengths(pattern: int, t: float, u: float, v: float, out: FloatArray) -> None:
    """Signed lengths of a pattern's pieces."""
    out[0], out[1], out[2], out[3], out[4] = t, u, v, 0.0, 0.0
    if pattern == LRLR_SAME:
        out[2], out[3] = -u, v
    elif pattern == LRLR_CUSP:
        out[2], out[3] = u, v
    elif pattern in (LRSL, LRSR):
        out[1], out[2], out[3] = -pi / 2, u, v
    elif pattern == LRSLR:
        out[1], out[2], out[3], out[4] = -pi / 2, u, -pi / 2, v


@njit(cache=True)
def _offer(
    best: FloatArray, pieces: FloatArray, weights: FloatArray, pattern: int,
    flip: float, mirror: float, backward: float, t: float, u: float, v: float,
) -> None:  # fmt: skip
    """Keep the solution if it costs less than the best so far."""
    length = abs(t) + abs(u) + abs(v)
    if pattern in (LRLR_SAME, LRLR_CUSP):
        length += abs(u)
    elif pattern in (LRSL, LRSR):
        length += pi / 2
    elif pattern == LRSLR:
        length += pi
    if length >= best[COST]:
        return
    cost = length
    if weights[0] != 1.0 or weights[1] != 0.0:
        _lengths(pattern, t, u, v, pieces)
        cost = _weigh(pieces, flip, weights)
        if cost >= best[COST]:
            return
    best[COST], best[PATTERN], best[FLIP], best[MIRROR], best[BACKWARD] = cost, pattern, flip, mirror, backward
    best[T], best[U], best[V] = t, u, v


@njit(cache=True)
def _weigh(pieces: FloatArray, flip: float, weights: FloatArray) -> float:
    cost, before = 0.0, 0.0
    for i in range(5):
        length = flip * pieces[i]
        if abs(length) <= SLACK:
            continue
        cost += length if length > 0.0 else -weights[0] * length
        if length * before < 0.0:
            cost += weights[1]
        before = length
    return float(cost)


@njit(cache=True)
def _tau_omega(u: float, v: float, xi: float, eta: float, phi: float) -> tuple[float, float]:
    """First and last angle of the four-arc patterns, whose middle angles are u and v."""
    delta = u - v
    a, b = sin(u) - sin(delta), cos(u) - cos(delta) - 1.0
    t = atan2(eta * a - xi * b, xi * a + eta * b)
    if 2.0 * (cos(delta) - cos(v) - cos(u)) + 3.0 < 0.0:
        t += pi
    return t, t - u + v - phi


@njit(cache=True)
def _three_arcs(
    best: FloatArray, pieces: FloatArray, weights: FloatArray, flip: float, mirror: float, backward: float,
    phi: float, r1: float, a1: float, r2: float, xi2: float, eta2: float,
) -> None:  # fmt: skip
    """Patterns that are also valid in reversed order: LRL, LRSL, LRSR; polar (r, a) of the end circle's centre."""
    if r1 <= 4.0 and 0.5 * r1 < best[COST]:
        u = -2.0 * asin(r1 / 4.0)
        t = _up(a1 + u / 2 + pi)
        if t >= -SLACK:
            _offer(best, pieces, weights, LRL, flip, mirror, backward, t, u, _up(phi - t + u))
    if r1 >= 2.0:
        r = sqrt(r1 * r1 - 4.0)
        u = 2.0 - r
        if u <= SLACK and pi / 2 - u < best[COST]:
            t = _up(a1 + atan2(r, -2.0))
            v = _down(phi - pi / 2 - t)
            if t >= -SLACK and v <= SLACK:
                _offer(best, pieces, weights, LRSL, flip, mirror, backward, t, u, v)
    if r2 >= 2.0 and pi / 2 + r2 - 2.0 < best[COST]:
        u = 2.0 - r2
        t = _up(atan2(xi2, -eta2))
        v = _down(t + pi / 2 - phi)
        if t >= -SLACK and v <= SLACK:
            _offer(best, pieces, weights, LRSR, flip, mirror, backward, t, u, v)


@njit(cache=True)
def _others(
    best: FloatArray, pieces: FloatArray, weights: FloatArray, flip: float, mirror: float,
    phi: float, r1: float, a1: float, r2: float, a2: float, xi2: float, eta2: float,
) -> None:  # fmt: skip
    """Patterns that reversed are again one of their own."""
    t = _up(a1)
    if t >= -SLACK and r1 + t < best[COST]:
        v = _up(phi - t)
        if v >= -SLACK:
            _offer(best, pieces, weights, LSL, flip, mirror, 1.0, t, r1, v)
    if r2 >= 2.0:
        u = sqrt(r2 * r2 - 4.0)
        if u < best[COST]:
            t = _up(a2 + atan2(2.0, u))
            v = _up(t - phi)
            if t >= -SLACK and v >= -SLACK:
                _offer(best, pieces, weights, LSR, flip, mirror, 1.0, t, u, v)
        u = 4.0 - u
        if u <= SLACK and pi - u < best[COST]:
            t = _up(atan2((4.0 - u) * xi2 - 2.0 * eta2, -2.0 * xi2 + (u - 4.0) * eta2))
            v = _up(t - phi)
            if t >= -SLACK and v >= -SLACK:
                _offer(best, pieces, weights, LRSLR, flip, mirror, 1.0, t, u, v)
    rho = (2.0 + r2) / 4.0
    if rho <= 1.0 and 2.0 * acos(rho) < best[COST]:
        u = acos(rho)
        t, v = _tau_omega(u, -u, xi2, eta2, phi)
        t, v = _up(t), _down(v)
        if t >= -SLACK and v <= SLACK:
            _offer(best, pieces, weights, LRLR_SAME, flip, mirror, 1.0, t, u, v)
    rho = (20.0 - r2 * r2) / 16.0
    if 0.0 <= rho <= 1.0 and 2.0 * acos(rho) < best[COST]:
        u = -acos(rho)
        t, v = _tau_omega(u, u, xi2, eta2, phi)
        t, v = _up(t), _up(v)
        if t >= -SLACK and v >= -SLACK:
            _offer(best, pieces, weights, LRLR_CUSP, flip, mirror, 1.0, t, u, v)


@njit(cache=True)
def solve(x: float, y: float, phi: float, weights: FloatArray, best: FloatArray, pieces: FloatArray) -> None:
    """Cheapest word from the origin to (x, y, phi).

    Args:
        x: in turning radii.
        y: in turning radii.
        phi: rad.
        weights: cost of a radius backward (at least 1), and of a change of direction (at least 0).
        best: shape (8,), gets the solution.
        pieces: shape (5,), scratch.
    """
    best[COST] = inf
    sin_phi, cos_phi = sin(phi), cos(phi)
    back_x, back_y = x * cos_phi + y * sin_phi, x * sin_phi - y * cos_phi
    for k in range(4):
        flip = -1.0 if k & 1 else 1.0
        mirror = -1.0 if k & 2 else 1.0
        turn = flip * mirror
        px, py, s, angle = flip * x, mirror * y, turn * sin_phi, turn * phi
        xi1, eta1, xi2, eta2 = px - s, py - 1.0 + cos_phi, px + s, py - 1.0 - cos_phi
        r1, a1, r2 = sqrt(xi1 * xi1 + eta1 * eta1), atan2(eta1, xi1), sqrt(xi2 * xi2 + eta2 * eta2)
        _others(best, pieces, weights, flip, mirror, angle, r1, a1, r2, atan2(eta2, xi2), xi2, eta2)
        _three_arcs(best, pieces, weights, flip, mirror, 1.0, angle, r1, a1, r2, xi2, eta2)
        px, py = flip * back_x, mirror * back_y
        xi1, eta1, xi2, eta2 = px - s, py - 1.0 + cos_phi, px + s, py - 1.0 - cos_phi
        r1, a1, r2 = sqrt(xi1 * xi1 + eta1 * eta1), atan2(eta1, xi1), sqrt(xi2 * xi2 + eta2 * eta2)
        _three_arcs(best, pieces, weights, flip, mirror, -1.0, angle, r1, a1, r2, xi2, eta2)


@njit(cache=True)
def spell(best: FloatArray, radius: float, rows: FloatArray, pieces: FloatArray) -> int:
    """Write a solution as at most 5 rows (signed length m, curvature 1/m, sideslip rad); returns their number."""
    pattern = int(best[PATTERN])
    count = PIECES[pattern]
    _lengths(pattern, best[T], best[U], best[V], pieces)
    written = 0
    for i in range(count):
        k = i if best[BACKWARD] > 0.0 else count - 1 - i
        length = best[FLIP] * pieces[k]
        if abs(length) <= SLACK:
            continue
        rows[written, 0] = length * radius
        rows[written, 1] = best[MIRROR] * TURNS[pattern, k] / radius
        rows[written, 2] = 0.0
        written += 1
    return written


@njit(cache=True)
def relative(start: FloatArray, goal: FloatArray, radius: float) -> tuple[float, float, float]:
    """Goal seen from the start, lengths in turning radii, the angle within +-pi."""
    dx, dy = (goal[0] - start[0]) / radius, (goal[1] - start[1]) / radius
    c, s = cos(start[2]), sin(start[2])
    turn = goal[2] - start[2]
    return dx * c + dy * s, dy * c - dx * s, turn - 2 * pi * floor((turn + pi) / (2 * pi))


@njit(cache=True)
def distances(starts: FloatArray, goals: FloatArray, radius: float, weights: FloatArray) -> FloatArray:
    """Cost of the cheapest word of every pair, in radii times ``radius``."""
    result = np.empty(len(starts))
    best, pieces = np.empty(8), np.empty(5)
    for i in range(len(starts)):
        x, y, phi = relative(starts[i], goals[i], radius)
        solve(x, y, phi, weights, best, pieces)
        result[i] = best[COST] * radius
    return result
