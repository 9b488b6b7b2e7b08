"""Drives without steering: differential, skid-steer, and omnidirectional drives on Swedish wheels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from monstertruck_kinematics.drive import TWIST, refuse, unpacked
from monstertruck_kinematics.elementary import Array, KinematicsError, Real, require_finite, require_positive
from monstertruck_kinematics.se2 import TwistOf
from monstertruck_kinematics.wheels import CasterWheel, FixedWheel, SwedishWheel, Wheel, rolling_matrix


@dataclass(frozen=True)
class Differential:
    """Differential drive about the middle of its axle: v = r (w_R + w_L)/2, omega = r (w_R - w_L)/track.

    Args:
        radius: radius of the wheels, m.
        track: distance between the wheels, m.

    Raises:
        KinematicsError: a field is not above 0.
    """

    radius: float = 0.1
    track: float = 0.3

    inputs = ("left", "right")

    def __post_init__(self) -> None:
        require_positive("radius", self.radius)
        require_positive("track", self.track)

    def forward(self, command: Sequence[Real]) -> TwistOf[Real]:
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

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """Two fixed wheels and the roller ball that balances them."""
        unpacked(command, self.inputs)
        half = self.track / 2.0
        return (
            FixedWheel("left", 0.0, half, self.radius),
            FixedWheel("right", 0.0, -half, self.radius),
            CasterWheel("balance", -self.track, 0.0, self.radius / 2.0, 0.0, self.radius / 4.0),
        )


@dataclass(frozen=True)
class SkidSteer:
    """Skid-steer drive (skid-steer paper, eqs. 1-11, and their extension by ICR parameters).

    One model covers four cases. Each side's tread moves as if it turned about its own ICR on the lateral axis: at the
    wheels for an ideal robot, further out for one that skids (it turns more slowly). An effective radius or a slip
    factor scales a side's speed, and a reference point off the middle shifts both ICRs equally.

    omega = (s_R - s_L)/(y_L - y_R), v_x = (s_R y_L - s_L y_R)/(y_L - y_R), v_y = -x_ICR omega (eq. 6), with the side
    speeds s = gain r times the wheel rate.

    Args:
        radius: radius of the wheels, m.
        icr_left: lateral position y_L of the left side's ICR in the reference point's frame, m (ideal: c).
        icr_right: y_R of the right side's (ideal: -c).
        icr_x: longitudinal position x_ICR of the ICRs, m.
        gain_left: effective over nominal radius, slip included, of the left side.
        gain_right: of the right side.
        front: b, distance of the front wheels ahead of the reference point, m.
        rear: a, distance of the rear wheels behind it, m; unlike ``front`` where the mass lies off the middle.

    Raises:
        KinematicsError: a length or gain not above 0, or icr_left not left of icr_right.
    """

    radius: float
    icr_left: float
    icr_right: float
    icr_x: float = 0.0
    gain_left: float = 1.0
    gain_right: float = 1.0
    front: float = 0.0305
    rear: float = 0.0305

    inputs = ("left", "right")

    def __post_init__(self) -> None:
        for name in ("radius", "gain_left", "gain_right", "front", "rear"):
            require_positive(name, getattr(self, name))
        for name in ("icr_left", "icr_right", "icr_x"):
            require_finite(name, getattr(self, name))
        if self.icr_left <= self.icr_right:
            raise KinematicsError(f"icr_left is {self.icr_left}: expected more than icr_right, {self.icr_right}")

    @classmethod
    def ideal(cls, radius: float, half_track: float) -> "SkidSteer":
        """No slip at all: a differential drive of half track c (eqs. 10, 11)."""
        return cls(radius, half_track, -half_track)

    def forward(self, command: Sequence[Real]) -> TwistOf[Real]:
        """Twist from the wheel rates (left, right)."""
        left, right = unpacked(command, self.inputs)
        left, right = left * (self.gain_left * self.radius), right * (self.gain_right * self.radius)
        width = self.icr_left - self.icr_right
        wz = (right - left) / width
        return (right * self.icr_left - left * self.icr_right) / width, -self.icr_x * wz, wz

    def skids(self, command: Sequence[Real]) -> tuple[Real, Real]:
        """Sideways speeds, m/s, of the front and rear wheels: (b - x_ICR) omega and (-a - x_ICR) omega (eq. 9)."""
        _, vy, wz = self.forward(command)
        return vy + self.front * wz, vy - self.rear * wz

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """Wheel rates for a twist whose side speed is -x_ICR times its yaw rate."""
        vx, vy, wz = unpacked(twist, TWIST)
        refuse("vy", vy + self.icr_x * wz, vx, "a skid-steer drive's side speed is -icr_x times its yaw rate")
        return (
            (vx - self.icr_left * wz) / (self.gain_left * self.radius),
            (vx - self.icr_right * wz) / (self.gain_right * self.radius),
        )

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """Four fixed wheels at the centres of the sides; without slip, they could only drive straight."""
        unpacked(command, self.inputs)
        return tuple(
            FixedWheel(name, x, y, self.radius)
            for name, x, y in (
                ("rear left", -self.rear, self.icr_left),
                ("front left", self.front, self.icr_left),
                ("front right", self.front, self.icr_right),
                ("rear right", -self.rear, self.icr_right),
            )
        )


@dataclass(frozen=True)
class SwedishDrive:
    """Any set of driven Swedish wheels.

    With more than three wheels a command may contradict itself; forward is then the least-squares twist.

    Args:
        swedish: the wheels; the command is their rates in this order, rad/s.

    Raises:
        KinematicsError: the wheels cannot drive every direction (all in line, or fewer than three).
    """

    swedish: tuple[SwedishWheel, ...]
    rates_of_twist: Array = field(init=False, repr=False, compare=False)
    """(m, 3): wheel rates for a unit of each twist component."""
    twist_of_rates: Array = field(init=False, repr=False, compare=False)
    """(3, m): its pseudo-inverse."""

    def __post_init__(self) -> None:
        matrix = rolling_matrix(self.swedish)
        size = max(math.hypot(w.x, w.y) for w in self.swedish) or 1.0
        if np.linalg.matrix_rank(matrix / [1.0, 1.0, size], tol=1e-9 * float(np.abs(matrix).max())) < 3:
            names = ", ".join(w.name for w in self.swedish)
            raise KinematicsError(f"wheels {names}: together they cannot produce all of vx, vy and wz")
        object.__setattr__(self, "rates_of_twist", matrix)
        object.__setattr__(self, "twist_of_rates", np.linalg.pinv(matrix))

    @property
    def inputs(self) -> tuple[str, ...]:
        """The wheels' names."""
        return tuple(w.name for w in self.swedish)

    def forward(self, command: Sequence[Real]) -> TwistOf[Real]:
        """Twist from the wheel rates."""
        rates = unpacked(command, self.inputs)
        vx, vy, wz = (_combined(row, rates) for row in self.twist_of_rates.tolist())
        return vx, vy, wz

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """Wheel rates for any twist."""
        components = unpacked(twist, TWIST)
        return tuple(_combined(row, components) for row in self.rates_of_twist.tolist())

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The wheels."""
        unpacked(command, self.inputs)
        return self.swedish


def omni(circle: float = 0.2, wheel_radius: float = 0.05, count: int = 3) -> SwedishDrive:
    """Robot with ``count`` 90 deg Swedish wheels spaced evenly on a circle, rolling along it.

    Args:
        circle: radius of the circle, m.
        wheel_radius: m.
        count: count of wheels, three or more.

    Raises:
        KinematicsError: fewer than three wheels, or a length not above 0.
    """
    require_positive("circle", circle)
    if count < 3:
        raise KinematicsError(f"count is {count}: expected three Swedish wheels or more")
    angles = [2.0 * math.pi * i / count for i in range(count)]
    wheels = tuple(
        SwedishWheel(f"wheel {i + 1}", circle * math.cos(a), circle * math.sin(a), wheel_radius, a + math.pi / 2.0)
        for i, a in enumerate(angles)
    )
    return SwedishDrive(wheels)


def mecanum(wheelbase: float = 0.32, track: float = 0.26, wheel_radius: float = 0.05) -> SwedishDrive:
    """Four mecanum wheels whose rollers, seen from above, form an X (a driven front left wheel pushes to the right).

    Args:
        wheelbase: m.
        track: m.
        wheel_radius: m.

    Raises:
        KinematicsError: a length is not above 0.
    """
    require_positive("wheelbase", wheelbase)
    require_positive("track", track)
    ahead, aside = wheelbase / 2.0, track / 2.0
    corners = (
        ("front left", ahead, aside, -1.0),
        ("front right", ahead, -aside, 1.0),
        ("rear left", -ahead, aside, 1.0),
        ("rear right", -ahead, -aside, -1.0),
    )
    return SwedishDrive(
        tuple(SwedishWheel(name, x, y, wheel_radius, 0.0, turn * math.pi / 4.0) for name, x, y, turn in corners),
    )


def _combined(weights: list[float], values: Sequence[Real]) -> Real:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total = total + weight * value
    return total
