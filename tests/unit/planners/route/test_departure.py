"""Starts that are nearer to an obstacle than routes pass: left without coming nearer, then the margin is kept."""

import math
from itertools import product

import numpy as np
import pytest

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.route import departure as departure_module
from monstertruck_planners.route.api import Budget, RouteMap, Vehicle
from monstertruck_planners.route.config import GridAstarConfig, HybridConfig, LatticeConfig
from monstertruck_planners.route.departure import departures
from monstertruck_planners.route.grid_astar import GridAstarPlanner
from monstertruck_planners.route.hybrid import HybridPlanner
from monstertruck_planners.route.lattice import LatticePlanner
from monstertruck_planners.route.motion import MotionPath
from monstertruck_planners.route.replan import remaining_route, replan
from monstertruck_schemas.reasons import Reason
from tests.long_kit import mostly_long
from tests.unit.planners.route.route_kit import CAR, TRUCK, assert_drivable, ground, room

SPARE_MARGIN = 0.002

DIFFERENTIAL = Vehicle.truck("2ws", geometry=FourWheelSteering(cg_split=1.0))
BODIES = {"4ws": TRUCK, "2ws": CAR, "differential": DIFFERENTIAL}
MARGIN = 0.04
WALL, SIDE, END = 0.05, TRUCK.footprint.half_width, TRUCK.footprint.half_length
GOAL = np.array([4.0, 2.5, 0.0])


def hybrid(vehicle=TRUCK, **config):
    return HybridPlanner(vehicle, HybridConfig(**{"effort": 60_000, "improve": False, "margin": MARGIN} | config))


def base_beside(way: str, gap: float) -> np.ndarray:
    """Pose of the base so far from the lower wall of the room, m."""
    poses = {
        "parallel": (3.0, WALL + gap + SIDE, 0.0),
        "facing": (3.0, WALL + gap + END, -math.pi / 2),
        "behind": (3.0, WALL + gap + END, math.pi / 2),
        "aslant": (3.0, WALL + gap + END * math.sin(0.3) + SIDE * math.cos(0.3), -0.3),
    }
    return np.array(poses[way])


def clearances(where, vehicle, path):
    """Of the path every 2 mm, m."""
    return where.field.clearance(vehicle.footprint, path.sample(0.002).poses, 0.06, 0.0005)


def assert_leaves(where, vehicle, path, *, dip=0.0):
    """Never nearer than it came from, until the margin is kept; from there on it always is."""
    clear = clearances(where, vehicle, path)
    off = int(np.argmax(clear >= MARGIN))
    assert clear[off] >= MARGIN
    assert (clear[:off] >= np.maximum.accumulate(clear[:off]) - dip - 0.0011).all()
    assert clear[off:].min() >= MARGIN - 1e-9
    return path.sample(0.002).travelled[off]


@pytest.mark.parametrize(
    ("body", "way", "gap"),
    mostly_long(
        product(BODIES, ("facing", "behind", "aslant"), (0.0, 0.02, 0.0405)),
        {
            ("4ws", "facing", 0.0), ("4ws", "behind", 0.02), ("4ws", "aslant", 0.0405),
            ("2ws", "facing", 0.02), ("2ws", "behind", 0.0405), ("2ws", "aslant", 0.0),
            ("differential", "facing", 0.0405), ("differential", "behind", 0.0), ("differential", "aslant", 0.02),
        },
    ),
)  # fmt: skip
def test_it_leaves_a_wall_ahead_or_behind_and_keeps_the_margin_from_there_on(body, way, gap):
    vehicle, where = BODIES[body], ground()
    start = vehicle.reference_pose(base_beside(way, gap + 1e-6))
    result = hybrid(vehicle).plan(where, start, GOAL)
    assert result.ok, result.text
    assert result.statistics["margin"] == MARGIN
    assert_drivable(result.path, where, vehicle, start, GOAL)
    assert assert_leaves(where, vehicle, result.path) < 0.5


@pytest.mark.parametrize("gap", [0.0, 0.0405])
def test_a_body_that_drives_sideways_leaves_a_wall_beside_it_without_coming_nearer(gap):
    where, start = ground(), base_beside("parallel", gap + 1e-6)
    result = hybrid().plan(where, start, GOAL)
    assert result.ok
    assert assert_leaves(where, TRUCK, result.path) < 0.3


