import math

import numpy as np
import pytest

from monstertruck_planners.route.api import RouteMap, Vehicle, make_planner, warm_up
from monstertruck_planners.route.catalog import ROUTE_PLANNERS
from monstertruck_planners.route.config import GridAstarConfig, LatticeConfig
from monstertruck_planners.route.grid_astar import GridAstarPlanner
from monstertruck_planners.route.lattice import ANGLES, LatticePlanner, make_primitives
from monstertruck_planners.route.motion import MotionPath
from monstertruck_planners.route.replan import replan
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.route.route_kit import CAR, TRUCK, assert_drivable, ground

WALL = (2.9, 0.0, 3.1, 2.8)
START, GOAL = np.array([1.0, 1.0, 0.0]), np.array([5.0, 1.0, 0.0])


@pytest.mark.parametrize("cell", [0.02, 0.03, 0.04, 0.05, 0.1])
@pytest.mark.parametrize(("radius", "crab"), [(0.757, 0.0), (0.378, 0.4)])
def test_primitives_end_on_cells_and_keep_the_radius(cell, radius, crab):
    primitives = make_primitives(radius, crab, cell)
    for h in range(16):
        assert primitives.used[h] == (7 if crab == 0.0 else 11)
        for k in range(primitives.used[h]):
            path = MotionPath(np.array([0.0, 0.0, ANGLES[h]]), primitives.segments[h, k])
            dx, dy, turn = primitives.shift[h, k].tolist()
            assert path.end[:2] == pytest.approx((dx * cell, dy * cell), abs=1e-9)
            assert math.remainder(path.end[2] - ANGLES[(h + turn) % 16], math.tau) == pytest.approx(0.0, abs=1e-9)
            assert path.greatest_curvature <= 1 / radius + 1e-9
            assert np.abs(path.segments[:, 2]).max() <= crab + 1e-9
            assert path.cusps == 0
            assert primitives.cost[h, k] >= path.length - 1e-12


def test_costs_are_the_authors():
    primitives = make_primitives(0.378, 0.4, 0.05)
    lengths = np.abs(primitives.segments[0, :, :, 0]).sum(axis=1)[: primitives.used[0]]
    factors = np.unique(np.round(primitives.cost[0, : primitives.used[0]] / lengths, 6)).tolist()
    assert factors == [1.0, 2.0, 3.0, 5.0]


@pytest.mark.parametrize("vehicle", [CAR, TRUCK])
def test_lattice_routes_are_drivable(vehicle):
    where = ground(WALL)
    planner = LatticePlanner(vehicle, LatticeConfig(effort=20_000))
    for goal in (GOAL, (1.5, 3.0, math.pi)):
        result = planner.plan(where, START, goal)
        assert result.ok
        assert_drivable(result.path, where, vehicle, START, goal)
        assert result.path.length <= result.statistics["first_length"] + 1e-9


def test_lattice_and_grid_refuse_by_name():
    shut = ground((2.9, 0.0, 3.1, 4.0))
    for planner in (LatticePlanner(CAR), GridAstarPlanner(CAR)):
        assert planner.plan(shut, START, GOAL).reason is Reason.GOAL_UNREACHABLE
        assert planner.plan(shut, START, (3.0, 1.0, 0.0)).reason is Reason.GOAL_BLOCKED
        assert planner.plan(shut, START, (3.0, math.inf, 0.0)).reason is Reason.NOT_FINITE


def test_the_authors_grid_costs():
    where = ground(WALL)
    planner = GridAstarPlanner(Vehicle.truck("counter"), GridAstarConfig())
    cell_cost = planner._cell_costs(np.array([0.1, 0.181, 0.3, 0.47, 0.5], np.float32))
    assert cell_cost.tolist() == [0, 0, 199, 91, 50]  # 252 exp(-0.01) is lethal, 252 exp(-1.2) and exp(-2.9) are not
    result = planner.plan(where, START, GOAL)
    assert result.ok
    assert result.poses[0] == pytest.approx(START)
    assert result.poses[-1] == pytest.approx(GOAL)
    assert where.field.lookup(result.poses[1:-1, :2]).min() > planner.vehicle.footprint.inscribed_radius
    step = np.diff(result.poses[:, :2], axis=0)
    assert np.hypot(*step.T).max() < 0.12
    assert result.poses[5:-5, 2] == pytest.approx(np.arctan2(step[5:-4, 1], step[5:-4, 0]))


@pytest.mark.parametrize("kind", ROUTE_PLANNERS)
def test_every_kind_plans(kind):
    planner = make_planner(CAR, ROUTE_PLANNERS.settings[kind](effort=2000))
    warm_up(planner)
    result = planner.plan(RouteMap.from_cells(np.zeros((60, 60), np.int8), 0.1), (1, 1, 0), (4, 4, 0))
    assert result.ok


def test_a_route_of_any_planner_of_paths_is_kept_while_it_is_good():
    planner = make_planner(CAR, ROUTE_PLANNERS.settings["lattice"](effort=2000))
    route_map = RouteMap.from_cells(np.zeros((60, 60), np.int8), 0.1)
    first = replan(planner, route_map, None, (1, 1, 0), (4, 4, 0))
    assert first.statistics["kept_route"] == 0.0
    on_the_way = first.path.part(0.5, math.inf).start
    again = replan(planner, route_map, first.path, on_the_way, (4, 4, 0))
    assert again.statistics["kept_route"] == 1.0
    assert again.path.length < first.path.length - 0.5 + 1e-3
