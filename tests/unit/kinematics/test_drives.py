"""Every family: forward and inverse agree, Jacobians are derivatives, limits keep the path, arcs are exact."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.se2 import integrate, integration_jacobians, to_body, to_world, twist_at
from monstertruck_kinematics.steered import Ackermann, Bicycle, FourWheelSteer, IndependentSteer, Synchro, Tricycle
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_kinematics.unsteered import Differential, SkidSteer, SwedishDrive, mecanum, omni
from monstertruck_kinematics.wheels import SwedishWheel, analyse, rolling_matrix, sliding_matrix

STATES = 100_000


def planar(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (3, n))


def unicycle(rng: np.random.Generator, n: int) -> np.ndarray:
    return planar(rng, n) * [[1.0], [0.0], [1.0]]


def steerable(rng: np.random.Generator, n: int) -> np.ndarray:
    speed = rng.uniform(-1.0, 1.0, n)
    return np.array([speed, 0.0 * speed, speed * rng.uniform(-2.0, 2.0, n)])


def steerable_with_sideslip(rng: np.random.Generator, n: int) -> np.ndarray:
    speed = rng.uniform(-1.0, 1.0, n)
    return np.array([speed, speed * rng.uniform(-0.5, 0.5, n), speed * rng.uniform(-2.0, 2.0, n)])


def skidding(rng: np.random.Generator, n: int) -> np.ndarray:
    twist = planar(rng, n)
    return np.array([twist[0], -0.02 * twist[2], twist[2]])


FAMILIES = {
    "differential": (Differential(), unicycle),
    "tricycle": (Tricycle(), unicycle),
    "bicycle rear": (Bicycle(), steerable),
    "bicycle front": (Bicycle(driven="front"), unicycle),
    "ackermann": (Ackermann(), steerable),
    "four-wheel steer": (FourWheelSteer(), steerable_with_sideslip),
    "four-wheel steer, cg ahead": (FourWheelSteer(FourWheelSteering(cg_split=0.3)), steerable_with_sideslip),
    "independent": (IndependentSteer(), planar),
    "synchro": (Synchro(), unicycle),
    "omni": (omni(), planar),
    "mecanum": (mecanum(), planar),
    "skid steer": (SkidSteer(0.021, 0.08, -0.07, 0.02, 1.1, 1.05), skidding),
}
each_family = pytest.mark.parametrize("name", FAMILIES)


@each_family
def test_forward_of_inverse_is_the_twist(name, rng):
    drive, twists = FAMILIES[name]
    twist = twists(rng, STATES)
    back = np.array(drive.forward(drive.inverse(twist)))
    assert np.abs(back - twist).max() <= 1e-12


@each_family
def test_scalars_and_arrays_agree(name, rng):
    drive, twists = FAMILIES[name]
    twist = twists(rng, 5)
    commands = drive.inverse(twist)
    for i in range(5):
        single = tuple(float(component[i]) for component in twist)
        command = drive.inverse(single)
        assert all(isinstance(value, float) for value in command)
        np.testing.assert_allclose(command, [float(c[i]) for c in commands], rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(drive.forward(command), single, atol=1e-13)


@each_family
def test_a_standing_robot_needs_no_special_case(name):
    drive, _ = FAMILIES[name]
    command = drive.inverse((0.0, 0.0, 0.0))
    assert drive.forward(command) == pytest.approx((0.0, 0.0, 0.0))
    both = drive.inverse(np.array([[0.0, 0.5], [0.0, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(drive.forward(both), [[0.0, 0.5], [0.0, 0.0], [0.0, 0.0]], atol=1e-15)


@each_family
def test_bad_commands_and_twists_are_refused_by_name(name):
    drive, _ = FAMILIES[name]
    with pytest.raises(KinematicsError, match="vx is nan"):
        drive.inverse((math.nan, 0.0, 0.0))
    with pytest.raises(KinematicsError, match=r"wz\[1\] is inf"):
        drive.inverse((np.zeros(2), np.zeros(2), np.array([0.0, math.inf])))
    bad = [0.0] * len(drive.inputs)
    bad[0] = math.nan
    with pytest.raises(KinematicsError, match=f"{drive.inputs[0]} is nan"):
        drive.forward(bad)
    with pytest.raises(KinematicsError, match="expected"):
        drive.forward([0.0] * (len(drive.inputs) + 1))


# What single families cannot do, and what only they can


def test_sideways_is_refused_where_wheels_forbid_it():
    for drive in (Differential(), Tricycle(), Bicycle(), Ackermann(), Synchro()):
        with pytest.raises(KinematicsError, match=r"vy is 0\.1"):
            drive.inverse((0.5, 0.1, 0.0))
    with pytest.raises(KinematicsError, match="vx is 0"):
        FourWheelSteer().inverse((0.0, 0.1, 0.0))
    with pytest.raises(KinematicsError, match="vx is 0"):
        FourWheelSteer().inverse((np.array([1.0, 0.0]), np.zeros(2), np.array([0.0, 0.2])))
    with pytest.raises(KinematicsError, match="steer that vx, wz need"):
        Bicycle().inverse((0.0, 0.0, 1.0))


def test_turning_on_the_spot():
    spot = (0.0, 0.0, 1.0)
    assert Differential(0.1, 0.4).inverse(spot) == pytest.approx((-2.0, 2.0))
    assert Tricycle(0.5).inverse(spot) == pytest.approx((0.5, math.pi / 2))
    command = IndependentSteer().inverse(spot)
    angle = math.atan2(0.16, -0.13) - math.pi
    assert command[:4] == pytest.approx((angle, -angle, -angle, angle))
    assert command[4:] == pytest.approx(math.hypot(0.16, 0.13) * np.array([-1, 1, -1, 1]))
    assert IndependentSteer().forward(command) == pytest.approx(spot)


def test_differential_textbook_values():
    drive = Differential(radius=0.1, track=0.4)
    v_x, _, omega = drive.forward((1.0, 3.0))
    assert (v_x, omega) == pytest.approx((0.2, 0.5))
    radius = 0.4 / 2 * (0.3 + 0.1) / (0.3 - 0.1)
    assert v_x / omega == pytest.approx(radius)


def test_tricycle_odometry_equals_its_motion(rng):
    drive = Tricycle(track=0.3)
    command = (rng.uniform(-1, 1, 100), rng.uniform(-1.4, 1.4, 100))
    twist = np.array(drive.forward(command))
    rates = rolling_matrix(drive.wheels((0.0, 0.0))[:2]) @ twist
    np.testing.assert_allclose(drive.odometry(*rates), twist, atol=1e-14)
    vx, _, wz = drive.forward((0.2, math.pi / 4))
    assert vx / wz == pytest.approx(drive.wheelbase)


def test_car_like_constraints_hold_at_both_axles(rng):
    heading, speed, steer = rng.uniform(-3, 3, 50), rng.uniform(-1, 1, 50), rng.uniform(-1, 1, 50)
    for driven in ("front", "rear"):
        drive = Bicycle(wheelbase=0.5, driven=driven)
        vx, vy, turn = drive.forward((speed, steer))
        x_rate, y_rate = to_world(heading, vx, vy)
        np.testing.assert_allclose(x_rate * np.sin(heading) - y_rate * np.cos(heading), 0.0, atol=1e-15)
        front = x_rate * np.sin(heading + steer) - y_rate * np.cos(heading + steer) - turn * 0.5 * np.cos(steer)
        np.testing.assert_allclose(front, 0.0, atol=1e-15)
        if driven == "front":
            np.testing.assert_allclose(x_rate, speed * np.cos(heading) * np.cos(steer), atol=1e-15)


def test_single_axle_steering_turns_about_the_straight_axle():
    truck = FourWheelSteer()
    front, rear = (analyse(truck.wheels((0.2, *angles))).icr for angles in ((0.3, 0.0), (0.0, 0.3)))
    assert front == pytest.approx((-0.16, 0.32 / math.tan(0.3)))
    assert rear == pytest.approx((0.16, -0.32 / math.tan(0.3)))


@pytest.mark.parametrize(("drive", "command"), [(FourWheelSteer(), (0.2, 0.3, -0.2)), (Ackermann(), (0.2, 0.3))])
def test_wheel_speeds_are_what_the_wheels_roll(drive, command):
    twist = drive.forward(command)
    speeds = [float(w.rolling_row @ twist) for w in drive.wheels(command)]
    assert drive.geometry.wheel_speeds(*(*command, 0.0)[:3]) == pytest.approx(speeds)


def test_synchro_platform_keeps_its_heading():
    drive = Synchro(wheel_radius=0.1)
    twist = drive.platform_twist((5.0, 0.7), math.pi / 6)
    assert twist == pytest.approx((0.5 * math.cos(math.pi / 6), 0.25, 0.0))
    assert integrate((0.0, 0.0, 0.0), *drive.forward((0.0, 0.5)), 2.0) == pytest.approx((0.0, 0.0, 1.0))
    assert integrate((0.0, 0.0, 0.0), *drive.forward((2.0, 0.0)), 3.0) == pytest.approx((0.6, 0.0, 0.0))


def test_mecanum_textbook_rates():
    drive = mecanum(wheelbase=0.4, track=0.3, wheel_radius=0.1)
    arm = 0.2 + 0.15
    fl, fr, rl, rr = drive.inverse((0.3, 0.2, 0.5))
    expected = (0.3 - 0.2 - arm * 0.5, 0.3 + 0.2 + arm * 0.5, 0.3 + 0.2 - arm * 0.5, 0.3 - 0.2 + arm * 0.5)
    assert (fl, fr, rl, rr) == pytest.approx(np.array(expected) / 0.1)


def test_omni_turns_and_slides():
    drive = omni(circle=0.2, wheel_radius=0.05)
    assert drive.inverse((0.0, 0.0, 1.0)) == pytest.approx((4.0, 4.0, 4.0))
    assert drive.inverse((0.0, 1.0, 0.0)) == pytest.approx((20.0, -10.0, -10.0))


def test_swedish_wheels_that_do_not_span_the_plane_are_refused():
    row = tuple(SwedishWheel(f"w{i}", 0.1 * i, 0.0, 0.05) for i in range(3))
    with pytest.raises(KinematicsError, match="w0, w1, w2"):
        SwedishDrive(row)
    with pytest.raises(KinematicsError, match="count is 2"):
        omni(count=2)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Differential(radius=-0.1), "radius"),
        (lambda: Differential(track=0.0), "track"),
        (lambda: Bicycle(wheelbase=math.nan), "wheelbase"),
        (lambda: Bicycle(driven="all"), "driven"),
        (lambda: Tricycle(track=-1.0), "track"),
        (lambda: Ackermann(radius=-0.075), "radius"),
        (lambda: Ackermann(wheelbase=0.0), "wheelbase"),
        (lambda: IndependentSteer(positions=((0.0, 0.0),)), "positions"),
        (lambda: Synchro(circle=-1.0), "circle"),
        (lambda: omni(wheel_radius=-0.05), "wheel 1: radius"),
        (lambda: mecanum(track=0.0), "track"),
        (lambda: SkidSteer(-0.02, 0.05, -0.05), "radius"),
        (lambda: SkidSteer(0.02, -0.05, 0.05), "icr_left"),
    ],
)
def test_impossible_robots_are_refused_by_field(make, field):
    with pytest.raises(KinematicsError, match=field):
        make()


# Wheels of every family roll as the body moves


@each_family
def test_wheels_belong_to_the_family(name, rng):
    drive, twists = FAMILIES[name]
    twist = tuple(float(component[0]) for component in twists(rng, 1) * 0.5)
    command = drive.inverse(twist)
    wheels = drive.wheels(command)
    if name in ("synchro", "skid steer"):
        return  # the twist lives in the wheels' frame; skidding wheels slip by nature
    np.testing.assert_allclose(sliding_matrix(wheels) @ twist, 0.0, atol=1e-12)


# Motion


@each_family
def test_integration_equals_many_small_steps(name, rng):
    drive, twists = FAMILIES[name]
    command = drive.inverse(tuple(float(c[0]) for c in twists(rng, 1)))
    pose = exact = (0.3, -0.2, 0.7)
    exact = integrate(exact, *drive.forward(command), 1.5)
    for _ in range(3000):
        half = integrate(pose, *drive.forward(command), 0.00025)
        vx, vy, wz = drive.forward(command)
        x_rate, y_rate = to_world(half[2], vx, vy)
        pose = (pose[0] + x_rate * 0.0005, pose[1] + y_rate * 0.0005, pose[2] + wz * 0.0005)
    assert exact == pytest.approx(pose, abs=1e-6)


def test_an_arc_lies_on_its_circle_and_a_full_turn_comes_back():
    pose = integrate((0.0, 0.0, 0.0), 0.2, 0.0, 0.5, 1.0)
    assert math.hypot(pose[0], pose[1] - 0.4) == pytest.approx(0.4, abs=1e-15)
    assert integrate((1.0, 2.0, 0.3), 0.2, 0.1, math.tau, 1.0) == pytest.approx((1.0, 2.0, 0.3 + math.tau), abs=1e-15)
    tiny = integrate((0.0, 0.0, 0.0), 1.0, 0.0, 1e-9, 1.0)
    assert tiny == pytest.approx((1.0, 5e-10, 1e-9), abs=1e-20)


def test_integrating_there_and_back_is_the_identity(rng):
    poses, twist = rng.uniform(-3, 3, (3, 1000)), rng.uniform(-2, 2, (3, 1000))
    back = integrate(integrate(tuple(poses), *twist, 0.4), *twist, -0.4)
    np.testing.assert_allclose(back, poses, atol=1e-14)


@pytest.mark.parametrize("scale", [1.0, 1e-2, 1e-5, 0.0])
def test_integration_jacobians_are_derivatives(rng, scale):
    pose, twist = rng.uniform(-2, 2, (3, 50)), rng.uniform(-1, 1, (3, 50))
    twist[2] *= scale
    by_pose, by_twist = integration_jacobians(tuple(pose), *twist, 0.3)
    for k in range(3):
        step = np.zeros((3, 1))
        step[k] = 1e-5
        slope = np.array(integrate(tuple(pose + step), *twist, 0.3)) - integrate(tuple(pose - step), *twist, 0.3)
        np.testing.assert_allclose(by_pose[:, k], slope / 2e-5, atol=1e-9)
        slope = np.array(integrate(tuple(pose), *(twist + step), 0.3)) - integrate(tuple(pose), *(twist - step), 0.3)
        np.testing.assert_allclose(by_twist[:, k], slope / 2e-5, atol=1e-9)
    assert integration_jacobians((0.0, 0.0, 0.1), 0.2, 0.0, 0.0, 0.1)[1].shape == (3, 3)


def test_frames_are_inverse_and_points_move_with_the_body():
    assert to_body(0.7, *to_world(0.7, 0.3, -0.4)) == pytest.approx((0.3, -0.4))
    assert to_world(math.pi / 2, 1.0, 0.0) == pytest.approx((0.0, 1.0))
    assert twist_at(0.0, 0.0, 2.0, 0.5, 0.25) == pytest.approx((-0.5, 1.0, 2.0))
