"""Drives that steer: bicycle, tricycle, car, four-wheel steering, independently steered wheels, synchro drive."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from monstertruck_kinematics.drive import TWIST, refuse, unpacked
from monstertruck_kinematics.elementary import (
    Array,
    KinematicsError,
    Real,
    atan2,
    cos,
    hypot,
    require_positive,
    require_within,
    sign,
    sin,
    tan,
)
from monstertruck_kinematics.se2 import TwistOf, to_world
from monstertruck_kinematics.truck import MAX_AXLE_ANGLE, FourWheelSteering
from monstertruck_kinematics.wheels import FixedWheel, SteeredWheel, Wheel


@dataclass(frozen=True)
class Bicycle:
    """One steered front wheel, one fixed rear wheel, either of them driven.

    Front-driven: xdot = u cos(th) cos(phi), thdot = u sin(phi)/l; rear-driven: xdot = u cos(th), thdot = u tan(phi)/l.

    Args:
        wheelbase: l, m.
        driven: wheel whose speed u is the input.
        radius: radius of the wheels, m.

    Raises:
        KinematicsError: a length is not above 0.
    """

    wheelbase: float = 0.32
    driven: Literal["front", "rear"] = "rear"
    radius: float = 0.075

    inputs = ("speed", "steer")

    def __post_init__(self) -> None:
        require_positive("wheelbase", self.wheelbase)
        require_positive("radius", self.radius)
        if self.driven not in ("front", "rear"):
            raise KinematicsError(f"driven is {self.driven!r}: expected front or rear")

    def forward(self, command: Sequence[Real]) -> TwistOf[Real]:
        """Twist of the rear axle's middle from (speed of the driven wheel, steering angle)."""
        speed, steer = unpacked(command, self.inputs)
        if self.driven == "front":
            return speed * cos(steer), 0.0 * speed, speed * sin(steer) / self.wheelbase
        require_within("steer", steer, -MAX_AXLE_ANGLE, MAX_AXLE_ANGLE)
        return speed + 0.0 * steer, 0.0 * speed, speed * tan(steer) / self.wheelbase

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """(speed, steer) for a twist without side speed; turning on the spot needs front drive."""
        vx, vy, wz = unpacked(twist, TWIST)
        refuse("vy", vy, vx, "the rear wheel cannot move sideways")
        facing = sign(vx)
        aside = facing * wz * self.wheelbase
        steer = atan2(aside, abs(vx))
        if self.driven == "front":
            return facing * hypot(vx, aside), steer
        require_within("steer that vx, wz need", steer, -MAX_AXLE_ANGLE, MAX_AXLE_ANGLE)
        return vx, steer

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The two wheels."""
        _, steer = unpacked(command, self.inputs)
        return (
            FixedWheel("rear", 0.0, 0.0, self.radius),
            SteeredWheel("front", self.wheelbase, 0.0, self.radius, steer),
        )


@dataclass(frozen=True)
class Tricycle(Bicycle):
    """Steered and driven front wheel, odometers on the two rear wheels.

    Args:
        wheelbase: d, from the rear axle to the front wheel, m.
        driven: front for the lecture's tricycle.
        radius: radius of the wheels, m.
        track: between the rear wheels, m.
    """

    driven: Literal["front", "rear"] = "front"
    track: float = 0.26

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("track", self.track)

    def odometry(self, left: Real, right: Real) -> TwistOf[Real]:
        """Twist measured by the two rear odometers (rates in rad/s), without knowing the steering angle."""
        return (0.5 * self.radius) * (left + right), 0.0 * left, (self.radius / self.track) * (right - left)

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The three wheels."""
        _, steer = unpacked(command, self.inputs)
        half = self.track / 2.0
        return (
            FixedWheel("rear left", 0.0, half, self.radius),
            FixedWheel("rear right", 0.0, -half, self.radius),
            SteeredWheel("front", self.wheelbase, 0.0, self.radius, steer),
        )


