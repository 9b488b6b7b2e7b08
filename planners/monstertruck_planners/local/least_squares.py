"""Least squares of a timed elastic band, compiled: residuals with analytic derivatives, banded normal equations.

Unknowns are x, y, yaw of each pose and the time of the interval before it. A residual touches at most three
neighbouring poses, so the normal matrix has eleven diagonals beside the main one. The idea of the timed band:
C. Roesmann and others, "Trajectory modification considering dynamic constraints of autonomous robots", 2012.

An interval is looked at in the frame of its middle heading: ``a`` metres along, ``b`` beside it, turned by ``d``. Then
the front axle has moved b + l_f d sideways and the rear axle b - l_r d, and the tangents of their angles are these over
a: linear where a curvature would be singular.
"""

from math import cos, hypot, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.collision_kernels import FieldData
from monstertruck_planners.local.bubbles import Cover, distance

FloatArray = NDArray[np.float64]

WIDTH = 12
"""Unknowns that a residual may touch, and diagonals of the matrix."""

LEAST_STEP = 0.01
"""Shortest way in an interval, m."""

LEAST_TIME = 0.02
"""Shortest time of an interval, s."""

FAR = 1.0e9
"""Put on the diagonal for what is given."""


class Terms(NamedTuple):
    """Vehicle, limits and weights."""

    l_f: float
    l_r: float
    """Distances of the axles before and behind the reference point, m."""
    front: float
    rear: float
    """Greatest tangents of their angles."""
    rate: float
    """Greatest rate of both tangents, 1/s."""
    speed: float
    reverse: float
    acceleration: float
    clearance: float
    """Wanted, m."""
    w_obstacle: float
    w_steering: float
    w_rate: float
    w_smooth: float
    w_crab: float
    w_time: float


class System(NamedTuple):
    """Normal equations of one linearisation."""

    matrix: FloatArray
    """Shape (4 n, WIDTH): lower diagonals; [i, k] couples the unknowns i and i - k."""
    gradient: FloatArray
    row: FloatArray
    """Shape (WIDTH,): derivatives of the residual at hand."""


@njit(cache=True)
def _add(system: System, base: int, residual: float) -> float:
    """Take in a residual whose derivatives are in ``row``, first unknown ``base``; clears the row."""
    row = system.row
    for i in range(WIDTH):
        if row[i] == 0.0:
            continue
        system.gradient[base + i] += row[i] * residual
        for j in range(i + 1):
            system.matrix[base + i, i - j] += row[i] * row[j]
    for i in range(WIDTH):
        row[i] = 0.0
    return residual * residual


@njit(cache=True)
def _interval(band: FloatArray, i: int, out: FloatArray) -> None:
    """a, b, d and cosine and sine of the middle heading of the interval before pose i."""
    middle = 0.5 * (band[i - 1, 2] + band[i, 2])
    c, s = cos(middle), sin(middle)
    dx, dy = band[i, 0] - band[i - 1, 0], band[i, 1] - band[i - 1, 1]
    out[0], out[1], out[2] = c * dx + s * dy, c * dy - s * dx, band[i, 2] - band[i - 1, 2]
    out[3], out[4] = c, s


@njit(cache=True)
def _spread(row: FloatArray, at: int, v: FloatArray, da: float, db: float, dd: float, dt: float) -> None:
    """Derivatives by the unknowns from those by a, b, d and t of an interval; ``at`` is its first pose in the row."""
    c, s = v[3], v[4]
    gx, gy = da * c - db * s, da * s + db * c
    turn = 0.5 * (da * v[1] - db * v[0])
    row[at] -= gx
    row[at + 1] -= gy
    row[at + 2] += turn - dd
    row[at + 4] += gx
    row[at + 5] += gy
    row[at + 6] += turn + dd
    row[at + 7] += dt