@pytest.mark.parametrize(
    ("body", "gap"),
    mostly_long(product(("2ws", "differential"), (0.003, 0.01, 0.04)), {("2ws", 0.003), ("differential", 0.01)}),
)
def test_a_body_that_turns_its_end_to_a_wall_beside_it_never_touches_it(body, gap):
    """Beside a long wall there is no motion that does not turn it: it comes nearer as little as it can."""
    vehicle, where = BODIES[body], ground()
    start = vehicle.reference_pose(base_beside("parallel", gap))
    result = hybrid(vehicle).plan(where, start, GOAL)
    assert result.ok
    assert_drivable(result.path, where, vehicle, start, GOAL)
    assert_leaves(where, vehicle, result.path, dip=gap if gap < 0.005 else gap / 2)


def test_a_corner_a_door_and_a_turned_map_are_left_too():
    corner = np.array([0.05 + END + 0.01, 0.05 + SIDE + 0.01, math.pi])
    for vehicle in BODIES.values():
        start = vehicle.reference_pose(corner)
        result = hybrid(vehicle).plan(ground(), start, GOAL)
        assert result.ok
        assert_drivable(result.path, ground(), vehicle, start, GOAL)
    where = ground((2.9, 0.0, 3.1, 1.8), (2.9, 2.2, 3.1, 4.0))  # 2 cm on either side
    result = hybrid().plan(where, np.array([3.0, 2.0, 0.0]), np.array([5.0, 2.0, 0.0]))
    assert result.ok
    assert_leaves(where, TRUCK, result.path)
    yaw = 0.4
    turned = RouteMap.from_cells(room(), 0.05, (0.0, 0.0, yaw))
    c, s = math.cos(yaw), math.sin(yaw)

    def placed(pose):
        return np.array([c * pose[0] - s * pose[1], s * pose[0] + c * pose[1], pose[2] + yaw])

    result = hybrid().plan(turned, placed(base_beside("parallel", 0.01)), placed(GOAL))
    assert result.ok
    assert_leaves(turned, TRUCK, result.path)


@pytest.mark.parametrize(
    "planner",
    [hybrid(position_tolerance=0.0), LatticePlanner(TRUCK, LatticeConfig(margin=MARGIN, position_tolerance=0.0))],
)
def test_what_touches_and_goals_within_the_margin_are_refused(planner):
    where = ground()
    touching = planner.plan(where, base_beside("parallel", -0.001), GOAL)
    assert (touching.reason, "overlaps" in touching.text) == (Reason.START_BLOCKED, True)
    beside = np.array([5.0, WALL + 0.02 + SIDE, 0.0])
    for start in (base_beside("parallel", 0.02), base_beside("facing", 0.005), GOAL):
        result = planner.plan(where, start, beside)
        assert result.reason is Reason.GOAL_BLOCKED
        assert "closer than" in result.text
    outside = planner.plan(where, base_beside("parallel", 0.02), np.array([50.0, 2.0, 0.0]))
    assert outside.reason is Reason.GOAL_OUTSIDE


