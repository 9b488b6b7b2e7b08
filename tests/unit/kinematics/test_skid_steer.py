"""Skid steer: the models, the paper's table, identification from a trajectory."""

import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.fitting import least_squares, minimax
from monstertruck_kinematics.identification import (
    MODEL_NAMES,
    PUBLISHED_CIRCLES,
    PUBLISHED_HALF_TRACK,
    PUBLISHED_RADIUS,
    MeasuredCircle,
    circle_errors,
    fit_circles,
    fit_trajectory,
    skid_model,
    unexplained_spread,
)
from monstertruck_kinematics.se2 import integrate, twist_at
from monstertruck_kinematics.unsteered import SkidSteer

IDEAL = SkidSteer.ideal(PUBLISHED_RADIUS, PUBLISHED_HALF_TRACK)


def model(name, **options):
    return skid_model(name, PUBLISHED_RADIUS, PUBLISHED_HALF_TRACK, **options)


def test_ideal_radii_and_speeds_as_tabled():
    for ratio, radius in ((2.0, 15.75), (3.0, 10.5)):
        vx, _, wz = IDEAL.forward((1.0, ratio))
        assert round(100 * vx / wz, 2) == radius
    speeds = [100.0 * IDEAL.forward((c.left, c.right))[0] for c in PUBLISHED_CIRCLES]
    assert np.round(speeds, 3).tolist() == [2.473, 1.969, 1.638, 2.198, 1.75, 1.456, 1.649]
    locked = IDEAL.forward((0.0, 1.57))
    assert locked[0] / locked[2] == pytest.approx(PUBLISHED_HALF_TRACK)
    deviations = [100 * (c.speed / (s / 100) - 1) for c, s in zip(PUBLISHED_CIRCLES[:6], speeds, strict=False)]
    assert np.round(deviations, 1).tolist() == [10.4, 13.3, 10.5, 11.5, 6.9, 14.0]


def test_offset_centre_is_the_same_robot_seen_elsewhere(rng):
    command = tuple(rng.uniform(-2.0, 2.0, 2).tolist())
    x, y = 0.01, -0.02
    seen = SkidSteer(PUBLISHED_RADIUS, PUBLISHED_HALF_TRACK - y, -PUBLISHED_HALF_TRACK - y, -x).forward(command)
    assert seen == pytest.approx(twist_at(*IDEAL.forward(command), x, y))
    faster = replace(IDEAL, gain_left=1.1, gain_right=1.1)
    assert faster.forward(command) == pytest.approx(tuple(1.1 * v for v in IDEAL.forward(command)))


def test_slip_of_front_and_rear_wheels():
    robot = SkidSteer(0.021, 0.06, -0.06, icr_x=0.01, front=0.02, rear=0.04)
    twist = robot.forward((1.0, 2.0))
    assert robot.skids((1.0, 2.0)) == pytest.approx(((0.02 - 0.01) * twist[2], (-0.04 - 0.01) * twist[2]))
    assert {wheel.name: wheel.x for wheel in robot.wheels((1.0, 2.0))} == {
        "rear left": -0.04, "front left": 0.02, "front right": 0.02, "rear right": -0.04,
    }  # fmt: skip
    with pytest.raises(KinematicsError, match=r"vy is 0\.1"):
        robot.inverse((0.1, 0.1, 0.0))


# The paper's table


@pytest.mark.parametrize(
    ("name", "bounded", "worst"),
    [("symmetric", True, 17.0), ("icr", True, 7.8), ("icr and slip", True, 6.1), ("effective radius", True, 32.3)],
)
def test_what_one_set_reaches_in_the_three_radii(name, bounded, worst):
    found = fit_circles(PUBLISHED_CIRCLES, model(name, bounded=bounded), objective="minimax", radii_only=True)
    assert 100 * np.abs(circle_errors(found.robot, PUBLISHED_CIRCLES)[0]).max() == pytest.approx(worst, abs=0.05)


