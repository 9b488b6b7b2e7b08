"""Motion of base from the wheels between two readings, for any drive family, with its covariance.

The covariance comes from the family's own kinematics: the noise of every driven shaft and of both axle angles is
propagated through the derivatives of the body's twist, and unmeasured motion (sideways slip, scrubbing) is added.
"""

import math
from dataclasses import dataclass

import numpy as np

from monstertruck_kinematics.chassis import Angles, Chassis, Speeds
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Twist2
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import DriveFeedback, SteeringFeedback


@dataclass(frozen=True, slots=True)
class WheelIncrement:
    """Motion of base between two readings of all driven shafts."""

    since: int
    """Stamp of the earlier reading (ns)."""
    stamp: int
    """Stamp of the later reading (ns)."""
    twist: Twist2
    """Mean vx, vy (m/s) and wz (rad/s) between both."""
    distance: float
    """Distance of the fastest shaft, not negative (m)."""
    pace: Speeds
    """Speeds of the family's inputs, see ``Chassis.input_speeds``."""
    angles: Angles
    """Mean steering angles (rad)."""
    lost: bool = False
    """Whether the drive's counter has a new origin: the motion is then unknown, and the twist is 0."""

    @property
    def dt(self) -> float:
        """Duration (s)."""
        return (self.stamp - self.since) / SECOND


class WheelMotion:
    """Convert drive and steering feedback to the base's motion.

    Args:
        chassis: maps motors and servos to the body's motion.
        max_speed: maximum speed between two positions (m/s); beyond it, the counter has a new origin.
    """

    def __init__(self, chassis: Chassis, max_speed: float) -> None:
        self._chassis = chassis
        self._max_speed = max_speed
        self._turns: Speeds | None = None
        self._angles = chassis.straight
        self._angles_then = chassis.straight
        self._pace: Speeds = (0.0,) * len(chassis.shafts)
        self.stamp = 0
        """Stamp of the latest reading used (ns)."""
        self.steered: int | None = None
        """Stamp of the latest servo angles (ns)."""

    @property
    def known(self) -> bool:
        """Whether the shafts' positions have been read."""
        return self._turns is not None

    @property
    def front(self) -> float:
        """Latest angle of the front axle (rad)."""
        return self._angles[0]

    @property
    def twist(self) -> Twist2:
        """Velocity (vx, vy, wz) at the latest speed and steering angles (m/s, rad/s)."""
        return self._chassis.twist(self._pace, *self._angles)

    def observe_steering(self, feedback: SteeringFeedback) -> None:
        """Add the commanded servo angles, unless the servo controller marks them untrusted."""
        if not feedback.trusted or not all(map(math.isfinite, feedback.servos)):
            return
        self._angles = self._chassis.steering(*feedback.servos)
        self.steered = feedback.stamp

    def observe_drive(self, *shafts: DriveFeedback) -> WheelIncrement | None:
        """Return the motion since the last reading; None for the first reading, an earlier one, or NaN.

        Positions that were read at different times are extrapolated to the latest stamp with their speeds; the next
        readings correct the error.
        """
        stamp = max(shaft.stamp for shaft in shafts)
        turns = tuple(shaft.position + shaft.velocity * ((stamp - shaft.stamp) / SECOND) for shaft in shafts)
        before, since, then = self._turns, self.stamp, self._angles_then
        dt = (stamp - since) / SECOND
        if not all(map(math.isfinite, turns)) or (before is not None and dt <= 0):
            return None
        self._turns, self.stamp, self._angles_then = turns, stamp, self._angles
        if before is None:
            return None
        drivetrain = self._chassis.drivetrain
        rolled = [drivetrain.distance(now - last) for now, last in zip(turns, before, strict=True)]
        angles = tuple((before + now) / 2 for before, now in zip(then, self._angles, strict=True))
        if max(map(abs, rolled)) > self._max_speed * dt:
            self._pace = (0.0,) * len(self._pace)
            return WheelIncrement(since, stamp, (0.0, 0.0, 0.0), 0.0, self._pace, angles, lost=True)
        self._pace = self._chassis.input_speeds(tuple(distance / dt for distance in rolled), *angles)
        distance = max(map(abs, self._pace)) * dt
        return WheelIncrement(since, stamp, self._chassis.twist(self._pace, *angles), distance, self._pace, angles)


def increment_covariance(
    chassis: Chassis, roll: WheelIncrement, shaft: float, angle: float, slip: tuple[float, float, float]
) -> Array:
    """Return the covariance of the motion (dx, dy, dyaw) of ``roll`` in base, shape (3, 3) (m, rad).

    It grows with the distance, not with the number of readings.

    Args:
        chassis: the robot's chassis.
        roll: motion of the wheels.
        shaft: standard deviation of every shaft's distance per root metre rolled (m).
        angle: standard deviation of the mean of every steering angle over one metre (rad).
        slip: standard deviations of motion that the wheels do not measure, forward and sideways (m) and in yaw (rad),
            per root metre.
    """
    dt = roll.dt
    result = np.diag(np.square(slip) * roll.distance)
    for k, pace in enumerate(roll.pace):
        unit = tuple(float(k == i) for i in range(len(roll.pace)))
        by_shaft = np.array(chassis.twist(unit, *roll.angles))
        result += np.outer(by_shaft, by_shaft) * (shaft**2 * abs(pace) * dt)
    if roll.distance <= 0:
        return result
    angle_step = 1e-4
    for error in chassis.steering_errors:
        step = angle_step * np.array(error)
        ahead = np.array(chassis.twist(roll.pace, *(np.array(roll.angles) + step).tolist()))
        behind = np.array(chassis.twist(roll.pace, *(np.array(roll.angles) - step).tolist()))
        by_angle = (ahead - behind) * (dt / (2 * angle_step))
        result += np.outer(by_angle, by_angle) * (angle**2 / roll.distance)
    return result
