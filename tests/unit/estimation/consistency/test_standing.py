"""When the scans show a body that stands although its wheels roll."""

import math

import numpy as np
import pytest

from monstertruck_estimation.consistency.standing import StandingWatch, place_covariance, spread
from monstertruck_estimation.slam.registration import CORRELATION, Cloud, Fit, register
from monstertruck_estimation.slam.scans import prepare_input, scans_in_a_room
from monstertruck_runtime.clock import SECOND
from tests.long_kit import mostly_long

PERIOD = SECOND // 10
STEP = 0.005
"""Distance between two scans at 0.05 m/s, m."""
NOISE = 0.002
"""Standard deviation of a place, m."""
ALONG = np.array((-1.0, 0.0, 0.0))


def found(shares, *, direction=ALONG, deviation=0.004, steps=STEP, slip=0.3, delay=0.2, drift=0.012, seed=1):
    """Findings while the body moves by these shares of the wheels' steps: number of the step, and the evidence."""
    rng, watch, offset, out = np.random.default_rng(seed), StandingWatch(slip, delay, drift), 0.0, []
    covariance = deviation**2 * np.eye(3)
    steps = np.broadcast_to(steps, len(shares))
    for k, (share, step) in enumerate(zip(shares, steps, strict=True)):
        noise = NOISE * rng.standard_normal()
        moved = (share * step + noise - offset) * direction
        offset = noise
        if (got := watch.observe(k * PERIOD, (k + 1) * PERIOD, step * direction, moved, covariance)) is not None:
            out.append((k, got))
    return out


@pytest.mark.parametrize("seed", mostly_long(range(20), range(5)))
def test_a_body_that_is_held_is_found_after_four_scans(seed):
    first, body = found([1.0] * 20 + [0.0] * 6, seed=seed)[0]
    assert 21 <= first <= 24
    assert body.stamp == (first + 1) * PERIOD
    assert abs(body.since - 20 * PERIOD) <= 2 * PERIOD
    assert body.rolled == pytest.approx(STEP * (body.stamp - body.since) / PERIOD)
    assert abs(body.shown) < 0.5 * body.rolled


@pytest.mark.parametrize("shares", [[1.0] * 200, [0.7] * 200, [1.0] * 60 + [0.7] * 140, [1.2] * 200, [1.0, 0.7] * 100])
@pytest.mark.parametrize("seed", mostly_long(range(5), [0]))
def test_a_body_that_slips_as_much_as_is_tolerated_is_not(shares, seed):
    assert not found(shares, seed=seed)


@pytest.mark.parametrize("seed", range(5))
def test_scans_that_drift_at_the_end_of_a_docking_show_no_standing_body(seed):
    """The last set-point of a docking, 0.012 m/s, is as small as the drift: the scans show rest."""
    slows = np.maximum(0.05 * 0.94 ** np.arange(40), 0.012)
    steps = np.concatenate((np.full(20, 0.05), slows)) * 0.1
    drifts = np.where(np.arange(60) >= 40, 0.012 * 0.1, 0.0)
    assert not found(1.0 - drifts / steps, steps=steps, seed=seed)
    assert found(1.0 - drifts / steps, steps=steps, seed=seed, drift=0.0)


def test_a_turn_on_the_spot_counts_as_well():
    assert found([1.0] * 20 + [0.0] * 6, direction=np.array((0.0, 0.0, 1.0)))


def test_a_body_held_from_the_start_is_found_without_an_earlier_slope():
    (first, body), *_ = found([0.0] * 14)
    assert first <= 10
    assert body.since >= 3 * PERIOD, "not before the tolerated delay has passed"


def test_where_the_scans_do_not_constrain_the_motion_nothing_is_found():
    assert not found([1.0] * 20 + [0.0] * 10, deviation=0.2)


@pytest.mark.parametrize("speeds", [(0.02, 0.004), (0.004, 0.02), (-0.02, 0.02)])
def test_late_scans_at_a_change_of_velocity_are_not_taken_for_a_standing_body(speeds):
    """The wheels start, then change their velocity; the scans follow 0.4 s later."""
    steps = np.repeat(speeds, 15)
    late = np.concatenate((np.zeros(4), steps[:-4]))
    assert not found(late / steps, steps=steps, delay=0.4)


def test_without_a_tolerated_delay_late_scans_show_a_standing_body():
    steps = np.full(15, 0.02)
    assert found(np.concatenate((np.zeros(6), np.ones(9))), steps=steps, delay=0.0)


def test_wheels_that_stand_or_start_show_nothing():
    watch = StandingWatch(0.3, 0.2, 0.012)
    for k in range(30):
        assert watch.observe(k * PERIOD, (k + 1) * PERIOD, np.zeros(3), np.zeros(3), np.zeros((3, 3))) is None


def test_the_covariance_of_a_place_follows_the_measured_spread():
    scan = prepare_input(scans_in_a_room()[0], 30.0, (0.0, 0.0, 0.0))
    cloud = Cloud.of(scan)
    fit = register(scan, cloud, np.zeros(3))
    assert spread(fit, scan, cloud) < 0.01, "the same points"
    plain = place_covariance(fit, 1.0)
    assert plain == pytest.approx(CORRELATION * np.linalg.inv(fit.information + np.eye(3)), rel=1e-6)
    assert place_covariance(fit, 4.0) == pytest.approx(4.0 * plain)


def test_the_covariance_of_a_place_is_one_in_base():
    """In a corridor along y of the registration, a robot that looks along y is unsure ahead."""
    information = np.diag((1e4, 1.0, 1e6))
    fit = Fit(np.array((0.0, 0.0, math.pi / 2)), information, 1.0, 0.0, 100, 0.0)
    ahead, aside, _ = np.diag(place_covariance(fit, 1.0))
    assert ahead > 1000 * aside
