"""Every wrong equation or figure of the sources: the printed form fails, ours holds. Tabled in docs/errata.md."""

import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_kinematics.identification import PUBLISHED_CIRCLES, PUBLISHED_HALF_TRACK, PUBLISHED_RADIUS
from monstertruck_kinematics.linkage import SteeringLinkage
from monstertruck_kinematics.polynomials import (
    F_CORRECTED,
    F_PRINTED,
    SteeringPolynomials,
    polynomial,
)
from monstertruck_kinematics.se2 import twist_at
from monstertruck_kinematics.steered import Ackermann, Synchro
from monstertruck_kinematics.truck import DriveTrain, FourWheelSteering, LinkedAxles
from monstertruck_kinematics.unsteered import SkidSteer
from monstertruck_kinematics.wheels import analyse
from tests.unit.kinematics.kit import H_PRINTED, round_trip_error

LINKAGE = SteeringLinkage(arms="forward")
GEOMETRY = FourWheelSteering(cg_split=0.4)
STATES = [(0.3, -0.2), (0.35, 0.1), (-0.2, 0.15), (-0.3, -0.35), (0.1, -0.4)]
each_state = pytest.mark.parametrize(("front", "rear"), STATES)


def cot(x):
    return 1.0 / math.tan(x)


# Thesis, drivetrain and devices


def test_2_1_spur_has_81_teeth_not_84():
    ratio = DriveTrain().ratio
    assert ratio == round(66 * 81 / 46 * 1.68 * 3.3) == round(66 * 1.76 * 1.68 * 3.3)
    assert ratio != round(66 * 84 / 46 * 1.68 * 3.3)


# Thesis, linkage


def printed_2_2(theta):
    link = LINKAGE
    root = math.sqrt(link.drag_link**2 - link.pitman**2 * (1 - math.cos(theta)) ** 2)
    swing = link.pitman * math.sin(abs(theta))
    return root + swing - link.drag_link if theta < 0 else -root - swing - link.drag_link


def test_2_2_jumps_for_positive_servo_angles():
    tiny = 1e-9
    assert printed_2_2(-tiny) == pytest.approx(0.0, abs=1e-9)
    assert printed_2_2(tiny) == pytest.approx(-2 * LINKAGE.drag_link)
    assert LINKAGE.shift(tiny) == pytest.approx(LINKAGE.shift(-tiny), abs=1e-9)
    assert printed_2_2(-0.4) == pytest.approx(LINKAGE.shift(0.4))  # the half that is right, servo turned round


def printed_root(theta, power):
    return math.sqrt(LINKAGE.drag_link**2 - LINKAGE.pitman**2 * (1 - math.cos(theta)) ** power)


def printed_2_5(theta, power=1):
    link = LINKAGE
    reach = printed_root(theta, power) + link.pitman * math.sin(abs(theta)) - link.drag_link
    return link.arm_angle + math.asin(reach / link.arm - math.sin(link.arm_angle))


def test_2_5_lacks_a_square():
    for degrees, miss in ((20, -0.43), (40, -1.42)):
        theta = math.radians(degrees)
        assert math.degrees(printed_2_5(theta) - LINKAGE.left_from_servo(theta)) == pytest.approx(miss, abs=0.005)
        assert printed_2_5(theta, power=2) == pytest.approx(LINKAGE.left_from_servo(theta), abs=1e-12)


def test_2_6_is_never_defined():
    link = LINKAGE
    for degrees in range(1, 60):
        theta = math.radians(degrees)
        sine = -printed_root(theta, 1) - link.pitman * math.sin(theta) - link.drag_link
        assert sine / link.arm + math.sin(link.arm_angle) < -4.5
    for degrees in (20, 40):
        theta = math.radians(degrees)
        sine = link.drag_link + link.pitman * math.sin(theta) - printed_root(theta, 2)
        outer = -link.arm_angle + math.asin(sine / link.arm + math.sin(link.arm_angle))
        assert outer == pytest.approx(-link.left_from_servo(-theta), abs=1e-12)


