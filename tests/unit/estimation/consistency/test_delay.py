"""The delay of the scans' content against the wheels, from motion that changes."""

import math

import pytest

from monstertruck_estimation.consistency.delay import scan_delay
from monstertruck_estimation.consistency.tracks import MotionTrack
from monstertruck_runtime.clock import SECOND

STEP = SECOND // 10


def swinging(at):
    """Turn of a robot that swings to and fro, rad, at a time in s."""
    return 0.4 * math.sin(1.3 * at)


def delay_of(seconds, slip=1.0, turn=swinging, tolerated=0.2):
    track, steps = MotionTrack(), []
    for k in range(120):
        at = k / 10
        track.add(SECOND + k * STEP, (0.02, 0.0, turn(at) - turn(at - 0.1)))
        if k > 50:
            moved = turn(at - seconds) - turn(at - seconds - 0.1)
            steps.append((SECOND + (k - 1) * STEP, SECOND + k * STEP, 0.02 * slip, moved * slip))
    return scan_delay(steps, track, tolerated)


@pytest.mark.parametrize("seconds", [0.4, 0.8, 1.2])
@pytest.mark.parametrize("slip", [0.7, 1.0])
def test_a_delay_is_found(seconds, slip):
    assert delay_of(seconds, slip).seconds == pytest.approx(seconds, abs=0.1)


@pytest.mark.parametrize("seconds", [-0.2, 0.0, 0.1, 0.2])
def test_a_tolerated_one_is_none(seconds):
    assert delay_of(seconds) is None


def test_steady_motion_says_nothing():
    assert delay_of(0.8, turn=lambda at: 0.2 * at) is None
