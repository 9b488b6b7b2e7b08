import itertools
import math

import numpy as np
import pytest

from monstertruck_planners.route.api import RouteMap, Vehicle
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.hybrid import RESOLUTIONS, HybridPlanner
from monstertruck_planners.route.motion import MotionPath
from monstertruck_planners.route.replan import KeepPolicy, ViaPoint, plan_through, remaining_route, replan
from monstertruck_planners.route.segment_buffer import current_segments, editable
from monstertruck_planners.route.smoothing import shortcut
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.route.route_kit import CAR, TRUCK, assert_drivable, ground, room

QUICK = HybridConfig(effort=6000)
FRONT, BOTH = HybridPlanner(CAR, QUICK), HybridPlanner(TRUCK, QUICK)
WALL = (2.9, 0.0, 3.1, 2.8)  # a way round at the top
START, GOAL = np.array([1.0, 1.0, 0.0]), np.array([5.0, 1.0, 0.0])


@pytest.mark.parametrize("planner", [FRONT, BOTH])
@pytest.mark.parametrize("goal", [GOAL, (5.0, 1.0, math.pi), (1.0, 1.4, 0.0), (1.3, 1.0, math.pi / 2)])
def test_routes_are_drivable(planner, goal):
    where = ground(WALL)
    result = planner.plan(where, START, goal)
    assert result.ok
    assert_drivable(result.path, where, planner.vehicle, START, goal)
    assert result.cost >= result.path.length
    assert result.statistics["first_length"] >= result.path.length - 1e-6


def test_both_axles_are_never_longer():
    where = ground(WALL)
    for goal in (GOAL, (1.0, 2.0, 0.0), (5.0, 3.0, math.pi)):
        assert BOTH.plan(where, START, goal).path.length <= FRONT.plan(where, START, goal).path.length + 0.02


def test_equal_work_gives_equal_routes():
    where = ground(WALL)
    first, second = (HybridPlanner(CAR, QUICK).plan(where, START, GOAL) for _ in range(2))
    assert np.array_equal(first.path.segments, second.path.segments)
    assert first.statistics == second.statistics


def test_the_clock_ends_the_improvement():
    ticks = itertools.count()
    result = FRONT.plan(ground(WALL), START, GOAL, now=lambda: 0.02 * next(ticks))
    assert result.ok
    assert result.statistics["elapsed_s"] >= 1.0
    assert next(ticks) < 70


@pytest.mark.parametrize(
    ("start", "goal", "reason"),
    [
        (START, (3.0, 1.0, 0.0), Reason.GOAL_BLOCKED),
        (START, (9.0, 1.0, 0.0), Reason.GOAL_OUTSIDE),
        (START, (math.nan, 1.0, 0.0), Reason.NOT_FINITE),
        (START, (1.0, 1.0), Reason.BAD_INPUT),
        ((3.0, 1.0, 0.0), GOAL, Reason.START_BLOCKED),
        (START, (5.0, 1.0, 0.0), Reason.GOAL_UNREACHABLE),
    ],
)
def test_bad_goals_are_refused_by_name(start, goal, reason):
    result = FRONT.plan(ground((2.9, 0.0, 3.1, 4.0)), start, goal)
    assert (result.reason, result.path) == (reason, None)
    assert result.text


def test_a_slit_is_no_way_for_a_truck_that_cannot_turn_into_it():
    # Wide enough for the footprint along, closed on the far side by a wall the truck cannot turn before.
    where = ground((2.0, 0.0, 4.0, 1.75), (2.0, 2.25, 4.0, 4.0), (4.15, 1.0, 4.3, 3.0))
    result = HybridPlanner(CAR, HybridConfig(effort=30_000)).plan(where, START, GOAL)
    assert result.reason in {Reason.GOAL_UNREACHABLE, Reason.ROUTE_TIMEOUT}


