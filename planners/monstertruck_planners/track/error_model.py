"""Linear model of the error from a path, for the optimal trackers.

With e the distance left of the reference along its heading, p the yaw error, tan_f and tan_r the axles' tangents and v
the forward speed (negative backwards), to first order

    de/dt = v (p + slip - slip_ref)      slip = (1 - c) tan_f + c tan_r      (eq. 2.34)
    dp/dt = v (turn - turn_ref)          turn = (tan_f - tan_r) / L          (eq. 2.37)

and both axles follow requests with a first-order lag. A steering mode is a basis of (tan_f, tan_r).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_schemas.plan import Steering

BASES: Final[dict[Steering, Array]] = {
    "front": np.array([[1.0], [0.0]]),
    "rear": np.array([[0.0], [1.0]]),
    "counter": np.array([[1.0], [-1.0]]),
    "crab": np.array([[1.0], [1.0]]),
    "hybrid": np.eye(2),
}
"""Axle tangents (front, rear) per unit of each input, as columns."""

LEAST_LAG: Final = 1e-3
"""Assumed minimum lag of the axles (s)."""


@dataclass(frozen=True, slots=True)
class Discrete:
    """Model x' = a x + b u + d r of one period; x = (e, p, axles), r = (tan slip_ref, turn_ref / cos slip_ref)."""

    a: Array
    b: Array
    d: Array


def discretise(geometry: FourWheelSteering, steering: Steering, speed: float, lag: float, period: float) -> Discrete:
    """Return the exact model over one period with constant inputs and reference.

    Args:
        geometry: geometry of the truck.
        steering: steering mode, with one or two inputs.
        speed: forward speed (m/s).
        lag: lag of the axles (s).
        period: period (s).
    """
    basis = BASES[steering]
    m = basis.shape[1]
    n, whole = 2 + m, 2 + m + m + 2
    slip = np.array([1.0 - geometry.cg_split, geometry.cg_split]) @ basis
    turn = np.array([1.0, -1.0]) @ basis / geometry.wheelbase
    rates = np.zeros((whole, whole))
    rates[0, 1] = speed
    rates[0, 2:n] = speed * slip
    rates[1, 2:n] = speed * turn
    rates[2:n, 2:n] = -np.eye(m) / max(lag, LEAST_LAG)
    rates[2:n, n : n + m] = np.eye(m) / max(lag, LEAST_LAG)
    rates[0, n + m] = rates[1, n + m + 1] = -speed
    step = exponential(rates * period)
    return Discrete(step[:n, :n], step[:n, n : n + m], step[:n, n + m :])


def exponential(matrix: Array) -> Array:
    """Return the matrix exponential of a small matrix: scaling, Taylor series, and squaring."""
    halvings = max(int(np.ceil(np.log2(max(float(np.abs(matrix).sum(axis=1).max()), 1e-9)))) + 1, 0)
    small = matrix / 2.0**halvings
    result = term = np.eye(len(matrix))
    for k in range(1, 13):
        term = term @ small / k
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result


def riccati(a: Array, b: Array, q: Array, r: Array, tolerance: float = 1e-10, most: int = 40) -> Array:
    """Return the stabilising solution of P = a'P a - a'P b (r + b'P b)^-1 b'P a + q, by structure-preserving doubling.

    Source: Chu, Fan, Lin and Wang, International Journal of Control 77 (2004).
    """
    g, h = b @ np.linalg.solve(r, b.T), q
    identity = np.eye(len(a))
    for _ in range(most):
        w = np.linalg.inv(identity + g @ h)
        wa = w @ a
        growth = a.T @ h @ wa
        g, h, a = g + a @ w @ g @ a.T, h + growth, a @ wa
        if float(np.abs(growth).max()) <= tolerance * float(np.abs(h).max()):
            break
    return 0.5 * (h + h.T)
