"""Beams by their directions, clockwise and counter-clockwise."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_kinematics.beams import is_full_turn, nearest_beams

angles = st.floats(-2 * math.tau, 2 * math.tau)


@given(
    start=angles,
    count=st.integers(2, 2000),
    share=st.floats(0.01, 0.999),
    clockwise=st.booleans(),
    turns=st.integers(-2, 2),
)
def test_each_beam_is_nearest_to_its_own_direction(start, count, share, clockwise, turns):
    step = (-1 if clockwise else 1) * share * math.tau / count
    bearings = start + step * np.arange(count) + turns * math.tau
    assert nearest_beams(bearings, start, step).tolist() == list(range(count))


@given(start=angles, count=st.integers(3, 2000), clockwise=st.booleans(), bearing=angles)
def test_of_a_full_turn_some_beam_is_within_half_a_step_of_every_direction(start, count, clockwise, bearing):
    step = (-1 if clockwise else 1) * math.tau / count
    (beam,) = nearest_beams(np.array([bearing]), start, step).tolist()
    off = math.remainder(bearing - start - step * (beam % count), math.tau)
    assert abs(off) <= abs(step) / 2 + 1e-9
    assert 0 <= beam <= count
    assert is_full_turn(count, step)


@pytest.mark.parametrize("step", [0.01, -0.01])
def test_no_beam_looks_beyond_the_field(step):
    beams = nearest_beams(np.array([0.0, 100 * step, -step, 101 * step, math.pi]), 0.0, step)
    assert beams[:2].tolist() == [0, 100]
    assert (beams[2:] > 100).all()
    assert not is_full_turn(101, step)


def test_a_single_beam_is_nearest_to_all_and_no_full_turn():
    assert nearest_beams(np.array([0.3, -2.0]), 0.3, 0.0).tolist() == [0, 0]
    assert not is_full_turn(1, math.tau)
