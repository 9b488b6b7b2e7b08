import math

import numpy as np
import pytest

from monstertruck_estimation.wheel_motion import WheelMotion, increment_covariance
from monstertruck_kinematics.chassis import Dimensions, truck_chassis
from monstertruck_runtime.bodies import BODIES
from monstertruck_runtime.clock import SECOND
from tests.unit.estimation.kit import DRIVETRAIN, drive_feedback, servo_feedback

STEERED = ("truck", "ackermann", "bicycle", "tricycle", "independent", "synchro")
KINDS = (*STEERED, "differential", "skid_steer", "omni", "mecanum")
STEP = SECOND // 20
SHAFT = 0.02


def rolls(chassis, speeds, angle, count, cuts=1):
    """Ways of ``count`` readings, each cut into ``cuts``."""
    wheels, turns, made = WheelMotion(chassis, 2.0), np.zeros(len(chassis.shafts)), []
    front, rear = (angle, angle) if chassis.freedom == "parallel" else (angle, 0.0)
    servos = chassis.servos(front, rear)
    for k in range(count * cuts + 1):
        now = SECOND + k * STEP // cuts
        feedback = servo_feedback(now, 0.0, 0.0).model_copy(update={"front": servos[0], "rear": servos[1]})
        wheels.observe_steering(feedback)
        roll = wheels.observe_drive(*(drive_feedback(now, DRIVETRAIN.motor_angle(way)) for way in turns))
        turns = turns + np.array(speeds) * (STEP / cuts / SECOND)
        if roll is not None:
            made.append(roll)
    return made


def total(chassis, made):
    return sum(increment_covariance(chassis, roll, SHAFT, 0.01, (0.005, 0.005, 0.01)) for roll in made)


@pytest.mark.parametrize("kind", KINDS)
def test_every_family_has_a_covariance_that_grows_with_the_way_not_with_the_readings(kind):
    chassis = BODIES[kind].implementation_class()(Dimensions(DRIVETRAIN))
    speeds = 0.2 + 0.02 * np.arange(len(chassis.shafts))
    short, long = rolls(chassis, speeds, 0.1, 10), rolls(chassis, speeds, 0.1, 20)
    one = total(chassis, short)
    assert np.linalg.eigvalsh(one)[0] > 0
    assert total(chassis, long)[:, :] == pytest.approx(2 * one, rel=0.15, abs=1e-7)
    assert total(chassis, rolls(chassis, speeds, 0.1, 10, cuts=4)) == pytest.approx(one, rel=0.05, abs=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_the_noise_of_the_shafts_gives_the_covariance_that_is_reported(kind):
    """Monte Carlo: 300 drives of 1 s with noisy shafts, against the sum of the ways' covariances."""
    chassis = BODIES[kind].implementation_class()(Dimensions(DRIVETRAIN))
    rng, speeds = np.random.default_rng(1), np.full(len(chassis.shafts), 0.2)
    made = rolls(chassis, speeds, 0.05, 20)
    reported = sum(increment_covariance(chassis, roll, SHAFT, 0.0, (0.0, 0.0, 0.0)) for roll in made)
    ends = []
    for _ in range(300):
        end = np.zeros(3)
        for roll in made:
            noise = rng.normal(0.0, SHAFT * np.sqrt(np.abs(roll.pace) / roll.dt))
            twist = chassis.twist(tuple(np.array(roll.pace) + noise), *roll.angles)
            end = end + np.array(twist) * roll.dt
        ends.append(end)
    seen = np.cov(np.array(ends).T)
    sizes = np.sqrt(np.diag(reported))
    assert (np.abs(seen - reported) <= 0.35 * np.outer(sizes, sizes) + 1e-9).all()


def test_the_covariance_of_a_truck_that_stands_is_none():
    chassis = truck_chassis(Dimensions(DRIVETRAIN))
    assert not total(chassis, rolls(chassis, (0.0,), 0.2, 5)).any()


def test_an_uncertain_axle_turns_the_truck():
    chassis = truck_chassis(Dimensions(DRIVETRAIN))
    sure, unsure = (
        sum(
            increment_covariance(chassis, roll, SHAFT, angle, (0.0, 0.0, 0.0))
            for roll in rolls(chassis, (0.2,), 0.0, 20)
        )
        for angle in (0.0, 0.05)
    )
    assert sure[2, 2] == pytest.approx(0.0, abs=1e-9)
    # Both axles, uncorrelated: the curvature is (front - rear) / wheelbase, over 0.2 m in 1 s.
    assert math.sqrt(unsure[2, 2]) == pytest.approx(0.05 * math.sqrt(2) / 0.32 * math.sqrt(0.2), rel=0.1)


def test_positions_that_are_no_numbers_or_not_later_are_left_out():
    wheels = WheelMotion(truck_chassis(Dimensions(DRIVETRAIN)), 0.6)
    assert wheels.observe_drive(drive_feedback(SECOND, 0.0)) is None
    bad = drive_feedback(2 * SECOND, 0.0).model_copy(update={"position": math.nan})
    assert wheels.observe_drive(bad) is None
    assert wheels.stamp == SECOND
    assert wheels.observe_drive(drive_feedback(SECOND, 5.0)) is None
    assert wheels.observe_drive(drive_feedback(2 * SECOND, 0.0)).distance == 0.0
