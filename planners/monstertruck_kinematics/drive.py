"""The protocol of all drive families, and the checks they share.

A command is the drive's inputs in order (speeds m/s, wheel rates rad/s, angles rad), a twist is (vx, vy, wz) of the
drive's reference point in the body frame. Both are tuples of floats, or of (N,) arrays for N states at once; an
(m, N) array serves as well.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from monstertruck_kinematics.elementary import Array, KinematicsError, Real, larger, require_finite, require_within
from monstertruck_kinematics.wheels import Wheel

Twist = tuple[Real, Real, Real]


class Drive(Protocol):
    """A drive family with its dimensions and limits."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the command's entries."""

    def forward(self, command: Sequence[Real]) -> Twist[Real]:
        """Twist that a command produces."""

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """Command that produces a twist, without regard to limits.

        Raises:
            KinematicsError: the family cannot produce this twist (the component is named), or NaN.
        """

    def limited(self, command: Sequence[Real]) -> tuple[Real, ...]:
        """Command within the limits, on the same path (curvature and side) as far as the steering allows."""

    def jacobian(self, command: Sequence[Real]) -> Array:
        """(3, m, ...) derivative of the twist by the command."""

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The wheels at a command's steering angles, for ``wheels.analyse``."""


def scaled_to(values: Sequence[Real], limit: float) -> Real:
    """Largest common factor, at most 1, that brings every value within +-limit."""
    largest = abs(values[0])
    for value in values[1:]:
        largest = larger(largest, abs(value))
    return 1.0 / larger(largest / limit, 1.0)


def scaled_alike(values: Sequence[Real], limit: float) -> tuple[Real, ...]:
    """All values scaled by one factor, at most 1, so that they are within +-limit: same path, slower."""
    factor = scaled_to(values, limit)
    return tuple(value * factor for value in values)


def refuse(name: str, value: Real, scale: Real, why: str) -> None:
    """Refuse a twist component that a family cannot produce.

    Raises:
        KinematicsError: |value| above rounding of ``scale``.
    """
    excess = np.abs(value) - 1e-9 * (1.0 + np.abs(scale))
    if np.any(excess > 0.0):
        worst = np.ravel(value)[int(np.argmax(excess))]
        raise KinematicsError(f"{name} is {worst:.6g}: {why}")


def unpacked(values: Sequence[Real], names: tuple[str, ...]) -> tuple[Real, ...]:
    """The values, finite and of the right number.

    Raises:
        KinematicsError: naming the entry.
    """
    if len(values) != len(names):
        raise KinematicsError(f"got {len(values)} values: expected {len(names)} ({', '.join(names)})")
    for name, value in zip(names, values, strict=True):
        require_finite(name, value)
    return tuple(values)


def require_limit(name: str, value: float, high: float = float("inf")) -> None:
    """Refuse a limit that is NaN, not above 0, or above ``high``.

    Raises:
        KinematicsError: naming the field.
    """
    require_within(name, value, 0.0, high)
    if value == 0.0:
        raise KinematicsError(f"{name} is 0: expected a limit above 0")


def stacked(rows: Sequence[Sequence[Real | float]]) -> Array:
    """(3, m, ...) array from rows of entries that broadcast."""
    flat = np.broadcast_arrays(*[np.asarray(entry, dtype=np.float64) for row in rows for entry in row])
    return np.array(flat).reshape(len(rows), len(rows[0]), *flat[0].shape)


TWIST = ("vx", "vy", "wz")