@dataclass(frozen=True)
class Ackermann:
    """Car with ideal Ackermann steering (thesis eqs. 2.9-2.26), reference point in the middle of the rear axle.

    Args:
        wheelbase: L, m.
        track: w, m.
        radius: radius of the wheels, m.

    Raises:
        KinematicsError: a length is not above 0.
    """

    wheelbase: float = 0.32
    track: float = 0.26
    radius: float = 0.075

    inputs = ("speed", "steer")

    def __post_init__(self) -> None:
        require_positive("radius", self.radius)
        _ = self.geometry

    @property
    def geometry(self) -> FourWheelSteering:
        """The body with its reference point on the rear axle."""
        return FourWheelSteering(self.wheelbase, self.track, cg_split=1.0)

    def forward(self, command: Sequence[Real]) -> TwistOf[Real]:
        """Twist from (speed, equivalent bicycle angle): R = L / tan(steer) (2.13)."""
        speed, steer = unpacked(command, self.inputs)
        return self.geometry.body_twist(speed, steer, 0.0 * steer)

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """(speed, steer) for a twist without side speed."""
        vx, vy, wz = unpacked(twist, TWIST)
        refuse("vy", vy, vx, "the rear wheels cannot move sideways")
        speed, steer, _ = self.geometry.steer_for_twist(vx, 0.0 * vx, wz)
        return speed, steer

    def front_angles(self, steer: Real) -> tuple[Real, Real]:
        """Front wheel angles (left, right): tan = L/(R -+ w/2) (2.10, 2.11); the sign of R selects the inner wheel."""
        left, right, _, _ = self.geometry.wheel_angles(steer, 0.0 * steer)
        return left, right

    def defect(self, left: Real, right: Real) -> Real:
        """Violation of Ackermann's condition by two front wheels, cot d_r - cot d_l = w/L (2.12): 0 if ideal.

        Multiplied out, tan d_l - tan d_r - (w/L) tan d_l tan d_r, so that straight ahead needs no special case.
        """
        tan_l, tan_r = tan(left), tan(right)
        return tan_l - tan_r - (self.track / self.wheelbase) * tan_l * tan_r

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The four wheels."""
        _, steer = unpacked(command, self.inputs)
        left, right = self.front_angles(steer)
        half = self.track / 2.0
        return (
            SteeredWheel("front left", self.wheelbase, half, self.radius, left),
            SteeredWheel("front right", self.wheelbase, -half, self.radius, right),
            FixedWheel("rear left", 0.0, half, self.radius),
            FixedWheel("rear right", 0.0, -half, self.radius),
        )


WHEEL_NAMES = ("front left", "front right", "rear left", "rear right")


@dataclass(frozen=True)
class FourWheelSteer:
    """The truck as a drive: speed of its reference point and the bicycle angles of both axles.

    Args:
        geometry: wheelbase, track and reference point.
        radius: radius of the wheels, m.

    Raises:
        KinematicsError: a field is out of range.
    """

    geometry: FourWheelSteering = field(default_factory=FourWheelSteering)
    radius: float = 0.075

    inputs = ("speed", "front", "rear")

    def __post_init__(self) -> None:
        require_positive("radius", self.radius)

    def forward(self, command: Sequence[Real]) -> TwistOf[Real]:
        """Twist from (speed, front, rear): see ``FourWheelSteering.body_twist``."""
        speed, front, rear = unpacked(command, self.inputs)
        return self.geometry.body_twist(speed, front, rear)

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """(speed, front, rear) through the common ICR."""
        vx, vy, wz = unpacked(twist, TWIST)
        return self.geometry.steer_for_twist(vx, vy, wz)

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The four wheels at their angles through the common ICR."""
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
    have to turn further rolls backwards instead. Forward takes the least-squares twist of inconsistent wheels.

    Args:
        positions: (x, y) of the wheels, m; at least two at different places.
        radius: radius of the wheels, m.

    Raises:
        KinematicsError: fewer than two places, or a field out of range.
    """

    positions: tuple[tuple[float, float], ...] = ((0.16, 0.13), (0.16, -0.13), (-0.16, 0.13), (-0.16, -0.13))
    radius: float = 0.075
    _solver: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        require_positive("radius", self.radius)
        if len(set(self.positions)) < 2:
            raise KinematicsError(f"positions has {len(set(self.positions))} places: expected two or more")
        rows = [row for x, y in self.positions for row in ([1.0, 0.0, -y], [0.0, 1.0, x])]
        object.__setattr__(self, "_solver", np.linalg.pinv(np.array(rows)))

    @property
    def inputs(self) -> tuple[str, ...]:
        """All steering angles, then all speeds."""
        count = range(1, len(self.positions) + 1)
        return (*(f"steer {i}" for i in count), *(f"speed {i}" for i in count))

    def forward(self, command: Sequence[Real]) -> TwistOf[Real]:
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
        """Angle and speed of every wheel; a wheel at the ICR (speed 0) keeps angle 0."""
        vx, vy, wz = unpacked(twist, TWIST)
        angles: list[Real] = []
        speeds: list[Real] = []
        for x, y in self.positions:
            ahead, aside = vx - wz * y, vy + wz * x
            facing = sign(ahead)
            angles.append(atan2(facing * aside, abs(ahead)))
            speeds.append(facing * hypot(ahead, aside))
        return tuple(angles + speeds)

    def wheels(self, command: Sequence[float]) -> tuple[Wheel, ...]:
        """The wheels at the command's angles."""
        values = unpacked(command, self.inputs)
        return tuple(
            SteeredWheel(f"wheel {i + 1}", x, y, self.radius, steer)
            for i, ((x, y), steer) in enumerate(zip(self.positions, values, strict=False))
        )


@dataclass(frozen=True)
class Synchro:
    """Synchro drive; its posture is (x, y, direction of the wheels), its twist is in the wheels' own frame.

    In those terms it moves like a unicycle: xdot = v cos th, ydot = v sin th, thdot = omega. ``platform_twist`` is
    the motion of the platform, which never turns.

    Args:
        wheel_radius: m.
        circle: radius of the circle (an equilateral triangle) that carries the three wheels, m.

    Raises:
        KinematicsError: a field is not above 0.
    """

    wheel_radius: float = 0.05
    circle: float = 0.2

    inputs = ("roll", "turn")

    def __post_init__(self) -> None:
        require_positive("wheel_radius", self.wheel_radius)
        require_positive("circle", self.circle)

    def forward(self, command: Sequence[Real]) -> TwistOf[Real]:
        """(v, 0, omega) in the wheels' frame from the rolling rate and the turning rate, rad/s."""
        roll, turn = unpacked(command, self.inputs)
        return roll * self.wheel_radius, 0.0 * roll, turn + 0.0 * roll

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """Rates for a twist in the wheels' frame."""
        vx, vy, wz = unpacked(twist, TWIST)
        refuse("vy", vy, vx, "the wheels cannot move sideways")
        return vx / self.wheel_radius, wz

    def platform_twist(self, command: Sequence[Real], direction: Real) -> TwistOf[Real]:
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