def test_a_taken_goal_is_met_within_tolerance():
    where = ground()
    # 21 mm into the wall
    goal = np.array([5.65, 2.0, 0.0])
    assert not where.field.free(TRUCK.footprint, np.array([[5.72, 2.0, 0.0]]))[0]
    beside = np.array([5.95 - 0.245 + 0.03, 2.0, 0.0])
    result = BOTH.plan(where, START, beside)
    assert result.ok
    assert 0.0 < math.hypot(*(result.path.end[:2] - beside[:2])) <= 0.05
    assert (
        HybridPlanner(TRUCK, HybridConfig(position_tolerance=0.0)).plan(where, START, beside).reason
        is Reason.GOAL_BLOCKED
    )
    assert BOTH.plan(where, START, goal).ok


def test_unknown_ground_by_policy():
    cells = room()
    cells[:40, 55:65] = -1  # below y = 2, across the straight way
    lengths = {}
    for policy in ("blocked", "dear", "free"):
        config = QUICK.model_copy(update={"unknown": policy, "unknown_cost": 20.0})
        where = RouteMap.from_cells(cells, 0.05, unknown=policy)
        lengths[policy] = HybridPlanner(CAR, config).plan(where, START, GOAL).path.length
    assert lengths["free"] == pytest.approx(4.0, abs=0.01)
    assert lengths["blocked"] > 4.3
    assert lengths["dear"] > 4.3


def test_steep_and_rough_ground_is_avoided():
    cells = room()
    hill = np.zeros(cells.shape)
    hill[:44, 50:70] = 2.0
    level = HybridPlanner(CAR, QUICK).plan(RouteMap.from_cells(cells, 0.05), START, GOAL)
    for layer in ("tilt", "roughness"):
        round_it = HybridPlanner(CAR, QUICK).plan(RouteMap.from_cells(cells, 0.05, **{layer: hill}), START, GOAL)
        assert round_it.path.sample(0.05).poses[:, 1].max() > 2.2 > level.path.sample(0.05).poses[:, 1].max()


def test_dear_cusps_and_reverse_are_left_out():
    where, behind = ground(), (0.6, 1.6, 0.0)
    cheap = HybridPlanner(CAR, QUICK).plan(where, (3.0, 2.0, 0.0), behind).path
    dear = HybridPlanner(CAR, QUICK.model_copy(update={"cusp_cost": 3.0})).plan(where, (3.0, 2.0, 0.0), behind).path
    assert dear.cusps <= cheap.cusps
    assert cheap.backward > 1.5
    turned = (1.5, 3.2, math.pi)
    back = HybridPlanner(CAR, QUICK.model_copy(update={"reverse_cost": 4.0})).plan(where, (3.0, 2.0, 0.0), turned).path
    assert back.backward <= FRONT.plan(where, (3.0, 2.0, 0.0), turned).path.backward


def test_margin_and_clearance_keep_off():
    where = ground(WALL)
    near = FRONT.plan(where, START, GOAL).path
    wide = HybridPlanner(CAR, QUICK.model_copy(update={"margin": 0.1})).plan(where, START, GOAL).path
    assert where.field.free(CAR.footprint, wide.sample(0.02).poses, 0.1).all()
    assert not where.field.free(CAR.footprint, near.sample(0.02).poses, 0.1).all()


def test_routes_over_waypoints():
    where = ground(WALL)
    places = [ViaPoint(1.0, 3.0), ViaPoint(3.0, 3.4), ViaPoint(5.0, 1.0, 0.0)]
    result = plan_through(BOTH, where, START, places)
    assert_drivable(result.path, where, TRUCK, START, GOAL)
    poses = result.path.sample(0.01).poses
    for place in places:
        assert np.hypot(poses[:, 0] - place.x, poses[:, 1] - place.y).min() < 0.02
    blocked = plan_through(BOTH, where, START, [places[0], ViaPoint(3.0, 1.0)])
    assert (blocked.reason, blocked.text[:5]) == (Reason.GOAL_BLOCKED, "goal ")
    blocked = plan_through(BOTH, where, START, [ViaPoint(3.0, 1.0), places[0]])
    assert "waypoint 1 of 1: goal " in blocked.text
    with pytest.raises(InputError, match="waypoint"):
        plan_through(BOTH, where, START, [])


