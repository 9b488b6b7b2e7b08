"""Ground of zones: polygons and masks give the same answers as the geometry that they stand for."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.se2 import points_placed
from monstertruck_planners.collision import Footprint
from monstertruck_planners.zones.shapes import SPACING, ZoneLayer, ZoneShape, changed, in_force, limits_of, mask_of
from monstertruck_schemas.zones import Zone
from tests.unit.planners.zones.zone_kit import SQUARE, zone, zones

BODY = Footprint(length=0.4, width=0.3, padding=0.0)


def masked(limits, resolution=0.1, origin=(1.0, 2.0)):
    return Zone(name="mask", kind="speed", mask=mask_of(np.array(limits), resolution, origin))


def test_a_polygon_has_its_limit_inside_and_points_all_along_its_edge():
    shape = ZoneShape(zone(kind="speed", limit=0.2))
    at = np.array([[2.5, 0.0], [1.9, 0.0], [3.1, 0.4]])
    assert shape.limits_at(at).tolist() == [0.2, math.inf, math.inf]
    steps = np.hypot(*np.diff(np.vstack((shape.points, shape.points[:1])), axis=0).T)
    assert steps.max() <= SPACING + 1e-9
    assert steps.sum() == pytest.approx(4.0)


def test_a_mask_survives_its_way_through_runs_without_its_empty_rim():
    limits = np.full((6, 8), np.inf)
    limits[2:4, 3:6], limits[3, 4] = 0.3, 0.0
    mask = mask_of(limits, 0.1, (1.0, 2.0))
    assert (mask.width, mask.height, mask.x, mask.y) == (3, 2, pytest.approx(1.3), pytest.approx(2.2))
    assert np.array_equal(limits_of(mask), limits[2:4, 3:6])
    assert mask_of(np.full((3, 3), np.inf), 0.1, (0.0, 0.0)) is None


def test_a_mask_has_the_limit_of_each_cell_and_the_lower_one_at_every_edge():
    shape = ZoneShape(masked([[0.5, 0.5, 0.2], [0.5, 0.5, 0.5]]))
    places = np.array([[1.05, 2.05], [1.25, 2.05], [1.25, 2.15], [0.95, 2.05], [1.35, 2.0]])
    assert shape.limits_at(places).tolist() == [0.5, 0.2, 0.5, math.inf, math.inf]
    slow = shape.points[shape.limits == 0.2]
    assert np.hypot(*(slow - (1.25, 2.05)).T).max() == pytest.approx(0.0674, abs=0.01)
    assert len(shape.points) == 5 * (10 + 2), "outer edges and the two inner ones, five points each"


@pytest.mark.parametrize("seed", range(20))
def test_what_a_footprint_reaches_into_is_what_dense_points_of_it_lie_in(seed):
    rng = np.random.default_rng(seed)
    turns, radii = np.arange(6) * math.pi / 3, rng.uniform(0.4, 1.0, 6)
    corners = np.column_stack((radii * np.cos(turns), radii * np.sin(turns)))
    cells = np.where(rng.random((12, 12)) < 0.2, 0.0, np.inf)
    layer = ZoneLayer([zone(corners=tuple(map(tuple, corners.tolist()))), masked(cells, 0.1, (-0.6, -0.6))])
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 81), np.linspace(-0.15, 0.15, 61))
    body = np.column_stack((x.ravel(), y.ravel()))
    for _ in range(20):
        pose = (*rng.uniform(-1.5, 1.5, 2).tolist(), float(rng.uniform(-3, 3)))
        there = points_placed(body, pose)
        truly = {shape.zone.name for shape in layer.shapes if (shape.limits_at(there) == 0.0).any()}
        assert truly <= {shape.zone.name for shape, _ in layer.reached(BODY, pose, 0.01)}
        assert {shape.zone.name for shape, _ in layer.reached(BODY, pose, -0.01)} <= truly


@pytest.mark.parametrize("margin", [0.0, 0.1])
def test_cells_near_a_keepout_zone_are_closed_and_no_others(margin):
    layer = ZoneLayer([zone(), zone("slow", ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)), "speed", limit=0.1)])
    origin, res = (1.0, -1.5, 0.2), 0.05
    closed = layer.keepout_cells((60, 60), res, origin, margin)
    row, column = np.mgrid[0:60, 0:60].reshape(2, -1)
    centres = points_placed((np.column_stack((column, row)) + 0.5) * res, origin)
    away = np.hypot(*np.maximum(np.abs(centres - (2.5, 0.0)) - 0.5, 0.0).T)
    exact = (away <= margin + res * math.sqrt(0.5)).reshape(60, 60)
    sure = (away <= margin + res * math.sqrt(0.5) - 0.005).reshape(60, 60)
    assert (closed >= sure).all()
    assert (closed <= exact).all()


def test_zones_that_are_off_or_around_the_robot_are_left_out():
    news = zones(zone(), zone("yard", off_until=5))
    layer = ZoneLayer(in_force(news))
    assert [shape.zone.name for shape in layer.shapes] == ["stairs"]
    assert layer.outside(BODY, (0.0, 0.0, 0.0)) is layer
    assert layer.outside(BODY, (2.5, 0.0, 0.0)).shapes == []
    assert layer.keepout(BODY, (1.75, 0.0, 0.0)) is None
    assert layer.keepout(BODY, (1.75, 0.0, 0.0), 0.06) == "stairs"
    assert (layer.keepout_at((2.9, 0.4)), layer.keepout_at((1.9, 0.4))) == ("stairs", None)


def test_shapes_are_computed_again_for_changed_ground_only():
    first = ZoneLayer([zone(), zone("yard")])
    again = ZoneLayer([zone(off_until=7), zone("yard", corners=SQUARE[:3])], first)
    assert again.shapes[0] is first.shapes[0]
    assert again.shapes[1] is not first.shapes[1]
    known = zones(zone())
    assert changed(None, known) is None
    assert changed(zones(zone(), inside=("stairs",)), known) is None
    assert changed(known, None) is known
