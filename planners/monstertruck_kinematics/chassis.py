"""A robot body with its actuators, for gate, odometry and simulation of any drive family.

A motion is requested in one of three forms, and ``forms`` lists the accepted ones:

- ``axles``: the motion of an equivalent bicycle about the base point, by its speed along the direction of travel and
  the angles of its two axles, whatever angles the wheels of a real linkage have (``truck.LinkedAxles``). ``freedom`` is
  the set of axle angles that a body can take.
- ``twist``: the velocity (vx, vy, wz) of the base itself.
- ``shafts``: the speed of every driven shaft, open loop, while the steering stays as it is. ``predicted`` is the twist
  that follows from it.

The first two forms determine the steering angles of the wheels and a twist of the base. For given steering angles, a
chassis computes the possible part of a twist (``along``) and the shaft speeds for it and, conversely, the twist from
measured shaft speeds and servo angles. Bodies without steering can change from any motion to any other.

The bicycle of a body without axles is virtual; its wheelbase is the reference length of the body. ``freedom``:

- ``both``: any pair of angles (truck, independent, omni, mecanum).
- ``front``: the rear angle is 0. A car's base lies between its axles; a differential or skid-steer drive is the
  bicycle whose rear axle lies on the line of its ICRs, curvature tan(front) / length.
- ``parallel``: both angles are equal, the body never turns (synchro).

Shaft speeds are speeds of the wheels' treads over ground, m/s, forward positive.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import ClassVar, Final, Literal

from monstertruck_kinematics.drive import Drive, refuse
from monstertruck_kinematics.elementary import KinematicsError, clip, signed_hypot
from monstertruck_kinematics.polynomials import AxlePolynomials, PolynomialSet, SteeringPolynomials
from monstertruck_kinematics.se2 import Twist2, twist_at
from monstertruck_kinematics.steered import WHEEL_NAMES, Ackermann, Bicycle, IndependentSteer, Synchro, Tricycle
from monstertruck_kinematics.truck import (
    FULL,
    MAX_AXLE_ANGLE,
    Axles,
    DriveTrain,
    FourWheelSteering,
    IdealAxles,
    LinkedAxles,
    Range,
    Reach,
    TurnDeficit,
)
from monstertruck_kinematics.unsteered import Differential, SkidSteer, mecanum, omni

Freedom = Literal["both", "front", "parallel"]
Form = Literal["axles", "twist", "shafts"]
Speeds = tuple[float, ...]
Angles = tuple[float, ...]
"""Steering angles, rad, left positive: of the front and the rear axle, or of every wheel in the order of its name."""

STILL: Final = (0.0, 0.0, 0.0)
"""Twist of a body at rest."""

MAX_ANGLE: Final = 1.4
"""Maximum axle angle of a turn, rad: beyond it the body turns on the spot or moves sideways."""

AXLES: Final = ("front", "rear")
"""Names of the two axles."""

STANDING: Final = 0.1
"""Share of the whole motion below which a forward speed counts as 0."""


WHEEL_REACH: Final = math.radians(100.0)
"""Angle that wheels with their own servos reach to both sides: more than a quarter turn, so that a wheel need not
turn about when its motion passes through sideways, rad."""


DIRECT: Final = SteeringPolynomials(AxlePolynomials((1.0, 0.0), (1.0, 0.0)), AxlePolynomials((1.0, 0.0), (1.0, 0.0)))
"""Servo that turns its wheel directly."""


@dataclass(frozen=True)
class Chassis(ABC):
    """One robot's wheels, motors and servos.

    Args:
        bicycle: the equivalent bicycle about the base point.
        drivetrain: motor to wheel, the same for every shaft.
        shafts: names of the driven shafts, in the order of their devices.
        freedom: which axle angles of the bicycle it can take.
        linkage: servos to axle angles; None: no steered axles.
    """

    bicycle: FourWheelSteering
    drivetrain: DriveTrain
    shafts: tuple[str, ...]
    freedom: Freedom
    linkage: Axles | None

    forms: ClassVar[frozenset[Form]] = frozenset({"axles", "twist", "shafts"})
    """Accepted forms of requests."""
    straight: ClassVar[Angles] = (0.0, 0.0)
    """Steering angles for driving straight ahead; constant for a body that steers nothing."""

    @abstractmethod
    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """Speed of every shaft for a motion of the bicycle."""

    @abstractmethod
    def input_speeds(self, shaft_speeds: Speeds, *angles: float) -> Speeds:
        """Speeds of the drive family's own inputs, m/s, from the shaft speeds; valid while the steering changes."""

    @abstractmethod
    def twist(self, inputs: Speeds, *angles: float) -> Twist2:
        """Velocity (vx, vy, wz) of the base at steering angles."""

    def fastest_wheel_speed(self, shaft_speeds: Speeds) -> float:
        """Speed of the fastest wheel, m/s, negative when the body goes backwards."""
        if len(shaft_speeds) == 1:
            return shaft_speeds[0]
        fastest = max(map(abs, shaft_speeds))
        vx = self.twist(self.input_speeds(shaft_speeds, *self.straight), *self.straight)[0]
        return -fastest if vx < -STANDING * fastest else fastest

    @property
    def steering_errors(self) -> tuple[Angles, ...]:
        """Independent unit errors of the steering angles; coupled axles have a common error."""
        if not self.steered:
            return ()
        return {"both": ((1.0, 0.0), (0.0, 1.0)), "front": ((1.0, 0.0),), "parallel": ((1.0, 1.0),)}[self.freedom]

    # Motions

    @property
    def steered(self) -> bool:
        """Whether servos steer any of its wheels."""
        return self.linkage is not None

    def possible(self, twist: Twist2) -> Twist2:
        """Return the twist, with the sideways speed that the turn causes if the body cannot choose it.

        A ``vy`` of 0 means no request: a car whose base is not on its rear axle moves sideways as it turns.

        Raises:
            KinematicsError: the body cannot execute this motion or one close to it; the text gives the reason.
        """
        vx, vy, wz = twist
        if self.freedom == "parallel":
            refuse("wz", wz, vx, "expected 0, because this body keeps its heading")
        elif self.freedom == "front":
            follows = self.bicycle.l_r * wz
            if vy != 0.0:
                refuse(
                    "vy", vy - follows, vx, f"more than the {follows:.6g} of its turn, this body cannot move sideways"
                )
            vy = follows
        if self.steered and len(self.straight) == len(AXLES):
            _require_way(vx, vy, wz, self.bicycle)
        return vx, vy, wz

    def steering_for(self, twist: Twist2, near: Angles) -> Angles:
        """Steering angles for a possible twist; those nearest to ``near`` where there is a choice."""
        if not self.steered or twist == STILL:
            return near
        return self.bicycle.steer_for_twist(*twist)[1:]

    def steering_for_axles(self, front: float, rear: float, near: Angles) -> Angles:
        """Steering angles for the bicycle's angles; where there is a choice, the nearest to ``near``."""
        return (front, rear) if self.steered else near

    def along(self, twist: Twist2, *angles: float) -> Twist2:
        """Part of a twist that the body executes at its current steering angles."""
        if not self.steered:
            return twist
        return self.bicycle.body_twist(signed_hypot(twist[0], twist[1]), *angles)

    def shafts_along(self, twist: Twist2, *angles: float) -> Speeds:
        """Return the speed of every shaft for a twist that is possible at the steering angles."""
        return self.shaft_speeds(signed_hypot(twist[0], twist[1]), *angles)

    def predicted(self, shaft_speeds: Speeds, *angles: float) -> Twist2:
        """Return the twist of the base for shaft speeds and steering angles.

        Raises:
            KinematicsError: wrong number of shafts, or the shafts work against each other, so that the body's motion
                is undetermined.
        """
        if len(shaft_speeds) != len(self.shafts):
            raise KinematicsError(
                f"{len(shaft_speeds)} shaft speeds: expected {len(self.shafts)} ({', '.join(self.shafts)})"
            )
        twist = self.twist(self.input_speeds(shaft_speeds, *angles), *angles)
        fit = self.shafts_along(twist, *angles)
        off, name = max((abs(a - b), name) for a, b, name in zip(shaft_speeds, fit, self.shafts, strict=True))
        contradiction = 0.2  # shaft speeds may be off the motion they agree on best by this share of the fastest
        if off > contradiction * max(map(abs, shaft_speeds)) + 1e-9:  # m/s
            raise KinematicsError(
                f"the shafts work against each other: {name} deviates by {off:.3g} m/s from the best common motion"
            )
        return twist

    def aligned(self, angles: Angles, target: Angles) -> bool:
        """Whether the body may move while its wheels turn from ``angles`` to ``target``."""
        return True

    def axle_angles(self, twist: Twist2, angles: Angles) -> tuple[float, float]:
        """Axle angles of the bicycle with this motion; 0 if no angles give it."""
        if self.steered and len(angles) == len(AXLES):
            return angles[0], angles[1]
        if abs(twist[0]) <= STANDING * max(map(abs, twist)):
            return 0.0, 0.0
        return self.bicycle.steer_for_twist(*twist)[1:]

    # Steering

    def refusal(self, front: float, rear: float) -> str | None:
        """Why the body cannot take these axle angles; None if it can."""
        straight = 1e-6  # axle angles this close count as equal, rad
        if self.freedom == "front" and abs(rear) > straight:
            return (
                f"rear is {rear:.6g}: expected 0, because this body has no second steered axle and cannot move sideways"
            )
        if self.freedom == "parallel" and abs(front - rear) > straight:
            return (
                f"front is {front:.6g}, rear is {rear:.6g}: expected equal angles, because this body keeps its heading"
            )
        return None

    def limited(self, front: float, rear: float, limit: float) -> tuple[float, float]:
        """Return axle angles within the limit that the body can take and that keep the curvature as far as possible."""
        if self.freedom == "both":
            return self.bicycle.limit_keeping_curvature(front, rear, limit)
        front = clip(front, -limit, limit)
        return front, self._rear(front)

    def limited_steering(self, angles: Angles, limit: float) -> tuple[Angles, bool]:
        """Return the steering angles with axle angles limited as in ``limited``, and whether this changed them."""
        if not self.steered or max(map(abs, angles)) <= limit:
            return angles, False
        return self.limited(angles[0], angles[1], limit), True

    def reached(self, angles: Angles) -> Angles:
        """Steering angles that the servos' pulses reach; they keep the curvature, then the sideslip, if possible.

        Angles within reach come back as they were.
        """
        if self.freedom == "both":
            return angles if self.linkage is None else self._reach.limited(angles[0], angles[1])
        front = angles[0] if self.linkage is None else clip(angles[0], *self._front_reach)
        return front, self._rear(front)

    @property
    def reached_angle(self) -> float:
        """Largest axle angle that the servos reach to both sides in every steering mode, rad."""
        ways = {"both": ((1.0, -1.0), (1.0, 1.0)), "front": ((1.0, 0.0),), "parallel": ((1.0, 1.0),)}[self.freedom]
        low, high = 0.0, MAX_AXLE_ANGLE
        for _ in range(30):
            middle = 0.5 * (low + high)
            asked = [(side * front, side * rear) for front, rear in ways for side in (middle, -middle)]
            low, high = (middle, high) if all(self.reached(angles) == angles for angles in asked) else (low, middle)
        return low

    def servos(self, *angles: float) -> Angles:
        """Servo angles for steering angles; 0 for axles that are not steered."""
        return self.straight if self.linkage is None else self.linkage.servos(*angles)

    def steering(self, *servos: float) -> Angles:
        """Steering angles at servo angles, which are clamped to the linkage's range."""
        if self.linkage is None:
            return self.straight
        front, rear = self.linkage.angles(*servos)
        return front, rear if self.freedom == "both" else self._rear(front)

    def _rear(self, front: float) -> float:
        return front if self.freedom == "parallel" else 0.0

    @cached_property
    def _reach(self) -> Reach:
        assert self.linkage is not None
        return Reach(self.bicycle, self.linkage)

    @cached_property
    def _front_reach(self) -> Range:
        assert self.linkage is not None
        low, high = (self.linkage.angles(end, 0.0)[0] for end in self.linkage.ranges[0])
        return low, high