def residual_2_7(inner, outer, *, printed):
    """Left minus right side of 2.7 for forward arms (lengths over d)."""
    link = LINKAGE
    beta, w_k = link.arm_angle, link.king_pins / link.arm
    spread = math.cos(beta - inner) - math.cos(beta + outer)
    left = math.sin(beta + outer) + math.sin(beta - inner)
    if printed:
        wheelbase, track = 0.32, 0.26
        rod = wheelbase / link.arm - track * math.sin(beta)
        return left - (wheelbase / link.arm + math.sqrt(rod**2 - spread**2))
    return left - (w_k - math.sqrt((w_k - 2 * math.sin(beta)) ** 2 - spread**2))


def test_2_7_mixes_lengths_and_takes_the_wrong_root():
    assert residual_2_7(0.0, 0.0, printed=True) == pytest.approx(2 * math.sin(LINKAGE.arm_angle) - 25.5, abs=0.05)
    for left in np.radians([5.0, 15.0, 25.0]):
        inner, outer = float(left), float(LINKAGE.right_from_left(left))
        assert abs(residual_2_7(inner, outer, printed=True)) > 20
        assert residual_2_7(inner, outer, printed=False) == pytest.approx(0.0, abs=1e-12)
    # The order of inner and outer as printed belongs to forward arms only.
    rearward = SteeringLinkage(arms="rearward")
    inner, outer = 0.4, rearward.right_from_left(0.4)
    assert abs(residual_2_7(inner, outer, printed=False)) > 0.05
    assert residual_2_7(outer, inner, printed=False) == pytest.approx(0.0, abs=1e-12)


# Thesis, polynomials


def test_2_8_cubic_term_is_misplaced_by_a_digit():
    thirty = math.radians(30)
    assert math.degrees(round_trip_error(F_PRINTED, H_PRINTED, thirty)) == pytest.approx(0.768, abs=5e-4)
    assert math.degrees(round_trip_error(F_CORRECTED, H_PRINTED, thirty)) == pytest.approx(0.011, abs=5e-4)
    assert F_CORRECTED[2] == pytest.approx(10 * F_PRINTED[2])


def turned(coefficients):
    return tuple(-c for c in coefficients)


@pytest.mark.parametrize(
    ("f", "at_30", "at_45"), [(F_PRINTED, 2.05, 7.4), (F_CORRECTED, 1.28, 4.1)], ids=["printed", "cubic mended"]
)
def test_2_8_rear_lines_do_not_invert(f, at_30, at_45):
    for limit, miss in ((30, at_30), (45, at_45)):
        error = math.degrees(round_trip_error(turned(f), turned(H_PRINTED), math.radians(limit)))
        assert error == pytest.approx(miss, abs=0.05)


def test_2_8_rear_right_wheel_goes_against_its_tie_rod():
    left = math.radians(15)
    assert math.degrees(polynomial(turned(SteeringPolynomials().front.right_from_left), left)) == pytest.approx(
        -14.9, abs=0.05
    )
    rear = SteeringPolynomials().rear
    assert math.degrees(rear.right_of(left)) == pytest.approx(15.0, abs=0.6)


def test_2016_front_quadratic_has_a_sign_slip():
    back, limit = (0.1047, 1.5362, -0.0009), math.radians(30)
    assert math.degrees(round_trip_error((0.029, 0.6515, 0.0006), back, limit)) > 1.4
    mended = SteeringPolynomials.named("2016").front.left_from_servo
    assert math.degrees(round_trip_error(mended, back, limit)) < 0.012


# Thesis, Ackermann and four-wheel steering


def test_2_12_has_the_left_side_turned():
    car = Ackermann()
    inner, outer = car.front_angles(0.3)
    assert cot(inner) - cot(outer) == pytest.approx(-0.8125)
    assert cot(outer) - cot(inner) == pytest.approx(car.track / car.wheelbase)
    assert car.defect(inner, outer) == pytest.approx(0.0, abs=1e-15)
    assert abs(car.defect(outer, inner)) > 0.1


def test_2_14_words_exchange_the_centre_of_mass_distances():
    steer, l_f, l_r = 0.3, 0.10, 0.22
    car = Ackermann()
    moved = FourWheelSteering(cg_split=l_f / 0.32)
    radius = 1.0 / moved.curvature(steer, 0.0)
    rear_axle = 1.0 / car.geometry.curvature(steer, 0.0)
    assert math.hypot(rear_axle, l_r) == pytest.approx(radius)
    assert math.hypot(rear_axle, l_f) != pytest.approx(radius, rel=1e-3)


