"""The truck: eqs. 2.1 and 2.27-2.56 against plain rigid-body motion, limits, radii."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.truck import DriveTrain, FourWheelSteering

SPLITS = (0.0, 0.3, 0.5, 0.8, 1.0)


def test_drivetrain():
    train = DriveTrain()
    top = 18000.0 * math.tau / 60.0
    assert round(train.speed(top), 4) == 0.2195
    assert round(DriveTrain(wheel_radius=0.07).speed(top), 3) == 0.205
    assert train.motor_rate(train.speed(100.0)) == pytest.approx(100.0)
    assert train.motor_angle(train.distance(12.0)) == pytest.approx(12.0)
    assert train.distance(644.0 * math.tau) == pytest.approx(0.075 * math.tau)
    np.testing.assert_allclose(train.speed(np.array([1.0, 2.0])), [0.075 / 644.0, 0.15 / 644.0])


@pytest.mark.parametrize("bad", [{"ratio": 0.0}, {"wheel_radius": -0.1}, {"ratio": math.nan}])
def test_impossible_drivetrains(bad):
    with pytest.raises(KinematicsError, match=next(iter(bad))):
        DriveTrain(**bad)


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("mode", ["free", "front", "rear", "counter", "crab"])
def test_wheel_velocities_are_rigid_body_velocities(split, mode, rng):
    geometry = FourWheelSteering(cg_split=split)
    front, rear = rng.uniform(-0.9, 0.9, (2, 20_000))
    if mode == "front":
        rear = 0.0 * front
    elif mode == "rear":
        front = 0.0 * rear
    elif mode in ("counter", "crab"):
        rear = front * (-1.0 if mode == "counter" else 1.0)
    speed = rng.uniform(-1.0, 1.0, front.size)
    vx, vy, wz = geometry.body_twist(speed, front, rear)
    np.testing.assert_allclose(np.hypot(vx, vy), np.abs(speed), atol=1e-12)
    angles, speeds = geometry.wheel_angles(front, rear), geometry.wheel_speeds(speed, front, rear)
    for (x, y), angle, rolling in zip(geometry.wheel_positions, angles, speeds, strict=True):
        assert (np.abs(angle) < math.pi / 2).all()
        np.testing.assert_allclose(rolling * np.cos(angle), vx - wz * y, atol=1e-12)
        np.testing.assert_allclose(rolling * np.sin(angle), vy + wz * x, atol=1e-12)
    back = geometry.steer_for_twist(vx, vy, wz)
    np.testing.assert_allclose(back, (speed, front, rear), atol=1e-12)
    np.testing.assert_allclose(wz, speed * geometry.curvature(front, rear), atol=1e-12)
    np.testing.assert_allclose(
        geometry.steer_for(geometry.curvature(front, rear), geometry.sideslip(front, rear)), (front, rear), atol=1e-12
    )


def test_crab_and_counter():
    geometry = FourWheelSteering()
    assert geometry.body_twist(0.2, 0.3, 0.3) == pytest.approx((0.2 * math.cos(0.3), 0.2 * math.sin(0.3), 0.0))
    vx, vy, wz = geometry.body_twist(0.2, 0.4, -0.4)
    assert (vx, vy) == (0.2, 0.0)
    assert wz == pytest.approx(0.2 / 0.37844, rel=1e-4)
    assert geometry.body_twist(-0.2, 0.4, -0.4)[2] == -wz


def test_radii_as_tabled():
    geometry = FourWheelSteering()
    table = {
        ("front", 22.5, False): 0.773, ("front", 25.0, False): 0.686,
        ("counter", 22.5, False): 0.386, ("counter", 25.0, False): 0.343,
        ("front", 25.0, True): 0.816, ("counter", 25.0, True): 0.473,
    }  # fmt: skip
    for (mode, degrees, every), radius in table.items():
        assert round(geometry.minimum_radius(mode, math.radians(degrees), every_wheel=every), 3) == radius
    assert round(geometry.minimum_radius("front", 0.4), 3) == 0.757
    assert round(geometry.minimum_radius("rear", 0.4), 3) == 0.757
    assert round(geometry.minimum_radius("counter", 0.4), 3) == 0.378
    assert round(geometry.minimum_radius("front", 0.4, every_wheel=True), 3) == 0.887
    assert round(geometry.minimum_radius("counter", 0.4, every_wheel=True), 3) == 0.508
    assert geometry.minimum_radius("crab", 0.4) == math.inf
    assert geometry.minimum_radius("front", 0.0) == math.inf
    assert geometry.minimum_radius("spot", 0.4) == 0.0
    inner = math.degrees(geometry.wheel_angles(math.radians(25), math.radians(-25))[0])
    assert (round(inner, 1), round(math.degrees(geometry.wheel_angles(math.radians(25), 0.0)[0]), 1)) == (36.9, 29.9)


@given(
    st.floats(-1.2, 1.2),
    st.floats(-1.2, 1.2),
    st.floats(0.05, 0.6),
    st.none() | st.floats(0.0, 0.6),
    st.sampled_from(SPLITS),
)
@settings(max_examples=100, deadline=None)
def test_limits_keep_curvature_then_sideslip(front, rear, limit, rear_limit, split):
    geometry = FourWheelSteering(cg_split=split)
    far = limit if rear_limit is None else rear_limit
    kept_f, kept_r = geometry.limit_keeping_curvature(front, rear, limit, rear_limit)
    assert abs(kept_f) <= limit
    assert abs(kept_r) <= far
    best = geometry.curvature(limit, -far)
    wanted = geometry.curvature(front, rear)
    assert geometry.curvature(kept_f, kept_r) == pytest.approx(min(max(wanted, -best), best), abs=1e-9)
    if abs(front) <= limit and abs(rear) <= far:
        assert (kept_f, kept_r) == pytest.approx((front, rear), abs=1e-12)
    elif abs(wanted) < best * (1 - 1e-9):
        # Some limit is touched: no closer sideslip has this curvature.
        assert min(limit - abs(kept_f), far - abs(kept_r)) == pytest.approx(0.0, abs=1e-9)
    array_f, array_r = geometry.limit_keeping_curvature(np.array([front]), np.array([rear]), limit, rear_limit)
    assert (float(array_f[0]), float(array_r[0])) == pytest.approx((kept_f, kept_r), abs=1e-14)


def test_no_pair_of_angles_turns_tighter_than_the_limit_says(rng):
    for split in SPLITS:
        geometry = FourWheelSteering(cg_split=split)
        front, rear = rng.uniform(-0.4, 0.4, (2, 5000))
        assert geometry.curvature(front, rear).max() <= geometry.curvature(0.4, -0.4)


def test_wheels_beside_and_beyond_the_turning_centre():
    geometry = FourWheelSteering(wheelbase=1.0, track=2.0, cg_split=1.0)
    steep = math.atan(1.0) + 1e-17  # the turning centre lies under the rear left wheel
    angles, speeds = geometry.wheel_angles(steep, 0.0), geometry.wheel_speeds(1.0, steep, 0.0)
    assert angles[0] == pytest.approx(math.pi / 2)
    assert speeds[0] == pytest.approx(1.0)
    assert speeds[2] == pytest.approx(0.0, abs=1e-15)
    tighter = math.atan(2.0)
    assert geometry.wheel_angles(tighter, 0.0)[0] == pytest.approx(math.atan2(2.0, -1.0) - math.pi)
    assert geometry.wheel_speeds(1.0, tighter, 0.0)[2] == pytest.approx(-1.0)


def test_bad_input_is_named():
    geometry = FourWheelSteering()
    for call, field in (
        (lambda: FourWheelSteering(wheelbase=-0.3), "wheelbase"),
        (lambda: FourWheelSteering(track=0.0), "track"),
        (lambda: FourWheelSteering(cg_split=1.2), "cg_split"),
        (lambda: geometry.body_twist(math.nan, 0.0, 0.0), "speed is nan"),
        (lambda: geometry.body_twist(0.2, math.nan, 0.0), "front is nan"),
        (lambda: geometry.body_twist(0.2, 0.0, 1.57), "rear is 1.57"),
        (lambda: geometry.steer_for(math.inf, 0.0), "curvature is inf"),
        (lambda: geometry.steer_for(0.0, 2.0), "sideslip is 2"),
        (lambda: geometry.steer_for_twist(0.1, math.nan, 0.0), "vy is nan"),
        (lambda: geometry.limit_keeping_curvature(0.1, 0.1, -0.1), "limit is -0.1"),
        (lambda: geometry.limit_keeping_curvature(0.1, 0.1, 0.1, 2.0), "rear_limit is 2"),
        (lambda: geometry.minimum_radius("sideways", 0.4), "mode 'sideways'"),
        (lambda: geometry.minimum_radius("front", -0.4), "limit is -0.4"),
    ):
        with pytest.raises(KinematicsError, match=field):
            call()


def test_nothing_is_a_valid_number_of_states():
    empty = np.zeros(0)
    assert all(part.size == 0 for part in FourWheelSteering().body_twist(empty, empty, empty))


def test_motor_sees_the_mean_of_both_axles():
    geometry = FourWheelSteering()
    assert geometry.drive_speed(0.2, 0.0, 0.0) == 0.2
    assert geometry.drive_speed(0.2, 0.3, 0.3) == pytest.approx(0.2)
    assert geometry.drive_speed(-0.2, 0.4, -0.4) == pytest.approx(-0.2 / math.cos(0.4))
    vx, vy, wz = geometry.body_twist(0.2, 0.3, 0.0)
    axles = (math.hypot(vx, vy + 0.16 * wz), math.hypot(vx, vy - 0.16 * wz))
    assert geometry.drive_speed(0.2, 0.3, 0.0) == pytest.approx(sum(axles) / 2)


def test_integrate_is_the_shared_one():
    pose = FourWheelSteering().integrate((0.0, 0.0, 0.0), 0.2, 0.0, math.pi, 1.0)
    assert pose == pytest.approx((0.0, 0.4 / math.pi, math.pi))
