"""Four steered wheels: two steered axles (the truck), and every wheel steered and driven alone."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from monstertruck_kinematics.elementary import (
    Array,
    Real,
    atan2,
    clip,
    cos,
    hypot,
    require_positive,
    secant,
    sign,
    sin,
    tan,
)
from monstertruck_kinematics.errors import KinematicsError
from monstertruck_kinematics.families.base import TWIST, Twist, require_limit, scaled_to, stacked, unpacked
from monstertruck_kinematics.truck import STEEPEST, FourWheelSteering, Mode
from monstertruck_kinematics.wheels import SteeredWheel, Wheel

WHEEL_NAMES = ("front left", "front right", "rear left", "rear right")


@dataclass(frozen=True)
class FourWheelSteer:
    """The truck as a drive: speed of its reference point and the bicycle angles of both axles.

    Args:
        geometry: wheelbase, track and reference point.
        radius: of the wheels, m.
        max_steer: of either axle, rad.
        max_speed: of the reference point, m/s.

    Raises:
        KinematicsError: a field is out of range.
    """

    geometry: FourWheelSteering = field(default_factory=FourWheelSteering)
    radius: float = 0.075
    max_steer: float = 0.4
    max_speed: float = math.inf

    inputs = ("speed", "front", "rear")

    def __post_init__(self) -> None:
        require_positive("radius", self.radius)
        require_limit("max_steer", self.max_steer, STEEPEST)
        require_limit("max_speed", self.max_speed)

    def forward(self, command: Sequence[Real]) -> Twist[Real]:
        """Twist from (speed, front, rear): see ``FourWheelSteering.body_twist``."""
        speed, front, rear = unpacked(command, self.inputs)
        return self.geometry.body_twist(speed, front, rear)

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """(speed, front, rear) through the common turning centre."""
        vx, vy, wz = unpacked(twist, TWIST)
        return self.geometry.steer_for_twist(vx, vy, wz)

    def limited(self, command: Sequence[Real]) -> tuple[Real, ...]:
        """Angles within the limit that keep the curvature, then the sideslip; speed clipped."""
        speed, front, rear = unpacked(command, self.inputs)
        front_kept, rear_kept = self.geometry.limit_keeping_curvature(front, rear, self.max_steer)
        return clip(speed, -self.max_speed, self.max_speed), front_kept, rear_kept

    def jacobian(self, command: Sequence[Real]) -> Array:
        """By (speed, front, rear)."""
        speed, front, rear = unpacked(command, self.inputs)
        vx, vy, wz = self.geometry.body_twist(speed, front, rear)
        length = self.geometry.wheelbase
        tan_f, tan_r = tan(front), tan(rear)
        tan_b = self.geometry.tan_sideslip(tan_f, tan_r)
        cos_b = 1.0 / secant(tan_b)
        columns = [(cos_b, cos_b * tan_b, cos_b * (tan_f - tan_r) / length)]
        for tangent, share, side in ((tan_f, self.geometry.l_r, 1.0), (tan_r, self.geometry.l_f, -1.0)):
            slope = 1.0 + tangent * tangent
            lean = slope * share / length
            fading = -tan_b * cos_b * cos_b * lean
            columns.append((vx * fading, vy * fading + vx * lean, wz * fading + side * vx * slope / length))
        return stacked(list(zip(*columns, strict=True)))

    def steering(self, mode: Mode, angle: Real) -> tuple[Real, Real]:
        """Axle angles (front, rear) of a steering mode; ``angle`` is the front one, for rear steering the rear one.

        Raises:
            KinematicsError: the mode is spot, or unknown.
        """
        zero = 0.0 * angle
        if mode == "front":
            return angle, zero
        if mode == "rear":
            return zero, angle
        if mode == "counter":
            return angle, -angle
        if mode == "crab":
            return angle, angle
        raise KinematicsError(f"mode {mode!r}: expected front, rear, counter or crab")

    def wheel_rates(self, command: Sequence[Real]) -> tuple[Real, Real, Real, Real]:
        """Rates of the four wheels, rad/s (2.47-2.50)."""
        speed, front, rear = unpacked(command, self.inputs)
        fl, fr, rl, rr = self.geometry.wheel_speeds(speed, front, rear)
        return fl / self.radius, fr / self.radius, rl / self.radius, rr / self.radius

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The four wheels at their angles through the common turning centre."""
        _, front, rear = unpacked(command, self.inputs)
        angles = self.geometry.wheel_angles(front, rear)
        return tuple(
            SteeredWheel(name, x, y, self.radius, angle)
            for name, (x, y), angle in zip(WHEEL_NAMES, self.geometry.wheel_positions, angles, strict=True)
        )


