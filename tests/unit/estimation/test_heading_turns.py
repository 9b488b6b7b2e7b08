"""Turns of headings, compared with those of the robot."""

import math

import pytest

from monstertruck_estimation.heading_turns import HeadingTurns

LONGEST_TURN = 3.0


def contradicted(share, turn=1.0, distance=1.0, start=3.0, steps=40):
    """Whether headings that show ``share`` of a turn, rad, over a distance, m, turn against it."""
    turns = HeadingTurns()
    for k in range(steps + 1):
        turns.observe(math.remainder(start + share * turn * k / steps, math.tau))
        turns.moved(turn / steps, distance / steps)
    return turns.contrary is not None


@pytest.mark.parametrize("turn", [1.0, -1.0, 7.0])
def test_headings_that_turn_the_other_way_are_contrary(turn):
    assert contradicted(-1.0, turn)
    assert contradicted(-0.6, turn)
    assert not contradicted(1.0, turn)
    assert not contradicted(0.0, turn), "stuck, or slipping wheels: nobody knows who is right"


def test_a_slow_drift_is_no_turn_and_a_spot_turn_is_one():
    assert not contradicted(-1.0, turn=0.5, distance=3 * LONGEST_TURN)
    assert contradicted(-1.0, turn=0.5, distance=0.0)
    assert not contradicted(-1.0, turn=0.2)


def test_they_count_again_once_they_turn_along():
    turns, heading = HeadingTurns(), 0.0
    for share in (-1.0, 0.0, 1.0):
        for _ in range(20):
            turns.moved(0.05, 0.02)
            heading += 0.05 * share
            changed = turns.observe(heading)
        assert (turns.contrary is None) is (share > 0.0)
    assert not changed


def test_what_was_before_a_disturbance_is_not_compared():
    turns = HeadingTurns()
    turns.observe(0.0)
    turns.moved(0.2, 0.1)
    turns.observe(-0.2)
    turns.forget()
    turns.moved(0.2, 0.1)
    assert not turns.observe(-0.4)
    assert turns.contrary is None
