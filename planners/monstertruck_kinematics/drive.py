"""Protocol of all drive families, and their common checks.

A command consists of the drive's inputs in order (speeds m/s, wheel rates rad/s, angles rad). A twist is (vx, vy, wz)
of the drive's reference point in the body frame. Both are tuples of floats, or of (N,) arrays for N states at once; an
(m, N) array works as well.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from monstertruck_kinematics.elementary import KinematicsError, Real, require_finite
from monstertruck_kinematics.se2 import TwistOf
from monstertruck_kinematics.wheels import Wheel


class Drive(Protocol):
    """A drive family with its dimensions."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the command's entries."""

    def forward(self, command: Sequence[Real]) -> TwistOf[Real]:
        """Twist that a command produces."""

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """Command that produces a twist.

        Raises:
            KinematicsError: the family cannot produce this twist (the text names the component), or NaN.
        """

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The wheels at a command's steering angles, for ``wheels.analyse``."""


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
    """Return the values; refuse non-finite values and a wrong number of values.

    Raises:
        KinematicsError: the message names the entry.
    """
    if len(values) != len(names):
        raise KinematicsError(f"got {len(values)} values: expected {len(names)} ({', '.join(names)})")
    for name, value in zip(names, values, strict=True):
        require_finite(name, value)
    return tuple(values)


TWIST = ("vx", "vy", "wz")