@njit(cache=True)
def _single(terms: Terms, band: FloatArray, sense: FloatArray, i: int, system: System, v: FloatArray) -> float:
    """Terms of the interval before pose i."""
    total = 0.0
    base = 4 * (i - 1)
    row, sign, t = system.row, sense[i], band[i, 3]
    _interval(band, i, v)
    ahead = sign * v[0]
    if ahead < LEAST_STEP:
        _spread(row, 0, v, -sign * terms.w_steering, 0.0, 0.0, 0.0)
        total += _add(system, base, terms.w_steering * (LEAST_STEP - ahead))
    for axle in range(2):
        arm = terms.l_f if axle == 0 else -terms.l_r
        limit = terms.front if axle == 0 else terms.rear
        aside = v[1] + arm * v[2]
        over = abs(aside) - limit * max(ahead, 0.0)
        if over > 0.0:
            side = 1.0 if aside > 0.0 else -1.0
            w = terms.w_steering
            _spread(row, 0, v, -w * limit * sign if ahead > 0.0 else 0.0, w * side, w * side * arm, 0.0)
            total += _add(system, base, w * over)
    row[7] = terms.w_time
    total += _add(system, base, terms.w_time * t)
    limit = terms.speed if sign > 0.0 else terms.reverse
    long = hypot(v[0], v[1])
    if long > limit * t and long > 1e-9:
        w = 10.0 * terms.w_rate
        _spread(row, 0, v, w * v[0] / long, w * v[1] / long, 0.0, -w * limit)
        total += _add(system, base, w * (long - limit * t))
    if t < LEAST_TIME:
        row[7] = -10.0
        total += _add(system, base, 10.0 * (LEAST_TIME - t))
    if terms.rear > 0.0:
        _spread(row, 0, v, 0.0, terms.w_crab * 10.0, 0.0, 0.0)
        total += _add(system, base, terms.w_crab * 10.0 * v[1])
    return total


@njit(cache=True)
def _double(
    terms: Terms, band: FloatArray, sense: FloatArray, i: int, system: System, v: FloatArray, u: FloatArray
) -> float:
    """Terms of the intervals before and after pose i."""
    total = 0.0
    base, row = 4 * (i - 1), system.row
    _interval(band, i, v)
    _interval(band, i + 1, u)
    t0, t1 = band[i, 3], band[i + 1, 3]
    v0, v1 = v[0] / t0, u[0] / t1
    change = v1 - v0
    over = abs(change) - terms.acceleration * 0.5 * (t0 + t1)
    if over > 0.0:
        w = terms.w_rate * (1.0 if change > 0.0 else -1.0)
        half = 0.5 * terms.w_rate * terms.acceleration
        _spread(row, 0, v, -w / t0, 0.0, 0.0, w * v0 / t0 - half)
        _spread(row, 4, u, w / t1, 0.0, 0.0, -w * v1 / t1 - half)
        total += _add(system, base, terms.w_rate * over)
    if sense[i] != sense[i + 1] or abs(v[0]) < LEAST_STEP or abs(u[0]) < LEAST_STEP:
        return total
    for axle in range(2):
        if axle == 1 and terms.rear <= 0.0:
            continue
        arm = terms.l_f if axle == 0 else -terms.l_r
        f0, f1 = (v[1] + arm * v[2]) / v[0], (u[1] + arm * u[2]) / u[0]
        turned = f1 - f0
        over = abs(turned) - terms.rate * 0.5 * (t0 + t1)
        for kind in range(2):
            if kind == 1 and over <= 0.0:
                continue
            w = terms.w_smooth if kind == 0 else terms.w_rate * (1.0 if turned > 0.0 else -1.0)
            half = 0.0 if kind == 0 else 0.5 * terms.w_rate * terms.rate
            _spread(row, 0, v, w * f0 / v[0], -w / v[0], -w * arm / v[0], -half)
            _spread(row, 4, u, -w * f1 / u[0], w / u[0], w * arm / u[0], -half)
            total += _add(system, base, w * turned if kind == 0 else terms.w_rate * over)
    return total


@njit(cache=True)
def _obstacles(field: FieldData, cover: Cover, terms: Terms, band: FloatArray, i: int, system: System) -> float:
    """Clearance of pose i."""
    total = 0.0
    x, y = band[i, 0], band[i, 1]
    c, s = cos(band[i, 2]), sin(band[i, 2])
    for k in range(len(cover.x)):
        ox, oy = cover.x[k] * c - cover.y[k] * s, cover.x[k] * s + cover.y[k] * c
        value, gx, gy = distance(field, x + ox, y + oy)
        lack = terms.clearance - (value - cover.radius[k])
        if lack > 0.0:
            w = terms.w_obstacle / sqrt(len(cover.x))
            system.row[0], system.row[1], system.row[2] = -w * gx, -w * gy, -w * (gy * ox - gx * oy)
            total += _add(system, 4 * i, w * lack)
    return total


