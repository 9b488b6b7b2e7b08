"""Omnidirectional drives on Swedish wheels: three 90 deg wheels, mecanum, or any other set that spans the plane."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from monstertruck_kinematics.elementary import Array, Real, require_positive
from monstertruck_kinematics.errors import KinematicsError
from monstertruck_kinematics.families.base import TWIST, Twist, require_limit, scaled_to, stacked, unpacked
from monstertruck_kinematics.wheels import SwedishWheel, Wheel, rolling_matrix


@dataclass(frozen=True)
class SwedishDrive:
    """Any set of driven Swedish wheels.

    With more than three wheels a command may contradict itself; forward is then the least-squares twist.

    Args:
        swedish: the wheels; the command is their rates in this order, rad/s.
        max_rate: of a wheel, rad/s.

    Raises:
        KinematicsError: the wheels cannot drive every direction (all in line, or fewer than three).
    """

    swedish: tuple[SwedishWheel, ...]
    max_rate: float = math.inf
    rates_of_twist: Array = field(init=False, repr=False, compare=False)
    """(m, 3): wheel rates for a unit of each twist component."""
    twist_of_rates: Array = field(init=False, repr=False, compare=False)
    """(3, m): its pseudo-inverse."""

    def __post_init__(self) -> None:
        require_limit("max_rate", self.max_rate)
        matrix = rolling_matrix(self.swedish)
        size = max(math.hypot(w.x, w.y) for w in self.swedish) or 1.0
        if np.linalg.matrix_rank(matrix / [1.0, 1.0, size], tol=1e-9 * float(np.abs(matrix).max())) < 3:
            names = ", ".join(w.name for w in self.swedish)
            raise KinematicsError(f"wheels {names}: together they do not drive all of vx, vy and wz")
        object.__setattr__(self, "rates_of_twist", matrix)
        object.__setattr__(self, "twist_of_rates", np.linalg.pinv(matrix))

    @property
    def inputs(self) -> tuple[str, ...]:
        """The wheels' names."""
        return tuple(w.name for w in self.swedish)

    def forward(self, command: Sequence[Real]) -> Twist[Real]:
        """Twist from the wheel rates."""
        rates = unpacked(command, self.inputs)
        vx, vy, wz = (_combined(row, rates) for row in self.twist_of_rates.tolist())
        return vx, vy, wz

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """Wheel rates for any twist."""
        components = unpacked(twist, TWIST)
        return tuple(_combined(row, components) for row in self.rates_of_twist.tolist())

    def limited(self, command: Sequence[Real]) -> tuple[Real, ...]:
        """All rates scaled alike: same path, slower."""
        rates = unpacked(command, self.inputs)
        factor = scaled_to(rates, self.max_rate)
        return tuple(rate * factor for rate in rates)

    def jacobian(self, command: Sequence[Real]) -> Array:
        """Constant."""
        rates = unpacked(command, self.inputs)
        rows = self.twist_of_rates.tolist()
        return stacked([[weight + 0.0 * rate for weight, rate in zip(row, rates, strict=True)] for row in rows])

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The wheels."""
        unpacked(command, self.inputs)
        return self.swedish


def omni(circle: float = 0.2, wheel_radius: float = 0.05, count: int = 3, max_rate: float = math.inf) -> SwedishDrive:
    """Robot with ``count`` 90 deg Swedish wheels spaced evenly on a circle, rolling along it.

    Args:
        circle: radius of the circle, m.
        wheel_radius: m.
        count: of wheels, three or more.
        max_rate: of a wheel, rad/s.

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
    return SwedishDrive(wheels, max_rate)


def mecanum(
    wheelbase: float = 0.32, track: float = 0.26, wheel_radius: float = 0.05, max_rate: float = math.inf
) -> SwedishDrive:
    """Four mecanum wheels whose rollers, seen from above, form an X (a driven front left wheel pushes to the right).

    Args:
        wheelbase: m.
        track: m.
        wheel_radius: m.
        max_rate: of a wheel, rad/s.

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
        max_rate,
    )


def _combined(weights: list[float], values: Sequence[Real]) -> Real:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total = total + weight * value
    return total