def _require_way(vx: float, vy: float, wz: float, bicycle: FourWheelSteering) -> None:
    """Refuse a twist that no angles of two axles below ``MAX_ANGLE`` give.

    Raises:
        KinematicsError: it is turning on the spot, or sideways motion.
    """
    sideways = max(abs(vy + bicycle.l_f * wz), abs(vy - bicycle.l_r * wz))
    if sideways > abs(vx) * math.tan(MAX_ANGLE) and sideways > 0.0:
        what = "turn on the spot" if abs(vy) < abs(wz) * bicycle.wheelbase else "move sideways"
        raise KinematicsError(f"vx is {vx:.6g}, vy is {vy:.6g}, wz is {wz:.6g}: this body cannot {what}")


@lru_cache(maxsize=8)
def _drive_secants(bicycle: FourWheelSteering, front: float, rear: float) -> tuple[float, float]:
    """Return ``drive_secants``, cached because the gate needs the same angles several times in every tick."""
    return bicycle.drive_secants(front, rear)


@dataclass(frozen=True)
class TruckChassis(Chassis):
    """The truck: one motor that turns with the mean of four wheels, two steered axles.

    At the angles of the equivalent bicycle ``drive_speed`` is that mean within 0.1 %, though its wheels share no ICR.
    """

    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """Motor speed for the base's speed."""
        travel, wheels = _drive_secants(self.bicycle, front, rear)
        return (speed / travel * wheels,)

    def input_speeds(self, shaft_speeds: Speeds, *angles: float) -> Speeds:
        """Speed of the base along its direction of travel."""
        return (shaft_speeds[0] / self.bicycle.drive_speed(1.0, *angles),)

    def twist(self, inputs: Speeds, *angles: float) -> Twist2:
        """See ``FourWheelSteering.body_twist``."""
        return self.bicycle.body_twist(inputs[0], *angles)