@each_state
def test_2_33_needs_a_minus_between_its_terms(front, rear):
    fl, fr, rl, rr = GEOMETRY.wheel_angles(front, rear)
    ahead, behind = 1 / (cot(fr) - cot(fl)), 1 / (cot(rr) - cot(rl))
    length_over_track = GEOMETRY.wheelbase / GEOMETRY.track
    assert ahead - behind == pytest.approx(length_over_track)
    assert ahead + behind != pytest.approx(length_over_track, rel=0.05)
    # 2.31 and 2.32 are right with signed c1, c2.
    radius = GEOMETRY.wheelbase / (math.tan(front) - math.tan(rear))
    c1, c2 = radius * math.tan(front), radius * math.tan(rear)
    assert cot(fr) - cot(fl) == pytest.approx(GEOMETRY.track / c1)
    assert cot(rr) - cot(rl) == pytest.approx(GEOMETRY.track / c2)
    assert c1 - c2 == pytest.approx(GEOMETRY.wheelbase)


def test_2_33_as_printed_in_symmetric_counter_steer_is_zero():
    centred = FourWheelSteering()
    fl, fr, rl, rr = centred.wheel_angles(0.3, -0.3)
    assert 1 / (cot(fr) - cot(fl)) + 1 / (cot(rr) - cot(rl)) == pytest.approx(0.0, abs=1e-12)
    assert 1 / (cot(fr) - cot(fl)) - 1 / (cot(rr) - cot(rl)) == pytest.approx(centred.wheelbase / centred.track)


def test_2_37_with_magnitudes_has_no_counter_steer():
    angle = math.radians(20)
    centred = FourWheelSteering()
    assert round(1 / centred.curvature(angle, -angle), 2) == 0.44
    assert centred.curvature(abs(angle), abs(-angle)) == 0.0  # as printed


@each_state
def test_2_35_to_2_50_hold_signed_and_2_48_to_2_50_slip_an_index(front, rear):
    v_c, half = 0.2, GEOMETRY.track / 2
    radius = GEOMETRY.wheelbase / (math.tan(front) - math.tan(rear))
    beta = GEOMETRY.sideslip(front, rear)
    r_c = radius / math.cos(beta)
    assert 1 / r_c == pytest.approx(GEOMETRY.curvature(front, rear))
    angles = GEOMETRY.wheel_angles(front, rear)
    speeds = GEOMETRY.wheel_speeds(v_c, front, rear)
    assert 2 * cot(front) == pytest.approx(cot(angles[0]) + cot(angles[1]))
    assert 2 * cot(rear) == pytest.approx(cot(angles[2]) + cot(angles[3]))
    for side, angle, speed in zip((-1, 1, -1, 1), angles, speeds, strict=True):
        assert v_c / r_c * (radius + side * half) / math.cos(angle) == pytest.approx(speed)
    assert all(abs(speed - speeds[0]) > 1e-4 for speed in speeds[1:])


@each_state
def test_2_52_has_the_wrong_sign_and_2_54_2_55_square_the_wrong_thing(front, rear):
    vx, vy, wz = GEOMETRY.body_twist(0.2, front, rear)
    beta = GEOMETRY.sideslip(front, rear)
    assert vy == pytest.approx(vx * math.tan(beta))
    assert vx**2 * (1 + math.tan(beta) ** 2) == pytest.approx(0.2**2)
    assert vx**2 * (1 - math.tan(beta) ** 2) != pytest.approx(0.2**2, rel=1e-4)
    assert vx**2 * (1 + math.tan(beta**2)) != pytest.approx(0.2**2, rel=1e-6)
    assert wz == pytest.approx(0.2 * math.cos(beta) * (math.tan(front) - math.tan(rear)) / GEOMETRY.wheelbase)


# Skid-steer paper

ROBOT = SkidSteer(
    PUBLISHED_RADIUS, PUBLISHED_HALF_TRACK - 0.01, -PUBLISHED_HALF_TRACK - 0.01, icr_x=-0.004, front=0.025, rear=0.036
)


