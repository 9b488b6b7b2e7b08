"""The parts trackers are made of: axles, reference, ground, rules, gains."""

import math

import numpy as np
import pytest

from monstertruck_estimation.ground.terrain import TerrainEstimator
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.config import PurePursuitConfig
from monstertruck_planners.track.error_model import discretise, exponential, riccati
from monstertruck_planners.track.fuzzy import FuzzyInputs, Rules
from monstertruck_planners.track.path_tracker import AxleModel, SpeedProfile
from monstertruck_planners.track.segments import RunStates, SegmentedPath
from tests.unit.planners.kit import STEERING, circle, figure_eight, path, straight


def course(route, mode="counter", geometry=STEERING):
    line = SegmentedPath(route, (0.0, 0.0, 0.0), 0.8)
    return RunStates(line.runs[0], geometry, mode)


@pytest.mark.parametrize(("lag", "rate"), [(0.1, 5.0), (0.1, 0.5), (0.0, 1.0)])
def test_axles_follow_after_the_dead_time_by_lag_and_rate(lag, rate):
    axles = AxleModel(0.05, lag, rate)
    axles.advance(0.0)
    axles.request(0.0, (0.3, -0.1))
    simulated, dt = 0.0, 1e-4
    for k in range(1, 61):
        axles.advance(0.01 * k)
        for i in range(100):
            if (k - 1) * 0.01 + i * dt >= 0.05:
                gap = 0.3 - simulated
                step = gap if lag == 0.0 else gap * dt / lag
                simulated += math.copysign(min(abs(step), rate * dt), gap)
        assert axles.angles[0] == pytest.approx(simulated, abs=2e-3)
    assert axles.requested == (0.3, -0.1)


def test_a_request_due_at_the_very_step_counts():
    axles = AxleModel(0.05, 0.0, 100.0)
    axles.advance(0.0)
    axles.request(0.0, (0.2, 0.0))
    axles.advance(0.05)
    axles.advance(0.1)
    assert axles.angles == pytest.approx((0.2, 0.0))


def test_the_pose_is_predicted_over_the_dead_time():
    axles = AxleModel(0.2, 0.0, 100.0)
    axles.advance(0.0)
    axles.request(0.0, (0.3, -0.3))
    axles.advance(0.1)
    pose, angles = axles.ahead((0.0, 0.0, 0.0), 0.5, STEERING, 0.2)
    straight_on = (0.05, 0.0, 0.0)
    assert pose == pytest.approx(STEERING.integrate(straight_on, *STEERING.body_twist(0.5, 0.3, -0.3), 0.1), abs=1e-3)
    assert angles == pytest.approx((0.3, -0.3))


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("mode", ["front", "rear", "counter", "hybrid"])
def test_on_a_circle_the_reference_is_the_steady_turn(mode, direction):
    route = circle(1.0, 0.5, 0.005)
    found = course(path(route, [direction] * len(route)), mode).state(1.5)
    assert found.curvature == pytest.approx(1.0, rel=0.01)
    front, rear = STEERING.steer_for(found.turn, found.slip)
    fixed = {"front": rear, "rear": front}.get(mode, front + rear)
    assert fixed == pytest.approx(0.0, abs=4e-3)
    assert direction * STEERING.curvature(front, rear) == pytest.approx(1.0, rel=0.01)


def test_one_spot_is_as_one_of_many():
    found = course(path(figure_eight(), closed=True), "front")
    places = np.concatenate(
        (np.random.default_rng(1).uniform(-0.5, found.places[-1] + 0.5, 100), found.places[[0, 7, -1]])
    )
    expected = np.column_stack(found.at(places))
    assert np.array([found.state(s) for s in places.tolist()]) == pytest.approx(expected, abs=1e-12)


def test_the_pace_lets_every_curve_ahead_be_reached_slowly_enough():
    config = PurePursuitConfig(lateral_acceleration=0.02, deceleration=0.05, steering_distance=0.1, steering_rate=0.5)
    line = SegmentedPath(path(figure_eight(), closed=True), (0.0, 0.0, 0.0), 0.8)
    found = RunStates(line.runs[0], STEERING, "front")
    pace = SpeedProfile(config, line.runs[0], found)
    s = found.places
    speed = np.array([pace.at(place) for place in s.tolist()])
    curvature = np.maximum(np.abs(found.at(s).curvature), 1e-6)
    assert (speed**2 * curvature <= config.lateral_acceleration + 1e-9).all()
    assert (
        speed * found.axle_change(config.steering_distance) <= config.steering_distance * config.steering_rate + 1e-9
    ).all()
    assert (np.diff(speed**2) >= -2 * config.deceleration * np.diff(s) - 1e-9).all()
    for i in range(0, len(s), 25):  # and no slower than that
        bound = np.minimum(
            config.lateral_acceleration / curvature[i:], (0.05 / np.maximum(found.axle_change(0.1)[i:], 1e-6)) ** 2
        )
        assert speed[i] ** 2 == pytest.approx((bound + 0.1 * (s[i:] - s[i])).min())
    assert pace.at(-1.0) == speed[0]
    assert pace.at(s[-1] + 1.0) == speed[-1]