@dataclass(frozen=True)
class FamilyChassis(Chassis):
    """Any drive family whose inputs are its shafts, followed by the angle of a steered front wheel if it has one.

    Args:
        family: the drive.
        per_speed: input that gives 1 m/s at a wheel: 1 for speeds, 1/radius for rates.
        origin: x of the family's reference point in base, m.
    """

    family: Drive
    per_speed: float = 1.0
    origin: float = 0.0
    _steered: bool = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_steered", len(self.family.inputs) > len(self.shafts))

    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """Shaft speeds by the family's inverse."""
        return self.shafts_along(self.bicycle.body_twist(speed, front, rear))

    def shafts_along(self, twist: Twist2, *angles: float) -> Speeds:
        """Shaft speeds by the family's inverse."""
        command = self.family.inverse(twist_at(*twist, self.origin, 0.0))
        return tuple(value / self.per_speed for value in command[: len(self.shafts)])

    def input_speeds(self, shaft_speeds: Speeds, *angles: float) -> Speeds:
        """Return the shaft speeds unchanged."""
        return shaft_speeds

    def twist(self, inputs: Speeds, *angles: float) -> Twist2:
        """Twist by the family's forward kinematics."""
        driven = tuple(value * self.per_speed for value in inputs)
        twist = self.family.forward((*driven, angles[0]) if self._steered else driven)
        return twist_at(*twist, -self.origin, 0.0)


