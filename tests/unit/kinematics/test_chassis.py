"""Every body does what the equivalent bicycle asks, measures it again, and refuses what it cannot do."""

import math
import re

import numpy as np
import pytest

from monstertruck_kinematics.chassis import (
    Dimensions,
    ackermann_chassis,
    bicycle_chassis,
    differential_chassis,
    independent_chassis,
    mecanum_chassis,
    omni_chassis,
    skid_steer_chassis,
    synchro_chassis,
    tricycle_chassis,
    truck_chassis,
)
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.truck import MAX_AXLE_ANGLE, DriveTrain

DRIVETRAIN = DriveTrain()
SKID = {"icr_left": 0.2, "icr_right": -0.21, "icr_x": -0.03, "gain_left": 0.98, "gain_right": 0.9}
BODIES = {
    "truck": truck_chassis(Dimensions(DRIVETRAIN)),
    "independent": independent_chassis(Dimensions(DRIVETRAIN)),
    "ackermann": ackermann_chassis(Dimensions(DRIVETRAIN)),
    "bicycle": bicycle_chassis(Dimensions(DRIVETRAIN)),
    "front-driven bicycle": bicycle_chassis(Dimensions(DRIVETRAIN), driven="front"),
    "tricycle": tricycle_chassis(Dimensions(DRIVETRAIN), driven="front"),
    "differential": differential_chassis(Dimensions(DRIVETRAIN)),
    "skid-steer": skid_steer_chassis(Dimensions(DRIVETRAIN), **SKID),
    "skid-steer, a motor in each wheel": skid_steer_chassis(Dimensions(DRIVETRAIN), **SKID, motors="wheels"),
    "synchro": synchro_chassis(Dimensions(DRIVETRAIN)),
    "omni": omni_chassis(Dimensions(DRIVETRAIN)),
    "omni of four": omni_chassis(Dimensions(DRIVETRAIN), count=4, circle=0.15),
    "mecanum": mecanum_chassis(Dimensions(DRIVETRAIN)),
}
every_body = pytest.mark.parametrize("chassis", BODIES.values(), ids=BODIES)


def angles_of(chassis, rng):
    front, rear = rng.uniform(-0.4, 0.4, 2).tolist()
    return {"both": (front, rear), "front": (front, 0.0), "parallel": (front, front)}[chassis.freedom]


@every_body
def test_shafts_move_the_base_as_the_bicycle_and_tell_it_again(chassis):
    rng = np.random.default_rng(3)
    for _ in range(100):
        speed, (front, rear) = float(rng.uniform(-0.3, 0.3)), angles_of(chassis, rng)
        assert chassis.refusal(front, rear) is None
        shafts = chassis.shaft_speeds(speed, front, rear)
        assert len(shafts) == len(chassis.shafts)
        twist = chassis.twist(chassis.input_speeds(shafts, front, rear), front, rear)
        assert twist == pytest.approx(chassis.bicycle.body_twist(speed, front, rear), abs=1e-12)


SKIDDING = ("skid-steer", "skid-steer, a motor in each wheel")


@every_body
def test_travel_is_the_fastest_wheel_with_the_sign_of_the_way(chassis):
    fastest = max(map(abs, chassis.shaft_speeds(0.2, 0.0, 0.0)))
    share = {**dict.fromkeys(SKIDDING, 1 / 0.9), "omni": math.cos(math.pi / 6)}
    assert fastest == pytest.approx(0.2 * next((share[n] for n in share if BODIES[n] is chassis), 1.0))
    for speed in (0.2, -0.2):
        travel = chassis.fastest_wheel_speed(chassis.shaft_speeds(speed, 0.0, 0.0))
        assert travel == pytest.approx(math.copysign(fastest, speed))


@every_body
def test_angles_are_limited_to_what_the_body_can_take(chassis):
    rng = np.random.default_rng(4)
    for _ in range(20):
        front, rear = angles_of(chassis, rng)
        limited = chassis.limited(2 * front, 2 * rear, 0.3)
        assert max(map(abs, limited)) <= 0.3 + 1e-12
        assert chassis.refusal(*limited) is None


@every_body
def test_servos_and_axles_are_each_others_inverse(chassis):
    front, rear = angles_of(chassis, np.random.default_rng(5))
    back = chassis.steering(*chassis.servos(front, rear))
    assert back == pytest.approx((front, rear) if chassis.linkage is not None else (0.0, 0.0), abs=1e-9)
    assert chassis.steering(2.0, 2.0) == chassis.steering(math.pi / 4, math.pi / 4)


WHEELS = independent_chassis(Dimensions(DRIVETRAIN), steering="wheels")


@pytest.mark.parametrize("chassis", [*BODIES.values(), WHEELS], ids=[*BODIES, "wheels"])
def test_a_possible_twist_is_made_by_its_steering_angles_and_shafts(chassis):
    rng = np.random.default_rng(6)
    for _ in range(50):
        speed, (front, rear) = float(rng.uniform(-0.3, 0.3)), angles_of(chassis, rng)
        wanted = chassis.possible(chassis.bicycle.body_twist(speed, front, rear))
        angles = chassis.steering_for(wanted, chassis.straight)
        assert chassis.along(wanted, *angles) == pytest.approx(wanted, abs=1e-12)
        shafts = chassis.shafts_along(wanted, *angles)
        assert chassis.twist(chassis.input_speeds(shafts, *angles), *angles) == pytest.approx(wanted, abs=1e-12)
        if len(angles) == 2 and chassis.steered:
            assert angles == pytest.approx((front, rear))
        assert chassis.axle_angles(wanted, angles) == pytest.approx((front, rear), abs=1e-9)
        assert chassis.steering(*chassis.servos(*angles)) == pytest.approx(angles)


