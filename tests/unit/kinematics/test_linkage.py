"""The linkage against an independent four-bar solve and the published example; what its error costs."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.linkage import SteeringLinkage, common_motion, dragged_speeds, reachable_servo
from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_kinematics.truck import FourWheelSteering

FORWARD = SteeringLinkage(arms="forward")
REARWARD = SteeringLinkage(arms="rearward")


def bisect(f, low, high):
    below = f(low) < 0.0
    assert below != (f(high) < 0.0)
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if (f(middle) < 0.0) == below else (low, middle)
    return 0.5 * (low + high)


def arm_end(linkage, side, delta):
    """Arm's end in the plane, from the drawing: king-pins at y = +-w_k/2, arms turned inward by beta."""
    along = 0.0 if linkage.arms == "forward" else math.pi
    inward = -side if linkage.arms == "forward" else side
    angle = along + inward * linkage.arm_angle + delta
    return np.array([linkage.arm * math.cos(angle), side * linkage.king_pins / 2 + linkage.arm * math.sin(angle)])


def right_by_bars(linkage, left):
    """Right wheel angle at which the tie rod keeps the length it has straight ahead."""
    length = np.hypot(*(arm_end(linkage, 1, 0.0) - arm_end(linkage, -1, 0.0)))
    end = arm_end(linkage, 1, left)
    return bisect(lambda d: np.hypot(*(end - arm_end(linkage, -1, d))) - length, left - 0.4, left + 0.4)


def left_by_bars(linkage, servo):
    """Left wheel angle from the servo arm's and the drag link's own circles, far end moving only sideways."""
    turned = servo if linkage.arms == "forward" else -servo
    # Servo arm stands along x at rest; its end goes sideways with the sine and back by (1 - cos).
    back = linkage.pitman * (1.0 - math.cos(turned))
    end = linkage.pitman * math.sin(turned)
    target = bisect(lambda y: math.hypot(back, y - end) - linkage.drag_link, end, end + 2 * linkage.drag_link)
    start = arm_end(linkage, 1, 0.0)[1]
    return bisect(lambda d: arm_end(linkage, 1, d)[1] - start - (target - linkage.drag_link), -1.2, 1.2)


@pytest.mark.parametrize("linkage", [FORWARD, REARWARD], ids=["forward", "rearward"])
def test_equals_an_independent_four_bar_solve(linkage):
    for servo in np.radians(np.linspace(-40.0, 40.0, 17)):
        left, right = linkage.wheels_from_servo(float(servo))
        assert left == pytest.approx(left_by_bars(linkage, float(servo)), abs=1e-9)
        assert right == pytest.approx(right_by_bars(linkage, left), abs=1e-9)
        assert math.copysign(1.0, left) == math.copysign(1.0, servo) or abs(servo) < 1e-12


def test_published_example():
    degrees = [math.degrees(FORWARD.left_from_servo(math.radians(s))) for s in (20, -20, 40, -40)]
    assert np.round(degrees, 2).tolist() == [15.82, -17.20, 29.37, -36.29]


def test_topologies_and_who_turns_more():
    inner = math.radians(25.0)
    assert round(math.degrees(-FORWARD.right_from_left(-inner)), 1) == 22.0
    assert round(math.degrees(FORWARD.right_from_left(inner)), 1) == 29.1
    assert round(math.degrees(REARWARD.right_from_left(inner)), 1) == 22.0
    mirror = np.linspace(-0.6, 0.6, 30)
    np.testing.assert_allclose(REARWARD.left_from_servo(mirror), -FORWARD.left_from_servo(-mirror))
    np.testing.assert_allclose(REARWARD.right_from_left(mirror), -FORWARD.right_from_left(-mirror))


def test_reach_is_where_it_locks():
    right, left = reachable_servo(REARWARD)
    assert right < math.radians(-45.0)
    assert left > math.radians(-45.0)
    REARWARD.wheels_from_servo(left)
    with pytest.raises(KinematicsError, match="servo: sine of the wheel arm"):
        REARWARD.wheels_from_servo(left + math.radians(0.2))


