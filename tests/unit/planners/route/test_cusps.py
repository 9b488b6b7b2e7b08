"""Few changes of direction, translations only where they help, and what an exhausted search may say."""

import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.route.api import Budget, RouteMap, Vehicle, check_endpoints
from monstertruck_planners.route.config import HybridConfig, LatticeConfig
from monstertruck_planners.route.heuristic import cell_at, cost_to_go
from monstertruck_planners.route.hybrid import RESOLUTIONS, HybridPlanner, SearchProblem, SearchRun
from monstertruck_planners.route.lattice import LatticePlanner
from monstertruck_planners.route.motion import MotionPath
from monstertruck_planners.route.search import count_cusps
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.route.route_kit import CAR, TRUCK, assert_drivable, ground


def corridor(width, length=6.5, resolution=0.025):
    cells = np.full((round(width / resolution) + 2, round(length / resolution)), 0, np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    return RouteMap.from_cells(cells, resolution)


@pytest.mark.parametrize("radius", [1.0, 1.1])
def test_a_truck_turns_round_in_a_narrow_corridor_with_few_cusps(radius):
    config = PlannerConfig()
    vehicle = Vehicle.truck(config.steering, angle=config.angle)
    vehicle = replace(vehicle, radius=radius * vehicle.radius)
    where, y = corridor(0.8), 0.425
    start, goal = np.array([2.0, y, 0.0]), np.array([2.5, y, math.pi])
    result = HybridPlanner(vehicle, config.route).plan(where, start, goal)
    assert result.ok
    assert_drivable(result.path, where, vehicle, start, goal)
    assert result.path.cusps <= 8


def zigzag(cusps):
    signs = np.where(np.arange(cusps + 1) % 2, -1.0, 1.0)
    return MotionPath(np.zeros(3), np.column_stack((0.3 * signs, np.zeros((cusps + 1, 2)))))


def test_cusps_beyond_a_few_cost_extra():
    config = HybridConfig(cusp_cost=0.1, free_cusps=4, many_cusps_cost=0.4, swing_cost=0.0, clearance_cost=0.0)
    planner, where = HybridPlanner(TRUCK, config), ground()
    costs = [planner.cost(where, zigzag(n)) - 0.3 * (n + 1) for n in (0, 4, 5, 8)]
    assert costs == pytest.approx([0.0, 0.4, 0.9, 2.4])


ROOMS = ((2.0, 0.0, 2.3, 2.6), (3.8, 1.4, 4.1, 4.0))
POSTS = tuple((x, y, x + 0.25, y + 0.25) for x in (1.6, 3.0, 4.4) for y in (0.6, 1.9, 3.0))


@pytest.mark.parametrize("effort", [3000, 30_000])
@pytest.mark.parametrize("blocks", [ROOMS, POSTS, ()], ids=["rooms", "posts", "open"])
def test_both_axles_make_no_route_longer(blocks, effort):
    front = replace(TRUCK, crab_angle=0.0, steering="front")
    where, config = ground(*blocks), HybridConfig(effort=effort)
    for goal in ((5.3, 1.0, 0.0), (5.2, 2.7, math.pi), (2.7, 2.0, math.pi / 2), (1.2, 1.6, 0.4)):
        both, plain = (HybridPlanner(v, config).plan(where, (1.0, 1.0, 0.0), goal) for v in (TRUCK, front))
        assert both.path.length <= plain.path.length + 1e-9


def test_an_exhausted_search_is_no_proof():
    # A pocket just longer than the truck: no primitive of the lattice is free, and yet there is a way.
    goal = np.array([5.0, 3.0, 0.0])
    where = ground(*[(0.9, 1.55, 1.5, 1.75), (0.9, 2.25, 1.5, 2.45), (0.75, 1.55, 0.9, 2.45), (1.75, 1.2, 1.9, 2.45)])
    start = np.array([1.2, 2.0, 0.0])
    result = LatticePlanner(CAR, LatticeConfig(effort=3000)).plan(where, CAR.reference_pose(start), goal)
    assert result.reason is Reason.ROUTE_TIMEOUT
    closed = ground((2.9, 0.0, 3.1, 4.0))
    for planner in (LatticePlanner(TRUCK), HybridPlanner(TRUCK, HybridConfig())):
        assert planner.plan(closed, (1.0, 1.0, 0.0), goal).reason is Reason.GOAL_UNREACHABLE


def test_a_search_keeps_to_the_greatest_number_of_cusps():
    where, start, goal = ground(), np.array([3.0, 2.0, 0.0]), np.array([3.0, 2.6, math.pi])
    planner = HybridPlanner(CAR, HybridConfig(improve=False))
    ends = check_endpoints(where, CAR, start, goal, 0.05, 0.09, 0.0)
    budget = Budget(1.0, None, 5000)
    problem = SearchProblem(
        where.field.data(), planner.footprint, where.cost_layer(planner.costs), ends.start, ends.goal, 2.0, budget,
        {"expanded": 0},
    )  # fmt: skip
    cell_cost, cell = where.cell_costs(planner.costs), where.coarse_cell
    places = [cell_at(where.field.data(), cell, *pose[:2]) for pose in (goal, start)]
    found = {}
    for most in (0, 1, 63):
        model = planner.motion_model(RESOLUTIONS[0], 0.0)._replace(max_cusps=most)
        run = SearchRun(problem, model, cost_to_go(cell_cost, cell, *places), RESOLUTIONS[0])
        segments = run.run(5000)
        found[most] = count_cusps(segments, len(segments), 0.0)
    assert found[0] == 0
    assert found[1] <= 1
    assert found[63] >= 1
