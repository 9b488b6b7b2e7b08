"""A drive family behind its actuators: what gate, odometry and plant need of any robot.

Requests, gate and trackers speak of one equivalent bicycle about the base point: its speed along the direction of
travel and the angles of its two axles. A chassis turns that into speeds of the driven shafts and servo angles, and
measured shaft speeds and servo angles back into the base's twist. How much of the bicycle a body can do is its
``freedom``; for one without axles the bicycle is imagined, its length being the body's reference length:

- ``both``: any pair of angles (truck, independent, omni, mecanum).
- ``front``: the rear angle is 0. A car's base lies between its axles; a differential or skid-steer drive is the
  bicycle whose rear axle stands at its turning centres, curvature tan(front) / length.
- ``parallel``: both angles are equal, the body never turns (synchro).

Speeds of shafts are those of the wheels' treads over ground, m/s, forward positive.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Final, Literal

from monstertruck_kinematics.elementary import clip
from monstertruck_kinematics.errors import KinematicsError
from monstertruck_kinematics.families import (
    Ackermann,
    Bicycle,
    Differential,
    Drive,
    IndependentSteer,
    Synchro,
    Tricycle,
    Twist,
    mecanum,
    omni,
)
from monstertruck_kinematics.families.four_wheel import WHEEL_NAMES
from monstertruck_kinematics.motion import moved_point
from monstertruck_kinematics.polynomials import AxlePolynomials, PolynomialSet, SteeringPolynomials
from monstertruck_kinematics.skid_steer import SkidSteer
from monstertruck_kinematics.truck import STEEPEST, DriveTrain, FourWheelSteering

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
        freedom: which axle angles of the bicycle it can do.
        linkage: servo to axle; None = nothing is steered.
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
    def pace(self, shaft_speeds: Speeds, front: float, rear: float) -> Speeds:
        """What the shafts make of the family's own inputs, m/s; lasts while the steering changes."""

    @abstractmethod
    def twist(self, pace: Speeds, front: float, rear: float) -> Twist[float]:
        """Velocity (vx, vy, wz) of the base at axle angles."""

    def travel(self, shaft_speeds: Speeds) -> float:
        """Speed of the fastest wheel, m/s, negative when the body goes backwards."""
        if len(shaft_speeds) == 1:
            return shaft_speeds[0]
        fastest = max(map(abs, shaft_speeds))
        return math.copysign(fastest, self.twist(self.pace(shaft_speeds, 0.0, 0.0), 0.0, 0.0)[0])

    # Steering

    @property
    def reach(self) -> float:
        """Greatest axle angle either way that the linkage allows, rad."""
        if self.linkage is None:
            return STEEPEST
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
        """Servo angles for axle angles; 0 where nothing is steered."""
        return (0.0, 0.0) if self.linkage is None else self.linkage.servo_from_axles(front, rear)

    def axles(self, front_servo: float, rear_servo: float) -> tuple[float, float]:
        """Axle angles at servo angles, which are cut to what the linkage takes."""
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
        """What the motor sees of the base's speed."""
        return (self.bicycle.drive_speed(speed, front, rear),)

    def pace(self, shaft_speeds: Speeds, front: float, rear: float) -> Speeds:
        """The base's speed along its direction of travel."""
        return (shaft_speeds[0] / self.bicycle.drive_speed(1.0, front, rear),)

    def twist(self, pace: Speeds, front: float, rear: float) -> Twist[float]:
        """See ``FourWheelSteering.body_twist``."""
        return self.bicycle.body_twist(pace[0], front, rear)


@dataclass(frozen=True)
class FamilyChassis(Chassis):
    """Any drive family whose inputs are its shafts and, behind them, the angle of a steered front wheel.

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
        twist = moved_point(*self.bicycle.body_twist(speed, front, rear), self.origin, 0.0)
        command = self.family.inverse(twist)
        return tuple(value / self.per_speed for value in command[: len(self.shafts)])

    def pace(self, shaft_speeds: Speeds, front: float, rear: float) -> Speeds:
        """The shafts themselves."""
        return shaft_speeds

    def twist(self, pace: Speeds, front: float, rear: float) -> Twist[float]:
        """The family's forward."""
        driven = tuple(value * self.per_speed for value in pace)
        twist = self.family.forward((*driven, front) if self._steered else driven)
        return moved_point(*twist, -self.origin, 0.0)


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

    def pace(self, shaft_speeds: Speeds, front: float, rear: float) -> Speeds:
        """The shaft itself."""
        return shaft_speeds

    def twist(self, pace: Speeds, front: float, rear: float) -> Twist[float]:
        """The platform translates along its wheels."""
        return self.family.platform_twist((pace[0] / self.family.wheel_radius, 0.0), front)