@njit(cache=True)
def _assemble(
    field: FieldData, cover: Cover, terms: Terms, band: FloatArray, sense: FloatArray, system: System
) -> float:
    """All residuals at a band; returns the sum of their squares."""
    n = len(band)
    system.matrix[:] = 0.0
    system.gradient[:] = 0.0
    system.row[:] = 0.0
    v, u = np.empty(5), np.empty(5)
    total = 0.0
    for i in range(1, n):
        total += _single(terms, band, sense, i, system, v)
        if i < n - 1:
            total += _double(terms, band, sense, i, system, v, u)
            total += _obstacles(field, cover, terms, band, i, system)
    return total


@njit(cache=True)
def _solve(matrix: FloatArray, vector: FloatArray) -> bool:
    """Solve a banded positive definite system in place (Cholesky); False if it is not definite."""
    n = len(vector)
    for i in range(n):
        first = max(0, i - WIDTH + 1)
        for j in range(first, i + 1):
            value = matrix[i, i - j]
            for k in range(max(first, j - WIDTH + 1), j):
                value -= matrix[i, i - k] * matrix[j, j - k]
            if i == j:
                if value <= 0.0:
                    return False
                matrix[i, 0] = sqrt(value)
            else:
                matrix[i, i - j] = value / matrix[j, 0]
    for i in range(n):
        value = vector[i]
        for k in range(max(0, i - WIDTH + 1), i):
            value -= matrix[i, i - k] * vector[k]
        vector[i] = value / matrix[i, 0]
    for i in range(n - 1, -1, -1):
        value = vector[i]
        for k in range(i + 1, min(n, i + WIDTH)):
            value -= matrix[k, k - i] * vector[k]
        vector[i] = value / matrix[i, 0]
    return True


@njit(cache=True)
def cost_and_gradient(
    field: FieldData, cover: Cover, terms: Terms, band: FloatArray, sense: FloatArray
) -> tuple[float, FloatArray]:
    """Half the sum of squares, and its gradient, shape (4 n,)."""
    n = len(band)
    # Residuals at the last poses reach over the end.
    system = System(np.zeros((4 * n + WIDTH, WIDTH)), np.zeros(4 * n + WIDTH), np.zeros(WIDTH))
    total = _assemble(field, cover, terms, band, sense, system)
    return 0.5 * total, system.gradient[: 4 * n].copy()


@njit(cache=True)
def settle(
    field: FieldData, cover: Cover, terms: Terms, band: FloatArray, sense: FloatArray, iterations: int
) -> tuple[float, int]:
    """Levenberg-Marquardt steps; the first and the last pose stay.

    Args:
        field: obstacles.
        cover: footprint.
        terms: vehicle, limits, weights.
        band: shape (n, 4): x, y, yaw (continuous), seconds of the interval before; changed in place.
        sense: shape (n,), +1 or -1: direction of the interval before.
        iterations: steps at most.

    Returns:
        Half the sum of squares at the end, and the number of steps that gained.
    """
    n = len(band)
    size = 4 * n
    system = System(np.zeros((size + WIDTH, WIDTH)), np.zeros(size + WIDTH), np.zeros(WIDTH))
    total = _assemble(field, cover, terms, band, sense, system)
    damping, gained = 1e-3, 0
    trial = band.copy()
    for _ in range(iterations):
        matrix, step = system.matrix[:size].copy(), -system.gradient[:size]
        for i in range(size):
            matrix[i, 0] += damping * (matrix[i, 0] + 1.0)
        for i in range(size):
            if i < 4 or size - 4 <= i < size - 1:
                matrix[i, 0] += FAR
                step[i] = 0.0
        if not _solve(matrix, step):
            damping *= 10.0
            continue
        for i in range(1, n):
            for k in range(3):
                trial[i, k] = band[i, k] + step[4 * i + k]
            trial[i, 3] = max(band[i, 3] + step[4 * i + 3], 0.5 * LEAST_TIME)
        new = _assemble(field, cover, terms, trial, sense, system)
        if new < total:
            gained += 1
            done = total - new < 1e-4 * total
            band[:] = trial
            total, damping = new, max(0.3 * damping, 1e-6)
            if done:
                break
        else:
            damping *= 8.0
            _assemble(field, cover, terms, band, sense, system)
    return 0.5 * total, gained