def test_points_rounded_to_millimetres_do_not_shake_the_reference():
    exact, rounded = circle(1.0, 0.5, 0.025), np.round(circle(1.0, 0.5, 0.025), 3)
    s = np.linspace(0.2, 2.8, 200)
    difference = course(path(rounded)).at(s).heading - course(path(exact)).at(s).heading
    assert np.abs(difference).max() < 0.03


def test_sections_end_where_the_steering_changes():
    found = course(path(straight(1.0, 0.1), steering=["counter"] * 6 + ["hybrid"] * 5))
    assert (found.section_end(0.2), found.section_end(0.7)) == pytest.approx((0.5, 1.0))
    assert (found.steering(0.2), found.steering(0.7)) == ("counter", "hybrid")


def test_rough_ground_is_felt_and_forgotten():
    ground = TerrainEstimator(2.0)
    for k in range(100):
        ground.add(0.05 * k, 0.05 * (-1) ** k, 0.0)
    assert ground.roughness == pytest.approx(0.05, rel=0.1)
    assert ground.tilt == pytest.approx(0.05)
    for k in range(100, 300):
        ground.add(0.05 * k, 0.2, 0.1)
    assert ground.roughness < 0.02
    assert ground.tilt == pytest.approx(math.acos(math.cos(0.2) * math.cos(0.1)))


def inferred(published=True, **more):
    values = {"bearing": 0.0, "orientation": 0.0, "distance": 0.6, "aside": 0.0, "direction": 1.0} | more
    return Rules(0.2, 0.05, published).infer(FuzzyInputs(**values))


@pytest.mark.parametrize(
    ("bearing", "share"),
    [(0, 0), (5, 0), (10, 0.25), (15, 0.5), (25, 0.5), (30, 0.75), (35, 1), (165, 1), (170, 0.5), (180, 0)],
)
def test_far_steering_is_as_published(bearing, share):
    assert inferred(bearing=bearing).front == pytest.approx(share)
    assert inferred(bearing=-bearing).front == pytest.approx(-share)


@pytest.mark.parametrize(("offset", "share"), [(0, 0), (0.5, 0.5), (1, 1), (1.5, 2 / 3), (2, 0), (3, 0)])
def test_sideways_steering_is_a_bump_as_published(offset, share):
    assert inferred(aside=0.05 * offset).sideways == pytest.approx(share)


def test_slips_of_the_rules_are_corrected():
    assert inferred(False, aside=0.2).sideways == pytest.approx(1.0)
    assert inferred(False, aside=0.05, direction=-1.0).sideways == pytest.approx(-1.0)
    backing = {"distance": 0.1, "direction": -1.0}
    assert inferred(True, **backing).front is None
    assert inferred(False, **backing).front == 0.0
    assert inferred(True, distance=0.1, orientation=-8).front != -inferred(True, distance=0.1, orientation=8).front
    assert inferred(False, distance=0.1, orientation=-8).front == -inferred(False, distance=0.1, orientation=8).front
    assert (inferred(distance=0.1).speed, inferred(distance=0.3).speed) == (0.5, pytest.approx(0.75))


@pytest.mark.parametrize("speed", [0.2, -0.5])
def test_the_gains_solve_the_riccati_equation(speed):
    model = discretise(FourWheelSteering(), "hybrid", speed, 0.1, 0.05)
    q, r = np.diag([1.0, 0.1, 0.0, 0.0]), np.eye(2) * 1e-3
    p = riccati(model.a, model.b, q, r)
    gain = np.linalg.solve(r + model.b.T @ p @ model.b, model.b.T @ p @ model.a)
    assert model.a.T @ p @ (model.a - model.b @ gain) + q == pytest.approx(p, rel=1e-6, abs=1e-6)
    assert np.abs(np.linalg.eigvals(model.a - model.b @ gain)).max() < 1.0


def test_the_exponential_of_a_stiff_matrix():
    assert exponential(np.array([[0.0, 2.0], [-2.0, 0.0]]))[0, 0] == pytest.approx(math.cos(2.0))
    assert exponential(np.diag([-100.0, 1.0])) == pytest.approx(np.diag([0.0, math.e]))
