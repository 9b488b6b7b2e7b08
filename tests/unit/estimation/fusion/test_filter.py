import math
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import Phase, given, settings

from monstertruck_estimation.fusion.estimator import MeasurementHistory
from monstertruck_estimation.fusion.filter import (
    HeadingMeasurement,
    ScanClone,
    ScanMeasurement,
    WheelMeasurement,
    apply_measurement,
    initial_state,
    predict,
)
from monstertruck_kinematics.se2 import between, between_jacobians
from monstertruck_runtime.clock import SECOND
from tests.unit.estimation.fusion.kit import config

CONFIG = config()
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)
small = st.floats(-0.3, 0.3)
spread = st.floats(-4.0, 1.0).map(lambda exponent: 10.0**exponent)
deltas = st.tuples(small, small, small).map(np.array)
noises = st.tuples(spread, spread, spread).map(lambda sigmas: np.diag(np.square(sigmas)))
steps = st.lists(
    st.tuples(st.integers(1, SECOND), st.sampled_from(("wheels", "scan", "heading", "mark")), deltas, noises),
    max_size=15,
)


def measurements(drawn):
    now, since = SECOND, {"wheels": SECOND, "scan": SECOND}
    for dt, kind, delta, noise in drawn:
        now += dt
        if kind == "wheels":
            yield WheelMeasurement(since[kind], now, delta, noise, slipping=bool(dt % 2))
        elif kind == "scan":
            yield ScanMeasurement(since[kind], now, delta, noise)
        elif kind == "mark":
            yield ScanClone(now, noise)
            since["scan"] = now
        else:
            yield HeadingMeasurement(now, float(delta[0] * 20), tilt=(float(delta[1]), float(delta[2])))
        if kind in since:
            since[kind] = now


@settings(deadline=None, max_examples=25, phases=PHASES)
@given(steps)
def test_the_covariance_stays_symmetric_and_positive(drawn):
    state = initial_state(SECOND, CONFIG)
    for measurement in measurements(drawn):
        state = apply_measurement(state, measurement, CONFIG)
        assert state.covariance == pytest.approx(state.covariance.T, abs=0.0)
        # Clones are copies: exactly singular at the instant they are made, so the bound is a rounding below 0.
        values = np.linalg.eigvalsh(state.covariance)
        assert values[0] > -1e-9 * max(values[-1], 1.0)
        assert np.linalg.eigvalsh(state.covariance[:3, :3])[0] > -1e-12
        assert np.isfinite(state.mean).all()


@settings(deadline=None, max_examples=10, phases=PHASES)
@given(steps, st.randoms(use_true_random=False))
def test_the_order_in_which_measurements_come_does_not_matter(drawn, random):
    made = list(measurements(drawn))
    histories = []
    for shuffled in (made, random.sample(made, len(made))):
        history = MeasurementHistory(
            initial_state(SECOND, CONFIG), lambda state, op: apply_measurement(state, op, CONFIG), 10**12
        )
        assert all(history.insert(measurement) for measurement in shuffled)
        history.catch_up(history.waiting)
        histories.append(history.newest)
    assert histories[0].mean == pytest.approx(histories[1].mean, abs=0.0)
    assert histories[0].covariance == pytest.approx(histories[1].covariance, abs=0.0)