@pytest.mark.parametrize("twist", [(0.0, 0.0, 0.7), (0.0, -0.1, 0.0), (-0.1, 0.05, 0.3), (0.0, 0.0, -0.2)])
def test_wheels_steered_one_by_one_make_any_twist_within_their_reach(twist):
    angles = WHEELS.steering_for(twist, WHEELS.straight)
    assert max(map(abs, angles)) <= math.radians(100)
    shafts = WHEELS.shafts_along(twist, *angles)
    assert WHEELS.twist(shafts, *angles) == pytest.approx(twist, abs=1e-12)


def test_wheels_that_stand_elsewhere_make_the_part_they_roll():
    assert WHEELS.along((0.2, 0.0, 0.0), *[0.3] * 4)[0] == pytest.approx(0.2 * math.cos(0.3) ** 2)
    assert WHEELS.aligned((0.0,) * 4, (0.3, -0.3, 0.3, 0.0))
    assert not WHEELS.aligned((0.0,) * 4, (0.3, -0.4, 0.3, 0.0))


@pytest.mark.parametrize("name", ["ackermann", "skid-steer"])
def test_the_sideways_speed_that_follows_from_a_turn_need_not_be_asked_for(name):
    chassis = BODIES[name]
    vx, vy, wz = chassis.possible((0.2, 0.0, 0.1))
    assert (vx, wz) == (0.2, 0.1)
    assert vy == pytest.approx(0.1 * chassis.bicycle.l_r)
    assert chassis.possible((vx, vy, wz)) == (vx, vy, wz)


def test_the_truck_is_its_own_formulas():
    truck = BODIES["truck"]
    assert truck.shaft_speeds(0.2, 0.3, -0.2) == (truck.bicycle.drive_speed(0.2, 0.3, -0.2),)
    assert truck.servos(0.3, -0.2) == truck.linkage.servos(0.3, -0.2)


def test_a_differential_drive_turns_by_different_wheels_and_about_its_axle():
    left, right = BODIES["differential"].shaft_speeds(0.2, 0.3, 0.0)
    wz = 0.2 * math.tan(0.3) / 0.32
    assert (left, right) == pytest.approx((0.2 - 0.13 * wz, 0.2 + 0.13 * wz))
    spin = BODIES["differential"].twist((-0.1, 0.1), 0.0, 0.0)
    assert spin == pytest.approx((0.0, 0.0, 0.2 / 0.26))


def test_mecanum_wheels_crab():
    speeds = BODIES["mecanum"].shaft_speeds(0.2, 0.4, 0.4)
    assert speeds == pytest.approx([0.2 * (math.cos(0.4) + sign * math.sin(0.4)) for sign in (-1, 1, 1, -1)])


@pytest.mark.parametrize(
    ("body", "front", "rear", "why"),
    [
        ("ackermann", 0.2, 0.1, r"rear is 0\.1: expected 0"),
        ("differential", 0.2, 0.2, "cannot move sideways"),
        ("skid-steer", 0.2, -0.2, r"rear is -0\.2"),
        ("synchro", 0.2, 0.0, "expected equal angles, because this body keeps its heading"),
    ],
)
def test_what_a_body_cannot_do_is_refused_with_the_reason(body, front, rear, why):
    assert re.search(why, BODIES[body].refusal(front, rear) or "")


PULSES = ((-0.667, 0.585), (-0.667, 0.585))
"""Servo angles that pulses of 1088 to 1840 us reach about a centre of 1439.2 us, front and rear, rad."""


def test_only_steered_axles_limit_the_reach():
    truck, car = (build(Dimensions(DRIVETRAIN, servo_ranges=PULSES)) for build in (truck_chassis, ackermann_chassis))
    assert truck.reached_angle == pytest.approx(0.3365, abs=1e-3)
    assert car.reached_angle == pytest.approx(0.352, abs=1e-3)
    assert car.reached((-0.6, 0.0))[0] == pytest.approx(car.steering(-0.667, 0.0)[0])  # further to the right
    assert BODIES["mecanum"].reached_angle == pytest.approx(MAX_AXLE_ANGLE)


def test_what_the_servos_do_not_reach_keeps_the_curvature_then_the_sideslip():
    truck = truck_chassis(Dimensions(DRIVETRAIN, servo_ranges=PULSES))
    bicycle, rng = truck.bicycle, np.random.default_rng(6)
    for front, rear in rng.uniform(-0.6, 0.6, (200, 2)).tolist():
        kept = truck.reached((front, rear))
        assert all(-0.6671 < servo < 0.5851 for servo in truck.servos(*kept))
        assert bicycle.curvature(*kept) == pytest.approx(
            min(max(bicycle.curvature(front, rear), -2.47), 2.303), abs=3e-3
        )
        assert truck.reached(kept) == pytest.approx(kept, abs=1e-9)
    assert truck.reached((0.33, -0.33)) == (0.33, -0.33)
    front, rear = truck.reached((0.5, 0.5))
    assert front == pytest.approx(rear)  # crab stays crab


@pytest.mark.parametrize(
    ("build", "parameters", "complaint"),
    [
        (skid_steer_chassis, {"icr_x": 0.1}, r"icr_x is 0\.1: expected -0\.32 to 0"),
        (skid_steer_chassis, {"icr_left": -0.3}, "icr_left is -0.3"),
        (differential_chassis, {"size": Dimensions(DRIVETRAIN, track=-1.0)}, "track"),
    ],
)
def test_bodies_nobody_can_build(build, parameters, complaint):
    with pytest.raises(KinematicsError, match=complaint):
        build(**{"size": Dimensions(DRIVETRAIN)} | parameters)
