"""How the axles answer requests: estimated while driving, whatever is configured."""

import math
from collections import deque
from functools import cache

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_planners.track.path_tracker import AxleModel, TruckState
from monstertruck_planners.track.response import Response, ResponseEstimate, ResponseEstimator, choose, rounded
from monstertruck_planners.track.service import Newest, TrackingStep, TrackSetup
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Attitude
from monstertruck_schemas.state import GateMode, GateState, Odometry
from tests.unit.planners.kit import STEERING, Follower, figure_eight, path, straight

RATE = 5.0
PERIOD = 0.05
RESPONSES = [(0.0, 0.0), (0.05, 0.0), (0.0, 0.15), (0.05, 0.1), (0.15, 0.0), (0.1, 0.1)]
MODELS = ["pure_pursuit", "lqr", "mpc"]
"""Trackers whose error is made by the delay; that of fuzzy is made by its rules."""


class Plant:
    """A truck whose axles answer late; requests act from the step on."""

    def __init__(self, dead_time, lag, speed, pose=(0.0, 0.0, 0.0), gain=1.0, trim=0.0):
        self.waiting = deque([(0.0, 0.0)] * round(dead_time / 0.01))
        self.lag, self.speed, self.pose, self.gain, self.trim = lag, speed, pose, gain, trim
        self.angles = (0.0, 0.0)

    def period(self, request):
        for _ in range(round(PERIOD / 0.01)):
            self.waiting.append(request)
            wanted = self.waiting.popleft()
            share = 0.01 / self.lag if self.lag else math.inf
            self.angles = tuple(
                a + min(max(min(share, 1.0) * (w - a), -RATE * 0.01), RATE * 0.01)
                for a, w in zip(self.angles, wanted, strict=True)
            )
            vx, vy, wz = STEERING.body_twist(self.speed, *self.angles)
            twist = (vx, vy, self.gain * wz + self.trim * self.speed)
            self.pose = STEERING.integrate(self.pose, *twist, 0.01)


def estimated(plant, seconds=20.0, noise=0.0, estimator=None, begin=0.0):
    """Drive with random requests."""
    estimator = estimator or ResponseEstimator(STEERING, RATE)
    rng = np.random.default_rng(1)
    for k in range(round(seconds / PERIOD)):
        t = begin + k * PERIOD
        estimator.observe(t, plant.pose[2] + noise * rng.standard_normal(), plant.speed)
        if k % 8 == 0:
            angle = float(rng.uniform(-0.3, 0.3))
        estimator.request(t, (angle, -angle))
        plant.period((angle, -angle))
    return estimator.estimate


@pytest.mark.parametrize("speed", [-0.15, 0.2, 1.0])
@pytest.mark.parametrize(("dead_time", "lag"), RESPONSES)
def test_dead_time_and_lag_are_found(dead_time, lag, speed):
    found = estimated(Plant(dead_time, lag, speed))
    assert found.response.total == pytest.approx(dead_time + lag, abs=0.015)
    assert abs(found.response.total - dead_time - lag) < 3 * found.deviation + 0.005
    assert found.samples > 20


@pytest.mark.parametrize(("dead_time", "lag"), RESPONSES)
def test_they_are_found_by_a_noisy_compass_on_a_truck_that_turns_less_and_pulls_to_a_side(dead_time, lag):
    found = estimated(Plant(dead_time, lag, 0.18, gain=0.85, trim=0.08), noise=0.003, seconds=60.0)
    assert found.response.total == pytest.approx(dead_time + lag, abs=0.03)


def test_a_straight_says_nothing_and_takes_nothing_away():
    plant, estimator = Plant(0.1, 0.0, 0.5), ResponseEstimator(STEERING, RATE)
    before = estimated(plant, estimator=estimator)
    for k in range(400):
        t = 20.0 + k * PERIOD
        estimator.observe(t, plant.pose[2], plant.speed)
        estimator.request(t, (0.0, 0.0))
        plant.period((0.0, 0.0))
    assert estimator.estimate.samples <= before.samples + 30
    assert estimator.estimate.response.total == pytest.approx(before.response.total, abs=0.005)


