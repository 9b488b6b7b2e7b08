"""What is remembered of obstacles, and when it is forgotten."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_planners.goals.plan_step import BEAM_WIDTH, SEEN_BEYOND, ObstacleMemory, seen_through

HERE = np.zeros(2)


def ring(radius: float, *gaps: tuple[float, float]) -> np.ndarray:
    """Returns all round, but for some bearings."""
    bearings = np.radians(np.arange(0.0, 360.0, 0.35))
    keep = np.ones(len(bearings), dtype=bool)
    for low, high in gaps:
        keep &= (bearings < low) | (bearings > high)
    return radius * np.column_stack((np.cos(bearings), np.sin(bearings)))[keep]


@pytest.mark.parametrize("bearing", [0.0, 1.0, math.pi, -math.pi, -1e-4, -3.0])
def test_a_place_is_seen_through_if_all_returns_near_its_bearing_lie_beyond(bearing: float):
    place = 2.0 * np.array([[math.cos(bearing), math.sin(bearing)]])
    assert seen_through(place, ring(3.0), HERE)
    assert not seen_through(place, ring(2.0 + 0.9 * SEEN_BEYOND), HERE)
    assert not seen_through(place, ring(1.0), HERE), "something is before it"
    assert not seen_through(place, np.vstack((ring(3.0), 0.995 * place)), HERE), "one beam still meets it"


def test_a_bearing_without_a_return_says_nothing():
    place = np.array([[0.0, 2.0]])
    assert not seen_through(place, ring(3.0, (1.5, 1.64)), HERE)
    assert not seen_through(place, np.empty((0, 2)), HERE)
    assert seen_through(np.empty((0, 2)), ring(3.0), HERE).shape == (0,)


@given(
    places=st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4)), min_size=1, max_size=20),
    points=st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4)), min_size=1, max_size=40),
)
def test_it_agrees_with_looking_at_every_pair(places: list[tuple[float, float]], points: list[tuple[float, float]]):
    expected = []
    for x, y in places:
        near = [
            math.hypot(*point)
            for point in points
            if abs(math.remainder(math.atan2(point[1], point[0]) - math.atan2(y, x), math.tau)) < BEAM_WIDTH
        ]
        expected.append(bool(near) and min(near) > math.hypot(x, y) + SEEN_BEYOND)
    assert seen_through(np.array(places), np.array(points), HERE).tolist() == expected


def test_it_keeps_one_place_a_square_until_a_scan_or_somebody_says_otherwise():
    memory = ObstacleMemory(0.05)
    for _ in range(3):
        memory.keep(np.array([[1.01, 0.01], [1.02, 0.02], [-1.0, 0.0]]))
    assert len(memory.places) == 2
    memory.look(ring(2.0, (3.0, 3.3)), HERE)
    assert memory.places.tolist() == [[-1.0, 0.0]], "behind, where nothing was seen"
    memory.drop_explained(lambda places: places[:, 0] > 0.0)
    assert len(memory.places) == 0


def test_what_is_suspended_waits_until_a_scan_sees_through_it_or_it_counts_again():
    memory = ObstacleMemory(0.05)
    memory.keep(np.array([[1.01, 0.01], [-1.0, 0.0], [-2.0, 0.0]]))
    memory.suspend(np.array([True, True, True]))
    assert (len(memory.places), len(memory.suspended)) == (0, 3)
    memory.look(ring(2.0, (3.0, 3.3)), HERE)
    assert sorted(memory.suspended[:, 0]) == [-2.0, -1.0]
    memory.restore(memory.suspended[:, 0] > -1.5)
    assert (memory.places.tolist(), memory.suspended.tolist()) == ([[-1.0, 0.0]], [[-2.0, 0.0]])
    memory.drop_explained(lambda places: places[:, 0] > 0.0)
    assert (len(memory.places), len(memory.suspended)) == (0, 0)
