"""A robot body with its actuators: what gate, odometry and simulation need of any drive family.

Requests, gate and trackers use one equivalent bicycle about the base point: its speed along the direction of travel
and the angles of its two axles. A chassis converts these to speeds of the driven shafts and servo angles, and measured
shaft speeds and servo angles to the base's twist. ``freedom`` is the set of axle angles that a body can take; for a
body without axles the bicycle is virtual, its wheelbase being the body's reference length:

- ``both``: any pair of angles (truck, independent, omni, mecanum).
- ``front``: the rear angle is 0. A car's base lies between its axles; a differential or skid-steer drive is the
  bicycle whose rear axle lies on the line of its ICRs, curvature tan(front) / length.
- ``parallel``: both angles are equal, the body never turns (synchro).

Shaft speeds are those of the wheels' treads over ground, m/s, forward positive.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Final, Literal

from monstertruck_kinematics.drive import Drive, Twist
from monstertruck_kinematics.elementary import KinematicsError, clip
from monstertruck_kinematics.motion import twist_at
from monstertruck_kinematics.polynomials import AxlePolynomials, PolynomialSet, SteeringPolynomials
from monstertruck_kinematics.steered import WHEEL_NAMES, Ackermann, Bicycle, IndependentSteer, Synchro, Tricycle
from monstertruck_kinematics.truck import MAX_AXLE_ANGLE, DriveTrain, FourWheelSteering
from monstertruck_kinematics.unsteered import Differential, SkidSteer, mecanum, omni

Freedom = Literal["both", "front", "parallel"]
Speeds = tuple[float, ...]

STRAIGHT: Final = 1e-6
"""Axle angles this close count as equal, rad."""

DIRECT: Final = SteeringPolynomials(AxlePolynomials((1.0, 0.0), (1.0, 0.0)), AxlePolynomials((1.0, 0.0), (1.0, 0.0)))
"""A servo that turns its wheel itself."""


@dataclass(frozen=True)
class Chassis(ABC):
    """One robot's wheels, motors and servos.

    Args:
        bicycle: the equivalent bicycle about the base point.
        drivetrain: motor to wheel, the same for every shaft.
        shafts: names of the driven shafts, in the order of their devices.
        freedom: which axle angles of the bicycle it can take.
        linkage: servo to axle; None = no steering.
    """

    bicycle: FourWheelSteering
    drivetrain: DriveTrain
    shafts: tuple[str, ...]
    freedom: Freedom
    linkage: SteeringPolynomials | None

    @abstractmethod
    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """Speed of every shaft for a motion of the bicycle."""

    @abstractmethod
    def input_speeds(self, shaft_speeds: Speeds, front: float, rear: float) -> Speeds:
        """Speeds of the drive family's own inputs, m/s, from the shaft speeds; they hold while the steering changes."""

    @abstractmethod
    def twist(self, inputs: Speeds, front: float, rear: float) -> Twist[float]:
        """Velocity (vx, vy, wz) of the base at axle angles."""

    def fastest_wheel_speed(self, shaft_speeds: Speeds) -> float:
        """Speed of the fastest wheel, m/s, negative when the body goes backwards."""
        if len(shaft_speeds) == 1:
            return shaft_speeds[0]
        fastest = max(map(abs, shaft_speeds))
        return math.copysign(fastest, self.twist(self.input_speeds(shaft_speeds, 0.0, 0.0), 0.0, 0.0)[0])

    # Steering

    @property
    def max_axle_angle(self) -> float:
        """Largest axle angle to either side that the linkage allows, rad."""
        if self.linkage is None:
            return MAX_AXLE_ANGLE
        steered = (self.linkage.front, self.linkage.rear) if self.freedom == "both" else (self.linkage.front,)
        return min(abs(end) for axle in steered for end in axle.axle_limits)

    def refusal(self, front: float, rear: float) -> str | None:
        """Why the body cannot take these axle angles; None if it can."""
        if self.freedom == "front" and abs(rear) > STRAIGHT:
            return f"rear is {rear:.6g}: expected 0, this body has no second steered axle and cannot move sideways"
        if self.freedom == "parallel" and abs(front - rear) > STRAIGHT:
            return f"front is {front:.6g}, rear is {rear:.6g}: expected equal angles, this body keeps its heading"
        return None

    def limited(self, front: float, rear: float, limit: float) -> tuple[float, float]:
        """Angles within the limit that keep the curvature as far as possible, of angles the body can take."""
        if self.freedom == "both":
            return self.bicycle.limit_keeping_curvature(front, rear, limit)
        front = clip(front, -limit, limit)
        return front, self._rear(front)

    def servos(self, front: float, rear: float) -> tuple[float, float]:
        """Servo angles for axle angles; 0 for axles that are not steered."""
        return (0.0, 0.0) if self.linkage is None else self.linkage.servo_from_axles(front, rear)

    def axles(self, front_servo: float, rear_servo: float) -> tuple[float, float]:
        """Axle angles at servo angles, which are clamped to the linkage's range."""
        if self.linkage is None:
            return 0.0, 0.0
        front = _axle(self.linkage.front, front_servo)
        return front, _axle(self.linkage.rear, rear_servo) if self.freedom == "both" else self._rear(front)

    def _rear(self, front: float) -> float:
        return front if self.freedom == "parallel" else 0.0