@dataclass(frozen=True)
class TricycleChassis(FamilyChassis):
    """One steered front wheel, and two passive rear wheels whose encoders measure the motion.

    Args:
        family: the drive.
    """

    family: Tricycle

    def twist_of_rear(self, left: float, right: float) -> Twist2:
        """Twist of the base from the speeds of the rear wheels, m/s."""
        twist = self.family.odometry(left / self.family.radius, right / self.family.radius)
        return twist_at(*twist, -self.origin, 0.0)

    def rear_of_twist(self, twist: Twist2) -> tuple[float, float]:
        """Speeds of the left and of the right rear wheel, m/s."""
        half = twist[2] * self.family.track / 2.0
        return twist[0] - half, twist[0] + half

    def lean(self, front: float) -> float:
        """Relative excess speed of the right rear wheel over its axle, at an angle of the front wheel."""
        return self.family.track / 2.0 * math.tan(front) / self.family.wheelbase


@dataclass(frozen=True)
class SynchroChassis(Chassis):
    """Synchro drive: one motor rolls all wheels, one servo turns them together.

    Args:
        family: the drive.
    """

    family: Synchro

    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """Equal speeds: all wheels roll as fast as the base."""
        return (self.family.inverse((speed, 0.0, 0.0))[0] * self.family.wheel_radius,)

    def input_speeds(self, shaft_speeds: Speeds, *angles: float) -> Speeds:
        """Return the speed of the only shaft."""
        return shaft_speeds

    def twist(self, inputs: Speeds, *angles: float) -> Twist2:
        """The platform translates along its wheels."""
        return self.family.platform_twist((inputs[0] / self.family.wheel_radius, 0.0), angles[0])


