"""Commanded motion: converts requests of any form to a motion of the body, and ramps towards that motion.

``Motion.target`` converts every form of request to a twist of the base and the steering angles it needs; limits, ramps
and the sweep are independent of the form. The size of a twist is its **pace**: the maximum speed of the base and of the
driven wheels (m/s). For a truck that drives straight the pace is the speed of the base; for a body that turns on the
spot it is the speed of the wheels.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from monstertruck_kinematics.chassis import MAX_ANGLE, STILL, Angles, Chassis, Speeds
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.se2 import Twist2
from monstertruck_planners.collision import UnitTwist
from monstertruck_schemas.req import DriveRequest, RequestedTwist
from monstertruckd.gate.config import InForce

AHEAD: Final = 0.5
"""Minimum forward speed of a motion ahead, as a fraction of its pace. Other motions have the speed limit of reverse:
part of the footprint moves out of the lidar's field of view. A motion whose base is slower than this fraction is a turn
on the spot."""

MAX_SPEED: Final = 1e3
"""Maximum of every component of a request, m/s and rad/s: larger requests are first scaled down so that sums stay
finite."""

ROUNDING: Final = 1e-6
"""Maximum relative difference of two equal motions."""


class Target(NamedTuple):
    """Motion of this body for a request."""

    twist: Twist2
    """Twist of the base."""
    angles: Angles
    """Steering angles needed for the twist, rad."""
    clipped: bool
    """Whether the motion differs from the request: it is the nearest motion that the body can perform."""
    saturated: bool
    """Whether the motion differs because of the servos' range."""
    shafts: Speeds | None = None
    """Open-loop shaft speeds, m/s; the twist is only predicted from them."""