def test_unbounded_radii_fit_exactly_with_a_robot_that_cannot_be():
    found = fit_circles(PUBLISHED_CIRCLES, model("icr and slip", bounded=False), radii_only=True)
    assert found.fit.worst < 1e-6
    values = dict(zip(found.model.parameters, found.fit.parameters, strict=True))
    assert values["slip_ratio"] > 5.0
    assert abs(values["icr_right"]) > 25 * PUBLISHED_HALF_TRACK


@pytest.mark.parametrize(
    ("name", "least", "worst"), [("symmetric", 8.65, 16.98), ("icr", 7.24, 10.38), ("icr and slip", 7.13, 9.15)]
)
@pytest.mark.parametrize("bounded", [True, False])
def test_radii_and_speeds_together(name, least, worst, bounded):
    squares = fit_circles(PUBLISHED_CIRCLES, model(name, bounded=bounded))
    assert 100 * squares.fit.rms == pytest.approx(least, abs=0.01)
    highest = fit_circles(PUBLISHED_CIRCLES, model(name, bounded=bounded), objective="minimax")
    assert 100 * highest.fit.worst == pytest.approx(worst, abs=0.02)
    assert highest.fit.worst < squares.fit.worst
    assert squares.fit.rms < highest.fit.rms
    assert squares.fit.rms < np.sqrt(np.mean(circle_errors(IDEAL, PUBLISHED_CIRCLES) ** 2))


def test_the_two_driven_ratios_alone_fit_within_5_5_percent():
    found = fit_circles(PUBLISHED_CIRCLES[:6], model("symmetric"), objective="minimax")
    assert 100 * found.fit.worst <= 5.5
    radii = fit_circles(PUBLISHED_CIRCLES[:6], model("symmetric"), objective="minimax", radii_only=True)
    assert 100 * radii.fit.worst == pytest.approx(5.1, abs=0.05)
    assert 100 * radii.fit.parameters[1] == pytest.approx(7.36, abs=0.01)


def test_what_no_model_linear_in_the_rates_explains():
    floor = unexplained_spread(PUBLISHED_CIRCLES)
    assert 100 * floor == pytest.approx(3.24, abs=0.01)
    for name in MODEL_NAMES:
        assert fit_circles(PUBLISHED_CIRCLES, model(name, bounded=False), objective="minimax").fit.worst >= floor - 1e-4


def test_standard_errors_tell_what_the_data_determine():
    table = {name: error for name, _, error in fit_circles(PUBLISHED_CIRCLES, model("symmetric")).parameter_table()}
    assert 0.01 < table["gain"] < 0.1
    assert 0.001 < table["half_track"] < 0.01
    table = {n: e for n, _, e in fit_circles(PUBLISHED_CIRCLES, model("symmetric"), radii_only=True).parameter_table()}
    assert table["gain"] == math.inf


# Trajectories


def driven(robot, rng, noise=(0.001, 0.001, 0.005)):
    times = np.arange(400) * 0.1
    rates = np.array([1.5 + np.sin(times * 0.7), 1.5 + np.cos(times * 0.4)])
    poses = [(0.0, 0.0, 0.0)]
    for k in range(times.size - 1):
        poses.append(integrate(poses[-1], *robot.forward((float(rates[0, k]), float(rates[1, k]))), 0.1))
    return times, rates, np.array(poses).T + rng.normal(0.0, 1.0, (3, times.size)) * np.array(noise)[:, None]


def test_identification_finds_the_robot_within_its_standard_errors(rng):
    robot = SkidSteer(0.021, 0.07, -0.085, 0.012, 1.08, 1.0)
    times, rates, poses = driven(robot, rng)
    found = fit_trajectory(times, rates, poses, model("icr and slip", with_icr_x=True))
    truth = {
        "gain": math.sqrt(1.08), "icr_left": 0.07, "icr_right": -0.085, "slip_ratio": 1 / 1.08, "icr_x": 0.012,
    }  # fmt: skip
    for name, value, error in found.parameter_table():
        assert abs(value - truth[name]) < 4.0 * error
        assert error < 0.2 * abs(truth[name])