def test_bad_linkages_are_named():
    for changes, field in (
        ({"pitman": 0.0}, "pitman"),
        ({"arm": -0.01}, "arm"),
        ({"arm_angle": 1.6}, "arm_angle"),
        ({"arms": "sideways"}, "arms is 'sideways'"),
        ({"king_pins": 0.01}, "king_pins"),
    ):
        with pytest.raises(KinematicsError, match=field):
            SteeringLinkage(**changes)
    with pytest.raises(KinematicsError, match="servo is nan"):
        FORWARD.left_from_servo(math.nan)
    with pytest.raises(KinematicsError, match="left is inf"):
        FORWARD.right_from_left(math.inf)
    with pytest.raises(KinematicsError, match="servo: l_PA"):
        SteeringLinkage(pitman=0.06, drag_link=0.05).left_from_servo(1.5)
    with pytest.raises(KinematicsError, match="left: cosine"):
        SteeringLinkage(arm_angle=1.2, arm=0.09).right_from_left(1.3)


# Steering error


def test_ideal_wheels_have_no_steering_error(rng):
    geometry = FourWheelSteering(cg_split=0.4)
    front, rear = rng.uniform(-0.4, 0.4, (2, 500))
    angles = geometry.wheel_angles(front, rear)
    slide, turn, errors = common_motion(geometry, angles)
    np.testing.assert_allclose(slide, np.tan(geometry.sideslip(front, rear)), atol=1e-12)
    np.testing.assert_allclose(turn * np.cos(np.arctan(slide)), geometry.curvature(front, rear), atol=1e-12)
    np.testing.assert_allclose(errors, 0.0, atol=1e-12)
    speeds = dragged_speeds(geometry, np.full(500, 0.2), angles)
    np.testing.assert_allclose(speeds, geometry.wheel_speeds(np.full(500, 0.2), front, rear), atol=1e-12)


def test_published_linkage_drags_its_wheels_in_counter_steer():
    geometry, steering = FourWheelSteering(), SteeringPolynomials()
    left = math.radians(25.0)
    angles = (left, steering.front.right_of(left), -left, steering.rear.right_of(-left))
    slide, turn, errors = common_motion(geometry, angles)
    assert slide == pytest.approx(0.0, abs=1e-12)
    assert 1.0 / turn == pytest.approx(0.38, abs=0.02)
    assert np.degrees(errors) == pytest.approx([-5.99, 7.31, 5.99, -7.31], abs=0.01)
    speeds = dragged_speeds(geometry, 0.2, angles)
    moved = [math.hypot(1 - y * turn, x * turn) * 0.2 for x, y in geometry.wheel_positions]
    assert speeds == pytest.approx([v * math.cos(e) for v, e in zip(moved, errors, strict=True)])


def test_best_common_motion_is_a_minimum(rng):
    geometry = FourWheelSteering()
    angles = tuple(rng.uniform(-0.4, 0.4, 4).tolist())
    slide, turn, _ = common_motion(geometry, angles)

    def slip(b, k):
        return sum(
            (-math.sin(a) * (1 - y * k) + math.cos(a) * (b + x * k)) ** 2
            for (x, y), a in zip(geometry.wheel_positions, angles, strict=True)
        )

    for db, dk in ((1e-3, 0), (-1e-3, 0), (0, 1e-3), (0, -1e-3)):
        assert slip(slide + db, turn + dk) > slip(slide, turn)
    square, inward = FourWheelSteering(2.0, 2.0), math.radians(-45.0)
    with pytest.raises(KinematicsError, match="towards one point"):
        common_motion(square, (inward, -inward, -inward, inward))
    with pytest.raises(KinematicsError, match="wheel rear left: angle is nan"):
        common_motion(geometry, (0.0, 0.0, math.nan, 0.0))