def _axle(linkage: AxlePolynomials, servo: float) -> float:
    return linkage.axle_from_servo(min(max(servo, -linkage.servo_limit), linkage.servo_limit))


@dataclass(frozen=True)
class TruckChassis(Chassis):
    """The truck: one motor that turns with the mean of four wheels, two steered axles."""

    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """Speed at the motor for the base's speed."""
        return (self.bicycle.drive_speed(speed, front, rear),)

    def input_speeds(self, shaft_speeds: Speeds, front: float, rear: float) -> Speeds:
        """The base's speed along its direction of travel."""
        return (shaft_speeds[0] / self.bicycle.drive_speed(1.0, front, rear),)

    def twist(self, inputs: Speeds, front: float, rear: float) -> Twist[float]:
        """See ``FourWheelSteering.body_twist``."""
        return self.bicycle.body_twist(inputs[0], front, rear)


@dataclass(frozen=True)
class FamilyChassis(Chassis):
    """Any drive family whose inputs are its shafts, followed by the angle of a steered front wheel if it has one.

    Args:
        family: the drive.
        per_speed: of the family's inputs for 1 m/s at a wheel: 1 for speeds, 1/radius for rates.
        origin: x of the family's reference point in base, m.
    """

    family: Drive
    per_speed: float = 1.0
    origin: float = 0.0
    _steered: bool = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_steered", len(self.family.inputs) > len(self.shafts))

    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """The family's inverse."""
        twist = twist_at(*self.bicycle.body_twist(speed, front, rear), self.origin, 0.0)
        command = self.family.inverse(twist)
        return tuple(value / self.per_speed for value in command[: len(self.shafts)])

    def input_speeds(self, shaft_speeds: Speeds, front: float, rear: float) -> Speeds:
        """The shafts themselves."""
        return shaft_speeds

    def twist(self, inputs: Speeds, front: float, rear: float) -> Twist[float]:
        """The family's forward."""
        driven = tuple(value * self.per_speed for value in inputs)
        twist = self.family.forward((*driven, front) if self._steered else driven)
        return twist_at(*twist, -self.origin, 0.0)


@dataclass(frozen=True)
class SynchroChassis(Chassis):
    """Synchro drive: one motor rolls all wheels, one servo turns them together.

    Args:
        family: the drive.
    """

    family: Synchro

    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """All wheels roll as fast as the base."""
        return (self.family.inverse((speed, 0.0, 0.0))[0] * self.family.wheel_radius,)

    def input_speeds(self, shaft_speeds: Speeds, front: float, rear: float) -> Speeds:
        """The shaft itself."""
        return shaft_speeds

    def twist(self, inputs: Speeds, front: float, rear: float) -> Twist[float]:
        """The platform translates along its wheels."""
        return self.family.platform_twist((inputs[0] / self.family.wheel_radius, 0.0), front)


@dataclass(frozen=True)
class IndependentChassis(Chassis):
    """Two steered axles with ideal linkages, every wheel with a motor of its own.

    Two axle angles always leave a forward speed, so the family's turning on the spot is not available.

    Args:
        family: the drive.
    """

    family: IndependentSteer

    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """Wheel speeds about the common ICR."""
        twist = self.bicycle.body_twist(speed, front, rear)
        return self.family.inverse(twist)[len(self.shafts) :]

    def input_speeds(self, shaft_speeds: Speeds, front: float, rear: float) -> Speeds:
        """The shafts themselves."""
        return shaft_speeds

    def twist(self, inputs: Speeds, front: float, rear: float) -> Twist[float]:
        """Least-squares twist of the wheels' velocities."""
        return self.family.forward((*self.bicycle.wheel_angles(front, rear), *inputs))