def counted():
    """A history of thirty headings, a tenth of a second apart, and the measurements it applied."""
    calls = []

    def advance(state, measurement):
        calls.append(measurement)
        return apply_measurement(state, measurement, CONFIG)

    history = MeasurementHistory(initial_state(SECOND, CONFIG), advance, 10**12)
    for k in range(30):
        history.insert(HeadingMeasurement(SECOND + k * SECOND // 10, 0.1))
    calls.clear()
    return history, calls


def flagged(measurement):
    return replace(measurement, disturbed=True)


def test_what_is_rewritten_is_redone_a_few_at_a_time_and_then_takes_over():
    (history, calls), (at_once, _) = counted(), counted()
    before = history.newest
    history.rewrite(2 * SECOND, flagged)
    at_once.rewrite(2 * SECOND, flagged)
    at_once.catch_up(at_once.waiting)
    assert not calls
    for done in (7, 14):
        history.catch_up(7)
        assert len(calls) == done
        assert history.newest is before
    history.catch_up(7)
    assert (len(calls), history.waiting) == (19, 0)
    assert history.newest.mean == pytest.approx(at_once.newest.mean, abs=0.0)
    assert history.newest.gate.disturbed
    assert not before.gate.disturbed


def test_while_something_waits_the_belief_goes_on_as_it_was():
    (history, calls), (at_once, _) = counted(), counted()
    for one in (history, at_once):
        one.rewrite(2 * SECOND, flagged)
    at_once.catch_up(at_once.waiting)
    history.catch_up(7)
    calls.clear()
    for one in (history, at_once):
        assert one.insert(HeadingMeasurement(4 * SECOND, 0.1))
        assert one.insert(HeadingMeasurement(3 * SECOND + 1, 0.1))
    assert len(calls) == 1
    assert history.newest.stamp == 4 * SECOND
    assert not history.newest.gate.disturbed
    for one in (history, at_once):
        one.catch_up(one.waiting)
    assert history.newest.covariance == pytest.approx(at_once.newest.covariance, abs=0.0)
    assert history.newest.gate == at_once.newest.gate


def test_what_is_before_the_horizon_is_forgotten():
    history = MeasurementHistory(
        initial_state(SECOND, CONFIG), lambda state, op: apply_measurement(state, op, CONFIG), SECOND
    )
    for k in range(30):
        assert history.insert(HeadingMeasurement(SECOND + k * SECOND // 10, 0.1))
    assert not history.insert(HeadingMeasurement(SECOND + SECOND // 20, 0.1))
    assert history.reaches(3 * SECOND)
    assert not history.reaches(2 * SECOND)


def test_a_prediction_in_two_steps_is_one_prediction():
    state = initial_state(SECOND, CONFIG)
    at_once = predict(state, 2 * SECOND, CONFIG)
    in_steps = predict(predict(state, 3 * SECOND // 2, CONFIG), 2 * SECOND, CONFIG)
    assert in_steps.mean == pytest.approx(at_once.mean)
    assert predict(state, SECOND // 2, CONFIG) is state


def test_a_scan_that_says_nothing_along_a_corridor_changes_nothing_along_it():
    state = initial_state(SECOND, CONFIG)
    noise = np.diag((1e4, 1e-6, 1e-6))
    state = apply_measurement(state, ScanClone(SECOND, noise), CONFIG)
    before = predict(state, 2 * SECOND, CONFIG)
    after = apply_measurement(state, ScanMeasurement(SECOND, 2 * SECOND, np.array((5.0, 0.0, 0.0)), noise), CONFIG)
    assert after.mean[0] == pytest.approx(before.mean[0], abs=1e-3)
    assert after.covariance[0, 0] == pytest.approx(before.covariance[0, 0], rel=1e-3)
    assert after.covariance[1, 1] < 1e-3 * before.covariance[1, 1]


def test_errors_of_scans_matched_to_one_map_do_not_add_up():
    noise = np.diag((0.01**2, 0.01**2, 0.005**2))
    state = apply_measurement(initial_state(SECOND, CONFIG), ScanClone(SECOND, noise), CONFIG)
    for k in range(400):
        since = SECOND + k * SECOND // 10
        state = apply_measurement(state, ScanMeasurement(since, since + SECOND // 10, np.zeros(3), noise), CONFIG)
    # The error of the first place, the drift of the map, and little else; independent motions would make 0.28 m.
    assert math.sqrt(state.covariance[0, 0]) < 0.03


def test_the_jacobians_of_a_motion_between_poses():
    origin, target, step = np.array((1.0, -2.0, 0.7)), np.array((1.4, -1.5, 1.1)), 1e-6
    by_origin, by_target = between_jacobians(origin, target)
    for k in range(3):
        off, here = step * np.eye(3)[k], between(origin, target)
        assert by_origin[:, k] == pytest.approx((between(origin + off, target) - here) / step, abs=1e-5)
        assert by_target[:, k] == pytest.approx((between(origin, target + off) - here) / step, abs=1e-5)
