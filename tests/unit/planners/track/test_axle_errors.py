"""Gain, trim and compliance of the axles: found from motion, used, separated by speed."""

import math

import numpy as np
import pytest

from monstertruck_planners.track.axle_errors import AxleError, AxleErrorEstimator, AxleErrors, AxleMotion
from monstertruck_planners.track.path_tracker import TruckState
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.kit import STEERING, Follower, figure_eight, path

STEP = 0.05


def driven(
    errors,
    speeds,
    seconds=60.0,
    noise=0.0,
    steering=(1.0, -0.6),
    *,
    located=True,
    compass=False,
    seed=1,
    freedom="both",
    each=lambda _: None,
):
    """Random requests to axles that obey at once, at each of some speeds in turn."""
    estimator, rng = AxleErrorEstimator(STEERING, freedom), np.random.default_rng(seed)
    pose, swept, angle = (0.0, 0.0, 0.0), (0.0, 0.0), 0.0
    for k in range(round(seconds / STEP)):
        t, speed = k * STEP, speeds[k // 200 % len(speeds)]
        if k % 30 == 0:
            angle = float(rng.uniform(-0.3, 0.3))
        asked = (steering[0] * angle, steering[1] * angle)
        wheels = errors.wheels(asked, speed**2 / STEERING.wheelbase)
        twist = STEERING.body_twist(speed, *wheels)
        yaw = pose[2] + noise * float(rng.standard_normal())
        heading = (t, yaw + 1.0) if compass else None
        estimator.observe(AxleMotion(t, swept, asked, (*pose[:2], yaw), twist[0], heading, located), 0.0)
        each(estimator)
        pose = STEERING.integrate(pose, *twist, STEP)
        swept = swept[0] + STEP * asked[0], swept[1] + STEP * asked[1]
    return estimator


def deviations(estimator):
    return np.sqrt(np.diag(estimator.covariance))


@pytest.mark.parametrize("speed", [0.18, -0.12, 1.0])
@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_gain_and_trim_of_each_axle_are_found(speed, noise):
    wrong = AxleErrors(AxleError(0.9, 0.05), AxleError(1.08, -0.02))
    found = driven(wrong, [speed], noise=noise)
    truth = np.array((-0.1, 0.05, 0.0, 0.08, -0.02, 0.0))
    off = np.abs(found.state - truth)
    assert (off < 3 * deviations(found) + 0.01).all()
    assert off[[1, 4]].max() < 0.006
    if abs(speed) < 0.5:
        assert off[[0, 3]].max() < 0.04


def test_slip_and_a_wrong_servo_are_separated_by_speed():
    slipping = AxleErrors(AxleError(compliance=0.03), AxleError(compliance=0.03))
    found = driven(slipping, [0.3, 1.2], steering=(1.0, 0.0))
    assert found.state[2] == pytest.approx(0.03, abs=0.004)
    assert abs(found.state[0]) < 0.02
    servo = driven(AxleErrors(AxleError(0.9)), [0.3, 1.2], steering=(1.0, 0.0))
    assert servo.state[0] == pytest.approx(-0.1, abs=0.02)
    assert abs(servo.state[2]) < 0.004


def test_a_compass_alone_shows_the_turn_and_leaves_the_axles_uncertain():
    wrong = AxleErrors(AxleError(0.9, 0.05), AxleError(0.9))
    found = driven(wrong, [0.18], steering=(1.0, -1.0), located=False, compass=True)
    mean = 0.5 * (found.state[0] + found.state[3])
    assert mean == pytest.approx(-0.1, abs=0.02)
    assert found.state[1] - found.state[4] == pytest.approx(0.05, abs=0.005)
    assert deviations(found)[[0, 3]].min() > 0.05
    assert deviations(found)[[1, 4]].min() > 0.02


def test_poses_that_come_from_the_requests_teach_nothing():
    found = driven(AxleErrors(AxleError(0.8)), [0.18], located=False)
    assert not found.state.any()
    assert found.metres == 0.0


def test_axles_on_one_servo_err_alike_and_are_requested_alike():
    wrong = AxleErrors(AxleError(0.9, 0.05), AxleError(0.9, 0.05))
    found = driven(wrong, [0.18], steering=(1.0, 1.0), freedom="parallel", noise=0.001)
    assert found.state[[1, 4]] == pytest.approx(0.05, abs=0.005)
    front, rear = found.errors.requests((0.2, 0.2), 0.1)
    assert front == pytest.approx(rear, abs=1e-9)


def test_an_axle_that_is_not_steered_has_no_error():
    found = driven(AxleErrors(AxleError(0.9, 0.05)), [0.18], steering=(1.0, 0.0), freedom="front")
    assert found.state[:2] == pytest.approx((-0.1, 0.05), abs=0.01)
    assert not found.state[3:].any()


def test_a_body_that_steers_nothing_learns_nothing():
    found = driven(AxleErrors(AxleError(0.9, 0.05)), [0.18], freedom=None)
    assert not found.state.any()
    assert found.metres == 0.0


def test_an_outlier_counts_little():
    estimator = driven(AxleErrors(AxleError(0.9, 0.03)), [0.18], noise=0.001)
    before = estimator.state.copy()
    newest = estimator._sums[-1].motion
    jumped = newest._replace(t=newest.t + 0.3, pose=(newest.pose[0] + 0.05, newest.pose[1], newest.pose[2] + 0.5))
    assert estimator.observe(jumped, 0.0)
    assert np.abs(estimator.state - before).max() < 0.01


def test_a_truck_at_rest_learns_nothing():
    found = driven(AxleErrors(AxleError(0.8, 0.1)), [0.0], noise=0.003)
    assert not found.state.any()


@pytest.mark.parametrize("grip", [0.0, 0.1, 3.0])
def test_requests_are_the_inverse_of_wheels(grip):
    errors = AxleErrors(AxleError(0.9, 0.05, 0.03), AxleError(1.1, -0.02, 0.01))
    assert errors.requests(errors.wheels((0.3, -0.2), grip), grip) == pytest.approx((0.3, -0.2))


@pytest.mark.parametrize("steering", ["front", "rear", "counter", "hybrid"])
@pytest.mark.parametrize("kind", ["lqr", "mpc"])
def test_a_truck_out_of_trim_follows_its_path_once_it_has_driven(kind, steering):
    """Both axles are off; one that the way of steering leaves alone stays off, the other makes up for it."""
    route = path(figure_eight(5.5, 960), closed=True)
    truck = Follower(route, pose=(0.0, 0.0, 0.78), kind=kind, steering=steering, dead_time=0.0, speed=0.3)
    wrong = AxleErrors(AxleError(0.9, 0.04), AxleError(0.95, -0.03))
    pose, speed, angles, errors = truck.pose, 0.0, (0.0, 0.0), []
    for k in range(4000):
        wheels = wrong.wheels(angles, 0.0)
        state = TruckState(pose, STEERING.body_twist(speed, *wheels)[0])
        command = truck.tracker.control(state, truck.path, truck.progress, 0.05 * k)
        truck.progress = command.progress
        if command.outcome is not Reason.DRIVING:
            break
        if truck.path.along(command.progress) > 4.0:
            errors.append(command.cross_track)
        for _ in range(5):
            wanted = (command.front, command.rear)
            angles = tuple(a + min(max(w - a, -0.01), 0.01) for a, w in zip(angles, wanted, strict=True))
            speed += min(max(command.speed - speed, -0.01), 0.01)
            pose = STEERING.integrate(pose, *STEERING.body_twist(speed, *wrong.wheels(angles, 0.0)), 0.01)
    assert command.outcome is Reason.GOAL_REACHED
    assert math.sqrt(np.mean(np.square(errors))) < 0.004
