"""People who walk: found in scans, predicted, and whom the robot approaches."""

import math

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_planners.local.config import PeopleConfig
from monstertruck_planners.local.people import PeopleTracker, Walker, meets
from monstertruck_runtime.clock import SECOND

SENSOR = np.zeros(2)
TIMES = np.linspace(0.0, 2.0, 9)
STILL = np.zeros((9, 3))
AHEAD = np.column_stack((0.18 * TIMES, np.zeros((9, 2))))


def seen(x: float, y: float, rng: np.random.Generator) -> np.ndarray:
    """Returns of a person of 0.2 m radius, with the lidar at the origin."""
    bearing, away = math.atan2(y, x), math.hypot(x, y)
    turns = np.arange(-math.asin(0.2 / away), math.asin(0.2 / away), math.radians(0.36))[1:-1]
    ranges = away * np.cos(turns) - np.sqrt(0.2**2 - (away * np.sin(turns)) ** 2) + rng.normal(0, 0.01, len(turns))
    return np.column_stack((ranges * np.cos(bearing + turns), ranges * np.sin(bearing + turns)))


def followed(vx: float, vy: float, scans: int = 12, behind: np.ndarray | None = None):
    """What the tracker says of a person who begins at (2, -0.5)."""
    rng, tracker = np.random.default_rng(1), PeopleTracker(PeopleConfig())
    for i in range(scans):
        points = seen(2.0 + vx * i / 10, -0.5 + vy * i / 10, rng)
        points = points if behind is None else np.vstack((points, behind))
        walkers, walking = tracker.observe(i * SECOND // 10, points, np.zeros(len(points), np.bool_), SENSOR)
    return walkers, walking


@pytest.mark.parametrize(("vx", "vy"), [(0.0, 0.8), (-0.5, 0.0), (0.3, -1.1)])
def test_a_person_who_walks_is_measured(vx: float, vy: float):
    (walker,), walking = followed(vx, vy)
    assert walker.velocity == pytest.approx((vx, vy), abs=0.12)
    assert walker.place == pytest.approx((2.0 + 1.1 * vx, -0.5 + 1.1 * vy), abs=0.12)
    assert walker.radius == pytest.approx(0.2, abs=0.06)
    assert walking.all()


def test_a_person_who_was_hidden_for_a_moment_is_followed_on():
    rng, tracker = np.random.default_rng(1), PeopleTracker(PeopleConfig())
    for i in range(14):
        points = np.zeros((0, 2)) if i in (11, 12) else seen(2.0, -0.5 + 0.08 * i, rng)
        walkers, _ = tracker.observe(i * SECOND // 10, points, np.zeros(len(points), np.bool_), SENSOR)
        assert len(walkers) == (i >= 4 and len(points) > 0), "half of the memory shows a velocity"


def test_a_person_who_stands_or_was_seen_too_shortly_is_an_obstacle():
    assert followed(0.0, 0.0)[0] == ()
    assert followed(0.0, 0.8, scans=3)[0] == ()


def test_a_wall_and_what_is_partly_hidden_do_not_walk():
    tracker = PeopleTracker(PeopleConfig())
    for i in range(12):
        # The gap between two boxes moves along a wall behind them, as seen from a robot that drives past.
        y = 0.05 * i
        left = np.column_stack((np.full(20, 1.0), np.linspace(-2.0, -0.3 + y, 20)))
        through = np.column_stack((np.full(10, 3.0), np.linspace(-0.3 + 3 * y, 0.3 + 3 * y, 10)))
        right = np.column_stack((np.full(20, 1.0), np.linspace(0.3 + y, 2.0, 20)))
        points = np.vstack((left, through, right))
        walkers, _ = tracker.observe(i * SECOND // 10, points, np.zeros(len(points), np.bool_), SENSOR)
        assert walkers == ()


def test_what_the_map_explains_does_not_walk():
    rng, tracker = np.random.default_rng(1), PeopleTracker(PeopleConfig())
    for i in range(12):
        points = seen(2.0, -0.5 + 0.08 * i, rng)
        assert tracker.observe(i * SECOND // 10, points, np.ones(len(points), np.bool_), SENSOR)[0] == ()


def test_a_walker_is_carried_into_another_frame():
    walker = Walker((2.0, 1.0), (0.5, 0.0), 0.2).carried((1.0, 1.0, 0.0), (4.0, 0.0, math.pi / 2))
    assert walker.place == pytest.approx((4.0, 1.0))
    assert walker.velocity == pytest.approx((0.0, 0.5))
    assert walker.radius == 0.2


@pytest.mark.parametrize(
    ("place", "velocity", "expected"),
    [
        ((0.7, -1.0), (0.0, 0.7), True),  # crosses ahead
        ((1.4, -1.6), (0.0, 0.8), False),  # far enough ahead
        ((-0.8, -1.0), (0.0, 0.8), False),  # crosses behind
        ((1.0, 0.0), (0.6, 0.0), False),  # walks away
        ((1.6, 0.0), (-0.6, 0.0), True),  # comes towards the robot
        ((-1.6, 0.0), (0.6, 0.0), False),  # comes from behind: the robot moves away
        ((1.0, 0.9), (-0.6, 0.0), False),  # passes by
    ],
)
def test_the_robot_approaches_whom_it_would_meet_on_its_way(place, velocity, expected):
    walker = Walker(place, velocity, 0.2)
    assert meets((walker,), AHEAD, TIMES, Footprint(), 0.2, 0.1) is expected
    assert not meets((walker,), STILL, TIMES, Footprint(), 0.2, 0.1)
