"""Measures of estimates against the truth, on cases whose results are known."""

import math

import numpy as np
import pytest

from benchmarks import scoring
from monstertruck_planners.collision import DistanceField, Footprint


def test_a_trajectory_is_scored_without_alignment():
    truth = np.column_stack((np.linspace(0.0, 2.0, 5), np.zeros(5), np.zeros(5)))
    score = scoring.trajectory(truth + np.array((0.03, 0.04, math.tau + 0.1)), truth)
    assert score == pytest.approx({"ate_m": 0.05, "max_m": 0.05, "end_m": 0.05, "end_rad": 0.1, "driven_m": 2.0})


def test_relative_errors_do_not_see_where_it_began():
    stamps = np.arange(0.0, 5.0, 0.5)
    truth = np.column_stack((0.2 * stamps, np.zeros(10), np.zeros(10)))
    estimate = np.column_stack((np.ones(10), 0.22 * stamps, np.full(10, math.pi / 2)))  # elsewhere, 10 % too far
    assert scoring.relative(stamps, estimate, truth, 1.0) == pytest.approx(0.02)


def test_poses_between_stamps_turn_the_short_way():
    poses = np.array([[0.0, 0.0, 3.1], [1.0, 2.0, -3.1]])
    ((x, y, yaw),) = scoring.at(np.array([0.0, 1.0]), poses, np.array([0.5]))
    assert (x, y, yaw) == pytest.approx((0.5, 1.0, math.pi), abs=1e-9)


def test_a_wall_drawn_beside_the_true_one_is_off_by_its_distance():
    true = np.zeros((40, 40), bool)
    true[:, 20] = True
    world = DistanceField(np.pad(true, 10, mode="edge"), 0.05, (-0.5, -0.5, 0.0))  # its edge counts as a wall
    cells = np.where(true, 100, 0).astype(np.int8)
    exact = scoring.map_error(cells, (0.0, 0.0), 0.05, world)
    moved = scoring.map_error(np.roll(cells, 2, axis=1), (0.0, 0.0), 0.05, world)
    assert exact["wall_mean_m"] == pytest.approx(0.0, abs=1e-6)
    assert exact["false_free_share"] == 0.0
    assert moved["wall_mean_m"] == pytest.approx(0.1, abs=1e-6)
    assert moved["false_free_share"] > 0.0
    overlaps = [scoring.wall_iou(np.roll(cells, k, axis=1), (0.0, 0.0), 0.05, world, 0.06) for k in (0, 2)]
    assert overlaps[0] == 1.0
    assert overlaps[1] < 0.5


def test_distance_from_a_line_and_clearance_of_a_footprint():
    line = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    assert scoring.distance(np.array([[0.5, 0.2], [1.3, 0.5], [1.0, 1.4]]), line) == pytest.approx([0.2, 0.3, 0.4])
    wall = np.zeros((80, 80), bool)
    wall[:, 60] = True
    room = scoring.clearance(DistanceField(wall, 0.05), Footprint(padding=0.0), np.array([[2.0, 2.0, 0.0]]))
    assert room == pytest.approx(3.0 - 2.235, abs=0.06)


def test_the_sharpest_turn_of_a_line_of_points():
    angles = np.linspace(0.0, 3.0, 400)
    assert scoring.sharpest(0.5 * np.column_stack((np.cos(angles), np.sin(angles)))) == pytest.approx(2.0, rel=1e-3)
    assert scoring.sharpest(np.array([[0.0, 0.0], [0.05, 0.0], [0.05, 0.05]])) == pytest.approx(math.pi / 2 / 0.05)


def test_a_period_without_an_instant_is_missed():
    assert scoring.missed([0.05, 0.1, 0.35, 0.9], 0.0, 1.0, 0.2) == pytest.approx(0.4)
    assert scoring.missed([], 2.0, 3.0, 0.2) == 1.0


@pytest.mark.parametrize(("limit", "found"), [(7.0, (7.0, 7.7)), (0.5, (1.0, 1.0)), (99.0, (math.inf, math.inf))])
def test_the_first_factor_that_misses_is_bisected(limit, found):
    tried = []

    def share(factor):
        tried.append(factor)
        return 0.02 if factor >= limit else 0.01

    least, most = found
    assert least <= scoring.first_miss(share, (1.0, 3.0, 12.0, 40.0), 0.01, 1.1) <= most
    assert len(tried) < 10