def test_outliers_do_not_spoil_it(rng):
    robot = SkidSteer(0.021, 0.07, -0.07, 0.0, 1.1, 1.1)
    times, rates, poses = driven(robot, rng)
    poses[0, 50:400:60] += 0.5
    poses[2] = np.arctan2(np.sin(poses[2]), np.cos(poses[2]))  # wrapped headings are fine
    robust = fit_trajectory(times, rates, poses, model("symmetric"))
    plain = fit_trajectory(times, rates, poses, model("symmetric"), huber=None)
    assert robust.fit.parameters == pytest.approx([1.1, 0.07], rel=0.03)
    assert abs(plain.fit.parameters[0] - 1.1) > 2 * abs(robust.fit.parameters[0] - 1.1)


def test_bad_identification_input_is_named(rng):
    times, rates, poses = driven(IDEAL, rng)
    symmetric = model("symmetric")
    broken = times.copy()
    broken[7] = broken[6]
    nan = poses.copy()
    nan[1, 3] = math.nan
    for call, text in (
        (lambda: fit_trajectory(broken, rates, poses, symmetric), r"times\[7\]"),
        (lambda: fit_trajectory(times, rates[:, 1:], poses, symmetric), r"rates \(2, 399\)"),
        (lambda: fit_trajectory(times, rates, nan, symmetric), "finite"),
        (lambda: fit_trajectory(times, rates, poses, symmetric, window=400), "window is 400"),
        (lambda: fit_circles([], symmetric), "circles is empty"),
        (lambda: fit_circles([MeasuredCircle("line", 1.0, 1.0, 1.0, 1.0)], symmetric), "circle line"),
        (lambda: fit_circles(PUBLISHED_CIRCLES[:1], model("icr and slip")), "2 residuals"),
        (lambda: model("rubber"), "rubber"),
        (lambda: skid_model("icr", -0.1, 0.1), "radius"),
    ):
        with pytest.raises(KinematicsError, match=text):
            call()


# The solver itself


def test_solver_respects_bounds_and_finds_them_active():
    far = np.full(2, np.inf)
    rosenbrock = least_squares(
        lambda p: np.array([10.0 * (p[1] - p[0] ** 2), 1.0 - p[0]]), np.array([-1.2, 1.0]), -far, far
    )
    assert rosenbrock.parameters == pytest.approx([1.0, 1.0])
    bounded = least_squares(lambda p: p - np.array([3.0, -1.0]), np.zeros(2), -np.ones(2), np.ones(2) * 2.0)
    assert bounded.parameters == pytest.approx([2.0, -1.0])
    assert bounded.standard_errors[0] == math.inf


def test_straight_line_standard_errors_are_the_textbooks(rng):
    x = np.linspace(0.0, 1.0, 50)
    y = 2.0 * x + 1.0 + rng.normal(0.0, 0.1, 50)
    far = np.full(2, np.inf)
    fit = least_squares(lambda p: p[0] * x + p[1] - y, np.zeros(2), -far, far)
    design = np.column_stack([x, np.ones(50)])
    best, squares, _, _ = np.linalg.lstsq(design, y, rcond=None)
    spread = squares[0] / 48 * np.linalg.inv(design.T @ design)
    assert fit.parameters == pytest.approx(best, abs=1e-8)
    assert fit.standard_errors == pytest.approx(np.sqrt(np.diag(spread)), rel=1e-6)


def test_minimax_of_a_constant_is_the_middle():
    data = np.array([1.0, 2.0, 10.0])
    far = np.full(1, np.inf)
    assert minimax(lambda p: p[0] - data, np.zeros(1), -far, far).parameters == pytest.approx([5.5], rel=1e-3)


def test_solver_refuses_nonsense():
    one, far = np.ones(1), np.full(1, np.inf)
    with pytest.raises(KinematicsError, match="outside the bounds"):
        least_squares(lambda p: p, one * 2, -one, one)
    with pytest.raises(KinematicsError, match="not finite"):
        least_squares(lambda p: p * np.nan, one, -far, far)
