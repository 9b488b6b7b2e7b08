"""Narrow places: gaps that look wide enough and are not, less margin where there is no other way, fine searches."""

import math

import numpy as np
import pytest

from monstertruck_planners.collision import DistanceField, Footprint
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.corridors import footprint_fits
from monstertruck_planners.route.hybrid import MAX_TABLE_CELLS, RESOLUTIONS, HybridPlanner, narrower_configs
from monstertruck_planners.route.replan import ViaPoint, plan_through, replan
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.route.route_kit import CAR, TRUCK, assert_drivable, ground

START, GOAL = np.array([1.0, 2.0, 0.0]), np.array([5.0, 2.0, 0.0])
DOOR = ((2.9, 0.0, 3.1, 1.8), (2.9, 2.25, 3.1, 4.0))
"""0.45 m wide, 45 mm beside the truck on each side."""


def planner(vehicle=TRUCK, **config):
    return HybridPlanner(vehicle, HybridConfig(**{"effort": 20_000, "improve": False} | config))


@pytest.mark.parametrize("vehicle", [TRUCK, CAR], ids=["4ws", "2ws"])
@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_a_footprint_fits_where_a_heading_is_free(vehicle, yaw):
    cells = np.zeros((60, 60), bool)
    cells[:26], cells[43:] = True, True  # a corridor of 17 cells, 0.425 m
    field = DistanceField(cells, 0.025, (0.0, 0.0, yaw)).data()
    x, y = 0.75 * math.cos(yaw) - 0.8625 * math.sin(yaw), 0.75 * math.sin(yaw) + 0.8625 * math.cos(yaw)
    assert footprint_fits(field, vehicle.footprint.data(), 0.025, x, y)
    assert not footprint_fits(field, vehicle.footprint.data(), 0.035, x, y)
    assert not footprint_fits(
        field, vehicle.footprint.data(), 0.025, x - 0.01 * math.sin(yaw), y + 0.01 * math.cos(yaw)
    )


def test_a_gap_too_narrow_by_less_than_a_cell_is_no_way_and_soon_known():
    result = planner(margin=0.05, narrow_margin=0.05).plan(ground(*DOOR), START, GOAL)
    assert result.reason is Reason.GOAL_UNREACHABLE
    assert result.text == "no passage 0.47 m wide leads there"
    assert result.statistics["expanded"] < 1000


def test_a_slit_does_not_hide_the_way_round():
    where = ground((2.9, 0.0, 3.1, 1.8), (2.9, 2.2, 3.1, 3.1))
    result = planner(margin=0.05).plan(where, START, GOAL)
    assert result.ok
    assert result.path.sample(0.05).poses[:, 1].max() > 3.2
    assert where.field.free(TRUCK.footprint, result.path.sample(0.02).poses, 0.05).all()


def test_less_margin_where_there_is_no_other_way():
    where = ground(*DOOR)
    result = planner(margin=0.06).plan(where, START, GOAL)
    assert result.ok
    assert result.statistics["margin"] == pytest.approx(0.04)
    assert_drivable(result.path, where, TRUCK, START, GOAL)
    assert where.field.free(TRUCK.footprint, result.path.sample(0.02).poses, 0.04).all()
    stubborn = planner(margin=0.06, narrow_margin=0.06).plan(where, START, GOAL)
    assert stubborn.reason is Reason.GOAL_UNREACHABLE
    assert planner(margin=0.06).plan(ground(), START, GOAL).statistics["margin"] == 0.06


def test_how_narrow_a_door_may_be_is_a_setting():
    where = ground((2.9, 0.0, 3.1, 1.8), (2.9, 2.2, 3.1, 4.0))  # 2 cm on either side
    refused = planner(margin=0.04).plan(where, START, GOAL)
    assert (refused.reason, refused.text) == (Reason.GOAL_UNREACHABLE, "no passage 0.43 m wide leads there")
    result = planner(margin=0.04, narrow_margin=0.01).plan(where, START, GOAL)
    assert result.ok
    assert where.field.free(TRUCK.footprint, result.path.sample(0.02).poses, 0.01).all()


def test_margins_go_down_in_small_steps_to_the_least():
    config = HybridConfig(margin=0.04)
    assert [round(c.margin, 4) for c in narrower_configs(config)] == [0.035, 0.03]
    assert all(c.clearance_cost > config.clearance_cost and not narrower_configs(c) for c in narrower_configs(config))
    assert not narrower_configs(HybridConfig(margin=0.02))


def test_a_goal_beside_a_wall_needs_less_margin_only_there():
    # 35 mm beside the truck
    beside = np.array([5.0, 0.05 + 0.18 + 0.035, 0.0])
    result = planner(margin=0.04, position_tolerance=0.0).plan(ground(), START, beside)
    assert result.ok
    assert result.statistics["margin"] < 0.04


def test_a_narrow_route_is_kept_like_any_other():
    where, tight = ground(*DOOR), planner(margin=0.06)
    route = tight.plan(where, START, GOAL).path
    again = replan(tight, where, route, route.sample(0.3).poses[2], GOAL)
    assert again.statistics["kept_route"] == 1.0
    assert tight.planner_for(0.06) is tight
    assert tight.planner_for(0.04).config.margin == pytest.approx(0.04)


def test_the_margin_of_a_route_over_waypoints_is_that_of_its_narrowest_leg():
    result = plan_through(planner(margin=0.06), ground(*DOOR), START, [ViaPoint(1.5, 2.5), ViaPoint(*GOAL)])
    assert result.statistics["margin"] == pytest.approx(0.04)


def test_a_fine_search_finds_what_the_coarse_one_does_not():
    # Out of a parking box with 15 cm before and behind the truck.
    where = ground((2.0, 0.0, 2.6, 0.5), (3.4, 0.0, 4.0, 0.5))
    start = np.array([3.0 + CAR.reference, 0.28, 0.0])
    assert where.field.free(CAR.footprint, start[None], 0.0)[0]
    result = planner(CAR, effort=60_000).plan(where, start, np.array([1.0, 2.0, 0.0]))
    assert result.ok
    assert_drivable(result.path, where, CAR, start, np.array([1.0, 2.0, 0.0]))
    assert result.path.cusps >= 2


def test_footprints_of_another_shape_fit_too():
    long = Footprint(length=1.2, width=0.2)
    cells = np.zeros((40, 40), bool)
    cells[:16] = cells[24:] = True
    field = DistanceField(cells, 0.05).data()
    assert footprint_fits(field, long.data(), 0.0, 1.0, 1.0)
    cells[:, 28:] = True
    assert not footprint_fits(DistanceField(cells, 0.05).data(), long.data(), 0.0, 1.0, 1.0)


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_the_table_of_a_search_stays_small_on_any_map(resolution):
    small, large = (DistanceField(np.zeros((n, n), bool), 0.1).data() for n in (100, 1500))
    assert resolution.fitted(small, 0.378) == resolution
    fitted = resolution.fitted(large, 0.378)
    assert (150.0 / (fitted.cell * 0.378)) ** 2 * fitted.headings < 1.01 * MAX_TABLE_CELLS
    assert fitted.primitive / fitted.cell == pytest.approx(resolution.primitive / resolution.cell)