@dataclass(frozen=True)
class SkidWheelsChassis(FamilyChassis):
    """Left and right wheels, each with its own motor: front left, front right, rear left, rear right.

    If the wheels of one side turn at different speeds, the side moves at their mean.
    """

    def shafts_along(self, twist: Twist2, *angles: float) -> Speeds:
        """Equal speeds of both wheels of a side."""
        return super().shafts_along(twist, *angles) * 2

    def twist(self, inputs: Speeds, *angles: float) -> Twist2:
        """Twist by the means of the sides."""
        front_left, front_right, rear_left, rear_right = inputs
        return super().twist(((front_left + rear_left) / 2, (front_right + rear_right) / 2), *angles)


@dataclass(frozen=True)
class IndependentChassis(Chassis):
    """Two steered axles with ideal linkages, every wheel with its own motor.

    Two axle angles always require a forward speed; only ``WheelSteerChassis`` can turn on the spot.

    Args:
        family: the drive.
    """

    family: IndependentSteer

    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """Wheel speeds about the common ICR."""
        twist = self.bicycle.body_twist(speed, front, rear)
        return self.family.inverse(twist)[len(self.shafts) :]

    def input_speeds(self, shaft_speeds: Speeds, *angles: float) -> Speeds:
        """Return the shaft speeds unchanged."""
        return shaft_speeds

    def twist(self, inputs: Speeds, *angles: float) -> Twist2:
        """Least-squares twist of the wheels' velocities."""
        return self.family.forward((*self.bicycle.wheel_angles(*angles), *inputs))


@dataclass(frozen=True)
class WheelSteerChassis(Chassis):
    """A servo and a motor for every wheel: any twist.

    Args:
        family: the drive.
    """

    family: IndependentSteer

    straight = (0.0, 0.0, 0.0, 0.0)

    @property
    def steered(self) -> bool:
        """True, because every wheel has a servo."""
        return True

    @property
    def steering_errors(self) -> tuple[Angles, ...]:
        """One independent error for every wheel."""
        return tuple(tuple(float(i == k) for k in range(len(self.shafts))) for i in range(len(self.shafts)))

    def servos(self, *angles: float) -> Angles:
        """Servo angles equal the wheel angles."""
        return angles

    def steering(self, *servos: float) -> Angles:
        """Wheel angles equal the servo angles."""
        return tuple(clip(servo, -WHEEL_REACH, WHEEL_REACH) for servo in servos)

    def steering_for(self, twist: Twist2, near: Angles) -> Angles:
        """Point the wheels along their velocities; a wheel rolls backwards if that needs a smaller turn."""
        if twist == STILL:
            return near
        return tuple(
            self._nearest(angle, now, still=speed == 0.0)
            for angle, speed, now in zip(*self._wheels(twist), near, strict=True)
        )

    def _nearest(self, angle: float, near: float, *, still: bool) -> float:
        """Return the angle or its opposite direction, whichever is within reach and nearest to ``near``."""
        if still:
            return near
        turned = [a for a in (angle, angle - math.pi, angle + math.pi) if abs(a) <= WHEEL_REACH]
        return min(turned, key=lambda a: abs(a - near))

    def steering_for_axles(self, front: float, rear: float, near: Angles) -> Angles:
        """Point the wheels perpendicular to the lines to the bicycle's ICR."""
        return self.steering_for(self.bicycle.body_twist(1.0, front, rear), near)

    def limited_steering(self, angles: Angles, limit: float) -> tuple[Angles, bool]:
        """Return the angles unchanged: wheels with their own servos have no axle angle."""
        return angles, False

    def along(self, twist: Twist2, *angles: float) -> Twist2:
        """Least-squares twist of the part of each wheel's velocity along the wheel."""
        return self.twist(self.shafts_along(twist, *angles), *angles)

    def aligned(self, angles: Angles, target: Angles) -> bool:
        """Whether all wheels are close to their targets: other wheels would scrub and push the body off its motion."""
        # 0.35: wheels that are steered one by one may roll while they turn to angles this close, rad
        return max(abs(to - at) for at, to in zip(angles, target, strict=True)) <= 0.35

    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """Wheel speeds about the bicycle's ICR."""
        return self._wheels(self.bicycle.body_twist(speed, front, rear))[1]

    def shafts_along(self, twist: Twist2, *angles: float) -> Speeds:
        """Component of every wheel's velocity along the wheel."""
        return tuple(
            speed * math.cos(angle - at) for angle, speed, at in zip(*self._wheels(twist), angles, strict=True)
        )

    def input_speeds(self, shaft_speeds: Speeds, *angles: float) -> Speeds:
        """Return the shaft speeds unchanged."""
        return shaft_speeds

    def twist(self, inputs: Speeds, *angles: float) -> Twist2:
        """Least-squares twist of the wheels' velocities."""
        return self.family.forward((*angles, *inputs))

    def _wheels(self, twist: Twist2) -> tuple[Angles, Speeds]:
        """Angle and speed of every wheel."""
        command = self.family.inverse(twist)
        return command[: len(self.shafts)], command[len(self.shafts) :]


