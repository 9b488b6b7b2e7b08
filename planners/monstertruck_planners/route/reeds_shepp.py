"""Shortest motions without obstacles: Reeds-Shepp, extended by translations for two steered axles. Loads numba.

Source: J. A. Reeds and L. A. Shepp, "Optimal paths for a car that goes both forwards and backwards", Pacific Journal of
Mathematics 145(2), 1990, section 8. Lengths are in turning radii, the start is the origin, L and R are arcs of radius
1, S is a straight line. A formula solves one pattern; driving backward (``flip``), mirrored left for right (``mirror``)
and the reversed order (``backward``) give the others, 48 words in all.

A vehicle that can crab has further words: arc, translation at the full crab angle, arc, each of them forward or
backward; arc and translation in either order, the translation at any angle the vehicle can take, or else a zigzag of
two at the full one.
"""

import math
from dataclasses import dataclass, field
from math import acos, asin, atan2, ceil, cos, floor, inf, pi, sin, sqrt

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.route.motion import MotionPath
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import Steering

SLACK = 1e-10
"""Rounding tolerance for signs in the formulas."""

MAX_SEGMENTS = 5
"""Maximum number of segments in a motion."""

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
def _wrap_upper(angle: float) -> float:
    """Wrap an angle to (-pi, pi], with a rounding error above -pi mapped to pi."""
    return float(angle - 2 * pi * ceil((angle - pi - SLACK) / (2 * pi)))


@njit(cache=True)
def _wrap_lower(angle: float) -> float:
    """Wrap an angle to [-pi, pi), with a rounding error below pi mapped to -pi."""
    return float(angle - 2 * pi * floor((angle + pi + SLACK) / (2 * pi)))


