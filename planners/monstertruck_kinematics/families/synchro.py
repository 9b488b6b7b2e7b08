"""Synchro drive: all wheels parallel, one motor rolls them, one turns them; the platform keeps its heading."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from monstertruck_kinematics.elementary import Array, Real, require_positive
from monstertruck_kinematics.families.base import TWIST, Twist, refuse, require_limit, scaled_to, stacked, unpacked
from monstertruck_kinematics.motion import to_world
from monstertruck_kinematics.wheels import SteeredWheel, Wheel


@dataclass(frozen=True)
class Synchro:
    """Synchro drive; its posture is (x, y, direction of the wheels), its twist is in the wheels' own frame.

    In those terms it moves like a unicycle: xdot = v cos th, ydot = v sin th, thdot = omega. ``platform_twist`` tells
    what the platform, which never turns, does.

    Args:
        wheel_radius: m.
        circle: radius of the circle (an equilateral triangle) on which the three wheels stand, m.
        max_rate: of the wheels, rad/s.
        max_turn: of the wheels' direction, rad/s.

    Raises:
        KinematicsError: a field is not above 0.
    """

    wheel_radius: float = 0.05
    circle: float = 0.2
    max_rate: float = math.inf
    max_turn: float = math.inf

    inputs = ("roll", "turn")

    def __post_init__(self) -> None:
        require_positive("wheel_radius", self.wheel_radius)
        require_positive("circle", self.circle)
        require_limit("max_rate", self.max_rate)
        require_limit("max_turn", self.max_turn)

    def forward(self, command: Sequence[Real]) -> Twist[Real]:
        """(v, 0, omega) in the wheels' frame from the rolling rate and the turning rate, rad/s."""
        roll, turn = unpacked(command, self.inputs)
        return roll * self.wheel_radius, 0.0 * roll, turn + 0.0 * roll

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """Rates for a twist in the wheels' frame."""
        vx, vy, wz = unpacked(twist, TWIST)
        refuse("vy", vy, vx, "the wheels cannot move sideways")
        return vx / self.wheel_radius, wz

    def limited(self, command: Sequence[Real]) -> tuple[Real, ...]:
        """Both rates scaled alike: same path, slower."""
        roll, turn = unpacked(command, self.inputs)
        factor = scaled_to((roll / self.max_rate, turn / self.max_turn), 1.0)
        return roll * factor, turn * factor

    def jacobian(self, command: Sequence[Real]) -> Array:
        """Constant."""
        roll, _ = unpacked(command, self.inputs)
        zero = 0.0 * roll
        return stacked([[zero + self.wheel_radius, zero], [zero, zero], [zero, zero + 1.0]])

    def platform_twist(self, command: Sequence[Real], direction: Real) -> Twist[Real]:
        """Twist of the platform when its wheels point along ``direction`` in its frame: it translates only."""
        speed, zero, _ = self.forward(command)
        vx, vy = to_world(direction, speed, zero)
        return vx, vy, zero

    def wheels(self, command: Sequence[float], direction: float = 0.0) -> tuple[Wheel, ...]:
        """Three steered wheels on one belt."""
        unpacked(command, self.inputs)
        corners = [2.0 * math.pi * i / 3.0 for i in range(3)]
        return tuple(
            SteeredWheel(
                f"wheel {i + 1}",
                self.circle * math.cos(a),
                self.circle * math.sin(a),
                self.wheel_radius,
                direction,
                group="belt",
            )
            for i, a in enumerate(corners)
        )