def test_a_good_route_is_kept():
    # Two ways round the block are nearly as long: the truck must not change its mind.
    block = (2.6, 1.4, 3.4, 2.6)
    start, goal = np.array([1.0, 2.0, 0.0]), np.array([5.0, 2.0, 0.0])
    where = ground(block)
    route = FRONT.plan(where, start, goal).path
    pose = route.sample(0.3).poses[2] + (0.01, -0.02, 0.02)
    again = replan(FRONT, where, route, pose, goal)
    assert again.statistics["kept_route"] == 1.0
    assert_drivable(again.path, where, CAR, pose, goal)
    side = np.sign(route.sample(0.05).poses[:, 1] - 2.0)[20:40].sum()
    assert np.sign(again.path.sample(0.05).poses[:, 1] - 2.0)[10:30].sum() * side > 0
    y = route.sample(0.05).poses[:, 1]
    shut = (2.6, 2.6, 3.4, 4.0) if y.max() - 2.0 > 2.0 - y.min() else (2.6, 0.0, 3.4, 1.4)
    other = replan(FRONT, ground(block, shut), route, pose, goal)
    assert other.ok
    assert other.statistics["kept_route"] == 0.0
    assert replan(FRONT, where, None, pose, goal).statistics["kept_route"] == 0.0
    assert replan(FRONT, where, route, pose, (5.0, 3.0, 0.0)).statistics["kept_route"] == 0.0
    assert remaining_route(FRONT, where, route, (1.0, 3.0, 0.0), goal, KeepPolicy().reach) is None


def test_a_detour_is_given_up_for_a_much_better_way():
    long_way = BOTH.plan(ground((2.9, 0.0, 3.1, 3.2)), START, GOAL).path
    result = replan(BOTH, ground(), long_way, START, GOAL)
    assert result.statistics["kept_route"] == 0.0
    assert result.path.length == pytest.approx(4.0, abs=0.01)
    stubborn = replan(BOTH, ground(), long_way, START, GOAL, policy=KeepPolicy(gain=0.9))
    assert stubborn.statistics["kept_route"] == 1.0


def test_the_truck_in_its_three_ways():
    assert Vehicle.truck("2ws").radius == pytest.approx(0.845, abs=1e-3)
    assert Vehicle.truck("counter").radius == pytest.approx(0.423, abs=1e-3)
    assert (Vehicle.truck("counter").crab_angle, Vehicle.truck("4ws").crab_angle) == (0.0, 0.362)
    rear = Vehicle.truck("2ws").reference_pose((1.0, 1.0, math.pi / 2))
    assert rear == pytest.approx([1.0, 0.84, math.pi / 2])
    with pytest.raises(InputError, match="shape"):
        RouteMap(ground().field, tilt=np.zeros((2, 2)))


@pytest.mark.parametrize("planner", [FRONT, BOTH])
def test_more_effort_makes_no_route_dearer_over_rough_ground(planner):
    cells = room()
    rough = np.zeros(cells.shape)
    rough[16:25, 45:77] = 0.01
    where = RouteMap.from_cells(cells, 0.05, roughness=rough)
    costs = []
    for effort in (2000, 8000, 20000):
        more = HybridPlanner(planner.vehicle, HybridConfig(effort=effort))
        result = more.plan(where, (1.0, 1.03, 0.0), (5.2, 1.03, 0.0))
        assert result.cost == pytest.approx(more.cost(where, result.path), abs=1e-6)
        costs.append(result.cost)
    assert costs == sorted(costs, reverse=True)


def test_no_shortcut_makes_a_route_dearer():
    """Costs of a stretch are summed at other places than those of the whole: what seems to gain may lose."""
    cells, random = room(), np.random.default_rng(3)
    where = RouteMap.from_cells(cells, 0.05, roughness=0.02 * random.random(cells.shape))
    field, layer = where.field.data(), where.cost_layer(FRONT.costs)
    model = FRONT.motion_model(RESOLUTIONS[0], 0.0)
    first = FRONT.plan(ground(WALL), START, GOAL).path
    path = editable(*first.copied())
    cost = FRONT.cost(where, first)
    for _ in range(300):
        shortcut(field, FRONT.footprint, layer, model, path, 10.0, 0.25, random.random((20, 6)))
        now = FRONT.cost(where, MotionPath(first.copied()[0], current_segments(path).copy()))
        assert now <= cost + 1e-9
        cost = now