@njit(cache=True)
def _lengths(pattern: int, t: float, u: float, v: float, out: Array) -> None:
    """Return the signed lengths of a pattern's pieces."""
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
def _keep_solution(
    best: Array, pieces: Array, weights: Array, pattern: int,
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
        cost = _word_cost(pieces, flip, weights)
        if cost >= best[COST]:
            return
    best[COST], best[PATTERN], best[FLIP], best[MIRROR], best[BACKWARD] = cost, pattern, flip, mirror, backward
    best[T], best[U], best[V] = t, u, v


@njit(cache=True)
def _word_cost(pieces: Array, flip: float, weights: Array) -> float:
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
    """Return first and last angle of the four-arc patterns with middle angles u and v."""
    delta = u - v
    a, b = sin(u) - sin(delta), cos(u) - cos(delta) - 1.0
    t = atan2(eta * a - xi * b, xi * a + eta * b)
    if 2.0 * (cos(delta) - cos(v) - cos(u)) + 3.0 < 0.0:
        t += pi
    return t, t - u + v - phi


@njit(cache=True)
def _reversible_patterns(
    best: Array, pieces: Array, weights: Array, flip: float, mirror: float, backward: float,
    phi: float, r1: float, a1: float, r2: float, xi2: float, eta2: float,
) -> None:  # fmt: skip
    """Patterns that are also valid in reversed order: LRL, LRSL, LRSR; polar (r, a) of the end circle's centre."""
    if r1 <= 4.0 and 0.5 * r1 < best[COST]:
        u = -2.0 * asin(r1 / 4.0)
        t = _wrap_upper(a1 + u / 2 + pi)
        if t >= -SLACK:
            _keep_solution(best, pieces, weights, LRL, flip, mirror, backward, t, u, _wrap_upper(phi - t + u))
    if r1 >= 2.0:
        r = sqrt(r1 * r1 - 4.0)
        u = 2.0 - r
        if u <= SLACK and pi / 2 - u < best[COST]:
            t = _wrap_upper(a1 + atan2(r, -2.0))
            v = _wrap_lower(phi - pi / 2 - t)
            if t >= -SLACK and v <= SLACK:
                _keep_solution(best, pieces, weights, LRSL, flip, mirror, backward, t, u, v)
    if r2 >= 2.0 and pi / 2 + r2 - 2.0 < best[COST]:
        u = 2.0 - r2
        t = _wrap_upper(atan2(xi2, -eta2))
        v = _wrap_lower(t + pi / 2 - phi)
        if t >= -SLACK and v <= SLACK:
            _keep_solution(best, pieces, weights, LRSR, flip, mirror, backward, t, u, v)


@njit(cache=True)
def _symmetric_patterns(
    best: Array, pieces: Array, weights: Array, flip: float, mirror: float,
    phi: float, r1: float, a1: float, r2: float, a2: float, xi2: float, eta2: float,
) -> None:  # fmt: skip
    """Patterns that are their own reversal."""
    t = _wrap_upper(a1)
    if t >= -SLACK and r1 + t < best[COST]:
        v = _wrap_upper(phi - t)
        if v >= -SLACK:
            _keep_solution(best, pieces, weights, LSL, flip, mirror, 1.0, t, r1, v)
    if r2 >= 2.0:
        u = sqrt(r2 * r2 - 4.0)
        if u < best[COST]:
            t = _wrap_upper(a2 + atan2(2.0, u))
            v = _wrap_upper(t - phi)
            if t >= -SLACK and v >= -SLACK:
                _keep_solution(best, pieces, weights, LSR, flip, mirror, 1.0, t, u, v)
        u = 4.0 - u
        if u <= SLACK and pi - u < best[COST]:
            t = _wrap_upper(atan2((4.0 - u) * xi2 - 2.0 * eta2, -2.0 * xi2 + (u - 4.0) * eta2))
            v = _wrap_upper(t - phi)
            if t >= -SLACK and v >= -SLACK:
                _keep_solution(best, pieces, weights, LRSLR, flip, mirror, 1.0, t, u, v)
    rho = (2.0 + r2) / 4.0
    if rho <= 1.0 and 2.0 * acos(rho) < best[COST]:
        u = acos(rho)
        t, v = _tau_omega(u, -u, xi2, eta2, phi)
        t, v = _wrap_upper(t), _wrap_lower(v)
        if t >= -SLACK and v <= SLACK:
            _keep_solution(best, pieces, weights, LRLR_SAME, flip, mirror, 1.0, t, u, v)
    rho = (20.0 - r2 * r2) / 16.0
    if 0.0 <= rho <= 1.0 and 2.0 * acos(rho) < best[COST]:
        u = -acos(rho)
        t, v = _tau_omega(u, u, xi2, eta2, phi)
        t, v = _wrap_upper(t), _wrap_upper(v)
        if t >= -SLACK and v >= -SLACK:
            _keep_solution(best, pieces, weights, LRLR_CUSP, flip, mirror, 1.0, t, u, v)


@njit(cache=True)
def _best_word(x: float, y: float, phi: float, weights: Array, best: Array, pieces: Array) -> None:
    """Find the cheapest word from the origin to (x, y, phi).

    Args:
        x: position (turning radii).
        y: position (turning radii).
        phi: heading (rad).
        weights: cost per radius backward (at least 1), and of a change of direction (at least 0).
        best: solution, shape (8,), written in place.
        pieces: scratch array, shape (5,).
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
        _symmetric_patterns(best, pieces, weights, flip, mirror, angle, r1, a1, r2, atan2(eta2, xi2), xi2, eta2)
        _reversible_patterns(best, pieces, weights, flip, mirror, 1.0, angle, r1, a1, r2, xi2, eta2)
        px, py = flip * back_x, mirror * back_y
        xi1, eta1, xi2, eta2 = px - s, py - 1.0 + cos_phi, px + s, py - 1.0 - cos_phi
        r1, a1, r2 = sqrt(xi1 * xi1 + eta1 * eta1), atan2(eta1, xi1), sqrt(xi2 * xi2 + eta2 * eta2)
        _reversible_patterns(best, pieces, weights, flip, mirror, -1.0, angle, r1, a1, r2, xi2, eta2)


@njit(cache=True)
def write_segments(best: Array, radius: float, segments: Array, pieces: Array) -> int:
    """Write a solution as up to 5 segments (signed length m, curvature 1/m, sideslip rad); return their number."""
    pattern = int(best[PATTERN])
    count = PIECES[pattern]
    _lengths(pattern, best[T], best[U], best[V], pieces)
    written = 0
    for i in range(count):
        k = i if best[BACKWARD] > 0.0 else count - 1 - i
        length = best[FLIP] * pieces[k]
        if abs(length) <= SLACK:
            continue
        segments[written, 0] = length * radius
        segments[written, 1] = best[MIRROR] * TURNS[pattern, k] / radius
        segments[written, 2] = 0.0
        written += 1
    return written


@njit(cache=True)
def _relative_pose(start: Array, goal: Array, radius: float) -> tuple[float, float, float]:
    """Return the goal relative to the start, lengths in turning radii, the angle within +-pi."""
    dx, dy = (goal[0] - start[0]) / radius, (goal[1] - start[1]) / radius
    c, s = cos(start[2]), sin(start[2])
    turn = goal[2] - start[2]
    return dx * c + dy * s, dy * c - dx * s, turn - 2 * pi * floor((turn + pi) / (2 * pi))


@njit(cache=True)
def _word_distances(starts: Array, goals: Array, radius: float, weights: Array) -> Array:
    """Return the cost of the cheapest word of every pair, in radii times ``radius``."""
    result = np.empty(len(starts))
    best, pieces = np.empty(8), np.empty(5)
    for i in range(len(starts)):
        x, y, phi = _relative_pose(starts[i], goals[i], radius)
        _best_word(x, y, phi, weights, best, pieces)
        result[i] = best[COST] * radius
    return result


@njit(cache=True)
def _wrap(angle: float) -> float:
    while angle > pi:
        angle -= 2 * pi
    while angle <= -pi:
        angle += 2 * pi
    return angle


@njit(cache=True)
def _keep_if_cheaper(
    word: Array, count: int, mirror: float, weights: Array, best: Array, segments: Array, kept: int
) -> int:
    """Keep a word (before mirroring) if it is the cheapest so far; return the number of segments of the best one."""
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
            segments[kept, 0], segments[kept, 1], segments[kept, 2] = (
                word[i, 0],
                mirror * word[i, 1],
                mirror * word[i, 2],
            )
            kept += 1
    return kept


@njit(cache=True)
def _set_segment(word: Array, i: int, length: float, curvature: float, sideslip: float) -> None:
    word[i, 0], word[i, 1], word[i, 2] = length, curvature, sideslip


@njit(cache=True)
def _arc_crab_arc(
    x: float, y: float, phi: float, crab: float, mirror: float, weights: Array,
    word: Array, best: Array, segments: Array, kept: int,
) -> int:  # fmt: skip
    """Try left arc, translation, left or right arc; the translation joins the two turning circles."""
    xi, eta = x - sin(phi), y - 1.0 + cos(phi)
    r, a = sqrt(xi * xi + eta * eta), atan2(eta, xi)
    xi2, eta2 = x + sin(phi), y - 1.0 - cos(phi)
    a2 = atan2(eta2, xi2)
    for k in range(4):
        slip = crab if k & 1 else -crab
        sign = 1.0 if k & 2 else -1.0
        t = _wrap(a + (0.0 if sign > 0.0 else pi) - slip)
        _set_segment(word, 0, t, 1.0, 0.0)
        _set_segment(word, 1, sign * r, 0.0, slip)
        _set_segment(word, 2, _wrap(phi - t), 1.0, 0.0)
        kept = _keep_if_cheaper(word, 3, mirror, weights, best, segments, kept)
        # In the frame turned by t the centres differ by (u cos, u sin - 2).
        root = 4.0 * sin(slip) ** 2 + xi2 * xi2 + eta2 * eta2 - 4.0
        if root < 0.0:
            continue
        u = 2.0 * sin(slip) + sign * sqrt(root)
        t = _wrap(a2 - atan2(u * sin(slip) - 2.0, u * cos(slip)))
        _set_segment(word, 0, t, 1.0, 0.0)
        _set_segment(word, 1, u, 0.0, slip)
        _set_segment(word, 2, _wrap(t - phi), -1.0, 0.0)
        kept = _keep_if_cheaper(word, 3, mirror, weights, best, segments, kept)
    return kept


@njit(cache=True)
def _translation(word: Array, first: int, x: float, y: float, crab: float) -> int:
    """Write the segments of the shortest translation by (x, y), from index ``first`` on; return their number."""
    r = sqrt(x * x + y * y)
    angle = atan2(y, x)
    if abs(angle) <= crab:
        _set_segment(word, first, r, 0.0, angle)
        return 1
    angle = atan2(-y, -x)
    if abs(angle) <= crab:
        _set_segment(word, first, -r, 0.0, angle)
        return 1
    along, aside = x / cos(crab), y / sin(crab)
    _set_segment(word, first, 0.5 * (along + aside), 0.0, crab)
    _set_segment(word, first + 1, 0.5 * (along - aside), 0.0, -crab)
    return 2


@njit(cache=True)
def _arc_and_crab(
    x: float, y: float, phi: float, crab: float, mirror: float, weights: Array,
    word: Array, best: Array, segments: Array, kept: int,
) -> int:  # fmt: skip
    """Try left arc and translation in both orders."""
    px, py = x - sin(phi), y - 1.0 + cos(phi)
    c, s = cos(phi), sin(phi)
    _set_segment(word, 0, phi, 1.0, 0.0)
    count = _translation(word, 1, px * c + py * s, py * c - px * s, crab)
    kept = _keep_if_cheaper(word, 1 + count, mirror, weights, best, segments, kept)
    count = _translation(word, 0, px, py, crab)
    _set_segment(word, count, phi, 1.0, 0.0)
    return _keep_if_cheaper(word, count + 1, mirror, weights, best, segments, kept)


@njit(cache=True)
def connect(
    start: Array, goal: Array, radius: float, crab: float, weights: Array,
    segments: Array, best: Array, scratch: Array,
) -> int:  # fmt: skip
    """Find the cheapest motion from one pose to another.

    Args:
        start: x, y (m), yaw (rad).
        goal: x, y (m), yaw (rad).
        radius: turning radius (m).
        crab: maximum angle of a translation (rad); 0 for none.
        weights: cost per metre backward and of a change of direction (radii), and factor on translations.
        segments: motion, shape (5, 3), written in place: signed length m, curvature 1/m, sideslip rad.
        best: array, shape (8,), whose first field receives the cost in radii.
        scratch: scratch array, shape (4, 3).

    Returns:
        Number of segments.
    """
    x, y, phi = _relative_pose(start, goal, radius)
    pieces = scratch.reshape(12)[:5]
    _best_word(x, y, phi, weights, best, pieces)
    kept = write_segments(best, radius, segments, pieces)
    if crab <= 0.0:
        return kept
    own = kept
    kept = -1
    for k in range(2):
        mirror = 1.0 if k == 0 else -1.0
        kept = _arc_crab_arc(x, mirror * y, mirror * phi, crab, mirror, weights, scratch, best, segments, kept)
        kept = _arc_and_crab(x, mirror * y, mirror * phi, crab, mirror, weights, scratch, best, segments, kept)
    if kept < 0:
        return own
    for i in range(kept):
        segments[i, 0] *= radius
        segments[i, 1] /= radius
    return kept


@njit(cache=True)
def _crab_distances(starts: Array, goals: Array, radius: float, crab: float, weights: Array) -> Array:
    """Return the cost of the cheapest motion of every pair (m)."""
    result = np.empty(len(starts))
    segments, best, scratch = np.empty((MAX_SEGMENTS, 3)), np.full(8, inf), np.empty((4, 3))
    for i in range(len(starts)):
        connect(starts[i], goals[i], radius, crab, weights, segments, best, scratch)
        result[i] = best[COST] * radius
    return result


@njit(cache=True)
def _best_segments(start: Array, goal: Array, radius: float, crab: float, weights: Array) -> Array:
    """Return the segments of the cheapest motion, shape (n, 3)."""
    segments, best, scratch = np.empty((MAX_SEGMENTS, 3)), np.full(8, inf), np.empty((4, 3))
    return segments[: connect(start, goal, radius, crab, weights, segments, best, scratch)]


@dataclass(frozen=True)
class ReedsShepp:
    """Cheapest motions between two poses: arcs of one radius, straight lines and, with a crab angle, translations.

    With the default costs a motion's cost is its length: the exact Reeds-Shepp metric.

    Args:
        radius: turning radius of the reference point (m).
        crab_angle: maximum angle between heading and translation (rad); 0 for no translations.
        reverse_cost: cost per metre backward, at least 1.
        cusp_cost: cost of a change of direction (m), at least 0.
        crab_cost: cost factor of a translation, at least 1.
        steering: steering mode of arcs and lines, see ``MotionPath``.
        reference: reference of the motions, see ``MotionPath``.

    Raises:
        InputError: a number is out of these bounds.
    """

    radius: float
    crab_angle: float = 0.0
    reverse_cost: float = 1.0
    cusp_cost: float = 0.0
    crab_cost: float = 1.0
    steering: Steering = "counter"
    reference: float = 0.0
    weights: Array = field(init=False, repr=False, compare=False)
    """Return the costs in the form used by ``connect``."""

    def __post_init__(self) -> None:
        if not (
            0.0 < self.radius < math.inf
            and 0.0 <= self.crab_angle < math.pi / 2
            and 1.0 <= self.reverse_cost < math.inf
            and 0.0 <= self.cusp_cost < math.inf
            and 1.0 <= self.crab_cost < math.inf
        ):
            raise InputError(
                f"Reeds-Shepp radius {self.radius} m, crab angle {self.crab_angle} rad, costs of reverse, cusp, crab "
                f"{self.reverse_cost}, {self.cusp_cost} m, {self.crab_cost}: expected a radius above 0, an angle from "
                "0 to below 90 deg, costs from 1, 0 and 1"
            )
        weights = np.array([self.reverse_cost, self.cusp_cost / self.radius, self.crab_cost])
        object.__setattr__(self, "weights", weights)

    def distance(self, starts: ArrayLike, goals: ArrayLike) -> Array:
        """Return the cost of the best motion of every pair (m).

        Args:
            starts: shape (n, 3) or (3,).
            goals: poses in the same shape; either argument may be a single pose.

        Returns:
            Shape (n,).
        """
        a, b = np.broadcast_arrays(_poses(starts), _poses(goals))
        if self.crab_angle:
            return _crab_distances(a, b, self.radius, self.crab_angle, self.weights)
        return _word_distances(a, b, self.radius, self.weights)

    def path(self, start: ArrayLike, goal: ArrayLike) -> MotionPath:
        """Return the best motion from one pose to another."""
        a, b = _poses(start)[0].copy(), _poses(goal)[0].copy()
        segments = _best_segments(a, b, self.radius, self.crab_angle, self.weights)
        return MotionPath(a, segments, self.steering, self.reference)


def _poses(values: ArrayLike) -> Array:
    poses = np.ascontiguousarray(np.atleast_2d(np.asarray(values, dtype=np.float64)))
    if poses.ndim != 2 or poses.shape[1] != 3 or not np.isfinite(poses).all():
        raise InputError("Reeds-Shepp: expected finite poses (x, y, yaw)")
    return poses
