"""The fitted steering maps: the sources' round-trip tables to the last digit, and inverses that lose nothing."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.polynomials import (
    F_CORRECTED,
    F_PRINTED,
    AxlePolynomials,
    SteeringPolynomials,
    mirrored,
    polynomial,
)
from tests.unit.kinematics.kit import H_PRINTED, round_trip_error

SETS = ("corrected", "as_published", "2016")


def in_degrees(value: float, digits: int) -> float:
    return round(math.degrees(value), digits)


@pytest.mark.parametrize(
    ("limit", "printed", "corrected", "digits"),
    [
        (15, 0.094, 0.010, 3),
        (20, 0.209, 0.011, 3),
        (25, 0.418, 0.011, 3),
        (30, 0.768, 0.011, 3),
        (40, 2.01, 0.034, 2),
        (45, 2.96, 0.139, 2),
        (60, 7.9, 2.05, 1),
    ],
)
def test_round_trip_of_the_fits_as_tabled(limit, printed, corrected, digits):
    assert in_degrees(round_trip_error(F_PRINTED, H_PRINTED, math.radians(limit)), digits) == printed
    digits = 2 if limit == 60 else 3
    assert in_degrees(round_trip_error(F_CORRECTED, H_PRINTED, math.radians(limit)), digits) == corrected


def test_round_trip_over_the_whole_range_in_the_mean():
    servo = np.linspace(-math.pi / 4, math.pi / 4, 20001)
    back = polynomial(H_PRINTED, polynomial(F_PRINTED, servo))
    assert in_degrees(float(np.sqrt(np.mean((back - servo) ** 2))), 2) == 1.02


@pytest.mark.parametrize(("limit", "printed"), [(15, 0.20), (20, 0.52), (25, 1.08)])
def test_round_trip_from_the_wheel_as_tabled(limit, printed):
    assert in_degrees(round_trip_error(H_PRINTED, F_PRINTED, math.radians(limit)), 2) == printed
    assert in_degrees(round_trip_error(H_PRINTED, F_CORRECTED, math.radians(limit)), 3) <= 0.016


def test_single_values_as_tabled():
    assert in_degrees(polynomial(SteeringPolynomials().front.right_from_left, math.radians(25)), 2) == 24.22
    assert in_degrees(polynomial(SteeringPolynomials().front.right_from_left, 0.0), 2) == 0.20
    ends = [in_degrees(polynomial(f, s * math.pi / 4), 1) for f in (F_PRINTED, F_CORRECTED) for s in (-1, 1)]
    assert ends == [-30.8, 28.8, -29.3, 27.3]


def test_quadratics_of_2016_as_tabled():
    rear, rear_back = (-0.014, 0.6515, -0.0002), (0.0511, 1.5351, 0.0003)
    front_back = (0.1047, 1.5362, -0.0009)
    for limit, rear_error, slip_error, mended in ((30, 0.007, 1.46, 0.011), (45, 0.028, 3.30, 0.069)):
        limit = math.radians(limit)
        assert in_degrees(round_trip_error(rear, rear_back, limit), 3) == rear_error
        assert in_degrees(round_trip_error((0.029, 0.6515, 0.0006), front_back, limit), 2) == slip_error
        assert in_degrees(round_trip_error((-0.029, 0.6515, 0.0006), front_back, limit), 3) == mended
    assert SteeringPolynomials.named("2016").front.left_from_servo[0] == -0.029


@pytest.mark.parametrize("name", SETS)
def test_inverse_is_exact_everywhere(name):
    for axle in (SteeringPolynomials.named(name).front, SteeringPolynomials.named(name).rear):
        servo = np.linspace(-axle.servo_limit, axle.servo_limit, 4001)
        np.testing.assert_allclose(axle.servo_from_axle(axle.axle_from_servo(servo)), servo, atol=1e-14)
        angle = np.linspace(*axle.axle_limits, 4001)
        np.testing.assert_allclose(axle.axle_from_servo(axle.servo_from_axle(angle)), angle, atol=1e-14)


@given(st.floats(-0.43, 0.43), st.floats(-0.43, 0.43))
@settings(max_examples=60, deadline=None)
def test_scalar_inverse_is_exact_and_agrees_with_the_array_one(front, rear):
    steering = SteeringPolynomials()
    servos = steering.servo_from_axles(front, rear)
    assert all(isinstance(servo, float) for servo in servos)
    axles = steering.front.axle_from_servo(servos[0]), steering.rear.axle_from_servo(servos[1])
    assert axles == pytest.approx((front, rear), abs=1e-14)
    arrays = steering.servo_from_axles(np.array([front]), np.array([rear]))
    assert [float(a[0]) for a in arrays] == pytest.approx(servos, abs=1e-14)


@pytest.mark.parametrize("name", SETS)
def test_positive_servo_turns_both_axles_left_and_tie_rods_hold(name):
    steering = SteeringPolynomials.named(name)
    for axle in (steering.front, steering.rear):
        left, right = axle.wheels_from_servo(0.5)
        assert left > 0.2
        assert abs(right - left) < math.radians(2.0)


def test_rear_axle_is_the_front_one_mirrored():
    steering = SteeringPolynomials()
    servo = np.linspace(-0.7, 0.7, 50)
    np.testing.assert_allclose(steering.rear.left_of(servo), -steering.front.left_of(-servo))
    np.testing.assert_allclose(steering.rear.right_of(servo), -steering.front.right_of(-servo))
    np.testing.assert_allclose(steering.rear.axle_from_servo(servo), -steering.front.axle_from_servo(-servo))
    assert mirrored((1.0, 2.0, 3.0, 4.0)) == (1.0, -2.0, 3.0, -4.0)


def test_axle_angle_lies_between_its_wheels_and_near_the_cotangent_mean():
    axle = SteeringPolynomials().front
    for servo in np.radians([-40.0, -20.0, -10.0, 10.0, 20.0, 40.0]):
        left, right = axle.wheels_from_servo(float(servo))
        angle = axle.axle_from_servo(float(servo))
        assert min(left, right) < angle < max(left, right)
        cotangents = math.atan(2.0 / (1.0 / math.tan(left) + 1.0 / math.tan(right)))
        assert angle == pytest.approx(cotangents, abs=math.radians(0.1))
    assert axle.axle_from_servo(0.0) == pytest.approx(0.0035 / 2, abs=1e-7)


def test_truck_angles_are_in_reach():
    for name in SETS:
        steering = SteeringPolynomials.named(name)
        for axle in (steering.front, steering.rear):
            assert axle.axle_limits[0] < -math.radians(25.0)
            assert axle.axle_limits[1] > math.radians(25.0)


def test_bad_input_is_named():
    axle = SteeringPolynomials().front
    with pytest.raises(KinematicsError, match=r"servo is 0\.8: expected -0\.785398 to 0\.785398"):
        axle.axle_from_servo(0.8)
    with pytest.raises(KinematicsError, match="axle is nan"):
        axle.servo_from_axle(math.nan)
    with pytest.raises(KinematicsError, match=r"axle\[1\] is 0\.6"):
        axle.servo_from_axle(np.array([0.1, 0.6]))
    with pytest.raises(KinematicsError, match="2017"):
        SteeringPolynomials.named("2017")
    with pytest.raises(KinematicsError, match="left_from_servo"):
        AxlePolynomials((-1.0, 0.0), (1.0, 0.0))