class Motion:
    """Commanded motion: twist of the base and steering angles (rad).

    Args:
        limits: limits in force.
        chassis: kinematics of the body.
    """

    def __init__(self, limits: InForce, chassis: Chassis) -> None:
        self._limits = limits
        self._chassis = chassis
        self.twist: Twist2 = STILL
        self.angles: Angles = chassis.straight
        self._open: Speeds | None = None
        """Shaft speeds commanded open loop, m/s; None if they follow from the twist."""
        self._servos = self.angles, chassis.servos(*self.angles)
        self._shafts = (STILL, self.angles), chassis.shafts_along(STILL, *self.angles)

    @property
    def standing(self) -> bool:
        """Whether standstill is commanded."""
        return self.twist == STILL and not any(self._open or ())

    @property
    def servos(self) -> Angles:
        """Servo angles for the steering angles (rad)."""
        if self._servos[0] != self.angles:
            self._servos = self.angles, self._chassis.servos(*self.angles)
        return self._servos[1]

    @property
    def axle_angles(self) -> tuple[float, float]:
        """Axle angles of the bicycle model with the same motion (rad); 0 if there is none."""
        return self._chassis.axle_angles(self.twist, self.angles)

    @property
    def motor_velocities(self) -> tuple[float, ...]:
        """Motor rate of every driven shaft, as in ``DriveCommand``."""
        return tuple(map(self._chassis.drivetrain.motor_rate, self.shaft_speeds))

    @property
    def shaft_speeds(self) -> Speeds:
        """Wheel speed over ground of every driven shaft (m/s)."""
        if self._open is not None:
            return self._open
        command = self.twist, self.angles
        if self._shafts[0] != command:
            self._shafts = command, self._chassis.shafts_along(self.twist, *self.angles)
        return self._shafts[1]

    def target(self, request: DriveRequest) -> Target:
        """Convert a request to a motion of this body, within the limit on the axle angles.

        Raises:
            KinematicsError: the body cannot perform the motion; the message states the reason.
        """
        if request.shafts is not None:
            return self._target_of_shafts(request.shafts)
        return self._target_of_axles(request) if request.twist is None else self._target_of_twist(request.twist)

    def _target_of_axles(self, request: DriveRequest) -> Target:
        chassis = self._chassis
        if (why := chassis.refusal(request.front, request.rear)) is not None:
            raise KinematicsError(why)
        front = min(max(request.front, -MAX_ANGLE), MAX_ANGLE)
        rear = min(max(request.rear, -MAX_ANGLE), MAX_ANGLE)
        clipped = max(abs(front), abs(rear)) > self._limits.config.angle
        if clipped:
            front, rear = chassis.limited(front, rear, self._limits.config.angle)
        (front, rear), saturated = self._reached((front, rear))
        speed = min(max(request.speed, -MAX_SPEED), MAX_SPEED)
        twist = chassis.bicycle.body_twist(speed, front, rear)
        return Target(twist, chassis.steering_for_axles(front, rear, self.angles), clipped or saturated, saturated)

    def _target_of_twist(self, request: RequestedTwist) -> Target:
        chassis = self._chassis
        asked = request.vx, request.vy, request.wz
        asked = scaled(asked, MAX_SPEED / max(*map(abs, asked), MAX_SPEED))
        twist = chassis.possible(asked)
        angles, clipped = chassis.limited_steering(chassis.steering_for(twist, self.angles), self._limits.config.angle)
        angles, saturated = self._reached(angles)
        return Target(twist, angles, clipped or saturated or not _same(twist, asked), saturated)

    def _target_of_shafts(self, rates: Sequence[float]) -> Target:
        """Convert wheel rates to open-loop shaft speeds; the steering angles do not change."""
        radius = self._chassis.drivetrain.wheel_radius
        speeds = [min(max(rate, -MAX_SPEED), MAX_SPEED) * radius for rate in rates]
        shafts = tuple(speed * min(MAX_SPEED / max(*map(abs, speeds), MAX_SPEED), 1.0) for speed in speeds)
        return Target(self._chassis.predicted(shafts, *self.angles), self.angles, False, False, shafts)

    def _reached(self, angles: Angles) -> tuple[Angles, bool]:
        """Return steering angles within reach of the servos, and whether they differ from ``angles``."""
        reached = self._chassis.reached(angles)
        # Minimum reported difference between requested and reachable steering angle, rad.
        saturated = 1e-4
        return reached, max(abs(asked - got) for asked, got in zip(angles, reached, strict=True)) > saturated

    def along(self, twist: Twist2, angles: Angles | None = None) -> Twist2:
        """Part of a twist that the body can perform at the given steering angles, by default the commanded angles."""
        return self._chassis.along(twist, *(self.angles if angles is None else angles))

    def pace(self, twist: Twist2, shafts: Speeds | None = None) -> float:
        """Maximum speed of the base and of the driven wheels for a twist at the commanded steering angles (m/s).

        Args:
            twist: twist of the base.
            shafts: open-loop wheel speeds, m/s; None if they follow from the twist.
        """
        rolling = self._chassis.shafts_along(twist, *self.angles) if shafts is None else shafts
        return max(math.hypot(twist[0], twist[1]), *map(abs, rolling))

    @property
    def present_pace(self) -> float:
        """Pace of the commanded motion (m/s)."""
        return self.pace(self.twist, self._open)

    def max_pace(self, twist: Twist2, shafts: Speeds | None = None) -> float:
        """Maximum pace allowed in the direction of ``twist`` (m/s); for the arguments see ``pace``."""
        ahead = twist[0] >= AHEAD * self.pace(twist, shafts)
        return self._limits.config.speed if ahead else self._limits.config.reverse_speed

    def progress(self, measured: Speeds, twist: UnitTwist) -> float:
        """Measured pace along a unit twist (m/s), from a least-squares fit of its shaft speeds to the measured ones."""
        shafts = self._chassis.shafts_along(twist, *self.angles)
        return _dot(measured, shafts) / (_dot(shafts, shafts) or 1.0)

    def steer(self, target: Angles, dt: float) -> None:
        """Turn all steered wheels towards ``target`` (rad) by the same fraction, within the steering rate."""
        step = max(abs(to - at) for at, to in zip(self.angles, target, strict=True))
        if step > 0:
            share = min(self._limits.config.steering_rate * dt / step, 1.0)
            self.angles = tuple(at + share * (to - at) for at, to in zip(self.angles, target, strict=True))
            self.twist = self.along(self.twist)

    def aligned(self, target: Angles) -> bool:
        """Return whether the body may move while its wheels turn to ``target``."""
        return self._chassis.aligned(self.angles, target)

    def reverses(self, target: Twist2, shafts: Speeds | None = None) -> bool:
        """Return whether ``target`` reverses most of the wheels' commanded motion.

        A change between open loop and the other forms is treated as a reversal: it passes through standstill.
        """
        if (shafts is None) is not (self._open is None) and not self.standing:
            return True
        rolling = self._chassis.shafts_along(target, *self.angles) if shafts is None else shafts
        return _dot(self.shaft_speeds, rolling) < 0

    def turn_shafts(self, target: Speeds, dt: float) -> None:
        """Change the open-loop shaft speeds towards ``target`` (m/s), in the way ``accelerate`` changes the twist."""
        now = self.shaft_speeds
        change = tuple(to - at for to, at in zip(target, now, strict=True))
        step = self.pace(self._forecast(change), change)
        share = 1.0
        if step > 0:
            growing = self.pace(self._forecast(target), target) > self.present_pace
            rate = self._limits.config.acceleration if growing else self._limits.config.deceleration
            share = min(rate * dt / step, 1.0)
        moved = tuple(at + share * part for at, part in zip(now, change, strict=True))
        self._open = target if share == 1.0 else moved
        self.twist = self._forecast(self._open)

    def slow_down(self, dt: float) -> None:
        """Ramp the commanded motion towards standstill, whatever its form."""
        if self._open is None:
            self.accelerate(STILL, dt)
        else:
            self.turn_shafts((0.0,) * len(self._open), dt)

    def _forecast(self, shafts: Speeds) -> Twist2:
        """Predict the twist of the base for shaft speeds, even if they are inconsistent while they change."""
        return self._chassis.twist(self._chassis.input_speeds(shafts, *self.angles), *self.angles)

    def accelerate(self, target: Twist2, dt: float) -> None:
        """Change the twist towards ``target``; neither the wheels nor the base exceed the allowed acceleration."""
        self._open = None
        change = (target[0] - self.twist[0], target[1] - self.twist[1], target[2] - self.twist[2])
        # The body may be unable to perform the difference of two motions.
        rolling = zip(self._chassis.shafts_along(target, *self.angles), self.shaft_speeds, strict=True)
        step = max(math.hypot(change[0], change[1]), *(abs(to - at) for to, at in rolling))
        if step == 0:
            self.twist = target
            return
        growing = self.pace(target) > self.pace(self.twist)
        rate = self._limits.config.acceleration if growing else self._limits.config.deceleration
        share = min(rate * dt / step, 1.0)
        if growing and change[2] != 0:
            share = min(share, self._limits.config.yaw_acceleration * dt / abs(change[2]))
        x, y, turn = (now + share * part for now, part in zip(self.twist, change, strict=True))
        self.twist = target if share == 1.0 else (x, y, turn)

    def halt(self) -> None:
        """Command standstill without a ramp: the drive controllers decelerate along their own profile."""
        self.twist = STILL
        self._open = None


def scaled(twist: Twist2, factor: float) -> Twist2:
    """Multiply a twist by a factor."""
    return twist[0] * factor, twist[1] * factor, twist[2] * factor


def _dot(one: Speeds, other: Speeds) -> float:
    return math.fsum(a * b for a, b in zip(one, other, strict=True))


def _same(one: Twist2, other: Twist2) -> bool:
    return all(math.isclose(a, b, rel_tol=ROUNDING, abs_tol=ROUNDING) for a, b in zip(one, other, strict=True))


Course = tuple[UnitTwist, float]
"""Motion of the base: twist per metre of pace, and pace (m/s)."""