def test_a_change_is_followed():
    estimator = ResponseEstimator(STEERING, RATE)
    estimated(Plant(0.0, 0.0, 0.5), estimator=estimator)
    estimator.forget_requests()
    found = estimated(Plant(0.15, 0.0, 0.5), estimator=estimator, begin=21.0, seconds=60.0)
    assert found.response.total == pytest.approx(0.15, abs=0.02)


def test_turns_that_were_not_requested_or_not_measured_alike_teach_nothing():
    estimator = ResponseEstimator(STEERING, RATE)
    for k in range(60):
        estimator.forget_requests()
        estimator.request(k * PERIOD, (0.3 * (-1) ** (k // 8), 0.0))
        assert not estimator.observe(k * PERIOD, 0.1 * k, 0.5)
    for k in range(60, 120):
        estimator.request(k * PERIOD, (0.3 * (-1) ** (k // 8), 0.0))
        assert not estimator.observe(k * PERIOD, 0.1 * k, 0.5, measured=k % 2 == 0)
    assert estimator.estimate.samples == 0


def test_what_is_configured_counts_until_it_is_contradicted():
    configured = Response(0.05, 0.0)

    def near(dead_time, lag, deviation=0.005):
        return ResponseEstimate(Response(dead_time, lag), deviation, deviation, 10)

    assert choose(configured, configured, near(0.08, 0.0)) is configured
    assert choose(configured, configured, near(0.15, 0.0, 0.04)) is configured, "not sure yet"
    other = choose(configured, configured, near(0.15, 0.0))
    assert other.total == pytest.approx(0.15)
    assert choose(other, configured, near(0.155, 0.0)) is other, "hardly moved"
    assert choose(other, configured, near(0.055, 0.0)) is configured
    assert choose(configured, configured, near(0.0, 0.05, 0.001)) is configured
    assert choose(Response(0.15, 0.0), Response(0.15, 0.0), near(0.05, 0.1)) == (pytest.approx(0.05), 0.1)


def test_delay_is_dead_time_until_it_shows_what_of_it_is_lag():
    assert rounded(ResponseEstimate(Response(0.05, 0.08), 0.01, 0.04, 9)) == (pytest.approx(0.13), 0.0)
    assert rounded(ResponseEstimate(Response(0.05, 0.08), 0.01, 0.01, 9)) == (pytest.approx(0.03), 0.1)


def test_axles_are_computed_anew_when_they_turn_out_to_answer_otherwise():
    late, known = AxleModel(0.0, 0.0, 5.0), AxleModel(0.15, 0.05, 5.0)
    for k in range(30):
        for axles in (late, known):
            axles.advance(k * PERIOD)
            axles.request(k * PERIOD, (0.02 * (k % 7), 0.0))
    late.respond(Response(0.15, 0.05))
    assert late.angles == pytest.approx(known.angles, abs=1e-3)
    late.advance(1.5)
    known.advance(1.5)
    assert late.angles == pytest.approx(known.angles, abs=1e-3)


def lap(kind, speed, plant, **config):
    """Greatest error on a figure of eight from 5 cm off, the first metre left out, and the tracker."""
    route = path(figure_eight(2.0))
    more = {"lookahead": 0.6, "min_lookahead": 0.2, "lookahead_time": 0.4} if kind == "pure_pursuit" else {}
    common = {"speed": speed, "steering_rate": RATE, "steering": "counter", "lateral_acceleration": 9.0}
    truck = Follower(route, pose=(0.0, 0.05, 0.78), kind=kind, **common, **more, **config)
    truck_at = Plant(*plant, speed, truck.pose)
    errors, outcome = [], Reason.DRIVING
    for k in range(2000):
        state = TruckState(truck_at.pose, STEERING.body_twist(speed, *truck_at.angles)[0])
        command = truck.tracker.control(state, truck.path, truck.progress, k * PERIOD)
        truck.progress, outcome = command.progress, command.outcome
        if outcome is not Reason.DRIVING:
            break
        if truck.path.along(command.progress) > 1.0:
            errors.append(command.cross_track)
        truck_at.period((command.front, command.rear))
    return float(np.sqrt(np.mean(np.square(errors)))), outcome, truck.tracker


@cache
def bound(plant):
    """Error of a tracker that knows the response."""
    return lap("pure_pursuit", 1.0, plant, dead_time=plant[0], lag=plant[1])[0]


@pytest.mark.parametrize("config", [{}, {"dead_time": 0.05}, {"dead_time": 0.15}, {"dead_time": 0.0, "lag": 0.0}])
@pytest.mark.parametrize("plant", [(0.0, 0.0), (0.05, 0.1), (0.15, 0.0)])
@pytest.mark.parametrize("kind", MODELS)
def test_an_unknown_or_wrong_response_costs_little(kind, plant, config):
    error, outcome, tracker = lap(kind, 1.0, plant, **config)
    assert outcome is not Reason.PATH_LOST
    assert error < 1.5 * bound(plant)
    assert tracker.response.total == pytest.approx(sum(plant), abs=0.035)
    wrong = bool(config) and abs(config["dead_time"] - sum(plant)) > 0.04
    assert tracker.contradicted or not wrong


@pytest.mark.parametrize("plant", [(0.0, 0.0), (0.05, 0.1), (0.15, 0.0)])
@pytest.mark.parametrize("kind", ["lqr", "mpc"])
def test_a_right_configuration_is_never_contradicted(kind, plant):
    error, _, tracker = lap(kind, 1.0, plant, dead_time=plant[0], lag=plant[1])
    assert error < 0.004
    assert not tracker.contradicted
    assert tracker.response == plant


def message(now):
    return {"stamp": now, "received": now, "seq": 0}


@pytest.mark.parametrize(("holder", "learns"), [("tracker", True), ("keyboard", False)])
def test_the_step_reports_what_is_configured_wrongly_by_the_compass(holder, learns):
    """Odometry that takes its yaw from the requests would hide the delay."""
    more = {"dead_time": 0.0, "steering_rate": RATE, "speed": 0.5, "kind": "lqr"}
    truck = Follower(path(figure_eight(1.5), closed=True), pose=(0.0, 0.0, 0.8), **more)
    step = TrackingStep(TrackSetup(truck.config, STEERING, Footprint(), (0.14, 0.0, 0.0)))
    plant, route, reasons, output = Plant(0.15, 0.0, 0.5, truck.pose), path(figure_eight(1.5), closed=True), [], None
    for k in range(200):
        now = 10**9 + k * 50_000_000
        x, y, yaw = plant.pose
        pose = Odometry(
            **message(now), frame="odom", pose=Pose2D(x=x, y=y, yaw=yaw), twist=Twist2D(vx=0.5, vy=0.0, wz=0.0),
            pose_covariance=np.zeros(9), twist_covariance=np.zeros(9), age=0.0, sources=(),
        )  # fmt: skip
        gate = GateState(**message(now), mode=GateMode.DRIVING, nonce="n", holder=holder, speed_limit=1.0)
        compass = Attitude(**message(now), heading=-yaw % math.tau, roll=0.0, pitch=0.0)
        output = step.step(now, Newest(pose, route, gate, None, compass))
        reasons += [event.reason for event in output.events]
        plant.period((output.command.front, output.command.rear))
    assert (Reason.RESPONSE_DIFFERS in reasons) is learns
    assert reasons.count(Reason.RESPONSE_DIFFERS) <= 1
    if learns:
        assert output.axles.delay == pytest.approx(0.15, abs=0.02)
        assert output.axles.dead_time + output.axles.lag == pytest.approx(0.15, abs=0.02)
    else:
        assert output.axles.dead_time + output.axles.lag == 0.0


def test_nothing_is_reported_of_a_truck_that_nobody_configured():
    step = TrackingStep(TrackSetup(Follower(path(straight())).config, STEERING, Footprint(), (0.14, 0.0, 0.0)))
    assert not step._axles().samples
    assert step._drain() == ()
