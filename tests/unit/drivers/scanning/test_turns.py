"""Revolutions of a turning head on equal steps."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from monstertruck_drivers.scanning.turns import MISSING, ArrivalTimes, BeamSamples, TurnCutter, codes_of, on_equal_steps
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM


def samples(turns, begin=0.0, period=1e8, *, falling=False):
    """Of a head that turns evenly; the range tells the angle behind the rear, or the angle left to it."""
    turns = np.asarray(turns, np.float64)
    behind = (turns - 0.5) % 1.0
    return BeamSamples(
        turns % 1.0,
        2.0 - behind if falling else 1.0 + behind,
        np.full(len(turns), 7, np.uint8),
        begin + (turns - 0.5) * period,
    )


@settings(max_examples=60, deadline=None)
@given(
    first=st.floats(0, 1, exclude_max=True),
    count=st.floats(60, 1500),
    pieces=st.integers(1, 40),
    falling=st.booleans(),
)
@example(first=0.5, count=60.0, pieces=1, falling=False)
@example(first=0.0, count=2000 / 5.5, pieces=1, falling=True)
def test_every_whole_turn_comes_once_however_it_is_cut(first, count, pieces, falling):
    turns = first + np.arange(round(3.6 * count)) / count
    cutter, found = TurnCutter(), []
    for part in np.array_split(turns, pieces):
        found += cutter.add(samples(part, falling=falling))
    # a revolution whose first sample is the first of all may have begun before it
    whole = int(np.floor(turns[-1] - 0.5) - (np.floor(first - 0.5) + 1))
    assert len(found) == whole
    for each in found:
        turn = on_equal_steps(each)
        assert len(turn.ranges) == pytest.approx(count, abs=1.0)
        assert np.isfinite(turn.ranges).sum() >= len(turn.ranges) - 1
        angle = 1.0 + turn.first + turn.step * np.arange(len(turn.ranges))
        met = np.isfinite(turn.ranges)
        shown = 3.0 - turn.ranges if falling else turn.ranges
        assert np.abs(np.mod(shown - angle + 0.5, 1.0) - 0.5)[met].max() < 0.51 / count
        assert turn.period == pytest.approx(1e8, rel=1e-6)
        assert (turn.begin - turn.first * 1e8 + 5e7) % 1e8 == pytest.approx(5e7, abs=10.0)


def test_lost_samples_leave_beams_that_say_nothing_and_the_others_in_their_places():
    turns = 0.5 + np.arange(451) / 450
    kept = np.ones(451, bool)
    kept[100:136] = False
    cutter = TurnCutter()
    cutter.add(samples([0.49]))
    (found,) = cutter.add(samples(turns[kept]))
    turn = on_equal_steps(found)
    assert len(turn.ranges) == 450
    assert np.isnan(turn.ranges).nonzero()[0].tolist() == list(range(100, 136))
    assert codes_of(turn, free=True)[[99, 100]].tolist() == [VALID_BEAM, MISSING]


@pytest.mark.parametrize(("free", "code"), [(True, NO_ECHO), (False, MISSING)])
def test_a_beam_without_a_return_is_free_or_says_nothing_as_configured(free, code):
    turns = np.arange(400) / 400
    some = samples(0.5 + turns)._replace(turns=turns, ranges=np.where(np.arange(400) == 7, 0.0, 2.0))
    turn = on_equal_steps(some)
    assert codes_of(turn, free=free)[7] == code
    assert turn.intensities[6:9].tolist() == [7, 0, 7]


def test_of_two_samples_at_one_step_the_nearer_counts():
    turns = np.append(np.arange(400) / 400, 0.2503)
    some = BeamSamples(turns, np.append(np.full(400, 2.0), 1.0), np.append(np.full(400, 9, np.uint8), 4), turns * 1e8)
    turn = on_equal_steps(some)
    assert (turn.ranges[100], turn.intensities[100]) == (1.0, 4)


def test_angles_that_waver_cut_no_turn_twice():
    rng = np.random.default_rng(2)
    turns = 0.2 + np.arange(2000) / 400 + rng.uniform(-0.02, 0.02, 2000)
    cutter = TurnCutter()
    found = [turn for part in np.array_split(turns, 200) for turn in cutter.add(samples(part))]
    assert len(found) == 4


def test_revolutions_without_times_lie_where_their_promptest_sample_came_from():
    rng, times, late = np.random.default_rng(4), ArrivalTimes(1e8 / 400), []
    for number in range(40):
        turns = np.arange(400) / 400
        measured = (number + turns) * 1e8
        delay = rng.uniform(0.0, 2e7, 400) if number % 5 else np.full(400, 2e7)
        found = times.timed(BeamSamples(turns, turns + 1.0, np.full(400, 9, np.uint8), measured + delay))
        late.append(float((found.times - measured).mean()))
    assert max(np.abs(late[1:])) < 2e6, "also where a whole revolution came 20 ms late"
    assert times.timed(samples([0.1, 0.2])).times.tolist() == samples([0.1, 0.2]).times.tolist()


def test_too_few_samples_make_no_turn():
    assert on_equal_steps(samples([0.1, 0.2])) is None
    assert TurnCutter().add(samples([])) == []