def test_a_refused_goal_costs_no_search_for_departures(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(departure_module, "departures", lambda *_: pytest.fail("searched"))
    touching = np.array([5.0, WALL - 0.05 + SIDE, 0.0])
    assert hybrid().plan(ground(), base_beside("parallel", 0.02), touching).reason is Reason.GOAL_BLOCKED


def test_the_other_planners_leave_a_wall_too():
    where, start = ground(), base_beside("parallel", 0.005)
    lattice = LatticePlanner(TRUCK, LatticeConfig(margin=MARGIN, effort=20_000)).plan(where, start, GOAL)
    assert lattice.ok
    assert_leaves(where, TRUCK, lattice.path)
    cells = GridAstarPlanner(TRUCK, GridAstarConfig(margin=MARGIN)).plan(where, start, GOAL)
    assert cells.ok
    assert np.abs(cells.poses[0] - start).max() < 1e-12


def test_a_body_shut_in_on_all_sides_is_soon_refused():
    start = np.array([3.0, 2.0, 0.0])
    boxed = ground((2.6, 1.7, 3.4, 1.8), (2.6, 2.2, 3.4, 2.3), (2.6, 1.7, 2.75, 2.3), (3.25, 1.7, 3.4, 2.3))
    ways = departures(boxed, TRUCK, start, HybridConfig(margin=MARGIN), Budget(1.0, None, 60_000))
    assert (ways.found, ways.exhausted) == ([], True)
    assert hybrid().plan(boxed, start, GOAL).reason is Reason.START_BLOCKED


@pytest.mark.parametrize(
    "planner", [hybrid(effort=2000), LatticePlanner(TRUCK, LatticeConfig(margin=MARGIN, effort=2000))]
)
def test_departures_are_part_of_the_budget_and_say_when_it_ends(planner):
    # 2 cm on either side all the way: there is much to be tried, and nowhere is the margin kept.
    shut_in = ground((1.0, 0.8, 5.0, 0.9), (1.0, 1.3, 5.0, 1.4), (1.0, 0.8, 1.1, 1.4), (4.9, 0.8, 5.0, 1.4))
    start, config = np.array([3.0, 1.1, 0.0]), HybridConfig(margin=MARGIN)
    result = planner.plan(shut_in, start, GOAL)
    assert result.reason is Reason.ROUTE_TIMEOUT
    assert "no route found in time" in result.text
    for reserve, share in ((0.0, 0.5), (0.5, 0.25)):
        budget = Budget(1.0, None, 2000)
        assert not departures(shut_in, TRUCK, start, config, budget, reserve).exhausted
        assert share < 1.0 - budget.remaining() < share + 0.1  # the rest is kept for the route and for other margins
    ticks = iter(np.arange(0.0, 9.0, 0.1).tolist())
    timed = Budget(1.0, ticks.__next__, 2000)
    assert not departures(shut_in, TRUCK, start, config, timed).exhausted
    assert next(ticks) < 1.5


def test_a_departure_ends_where_a_search_can_set_off_and_is_short():
    where = ground()
    for way, gap in (("facing", 0.0005), ("aslant", 0.02), ("parallel", 0.035)):
        start = base_beside(way, gap)
        config = HybridConfig(margin=MARGIN, reverse_cost=2.0)
        found = departures(where, TRUCK, start, config, Budget(1.0, None, 60_000)).found
        for departure in found:
            poses = MotionPath(start, departure.segments).sample(0.002).poses
            clear = where.field.clearance(TRUCK.footprint, poses, 0.04, 0.0005)
            assert np.diff(clear).min() >= -0.0011
        order = [(not d.turns, d.cost) for d in found]
        assert order == sorted(order)
        ends = np.array([d.end for d in found])
        assert where.field.free(Footprint(), ends, MARGIN + SPARE_MARGIN).all()
        assert start[1] < found[0].end[1] < start[1] + MARGIN - gap + 0.02
        assert np.abs(found[0].segments[:, 0]).min() >= 0.02


def off_the_wall(planner, where, start):
    """Route, and the pose in the middle of its departure a little off it."""
    route = planner.plan(where, start, GOAL).path
    left = planner.leaving(where, route)
    pose = route.sample(left.length / 2).poses[1] + (0.0007, 0.0005, 0.002)
    assert not where.field.free(planner.vehicle.footprint, pose[None], MARGIN)[0]
    return route, pose


@pytest.mark.parametrize(
    ("body", "way"), [("4ws", "parallel"), ("4ws", "aslant"), ("2ws", "facing"), ("2ws", "parallel")]
)
def test_a_route_is_kept_on_its_departure_too(body, way):
    vehicle, where, planner = BODIES[body], ground(), hybrid(BODIES[body])
    route, pose = off_the_wall(planner, where, vehicle.reference_pose(base_beside(way, 0.01)))
    again = replan(planner, where, route, pose, GOAL)
    assert again.statistics["kept_route"] == 1.0
    assert again.path.length < route.length
    assert_drivable(again.path, where, vehicle, pose, GOAL)
    assert_leaves(where, vehicle, again.path, dip=0.01)


def test_a_departure_that_would_touch_or_comes_nearer_than_a_new_one_is_not_kept():
    where, planner, start = ground(), hybrid(effort=3000), base_beside("facing", 0.03)
    nearer = MotionPath(start, np.array([[0.02, 0.0, 0.0]]))
    route = nearer.then(planner.plan(where, nearer.end, GOAL).path)
    assert planner.leaving(where, route).fall == pytest.approx(0.02, abs=0.001)
    assert remaining_route(planner, where, route, start, GOAL, 0.5, 0.025) is not None
    assert remaining_route(planner, where, route, start, GOAL, 0.5) is None
    assert planner.leaving(where, replan(planner, where, route, start, GOAL).path).fall <= 0.005
    route, pose = off_the_wall(planner, where, base_beside("facing", 0.005))
    x, y = planner.leaving(where, route).length * np.array([0.0, 1.0]) + pose[:2]
    shut = ground((x - 0.2, y + END + 0.05, x + 0.2, y + END + 0.1))
    assert replan(planner, shut, route, pose, GOAL).statistics.get("kept_route", 0.0) == 0.0
    touching = MotionPath(start, np.array([[0.05, 0.0, 0.0], [-0.5, 0.0, 0.0]]))
    assert planner.leaving(where, touching) is None
