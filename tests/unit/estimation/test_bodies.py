"""Dead reckoning of bodies with several shafts, whose controllers are read one after the other."""

import math

import pytest

from monstertruck_estimation.odometry import DeadReckoning, OdometryConfig
from monstertruck_kinematics.chassis import Dimensions
from monstertruck_kinematics.se2 import integrate
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.bodies import BODIES
from monstertruck_runtime.clock import SECOND
from tests.unit.estimation.kit import drive_feedback, servo_feedback

DRIVETRAIN = DriveTrain()
MOTIONS = {
    "differential": (0.2, 0.3, 0.0),
    "skid_steer": (-0.15, 0.3, 0.0),
    "omni": (0.2, 0.3, 0.1),
    "mecanum": (0.2, 0.35, 0.35),
}


class Robot:
    """Shafts that turn as asked; the i-th is read i times 12 ms late in each round of 50 ms."""

    def __init__(self, kind, **parameters):
        self.chassis = BODIES[kind].implementation_class()(Dimensions(DRIVETRAIN), **parameters)
        self.reckoning = DeadReckoning(OdometryConfig(compass=None), self.chassis)
        self.now, self.pose = SECOND, (0.0, 0.0, 0.0)
        self.turns = [1000.0 * i for i in range(len(self.chassis.shafts))]
        self.read([0.0] * len(self.turns))

    def read(self, rates):
        stamps = [self.now + round(0.012 * i * SECOND) for i in range(len(rates))]
        self.reckoning.observe_drive(
            *(
                drive_feedback(stamp, turn + rate * (stamp - self.now) / SECOND, rate)
                for stamp, turn, rate in zip(stamps, self.turns, rates, strict=True)
            )
        )
        return max(stamps)

    def roll(self, shafts, seconds, twist):
        rates = [DRIVETRAIN.motor_rate(speed) for speed in shafts]
        for _ in range(round(seconds * 20)):
            self.pose = integrate(self.pose, *twist, 0.05)
            self.turns = [turn + rate * 0.05 for turn, rate in zip(self.turns, rates, strict=True)]
            self.now += SECOND // 20
            last = self.read(rates)
        return self.reckoning.estimate(last), integrate(self.pose, *twist, (last - self.now) / SECOND)


@pytest.mark.parametrize("kind", MOTIONS)
def test_a_steady_arc_is_followed(kind):
    robot = Robot(kind)
    speed, front, rear = MOTIONS[kind]
    shafts = robot.chassis.shaft_speeds(speed, front, rear)
    estimate, truth = robot.roll(shafts, 8.0, robot.chassis.bicycle.body_twist(speed, front, rear))
    assert math.dist(estimate.pose[:2], truth[:2]) < 0.02  # the first reading was taken at rest
    assert math.remainder(estimate.pose[2] - truth[2], math.tau) == pytest.approx(0.0, abs=0.05)
    assert estimate.twist == pytest.approx(robot.chassis.bicycle.body_twist(speed, front, rear), abs=1e-6)


def test_turning_on_the_spot_is_followed_too():
    robot = Robot("differential")
    estimate, truth = robot.roll((-0.1, 0.1), 4.0, (0.0, 0.0, 0.2 / 0.26))
    assert estimate.pose[:2] == pytest.approx((0.0, 0.0), abs=0.005)
    assert math.remainder(estimate.pose[2] - truth[2], math.tau) == pytest.approx(0.0, abs=0.05)


def test_readings_at_different_instants_do_not_turn_a_straight_way():
    robot = Robot("differential")
    estimate, _ = robot.roll((0.2, 0.2), 5.0, (0.2, 0.0, 0.0))
    moved = robot.reckoning.estimate(robot.now + SECOND).pose[2] - estimate.pose[2]
    assert abs(estimate.pose[2]) < 0.05
    assert moved == pytest.approx(0.0, abs=1e-9)


def test_one_shaft_that_counts_from_a_new_origin_is_no_way():
    robot = Robot("differential")
    before, _ = robot.roll((0.1, 0.1), 1.0, (0.1, 0.0, 0.0))
    robot.turns[1] -= 1e4
    robot.now += SECOND // 20
    after = robot.reckoning.estimate(robot.read([0.0, 0.0]))
    assert math.dist(after.pose[:2], before.pose[:2]) < 0.01
    assert after.pose_covariance[0] > before.pose_covariance[0]


def test_a_cars_rear_servo_does_not_exist():
    robot = Robot("ackermann")
    front, _ = robot.chassis.servos(0.3, 0.0)
    feedback = servo_feedback(robot.now, 0.0, 0.0).model_copy(update={"front": front, "rear": -0.5})
    robot.reckoning.observe_steering(feedback)
    estimate, _ = robot.roll((0.2,), 1.0, (0.0, 0.0, 0.0))
    assert estimate.twist[2] / estimate.twist[0] == pytest.approx(math.tan(0.3) / 0.32)
