"""Differential drive: two wheels on one axle, each with its own motor."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from monstertruck_kinematics.elementary import Array, Real, require_positive
from monstertruck_kinematics.families.base import TWIST, Twist, refuse, require_limit, scaled_to, stacked, unpacked
from monstertruck_kinematics.wheels import CasterWheel, FixedWheel, Wheel


@dataclass(frozen=True)
class Differential:
    """Differential drive about the middle of its axle: v = r (w_R + w_L)/2, omega = r (w_R - w_L)/track.

    Args:
        radius: of the wheels, m.
        track: distance between the wheels, m.
        max_rate: of a wheel, rad/s.

    Raises:
        KinematicsError: a field is not above 0.
    """

    radius: float = 0.1
    track: float = 0.3
    max_rate: float = math.inf

    inputs = ("left", "right")

    def __post_init__(self) -> None:
        require_positive("radius", self.radius)
        require_positive("track", self.track)
        require_limit("max_rate", self.max_rate)

    def forward(self, command: Sequence[Real]) -> Twist[Real]:
        """Twist from the wheel rates (left, right)."""
        left, right = unpacked(command, self.inputs)
        return (
            (0.5 * self.radius) * (left + right),
            0.0 * left,
            (self.radius / self.track) * (right - left),
        )

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """Wheel rates for a twist without side speed."""
        vx, vy, wz = unpacked(twist, TWIST)
        refuse("vy", vy, vx, "a differential drive cannot move sideways")
        lean = wz * (0.5 * self.track)
        return (vx - lean) / self.radius, (vx + lean) / self.radius

    def limited(self, command: Sequence[Real]) -> tuple[Real, ...]:
        """Both rates scaled alike: same path, slower."""
        left, right = unpacked(command, self.inputs)
        factor = scaled_to((left, right), self.max_rate)
        return left * factor, right * factor

    def jacobian(self, command: Sequence[Real]) -> Array:
        """Constant."""
        left, _ = unpacked(command, self.inputs)
        zero = 0.0 * left
        half, turn = zero + 0.5 * self.radius, zero + self.radius / self.track
        return stacked([[half, half], [zero, zero], [-turn, turn]])

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """Two fixed wheels and the roller ball that balances them."""
        unpacked(command, self.inputs)
        half = self.track / 2.0
        return (
            FixedWheel("left", 0.0, half, self.radius),
            FixedWheel("right", 0.0, -half, self.radius),
            CasterWheel("balance", -self.track, 0.0, self.radius / 2.0, 0.0, self.radius / 4.0),
        )