# Builders: a body of the configuration names one of these


@dataclass(frozen=True, slots=True)
class Dimensions:
    """Dimensions that every robot has."""

    drivetrain: DriveTrain
    """Motor to wheel, the same for every shaft."""
    wheelbase: float = 0.32
    """Between the axles, m; of a body without them, the length of its equivalent bicycle."""
    track: float = 0.26
    """Between left and right wheels, m."""
    polynomials: PolynomialSet = "corrected"
    """Linkage of the truck's axles."""

    @property
    def centred(self) -> FourWheelSteering:
        """The bicycle whose base point lies in the middle between its axles."""
        return FourWheelSteering(self.wheelbase, self.track)

    @property
    def linkage(self) -> SteeringPolynomials:
        """Servo to axle."""
        return SteeringPolynomials.named(self.polynomials)


def truck_chassis(size: Dimensions) -> Chassis:
    """Two steered axles, one motor for all four wheels."""
    return TruckChassis(size.centred, size.drivetrain, ("drive",), "both", size.linkage)


def independent_chassis(size: Dimensions) -> Chassis:
    """Two steered axles, a motor in every wheel."""
    wheels = IndependentSteer(size.centred.wheel_positions, size.drivetrain.wheel_radius)
    return IndependentChassis(size.centred, size.drivetrain, WHEEL_NAMES, "both", size.linkage, wheels)


def synchro_chassis(size: Dimensions) -> Chassis:
    """Wheels that roll and turn together."""
    family = Synchro(size.drivetrain.wheel_radius)
    return SynchroChassis(size.centred, size.drivetrain, ("roll",), "parallel", DIRECT, family)


def ackermann_chassis(size: Dimensions) -> Chassis:
    """A car."""
    return _steered_front(size, size.linkage, Ackermann(size.wheelbase, size.track, size.drivetrain.wheel_radius))


def bicycle_chassis(size: Dimensions, driven: Literal["front", "rear"] = "rear") -> Chassis:
    """One steered front wheel, one fixed rear wheel.

    Args:
        size: the robot's.
        driven: wheel that the motor drives.
    """
    return _steered_front(size, DIRECT, Bicycle(size.wheelbase, driven, size.drivetrain.wheel_radius))


def tricycle_chassis(size: Dimensions, driven: Literal["front", "rear"] = "front") -> Chassis:
    """One steered front wheel, two fixed rear wheels.

    Args:
        size: the robot's.
        driven: axle that the motor drives.
    """
    return _steered_front(
        size, DIRECT, Tricycle(size.wheelbase, driven, size.drivetrain.wheel_radius, track=size.track)
    )


def _steered_front(size: Dimensions, steering: SteeringPolynomials, family: Drive) -> Chassis:
    return FamilyChassis(size.centred, size.drivetrain, ("drive",), "front", steering, family, origin=-size.centred.l_r)


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
) -> Chassis:
    """Left and right wheels that turn the body by skidding.

    Args:
        size: the robot's.
        icr_left: lateral position of the left side's ICR, m; None = half the track.
        icr_right: of the right side's, m; None = minus half the track.
        icr_x: longitudinal position of both, m, 0 to -wheelbase.
        gain_left: effective over nominal radius of the left wheels.
        gain_right: of the right wheels.

    Raises:
        KinematicsError: no robot can have these.
    """
    left = size.track / 2 if icr_left is None else icr_left
    right = -size.track / 2 if icr_right is None else icr_right
    family = SkidSteer(size.drivetrain.wheel_radius, left, right, icr_x, gain_left, gain_right)
    if not -size.wheelbase <= icr_x <= 0.0:
        raise KinematicsError(f"icr_x is {icr_x}: expected {-size.wheelbase:g} to 0, measured from the base")
    return _driven_sides(size, family, icr_x)


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
        count: of the wheels.
    """
    return _driven_wheels(size, omni(circle, size.drivetrain.wheel_radius, count))


def mecanum_chassis(size: Dimensions) -> Chassis:
    """Four driven mecanum wheels."""
    return _driven_wheels(size, mecanum(size.wheelbase, size.track, size.drivetrain.wheel_radius))


def _driven_wheels(size: Dimensions, family: Drive) -> Chassis:
    return FamilyChassis(
        size.centred, size.drivetrain, family.inputs, "both", None, family, 1.0 / size.drivetrain.wheel_radius
    )
