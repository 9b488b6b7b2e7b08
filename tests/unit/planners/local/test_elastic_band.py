"""Elastic band: bubbles, forces, refinement."""

import numpy as np
import pytest

from monstertruck_planners.collision import DiscFootprint, Footprint, clearance_to_points
from monstertruck_planners.local import elastic_band
from monstertruck_planners.local.config import BandConfig
from monstertruck_planners.local.elastic_band import band_parameters, cover_footprint, relax_band
from monstertruck_planners.pose_path import PosePath
from monstertruck_runtime.errors import InputError
from tests.unit.planners.local.local_kit import RES, line, window

COVER = cover_footprint(Footprint())
RULES = band_parameters(BandConfig(), COVER)


def test_discs_cover_the_rectangle_and_hardly_more():
    body = Footprint(offset=0.16)
    cover = cover_footprint(body)
    x, y = np.meshgrid(np.linspace(-0.085, 0.405, 60), np.linspace(-0.18, 0.18, 60))
    inside = np.hypot(x[..., None] - cover.x, y[..., None] - cover.y) <= cover.radius + 1e-9
    assert inside.any(axis=-1).all()
    assert (cover.x + cover.radius).max() < 0.405 + 0.015
    assert (cover.y + cover.radius).max() < 0.18 + 0.015


def test_discs_of_a_disc_footprint_are_its_own():
    cover = cover_footprint(DiscFootprint((-0.1, 0.1), 0.2))
    assert cover.x.tolist() == [-0.1, 0.1]
    assert cover.radius.tolist() == [0.2, 0.2]


def test_clearance_is_that_of_the_footprint_at_its_heading():
    field = window((2.6, 1.8, 2.64, 2.2))
    poses = np.array([[2.0, 2.0, yaw] for yaw in np.linspace(0, 3.1, 12)])
    edge = np.array([[2.6, y] for y in np.linspace(1.8, 2.2, 30)])
    exact = clearance_to_points(Footprint(), poses, edge)
    got = [elastic_band.clearance(field.data(), COVER, *pose) for pose in poses]
    assert np.abs(got - exact).max() < RES


def test_band_moves_off_an_obstacle_beside_it_and_keeps_its_ends():
    field = window((2.2, 1.6, 2.4, 1.84))
    route = line(end=3.4, y=2.08)
    band = relax_band(route, field, COVER, RULES)
    assert band.path is not None
    before = min(elastic_band.clearance(field.data(), COVER, *pose) for pose in route.poses)
    assert band.radii.min() > before + 0.05
    assert np.allclose(band.path.poses[[0, -1]], route.poses[[0, -1]])
    gaps = np.hypot(*np.diff(band.path.poses[:, :2], axis=0).T)
    assert gaps.max() <= 0.2 + 1e-9


def test_band_through_an_obstacle_is_broken_where_it_touches():
    band = relax_band(line(end=3.4), window((2.2, 1.8, 2.4, 2.2)), COVER, RULES)
    assert band.path is None
    assert 2.2 - 0.26 - 0.08 < line().poses[band.broken, 0] < 2.2


def test_a_bend_is_pulled_taut():
    route = PosePath(np.array([[1.0, 2.0, 0.0], [1.5, 2.3, 0.0], [2.0, 2.3, 0.0], [2.5, 2.0, 0.0]]), np.ones(4))
    band = relax_band(route, window(), COVER, RULES)
    assert band.path is not None
    assert band.path.travelled[-1] < 0.98 * route.travelled[-1]


def test_cusps_stay_where_they_are():
    poses = np.array([[1.0, 2.0, 0.0], [1.6, 2.1, 0.2], [2.2, 2.3, 0.3], [1.7, 2.1, 0.3], [1.2, 2.2, 0.0]])
    band = relax_band(PosePath(poses, np.array([1.0, 1, 1, -1, -1])), window(), COVER, RULES)
    assert band.path is not None
    cusp = np.flatnonzero(np.diff(band.path.directions))
    assert len(cusp) == 1
    assert np.allclose(band.path.poses[cusp[0]], poses[2])


@pytest.mark.parametrize("poses", [np.zeros((0, 3)), np.zeros((2, 2)), np.array([[0, 0, np.nan], [1, 0, 0]])])
def test_a_guide_that_is_none_is_refused(poses):
    with pytest.raises(InputError, match="path of"):
        PosePath(poses, np.ones(len(poses)))