@dataclass(frozen=True)
class IndependentSteer:
    """Every wheel steered and driven alone: any twist, turning on the spot (R = 0) included.

    The command is all steering angles, then all wheel speeds (m/s). Angles stay within +-90 deg, a wheel that would
    have to look back rolls backwards instead. Forward takes the least-squares twist if the wheels contradict.

    Args:
        positions: (x, y) of the wheels, m; at least two at different places.
        radius: of the wheels, m.
        max_speed: of a wheel, m/s.

    Raises:
        KinematicsError: fewer than two places, or a field out of range.
    """

    positions: tuple[tuple[float, float], ...] = ((0.16, 0.13), (0.16, -0.13), (-0.16, 0.13), (-0.16, -0.13))
    radius: float = 0.075
    max_speed: float = math.inf
    _solver: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        require_positive("radius", self.radius)
        require_limit("max_speed", self.max_speed)
        if len(set(self.positions)) < 2:
            raise KinematicsError(f"positions has {len(set(self.positions))} places: expected two or more")
        rows = [row for x, y in self.positions for row in ([1.0, 0.0, -y], [0.0, 1.0, x])]
        object.__setattr__(self, "_solver", np.linalg.pinv(np.array(rows)))

    @property
    def inputs(self) -> tuple[str, ...]:
        """All steering angles, then all speeds."""
        count = range(1, len(self.positions) + 1)
        return (*(f"steer {i}" for i in count), *(f"speed {i}" for i in count))

    def forward(self, command: Sequence[Real]) -> Twist[Real]:
        """Least-squares twist of the wheels' velocities; exact if they agree."""
        values = unpacked(command, self.inputs)
        count = len(self.positions)
        total = [0.0 * values[0], 0.0 * values[0], 0.0 * values[0]]
        for i, (steer, speed) in enumerate(zip(values[:count], values[count:], strict=True)):
            ahead, aside = speed * cos(steer), speed * sin(steer)
            for k in range(3):
                total[k] = total[k] + float(self._solver[k, 2 * i]) * ahead + float(self._solver[k, 2 * i + 1]) * aside
        return total[0], total[1], total[2]

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """Angle and speed of every wheel; a wheel that stands (at the turning centre) keeps angle 0."""
        vx, vy, wz = unpacked(twist, TWIST)
        angles: list[Real] = []
        speeds: list[Real] = []
        for x, y in self.positions:
            ahead, aside = vx - wz * y, vy + wz * x
            facing = sign(ahead)
            angles.append(atan2(facing * aside, abs(ahead)))
            speeds.append(facing * hypot(ahead, aside))
        return tuple(angles + speeds)

    def limited(self, command: Sequence[Real]) -> tuple[Real, ...]:
        """All speeds scaled alike: same path, slower."""
        values = list(unpacked(command, self.inputs))
        angles, speeds = values[: len(self.positions)], values[len(self.positions) :]
        factor = scaled_to(speeds, self.max_speed)
        return tuple(angles + [speed * factor for speed in speeds])

    def jacobian(self, command: Sequence[Real]) -> Array:
        """By all angles, then all speeds."""
        values = unpacked(command, self.inputs)
        count = len(self.positions)
        rows: list[list[Real]] = []
        for k in range(3):
            by_angle: list[Real] = []
            by_speed: list[Real] = []
            for i, (steer, speed) in enumerate(zip(values[:count], values[count:], strict=True)):
                ahead, aside = float(self._solver[k, 2 * i]), float(self._solver[k, 2 * i + 1])
                c, s = cos(steer), sin(steer)
                by_angle.append(speed * (aside * c - ahead * s))
                by_speed.append(ahead * c + aside * s)
            rows.append(by_angle + by_speed)
        return stacked(rows)

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The wheels at the command's angles."""
        values = unpacked(command, self.inputs)
        return tuple(
            SteeredWheel(f"wheel {i + 1}", x, y, self.radius, steer)
            for i, ((x, y), steer) in enumerate(zip(self.positions, values, strict=False))
        )