def test_2_35_wheels_of_the_linkage_share_no_centre():
    linkage, bicycle = SteeringPolynomials(), FourWheelSteering()
    axles = LinkedAxles(bicycle, linkage.front, linkage.rear)
    assert bicycle.minimum_radius("counter", 0.4) == pytest.approx(0.378, abs=1e-3)
    assert 1 / bicycle.curvature(*axles.angles(*linkage.servo_from_axles(0.4, -0.4))) == pytest.approx(0.422, abs=1e-3)


def test_k5_turning_centre_has_both_signs_turned():
    vx, vy, wz = ROBOT.forward((0.5, 1.5))
    d_cx, d_cy = vy / wz, -vx / wz  # eq. 4: vx/(-d_Cy) = vy/d_Cx = omega
    assert twist_at(vx, vy, wz, -d_cx, -d_cy) == pytest.approx((0.0, 0.0, wz))
    assert twist_at(vx, vy, wz, -d_cx, d_cy)[0] == pytest.approx(2.0 * vx)  # as printed, +d_Cy


def test_k8_front_and_back_are_exchanged_in_print():
    vx, vy, wz = ROBOT.forward((0.5, 1.5))
    a, b = ROBOT.rear, ROBOT.front
    front, back = ROBOT.skids((0.5, 1.5))
    assert (front, back) == pytest.approx((twist_at(vx, vy, wz, b, 0.0)[1], twist_at(vx, vy, wz, -a, 0.0)[1]))
    assert front == pytest.approx((b - ROBOT.icr_x) * wz)
    assert back == pytest.approx((-a - ROBOT.icr_x) * wz)
    assert front != pytest.approx((-a - ROBOT.icr_x) * wz, rel=0.1)


def test_k9_needs_the_velocity_vector():
    robot = replace(SkidSteer.ideal(PUBLISHED_RADIUS, PUBLISHED_HALF_TRACK), front=0.025, rear=0.036)
    vx, _, wz = robot.forward((0.5, 1.5))
    c, a, b, x_icr = PUBLISHED_HALF_TRACK, robot.rear, robot.front, robot.icr_x
    matrix = np.array([[1, -c], [1, c], [0, b - x_icr], [0, -a - x_icr]])
    left, right, front, back = matrix @ [vx, wz]
    assert (left, right) == pytest.approx((0.5 * robot.radius, 1.5 * robot.radius))
    assert (front, back) == pytest.approx(robot.skids((0.5, 1.5)))


def test_k_table_deviations_recomputed():
    ideal = SkidSteer.ideal(PUBLISHED_RADIUS, PUBLISHED_HALF_TRACK)
    recomputed = [100 * (c.speed / ideal.forward((c.left, c.right))[0] - 1) for c in PUBLISHED_CIRCLES[:6]]
    assert np.round(recomputed, 1).tolist() == [10.4, 13.3, 10.5, 11.5, 6.9, 14.0]
    printed = [12.34, 13.19, 9.39, 11.87, 6.85, 13.69]
    assert np.abs(np.array(printed) - recomputed).max() > 1.9


def test_k_straight_and_locked_speeds():
    ideal = SkidSteer.ideal(PUBLISHED_RADIUS, PUBLISHED_HALF_TRACK)
    assert round(100 * ideal.forward((1.57, 1.57))[0], 2) == 3.30  # printed 3.24
    assert round(100 * ideal.forward((0.0, 1.57))[0], 2) == 1.65  # printed 1.64


# Lecture


def test_m_synchro_drive_is_holonomic_for_its_point_only():
    found = analyse(Synchro().wheels((1.0, 0.2)))
    assert found.robot_class == (1, 1)
    assert found.non_holonomic  # the lecture calls it holonomic
    ahead = Synchro().platform_twist((1.0, 0.0), 0.0)
    aside = Synchro().platform_twist((1.0, 0.0), math.pi / 2)
    assert ahead[2] == aside[2] == 0.0  # the point goes anywhere, the body never turns
    assert np.linalg.matrix_rank([ahead, aside], tol=1e-9) == 2
