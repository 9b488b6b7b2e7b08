"""The grid of the ground: what is felt and seen, found again in messages, files and planes."""

import math

import numpy as np
import pytest

from monstertruck_estimation.ground.grid import FILE, GroundGrid, planes
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.state import GROUND_UNKNOWN, ROUGHNESS_STEP, TILT_STEP


def value(message, layer, x, y):
    column = math.floor((x - message.origin.x) / message.resolution + 1e-9)
    row = math.floor((y - message.origin.y) / message.resolution + 1e-9)
    assert 0 <= column < message.width
    assert 0 <= row < message.height
    return int(getattr(message, layer)[row * message.width + column])


def test_what_was_observed_stands_where_it_was_observed():
    grid = GroundGrid()
    assert grid.empty
    grid.observe(np.array([(1.23, -0.48)]), 0.1, 0.02)
    grid.observe(np.array([(-3.04, 5.01), (-3.06, 5.02)]), 0.2, 0.004)
    message = grid.message(7, 3, "map")
    assert (message.stamp, message.seq, message.frame, message.resolution) == (7, 3, "map", 0.1)
    assert value(message, "tilt", 1.23, -0.48) == round(0.1 / TILT_STEP)
    assert value(message, "roughness", 1.23, -0.48) == round(0.02 / ROUGHNESS_STEP)
    assert value(message, "tilt", -3.04, 5.01) == round(0.2 / TILT_STEP)
    assert value(message, "tilt", 0.0, 0.0) == value(message, "roughness", 0.0, 0.0) == GROUND_UNKNOWN
    assert np.count_nonzero(message.tilt != GROUND_UNKNOWN) == 2


def test_a_cell_is_the_mean_of_its_last_observations_and_extremes_are_no_unknown():
    grid, at = GroundGrid(), np.array([(0.05, 0.05)])
    for tilt in (0.1, 0.2):
        grid.observe(at, tilt, 5.0)
    assert value(grid.message(0, 0, "map"), "tilt", 0.05, 0.05) == round(0.15 / TILT_STEP)
    assert value(grid.message(0, 0, "map"), "roughness", 0.05, 0.05) == GROUND_UNKNOWN - 1
    for _ in range(200):
        grid.observe(at, 0.3, 0.0)
    assert value(grid.message(0, 0, "map"), "tilt", 0.05, 0.05) == pytest.approx(0.3 / TILT_STEP, abs=1)


def test_a_message_keeps_its_values_when_the_grid_grows_and_changes():
    grid, at = GroundGrid(), np.array([(0.05, 0.05)])
    grid.observe(at, 0.1, 0.01)
    first = grid.message(0, 0, "map")
    grid.observe(np.array([(-7.0, 9.0)]), 0.2, 0.02)
    assert value(grid.message(0, 0, "map"), "tilt", 0.05, 0.05) == round(0.1 / TILT_STEP)
    assert value(grid.message(0, 0, "map"), "tilt", -7.0, 9.0) == round(0.2 / TILT_STEP)
    grid.observe(at, 0.3, 0.01)
    assert value(first, "tilt", 0.05, 0.05) == round(0.1 / TILT_STEP)
    assert value(grid.message(0, 0, "map"), "tilt", 0.05, 0.05) == round(0.2 / TILT_STEP)


def test_places_far_off_are_left_out():
    grid = GroundGrid()
    grid.observe(np.array([(0.0, 0.0)]), 0.1, 0.0)
    grid.observe(np.array([(1e6, 0.0)]), 0.1, 0.0)
    assert grid.message(0, 0, "map").width < 100


def test_it_is_saved_with_the_map_and_read_again(tmp_path):
    assert GroundGrid.load(tmp_path).empty
    grid = GroundGrid()
    grid.observe(np.random.default_rng(1).uniform(-2, 2, (50, 2)), 0.1, 0.01)
    grid.save(tmp_path, "run")
    assert GroundGrid.load(tmp_path).message(1, 2, "map") == grid.message(1, 2, "map")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({}, "expected a grid of the ground"),
        ({"corner": np.zeros(3)}, "expected one of at most"),
        ({"tilt": np.zeros((2, 3))}, "expected one of at most"),
        ({"tilt": np.full((2, 2), np.nan)}, "expected finite"),
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path, content, expected):
    layers = {"corner": np.zeros(2), **{name: np.zeros((2, 2)) for name in ("counts", "tilt", "roughness")}}
    if content:
        np.savez(tmp_path / FILE, **(layers | content))
    else:
        (tmp_path / FILE).write_bytes(b"PK nothing")
    with pytest.raises(InputError, match=f"{FILE}: .*{expected}"):
        GroundGrid.load(tmp_path)


def test_planes_through_points_of_slopes_and_of_rough_ground():
    rng = np.random.default_rng(2)
    xy = rng.uniform((0.0, 0.0), (0.29, 0.29), (200, 2))
    slope = np.column_stack((xy, 0.1 * xy[:, 0]))
    points, tilt, roughness = planes(np.vstack((slope, slope + np.array((0.6, -0.3, 1.0)), [(5.0, 5.0, 0.0)])))
    assert len(points) == len(tilt) == len(roughness) == 400, "a lone point makes no plane"
    assert tilt == pytest.approx(math.atan(0.1), abs=1e-6)
    assert roughness == pytest.approx(0.0, abs=1e-6)
    slope[:, 2] += rng.normal(0.0, 0.02, 200)
    assert planes(slope)[2] == pytest.approx(0.02, rel=0.15)


def test_a_line_of_points_makes_no_plane():
    line = np.column_stack((np.linspace(0, 0.29, 50), np.full(50, 0.1), np.zeros(50)))
    for points in (line, np.empty((0, 3)), np.array([(0.1, 0.1, 0.0)])):
        assert not any(map(len, planes(points)))
