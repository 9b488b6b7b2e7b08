"""Wheel data of a truck that drives exactly as it is commanded."""

import math

import numpy as np

from monstertruck_estimation.body_tilt import Tilt
from monstertruck_estimation.odometry import DeadReckoning, OdometryConfig
from monstertruck_estimation.transforms import TransformService
from monstertruck_kinematics.chassis import Dimensions, truck_chassis
from monstertruck_kinematics.truck import DriveTrain, FourWheelSteering
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import Attitude, DriveFeedback, DriveMode, SteeringFeedback
from monstertruck_schemas.state import Transform

STEERING = FourWheelSteering()
DRIVETRAIN = DriveTrain()
CHASSIS = truck_chassis(Dimensions(DRIVETRAIN))


def drive_feedback(now, position, velocity=0.0):
    return DriveFeedback(stamp=now, received=now, seq=0, position=position, velocity=velocity, mode=DriveMode.ENABLED)


def servo_feedback(now, front, rear):
    servos = CHASSIS.servos(front, rear)
    return SteeringFeedback(stamp=now, received=now, seq=0, front=servos[0], rear=servos[1])


def heading(now, yaw, disturbed=False):
    return Attitude(
        stamp=now, received=now, seq=0, heading=(-yaw) % math.tau, roll=0.0, pitch=0.0, heading_disturbed=disturbed
    )


def felt_tilt(forward, left, roll, pitch):
    """Roll and pitch that an accelerometer shows on a body with a tilt and an acceleration in its level frame."""
    turn_pitch = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    turn_roll = np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]])
    x, y, z = (turn_pitch @ turn_roll).T @ (forward, left, 9.81)
    return Tilt(math.atan2(y, z), math.atan2(-x, math.hypot(y, z)))


class Truck:
    """Truth, and a filter fed with 20 Hz drive readings and servo angles."""

    def __init__(self, compass_error=None, **config):
        self.reckoning = DeadReckoning(OdometryConfig(**config), CHASSIS)
        self.now = SECOND
        self.pose = (0.0, 0.0, 0.0)
        self.motor = 1000.0
        self.compass_error = compass_error
        self.slip = 1.0
        self.north = 0.7
        self._count = 0
        self.reckoning.observe_drive(drive_feedback(self.now, self.motor))

    def drive(self, speed, front, rear, seconds, step=0.01):
        for _ in range(round(seconds / step)):
            self.pose = STEERING.integrate(self.pose, *STEERING.body_twist(speed, front, rear), step)
            self.motor += DRIVETRAIN.motor_angle(STEERING.drive_speed(speed, front, rear) * step) * self.slip
            self.now += round(step * SECOND)
            self._count += 1
            if self._count % 5 == 0:
                self.reckoning.observe_steering(servo_feedback(self.now, front, rear))
                self.reckoning.observe_drive(drive_feedback(self.now, self.motor))
                if self.compass_error is not None:
                    yaw = self.pose[2] - self.north + self.compass_error(self)
                    self.reckoning.observe_attitude(heading(self.now, yaw))

    @property
    def estimate(self):
        return self.reckoning.estimate(self.now)

    def error(self):
        """Position and yaw error."""
        estimate = self.estimate.pose
        return (
            math.hypot(estimate[0] - self.pose[0], estimate[1] - self.pose[1]),
            abs(math.remainder(estimate[2] - self.pose[2], math.tau)),
        )


def spread(covariance):
    return np.sqrt(np.diag(np.reshape(covariance, (3, 3))))


def looked_up(service: TransformService, parent: str, child: str) -> Transform:
    """Newest pose of ``child`` in ``parent``, as the service would publish it now."""
    service._refresh()
    return service._tree.lookup(parent, child)
