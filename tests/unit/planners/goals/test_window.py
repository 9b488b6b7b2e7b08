"""The window that moves with the truck: marks, clears, remembers."""

import math

import numpy as np
import pytest

from monstertruck_planners.collision import DistanceField, Footprint
from monstertruck_planners.goals.config import WindowConfig
from monstertruck_planners.goals.deform_step import Window
from monstertruck_runtime.errors import InputError

SENSOR, BASE = (0.1, 0.02), (0.0, 0.0)


def scan(window, distance, *, hit=True, base=BASE):
    """Beams all round, all of one length."""
    angles = np.linspace(-math.pi, math.pi, 721)
    ends = np.column_stack((SENSOR[0] + distance * np.cos(angles), SENSOR[1] + distance * np.sin(angles)))
    window.add_scan(SENSOR, base, ends, np.full(len(ends), hit))


def occupied_at(window, x, y):
    corner, res = window.corner, window.config.resolution
    return bool(window.cells[math.floor((y - corner[1]) / res), math.floor((x - corner[0]) / res)])


def test_returns_are_marked_and_cleared_again():
    window = Window()
    scan(window, 1.0)
    assert occupied_at(window, 1.1, 0.02)
    scan(window, 1.5)
    assert not occupied_at(window, 1.1, 0.02)
    assert occupied_at(window, 1.6, 0.02)
    scan(window, 4.0, hit=False)
    assert not window.cells.any()


def test_returns_beyond_the_marking_distance_are_none():
    window = Window(WindowConfig(mark=0.9))
    scan(window, 1.0)
    assert not window.cells.any()


def test_what_is_seen_stays_in_place_while_the_window_moves():
    window = Window()
    scan(window, 1.0)
    before = window.cells.sum()
    window.add_scan((0.6, 0.3), (0.5, 0.3), np.empty((0, 2)), np.empty(0, bool))
    assert window.corner == pytest.approx((-1.52, -1.72))
    assert occupied_at(window, 1.1, 0.02)
    assert window.cells.sum() == before
    window.add_scan((9.0, 9.0), (9.0, 9.0), np.empty((0, 2)), np.empty(0, bool))
    assert not window.cells.any()


def test_obstacles_of_the_map_count_with_those_seen():
    window = Window()
    scan(window, 1.0)
    known = np.zeros((100, 100), bool)
    known[50, 70:80] = True
    field = window.field(DistanceField(known, 0.02, (-1.0, -1.0, 0.0)))
    points = np.array([[0.5, 0.01], [1.1, 0.02], [0.5, 0.5], [1.5, 1.5]])
    assert (field.lookup(points) < 0.04).tolist() == [True, True, False, False]


def test_obstacles_are_thick_where_nobody_looked_behind_them():
    window = Window()
    scan(window, 1.0)
    behind, inside = np.array([[1.17, 0.02]]), np.array([[0.95, 0.02]])
    assert window.field().lookup(behind)[0] < 0.03
    assert window.field().lookup(inside)[0] > 0.08
    thin = Window(WindowConfig(thickness=0.0))
    scan(thin, 1.0)
    assert thin.field().lookup(behind)[0] > 0.04


def test_discs_close_the_cells_around_places_but_not_those_under_the_robot():
    window, footprint = Window(), Footprint()
    scan(window, 1.0)
    places = np.array([(0.8, 0.0), (0.3, 0.0)])
    closed = window.discs(places, 0.2, footprint, (0.0, 0.0, 0.0))
    away = np.hypot(*(window_middles(window, closed) - places[0]).T)
    assert away.max() < 0.2
    assert closed.sum() * window.config.resolution**2 == pytest.approx(math.pi * 0.2**2, rel=0.1)


def window_middles(window, cells):
    """Middles of the marked cells, m."""
    return (np.argwhere(cells)[:, ::-1] + 0.5) * window.config.resolution + window.corner


def test_a_scan_of_unequal_shapes_is_refused():
    with pytest.raises(InputError, match="scan"):
        Window().add_scan(SENSOR, BASE, np.zeros((3, 2)), np.zeros(2, bool))