# Builders: a body of the configuration names one of these


@dataclass(frozen=True, slots=True)
class Dimensions:
    """Dimensions that every robot has."""

    drivetrain: DriveTrain
    """Motor to wheel, the same for every shaft."""
    wheelbase: float = 0.32
    """Distance between the axles, m; for a body without axles, the length of its equivalent bicycle."""
    track: float = 0.26
    """Distance between left and right wheels, m."""
    polynomials: PolynomialSet | SteeringPolynomials = "corrected"
    """Linkage of the truck's axles."""
    servo_ranges: tuple[Range, Range] = (FULL, FULL)
    """Front and rear servo angles that the servo controller's pulses can reach, rad."""

    @property
    def centred(self) -> FourWheelSteering:
        """Equivalent bicycle with its base point midway between the axles."""
        return FourWheelSteering(self.wheelbase, self.track)

    @property
    def linkage(self) -> SteeringPolynomials:
        """Linkage from servos to wheels."""
        known = self.polynomials
        return known if isinstance(known, SteeringPolynomials) else SteeringPolynomials.named(known)

    def ideal(self, polynomials: SteeringPolynomials) -> IdealAxles:
        """Axles whose wheels share one ICR."""
        return IdealAxles(polynomials, ranges=self.servo_ranges)


def truck_chassis(size: Dimensions, turn_deficit: Mapping[str, float] | None = None) -> Chassis:
    """Truck: two steered axles, one motor for all four wheels.

    Args:
        size: dimensions of the robot.
        turn_deficit: fields of ``TurnDeficit``.
    """
    deficit = TurnDeficit(**turn_deficit) if turn_deficit and any(turn_deficit.values()) else None
    axles = LinkedAxles(size.centred, size.linkage.front, size.linkage.rear, deficit, ranges=size.servo_ranges)
    return TruckChassis(size.centred, size.drivetrain, ("drive",), "both", axles)


def independent_chassis(size: Dimensions, steering: Literal["axles", "wheels"] = "axles") -> Chassis:
    """Body with a motor in every wheel.

    Args:
        size: dimensions of the robot.
        steering: two steered axles with ideal linkages, or a servo for every wheel.
    """
    wheels = IndependentSteer(size.centred.wheel_positions, size.drivetrain.wheel_radius)
    if steering == "wheels":
        return WheelSteerChassis(size.centred, size.drivetrain, WHEEL_NAMES, "both", None, wheels)
    return IndependentChassis(size.centred, size.drivetrain, WHEEL_NAMES, "both", size.ideal(size.linkage), wheels)


def synchro_chassis(size: Dimensions) -> Chassis:
    """Synchro drive, whose wheels roll and turn together."""
    family = Synchro(size.drivetrain.wheel_radius)
    return SynchroChassis(size.centred, size.drivetrain, ("roll",), "parallel", size.ideal(DIRECT), family)


