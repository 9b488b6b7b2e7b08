"""Skid-steer kinematics: ideal, turning-centre parameters, centre of mass off the middle, effective radius.

All four are one model. Each side's tread touches the ground as if it turned about its own centre on the lateral axis;
an ideal robot has those centres at its wheels, a skidding one farther out (slower turning), an effective radius or a
slip factor scales a side's speed, and a reference point off the middle shifts both centres alike.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from monstertruck_kinematics.elementary import Array, Real, require_finite, require_positive
from monstertruck_kinematics.errors import KinematicsError
from monstertruck_kinematics.families.base import TWIST, Twist, refuse, require_limit, scaled_to, stacked, unpacked
from monstertruck_kinematics.wheels import FixedWheel, Wheel


@dataclass(frozen=True)
class SkidSteer:
    """Skid-steer drive (skid-steer paper, eqs. 1-11, and their extension by turning-centre parameters).

    omega = (s_R - s_L)/(y_L - y_R), v_x = (s_R y_L - s_L y_R)/(y_L - y_R), v_y = -x_ICR omega (eq. 6), with the side
    speeds s = gain r times the wheel rate.

    Args:
        radius: of the wheels, m.
        icr_left: lateral position y_L of the left side's centre in the reference point's frame, m (ideal: c).
        icr_right: y_R of the right side's (ideal: -c).
        icr_x: longitudinal position x_ICR of the turning centre, m.
        gain_left: effective over nominal radius, slip included, of the left side.
        gain_right: of the right side.
        max_rate: of a wheel, rad/s.
        length: between front and rear wheels, m; only ``wheels`` uses it.

    Raises:
        KinematicsError: a length or gain not above 0, or the centres the wrong way round.
    """

    radius: float
    icr_left: float
    icr_right: float
    icr_x: float = 0.0
    gain_left: float = 1.0
    gain_right: float = 1.0
    max_rate: float = math.inf
    length: float = 0.061

    inputs = ("left", "right")

    def __post_init__(self) -> None:
        for name in ("radius", "gain_left", "gain_right", "length"):
            require_positive(name, getattr(self, name))
        for name in ("icr_left", "icr_right", "icr_x"):
            require_finite(name, getattr(self, name))
        if self.icr_left <= self.icr_right:
            raise KinematicsError(f"icr_left is {self.icr_left}: expected more than icr_right, {self.icr_right}")
        require_limit("max_rate", self.max_rate)

    @classmethod
    def ideal(cls, radius: float, half_track: float) -> "SkidSteer":
        """No slip at all: a differential drive of half track c (eqs. 10, 11)."""
        return cls(radius, half_track, -half_track)

    def with_centre_of_mass(self, x: float, y: float) -> "SkidSteer":
        """The same robot about a reference point (x, y), m, off the present one (eq. 7)."""
        return replace(self, icr_left=self.icr_left - y, icr_right=self.icr_right - y, icr_x=self.icr_x - x)

    def with_effective_radius(self, factor: float) -> "SkidSteer":
        """The same robot with both sides' effective radius scaled."""
        return replace(self, gain_left=self.gain_left * factor, gain_right=self.gain_right * factor)

    def forward(self, command: Sequence[Real]) -> Twist[Real]:
        """Twist from the wheel rates (left, right)."""
        left, right = unpacked(command, self.inputs)
        left, right = left * (self.gain_left * self.radius), right * (self.gain_right * self.radius)
        width = self.icr_left - self.icr_right
        wz = (right - left) / width
        return (right * self.icr_left - left * self.icr_right) / width, -self.icr_x * wz, wz

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """Wheel rates for a twist whose side speed is -x_ICR times its yaw rate."""
        vx, vy, wz = unpacked(twist, TWIST)
        refuse("vy", vy + self.icr_x * wz, vx, "a skid-steer drive's side speed is -icr_x times its yaw rate")
        return (
            (vx - self.icr_left * wz) / (self.gain_left * self.radius),
            (vx - self.icr_right * wz) / (self.gain_right * self.radius),
        )

    def limited(self, command: Sequence[Real]) -> tuple[Real, ...]:
        """Both rates scaled alike: same path, slower."""
        left, right = unpacked(command, self.inputs)
        factor = scaled_to((left, right), self.max_rate)
        return left * factor, right * factor

    def jacobian(self, command: Sequence[Real]) -> Array:
        """Constant."""
        left, _ = unpacked(command, self.inputs)
        zero = 0.0 * left
        width = self.icr_left - self.icr_right
        by_left, by_right = self.gain_left * self.radius / width, self.gain_right * self.radius / width
        return stacked(
            [
                [zero - by_left * self.icr_right, zero + by_right * self.icr_left],
                [zero + by_left * self.icr_x, zero - by_right * self.icr_x],
                [zero - by_left, zero + by_right],
            ]
        )

    def turning_radius(self, ratio: Real) -> Real:
        """Signed radius of the path, m, when the right wheels turn ``ratio`` times as fast as the left ones.

        Ideal: c (k + 1)/(k - 1). Only the lateral part, v_x/omega; not for ratio = gain_left/gain_right (straight).
        """
        fast = ratio * (self.gain_right / self.gain_left)
        return (fast * self.icr_left - self.icr_right) / (fast - 1.0)

    def side_slip(self, twist: Sequence[Real], half_length: float) -> tuple[Real, Real]:
        """Sideways speeds v_F and v_B of the wheels half_length before and behind the reference point (eqs. 8, 9)."""
        _, vy, wz = unpacked(twist, TWIST)
        return vy + half_length * wz, vy - half_length * wz

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """Four fixed wheels where the sides' centres lie: without slip they could only go straight."""
        unpacked(command, self.inputs)
        ahead = self.length / 2.0
        return tuple(
            FixedWheel(name, x, y, self.radius)
            for name, x, y in (
                ("rear left", -ahead, self.icr_left),
                ("front left", ahead, self.icr_left),
                ("front right", ahead, self.icr_right),
                ("rear right", -ahead, self.icr_right),
            )
        )