@dataclass(frozen=True)
class IndependentChassis(Chassis):
    """Two steered axles with ideal linkages, every wheel with a motor of its own.

    Two axle angles always leave a forward speed, so the family's turning on the spot is out of their reach.

    Args:
        family: the drive.
    """

    family: IndependentSteer

    def shaft_speeds(self, speed: float, front: float, rear: float) -> Speeds:
        """Wheel speeds about the common turning centre."""
        twist = self.bicycle.body_twist(speed, front, rear)
        return self.family.inverse(twist)[len(self.shafts) :]

    def pace(self, shaft_speeds: Speeds, front: float, rear: float) -> Speeds:
        """The shafts themselves."""
        return shaft_speeds

    def twist(self, pace: Speeds, front: float, rear: float) -> Twist[float]:
        """Least-squares twist of the wheels' velocities."""
        return self.family.forward((*self.bicycle.wheel_angles(front, rear), *pace))


def build_chassis(
    kind: str,
    *,
    wheelbase: float = 0.32,
    track: float = 0.26,
    drivetrain: DriveTrain,
    polynomials: PolynomialSet = "corrected",
    driven: Literal["front", "rear"] = "rear",
    icr_left: float | None = None,
    icr_right: float | None = None,
    icr_x: float = 0.0,
    gain_left: float = 1.0,
    gain_right: float = 1.0,
    circle: float = 0.2,
    count: int = 3,
) -> Chassis:
    """A chassis by the name of its family.

    Args:
        kind: truck, ackermann, bicycle, tricycle, independent, differential, skid_steer, synchro, omni or mecanum.
        wheelbase: between the axles, m; of a body without them, the length of its equivalent bicycle.
        track: m.
        drivetrain: motor to wheel.
        polynomials: linkage of truck, ackermann and independent; the other steered bodies turn their wheel by the
            servo itself.
        driven: wheel of a bicycle or tricycle.
        icr_left: of a skid-steer drive, m; None = half the track.
        icr_right: likewise; None = minus half the track.
        icr_x: of a skid-steer drive, m, 0 to -wheelbase.
        gain_left: of a skid-steer drive.
        gain_right: of a skid-steer drive.
        circle: of an omni drive, m.
        count: of an omni drive's wheels.

    Raises:
        KinematicsError: no such family, or dimensions no robot can have.
    """
    radius = drivetrain.wheel_radius
    centred = FourWheelSteering(wheelbase, track)
    linkage = SteeringPolynomials.named(polynomials)
    if kind == "truck":
        return TruckChassis(centred, drivetrain, ("drive",), "both", linkage)
    if kind == "independent":
        wheels = IndependentSteer(centred.wheel_positions, radius)
        return IndependentChassis(centred, drivetrain, WHEEL_NAMES, "both", linkage, wheels)
    if kind == "synchro":
        return SynchroChassis(centred, drivetrain, ("roll",), "parallel", DIRECT, Synchro(radius))
    if kind in ("ackermann", "bicycle", "tricycle"):
        family: Drive = Ackermann(wheelbase, track, radius)
        if kind == "bicycle":
            family = Bicycle(wheelbase, driven, radius)
        elif kind == "tricycle":
            family = Tricycle(wheelbase, driven, radius, track=track)
        steering = linkage if kind == "ackermann" else DIRECT
        return FamilyChassis(centred, drivetrain, ("drive",), "front", steering, family, origin=-centred.l_r)
    if kind in ("differential", "skid_steer"):
        family = Differential(radius, track)
        if kind == "skid_steer":
            left = track / 2 if icr_left is None else icr_left
            right = -track / 2 if icr_right is None else icr_right
            family = SkidSteer(radius, left, right, icr_x, gain_left, gain_right)
            if not -wheelbase <= icr_x <= 0.0:
                raise KinematicsError(f"icr_x is {icr_x}: expected {-wheelbase:g} to 0, measured from the base")
        bicycle = FourWheelSteering(wheelbase, track, 1.0 + icr_x / wheelbase)
        return FamilyChassis(bicycle, drivetrain, ("left", "right"), "front", None, family, 1.0 / radius)
    if kind in ("omni", "mecanum"):
        family = omni(circle, radius, count) if kind == "omni" else mecanum(wheelbase, track, radius)
        return FamilyChassis(centred, drivetrain, family.inputs, "both", None, family, 1.0 / radius)
    raise KinematicsError(
        f"body {kind!r}: expected truck, ackermann, bicycle, tricycle, independent, differential, skid_steer, "
        "synchro, omni or mecanum"
    )