def ackermann_chassis(size: Dimensions) -> Chassis:
    """Car with Ackermann steering."""
    axles = LinkedAxles(size.centred, size.linkage.front, None, ranges=size.servo_ranges)
    return _steered_front(size, axles, Ackermann(size.wheelbase, size.track, size.drivetrain.wheel_radius))


def bicycle_chassis(size: Dimensions, driven: Literal["front", "rear"] = "rear") -> Chassis:
    """Bicycle: one steered front wheel, one fixed rear wheel.

    Args:
        size: dimensions of the robot.
        driven: wheel that the motor drives.
    """
    return _steered_front(size, size.ideal(DIRECT), Bicycle(size.wheelbase, driven, size.drivetrain.wheel_radius))


def tricycle_chassis(size: Dimensions, driven: Literal["front", "rear"] = "front") -> Chassis:
    """Tricycle: one steered front wheel, two fixed rear wheels.

    Args:
        size: dimensions of the robot.
        driven: axle that the motor drives.
    """
    family = Tricycle(size.wheelbase, driven, size.drivetrain.wheel_radius, track=size.track)
    return TricycleChassis(
        size.centred, size.drivetrain, ("drive",), "front", size.ideal(DIRECT), family, origin=-size.centred.l_r
    )


def _steered_front(size: Dimensions, axles: Axles, family: Drive) -> Chassis:
    return FamilyChassis(size.centred, size.drivetrain, ("drive",), "front", axles, family, origin=-size.centred.l_r)


def differential_chassis(size: Dimensions) -> Chassis:
    """Two driven wheels, to the left and right of the base point."""
    return _driven_sides(size, Differential(size.drivetrain.wheel_radius, size.track))


def skid_steer_chassis(
    size: Dimensions,
    icr_left: float | None = None,
    icr_right: float | None = None,
    icr_x: float = 0.0,
    gain_left: float = 1.0,
    gain_right: float = 1.0,
    motors: Literal["sides", "wheels"] = "sides",
) -> Chassis:
    """Left and right wheels that turn the body by skidding.

    Args:
        size: the robot's.
        icr_left: lateral position of the left side's ICR, m; None: half the track.
        icr_right: of the right side's, m; None: minus half the track.
        icr_x: longitudinal position of both, m, 0 to -wheelbase.
        gain_left: effective over nominal radius of the left wheels.
        gain_right: of the right wheels.
        motors: one for each side, or for each wheel.

    Raises:
        KinematicsError: no robot can have these.
    """
    left = size.track / 2 if icr_left is None else icr_left
    right = -size.track / 2 if icr_right is None else icr_right
    family = SkidSteer(size.drivetrain.wheel_radius, left, right, icr_x, gain_left, gain_right)
    if not -size.wheelbase <= icr_x <= 0.0:
        raise KinematicsError(f"icr_x is {icr_x}: expected {-size.wheelbase:g} to 0, measured from the base")
    sides = _driven_sides(size, family, icr_x)
    if motors == "sides":
        return sides
    per_speed = 1.0 / size.drivetrain.wheel_radius
    return SkidWheelsChassis(sides.bicycle, size.drivetrain, WHEEL_NAMES, "front", None, family, per_speed)


def _driven_sides(size: Dimensions, family: Drive, icr_x: float = 0.0) -> Chassis:
    bicycle = FourWheelSteering(size.wheelbase, size.track, 1.0 + icr_x / size.wheelbase)
    return FamilyChassis(
        bicycle, size.drivetrain, ("left", "right"), "front", None, family, 1.0 / size.drivetrain.wheel_radius
    )


def omni_chassis(size: Dimensions, circle: float = 0.2, count: int = 3) -> Chassis:
    """Driven Swedish wheels on a circle.

    Args:
        size: the robot's.
        circle: its radius, m.
        count: count of the wheels.
    """
    return _driven_wheels(size, omni(circle, size.drivetrain.wheel_radius, count))


def mecanum_chassis(size: Dimensions) -> Chassis:
    """Four driven mecanum wheels."""
    return _driven_wheels(size, mecanum(size.wheelbase, size.track, size.drivetrain.wheel_radius))


def _driven_wheels(size: Dimensions, family: Drive) -> Chassis:
    return FamilyChassis(
        size.centred, size.drivetrain, family.inputs, "both", None, family, 1.0 / size.drivetrain.wheel_radius
    )
