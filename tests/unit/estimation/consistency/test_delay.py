"""The delay of the scans' content against other measures, from motion that changes."""

import math

import numpy as np
import pytest

from monstertruck_estimation.consistency.comparison import Measure, errors_of
from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_estimation.consistency.delay import SIGMAS, ScanStep, lag_question, scan_delay
from monstertruck_estimation.consistency.tracks import MotionTrack
from monstertruck_runtime.clock import SECOND

STEP = SECOND // 10
ERRORS = errors_of(ConsistencyConfig())
NEWEST = 40
"""Steps of which the lag is found."""


def swinging(at):
    """Way (m) and turn (rad) of a robot that swings to and fro, at a time in s."""
    return 0.2 * at, 0.4 * math.sin(1.3 * at)


def starting(at):
    """Way and turn of a robot that sets off straight ahead after 9 s, with 0.3 m/s^2 up to 0.3 m/s."""
    seconds = max(at - 9.0, 0.0)
    return 0.15 * seconds**2 if seconds < 1.0 else 0.3 * seconds - 0.15, 0.0


def delay_of(seconds, slip=1.0, way=swinging, measure=Measure.WHEELS, deviations=(0.01, 0.003), silent=0):
    """Lag that is found of scans this late; the registration's errors are as great as it states.

    The other measure has not been heard for the last ``silent`` steps.
    """
    track, steps, rng = MotionTrack(), [], np.random.default_rng(2)
    noise = rng.normal(0.0, deviations, (121, 2))

    def moved(at):
        return np.subtract(way(at), way(at - 0.1))

    for k in range(120):
        at = k / 10
        ahead, turn = moved(at)
        if k < 120 - silent:
            track.add(SECOND + k * STEP, (float(ahead), 0.0, float(turn)))
        shown = moved(at - seconds) * slip + noise[k + 1] - noise[k]
        steps.append(ScanStep(SECOND + (k - 1) * STEP, SECOND + k * STEP, tuple(shown.tolist()), deviations))
    return scan_delay(lag_question(steps[-NEWEST:], [(ERRORS[measure], track)], 0.2))


@pytest.mark.parametrize("seconds", [0.5, 0.8, 1.1])
@pytest.mark.parametrize("slip", [0.7, 1.0])
@pytest.mark.parametrize("measure", [Measure.WHEELS, Measure.GYRO])
def test_a_delay_is_found(seconds, slip, measure):
    slip = 1.0 if measure is Measure.GYRO else slip
    delay = delay_of(seconds, slip, measure=measure)
    assert delay.seconds == pytest.approx(seconds, abs=0.1)
    assert delay.sigmas > SIGMAS


@pytest.mark.parametrize("way", [swinging, starting])
@pytest.mark.parametrize("seconds", [-0.2, 0.0, 0.1, 0.2])
@pytest.mark.parametrize("slip", [0.7, 1.0])
def test_a_tolerated_one_is_none(seconds, way, slip):
    assert delay_of(seconds, slip, way) is None


@pytest.mark.parametrize("silent", [3, 6])
def test_a_measure_that_is_behind_is_compared_with_the_scans_of_its_time(silent):
    assert delay_of(0.8, silent=silent).seconds == pytest.approx(0.8, abs=0.1)
    assert delay_of(-0.1, silent=silent) is None


def test_a_start_straight_ahead_shows_it():
    assert delay_of(0.8, way=starting).seconds == pytest.approx(0.8, abs=0.1)


def test_steady_motion_says_nothing():
    assert delay_of(0.8, way=lambda at: (0.2 * at, 0.2 * at)) is None


def test_scans_that_nothing_constrains_say_nothing():
    """In a corridor the registration states how little it knows of the way along it."""
    assert delay_of(0.8, way=starting, deviations=(0.3, 0.003)) is None


def test_measures_that_contradict_each_other_find_none():
    """The wheels are late themselves: what fits one measure does not fit the other."""
    tracks = {}
    for measure, late in ((Measure.WHEELS, -0.8), (Measure.GYRO, 0.0)):
        track = tracks.setdefault(measure, MotionTrack())
        for k in range(120):
            ahead, turn = np.subtract(swinging(k / 10 - late), swinging(k / 10 - late - 0.1)).tolist()
            track.add(SECOND + k * STEP, (ahead, 0.0, turn))
    steps = []
    for k in range(120):
        shown = np.subtract(swinging(k / 10), swinging(k / 10 - 0.1)).tolist()
        steps.append(ScanStep(SECOND + (k - 1) * STEP, SECOND + k * STEP, tuple(shown), (0.01, 0.003)))
    others = [(ERRORS[measure], track) for measure, track in tracks.items()]
    assert scan_delay(lag_question(steps[-NEWEST:], others[:1], 0.2)) is not None
    assert scan_delay(lag_question(steps[-NEWEST:], others, 0.2)) is None


def test_a_change_that_the_scans_do_not_show_is_no_delay():
    """Stuck encoders claim a turn that never comes: it may be the other measure that is wrong."""

    def jumping(at):
        return 0.2 * at, max(0.0, at - 11.4)

    track, steps = MotionTrack(), []
    for k in range(120):
        now, before = jumping(k / 10), jumping((k - 1) / 10)
        track.add(SECOND + k * STEP, (now[0] - before[0], 0.0, now[1] - before[1]))
        steps.append(ScanStep(SECOND + (k - 1) * STEP, SECOND + k * STEP, (0.02, 0.0), (0.01, 0.003)))
    assert scan_delay(lag_question(steps[-NEWEST:], [(ERRORS[Measure.ENCODERS], track)], 0.2)) is None
