"""Drives with one steered axle: bicycle (front- or rear-driven), tricycle, Ackermann car.

The reference point is the middle of the unsteered rear axle.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from monstertruck_kinematics.elementary import (
    Array,
    Real,
    atan2,
    clip,
    cos,
    hypot,
    require_positive,
    require_within,
    sign,
    sin,
    tan,
)
from monstertruck_kinematics.errors import KinematicsError
from monstertruck_kinematics.families.base import TWIST, Twist, refuse, require_limit, scaled_to, stacked, unpacked
from monstertruck_kinematics.truck import STEEPEST, FourWheelSteering
from monstertruck_kinematics.wheels import FixedWheel, SteeredWheel, Wheel


@dataclass(frozen=True)
class Bicycle:
    """One steered front wheel, one fixed rear wheel, either of them driven.

    Front-driven: xdot = u cos(th) cos(phi), thdot = u sin(phi)/l; rear-driven: xdot = u cos(th), thdot = u tan(phi)/l.

    Args:
        wheelbase: l, m.
        driven: wheel whose speed u is the input.
        radius: of the wheels, m.
        max_steer: of the front wheel, rad: below pi/2 if rear-driven, up to pi/2 if front-driven (turns on the spot).
        max_speed: of the driven wheel, m/s.

    Raises:
        KinematicsError: a length is not above 0, or a limit out of range.
    """

    wheelbase: float = 0.32
    driven: Literal["front", "rear"] = "rear"
    radius: float = 0.075
    max_steer: float = 0.6
    max_speed: float = math.inf

    inputs = ("speed", "steer")

    def __post_init__(self) -> None:
        require_positive("wheelbase", self.wheelbase)
        require_positive("radius", self.radius)
        if self.driven not in ("front", "rear"):
            raise KinematicsError(f"driven is {self.driven!r}: expected front or rear")
        require_limit("max_steer", self.max_steer, math.pi / 2.0 if self.driven == "front" else STEEPEST)
        require_limit("max_speed", self.max_speed)

    def forward(self, command: Sequence[Real]) -> Twist[Real]:
        """Twist of the rear axle's middle from (speed of the driven wheel, steering angle)."""
        speed, steer = unpacked(command, self.inputs)
        if self.driven == "front":
            return speed * cos(steer), 0.0 * speed, speed * sin(steer) / self.wheelbase
        require_within("steer", steer, -STEEPEST, STEEPEST)
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
        require_within("steer that vx, wz need", steer, -STEEPEST, STEEPEST)
        return vx, steer

    def limited(self, command: Sequence[Real]) -> tuple[Real, ...]:
        """Steering angle clipped, speed of the driven wheel clipped: same path unless it is too tight."""
        speed, steer = unpacked(command, self.inputs)
        return clip(speed, -self.max_speed, self.max_speed), clip(steer, -self.max_steer, self.max_steer)

    def jacobian(self, command: Sequence[Real]) -> Array:
        """By (speed, steer)."""
        speed, steer = unpacked(command, self.inputs)
        zero = 0.0 * (speed + steer)
        c, s = cos(steer), sin(steer)
        if self.driven == "front":
            return stacked(
                [[c, -speed * s], [zero, zero], [s / self.wheelbase, speed * c / self.wheelbase]],
            )
        return stacked(
            [[zero + 1.0, zero], [zero, zero], [s / c / self.wheelbase, speed / (c * c * self.wheelbase)]],
        )

    def radius_of(self, steer: Real) -> Real:
        """Turning radius at the rear axle's middle, R = l tan(pi/2 - steer), left positive; not for steer = 0."""
        return self.wheelbase * tan(math.pi / 2.0 - steer)

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
        radius: of the wheels, m.
        max_steer: rad.
        max_speed: of the front wheel, m/s.
        track: between the rear wheels, m.
    """

    driven: Literal["front", "rear"] = "front"
    max_steer: float = 1.4
    track: float = 0.26

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("track", self.track)

    def rear_rates(self, command: Sequence[Real]) -> tuple[Real, Real]:
        """Rates of the rear wheels (left, right), rad/s, that a command causes."""
        vx, _, wz = self.forward(command)
        lean = wz * (0.5 * self.track)
        return (vx - lean) / self.radius, (vx + lean) / self.radius

    def odometry(self, left: Real, right: Real) -> Twist[Real]:
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
        radius: of the wheels, m.
        max_steer: of the front axle's bicycle angle, rad.
        max_speed: of the reference point, m/s.

    Raises:
        KinematicsError: a length is not above 0, or a limit out of range.
    """

    wheelbase: float = 0.32
    track: float = 0.26
    radius: float = 0.075
    max_steer: float = 0.4
    max_speed: float = math.inf

    inputs = ("speed", "steer")

    def __post_init__(self) -> None:
        require_positive("radius", self.radius)
        require_limit("max_steer", self.max_steer, STEEPEST)
        require_limit("max_speed", self.max_speed)
        _ = self.geometry

    @property
    def geometry(self) -> FourWheelSteering:
        """The body with its reference point on the rear axle."""
        return FourWheelSteering(self.wheelbase, self.track, cg_split=1.0)

    def forward(self, command: Sequence[Real]) -> Twist[Real]:
        """Twist from (speed, equivalent bicycle angle): R = L / tan(steer) (2.13)."""
        speed, steer = unpacked(command, self.inputs)
        return self.geometry.body_twist(speed, steer, 0.0 * steer)

    def inverse(self, twist: Sequence[Real]) -> tuple[Real, ...]:
        """(speed, steer) for a twist without side speed."""
        vx, vy, wz = unpacked(twist, TWIST)
        refuse("vy", vy, vx, "the rear wheels cannot move sideways")
        speed, steer, _ = self.geometry.steer_for_twist(vx, 0.0 * vx, wz)
        return speed, steer

    def limited(self, command: Sequence[Real]) -> tuple[Real, ...]:
        """Angle clipped, speed scaled."""
        speed, steer = unpacked(command, self.inputs)
        return speed * scaled_to((speed,), self.max_speed), clip(steer, -self.max_steer, self.max_steer)

    def jacobian(self, command: Sequence[Real]) -> Array:
        """By (speed, steer)."""
        return Bicycle(self.wheelbase).jacobian(command)

    def front_angles(self, steer: Real) -> tuple[Real, Real]:
        """Front wheel angles (left, right): tan = L/(R -+ w/2) (2.10, 2.11); the sign of R tells which is inner."""
        left, right, _, _ = self.geometry.wheel_angles(steer, 0.0 * steer)
        return left, right

    def wheel_rates(self, command: Sequence[Real]) -> tuple[Real, Real, Real, Real]:
        """Rates of all four wheels, rad/s (2.18-2.26): front left, front right, rear left, rear right."""
        speed, steer = unpacked(command, self.inputs)
        fl, fr, rl, rr = self.geometry.wheel_speeds(speed, steer, 0.0 * steer)
        return fl / self.radius, fr / self.radius, rl / self.radius, rr / self.radius

    def steer_from_wheels(self, left: Real, right: Real) -> Real:
        """Bicycle angle of two ideal front wheels: cot d = (cot d_l + cot d_r)/2 (2.13), defined at 0 too."""
        tan_l, tan_r = tan(left), tan(right)
        half = 0.5 * self.track / self.wheelbase
        return atan2(0.5 * (tan_l / (1.0 + half * tan_l) + tan_r / (1.0 - half * tan_r)), 1.0 + 0.0 * tan_l)

    def defect(self, left: Real, right: Real) -> Real:
        """How far two front wheels are from Ackermann's condition cot d_r - cot d_l = w/L (2.12): 0 if ideal.

        Multiplied out, tan d_l - tan d_r - (w/L) tan d_l tan d_r, so that straight ahead is no special case.
        """
        tan_l, tan_r = tan(left), tan(right)
        return tan_l - tan_r - (self.track / self.wheelbase) * tan_l * tan_r

    def radius_at(self, steer: float, l_r: float) -> float:
        """Turning radius of a point on the middle line l_r before the rear axle: sqrt(R^2 + l_r^2) (2.14)."""
        return math.inf if steer == 0.0 else math.hypot(self.wheelbase / math.tan(steer), l_r)

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
