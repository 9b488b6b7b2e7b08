"""Servo angles, the bicycle that moves like the body, and back; what calibration adds."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.linkage import common_motion, dragged_speeds
from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_kinematics.truck import FourWheelSteering, IdealAxles, LinkedAxles, TurnDeficit

BICYCLE, POLYNOMIALS = FourWheelSteering(), SteeringPolynomials()
AXLES = LinkedAxles(BICYCLE, POLYNOMIALS.front, POLYNOMIALS.rear)


@pytest.mark.parametrize(
    ("front", "rear", "curvature", "ideal"),
    [(0.4, -0.4, 2.37, 2.64), (0.36, -0.36, 2.15, 2.35), (0.4, 0.0, 1.23, 1.29), (0.3, 0.3, 0.0, 0.0)],
)
def test_the_body_turns_as_its_four_wheels_let_it(front, rear, curvature, ideal):
    """Angles of the single axles by the mean of their wheels' tangents; the ideal bicycle turns too much."""
    servos = POLYNOMIALS.servo_from_axles(front, rear)
    assert BICYCLE.curvature(front, rear) == pytest.approx(ideal, abs=6e-3)
    assert BICYCLE.curvature(*AXLES.angles(*servos)) == pytest.approx(curvature, abs=6e-3)


def test_curvature_and_sideslip_are_those_of_the_least_squares_motion():
    for servos in np.random.default_rng(1).uniform(-0.78, 0.78, (50, 2)).tolist():
        slide, turn, _ = common_motion(BICYCLE, AXLES.wheel_angles(*servos))
        angles = AXLES.angles(*servos)
        assert math.tan(BICYCLE.sideslip(*angles)) == pytest.approx(slide, abs=1e-12)
        assert BICYCLE.curvature(*angles) == pytest.approx(turn * math.cos(math.atan(slide)), abs=1e-12)


@pytest.mark.parametrize("deficit", [None, TurnDeficit(0.3, 0.1, -0.2, 0.2, 0.4, -0.1)])
def test_servos_are_the_exact_inverse_and_arrays_are_floats(deficit):
    axles = LinkedAxles(BICYCLE, POLYNOMIALS.front, POLYNOMIALS.rear, deficit=deficit)
    servos = np.random.default_rng(2).uniform(-0.75, 0.75, (200, 2))
    front, rear = axles.angles(*servos.T)
    for asked, f, r in zip(servos.tolist(), front.tolist(), rear.tolist(), strict=True):
        assert axles.angles(*asked) == pytest.approx((f, r), abs=1e-12)
        assert axles.servos(f, r) == pytest.approx(asked, abs=1e-8)


def test_the_motor_turns_with_the_mean_of_the_dragged_wheels():
    grid = np.meshgrid(np.linspace(-0.78, 0.78, 21), np.linspace(-0.78, 0.78, 21))
    mean = np.mean(dragged_speeds(BICYCLE, np.ones_like(grid[0]), AXLES.wheel_angles(*grid)), axis=0)
    assert BICYCLE.drive_speed(np.ones_like(grid[0]), *AXLES.angles(*grid)) == pytest.approx(mean, rel=1.2e-3)
    full = POLYNOMIALS.servo_from_axles(0.4, -0.4)
    assert BICYCLE.drive_speed(1.0, *AXLES.angles(*full)) == pytest.approx(1.069, abs=1e-3)


def test_a_car_with_fixed_rear_wheels_turns_less_than_its_front_wheels_say():
    car = LinkedAxles(BICYCLE, POLYNOMIALS.front, None)
    servo = POLYNOMIALS.front.servo_from_axle(0.4)
    front, rear = car.angles(servo, 0.7)  # whatever its rear servo says
    assert rear == 0.0
    _, turn, _ = common_motion(BICYCLE, car.wheel_angles(servo, 0.0))
    assert math.tan(front) / 0.32 == pytest.approx(turn)
    assert front < 0.39
    assert car.servos(front, 0.0) == pytest.approx((servo, 0.0))


def test_deficits_are_of_axle_and_side_and_change_nothing_where_they_are_zero():
    plain = AXLES.angles(0.5, -0.5)
    assert LinkedAxles(BICYCLE, POLYNOMIALS.front, POLYNOMIALS.rear, deficit=TurnDeficit()).angles(
        0.5, -0.5
    ) == pytest.approx(plain)
    left = TurnDeficit(front_left=0.2)
    assert left.tangents(0.4, 0.1) == pytest.approx((0.4 * (1 - 0.2 * 0.16), 0.1))
    assert left.tangents(-0.4, 0.1) == (-0.4, 0.1)
    both = TurnDeficit(counter_left=0.2)
    assert both.tangents(0.4, -0.4) == pytest.approx((0.4 * (1 - 0.2 * 0.16), -0.4 * (1 - 0.2 * 0.16)))
    assert both.tangents(-0.4, 0.4) == (-0.4, 0.4)
    assert both.tangents(0.4, 0.4) == (0.4, 0.4)


def test_out_of_reach_and_not_finite():
    for axles in (AXLES, IdealAxles(POLYNOMIALS)):
        with pytest.raises(KinematicsError, match=r"front|axle"):
            axles.servos(0.9, 0.0)
        with pytest.raises(KinematicsError, match="nan"):
            axles.servos(math.nan, 0.0)
    with pytest.raises(KinematicsError, match="rear_left"):
        TurnDeficit(rear_left=math.nan)
