"""Deformers: round obstacles, drivable, kept, partial, refused; the same for every strategy and both trucks."""

import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_planners.collision import DistanceField
from monstertruck_planners.local.api import LocalPlannerState
from monstertruck_planners.local.catalog import LOCAL_PLANNERS, make_local_planner
from monstertruck_planners.local.config import LocalPlannerConfig, PublishedConfig, RsbandConfig, TebConfig
from monstertruck_planners.local.core import LocalPlannerCore, remaining_band, remaining_path
from monstertruck_planners.local.elastic_band import cover_footprint
from monstertruck_planners.local.published import oriented
from monstertruck_planners.local.teb import WIDTH, NormalEquations, _assemble, resampled, teb_parameters
from monstertruck_planners.pose_path import PosePath, nearest_pose
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.motion import MotionPath
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.reasons import Reason
from tests.long_kit import mostly_long
from tests.unit.planners.local.local_kit import Cycles, drivable, line, window

STRATEGIES = ("start_to_end", "start_to_next", "point_to_point", "skip_failures", "start_to_receding_end")
OURS = [RsbandConfig(strategy=s) for s in STRATEGIES] + [TebConfig()]
CARS = {kind: Vehicle.truck(kind) for kind in ("2ws", "counter", "4ws")}
BOX = (2.2, 1.76, 2.4, 1.96)
START = (0.8, 2.0, 0.0)


def name(value):
    return value if isinstance(value, str) else getattr(value, "strategy", value.kind)


@pytest.mark.parametrize("car", mostly_long(CARS, {"2ws", "4ws"}))
@pytest.mark.parametrize("config", OURS, ids=name)
@pytest.mark.parametrize("y", mostly_long([2.0, 2.2], [2.0]))
def test_goes_round_a_box_on_the_route_as_the_truck_can(car, config, y):
    vehicle, field = CARS[car], window(BOX)
    result = make_local_planner(vehicle, config).plan(line(y=y), field, (0.8, y, 0.0), LocalPlannerState())
    assert result.reason is Reason.OK
    assert field.free(vehicle.footprint, result.path.sample(0.01).poses, 0.01).all()
    assert drivable(vehicle, result.path)
    assert result.path.length > 0.5


@pytest.mark.parametrize("config", OURS, ids=name)
def test_the_same_question_has_the_same_answer(config):
    paths = [
        make_local_planner(CARS["4ws"], config).plan(line(), window(BOX), START, LocalPlannerState()).path.segments
        for _ in range(2)
    ]
    assert np.array_equal(*paths)


@pytest.mark.parametrize("config", OURS, ids=name)
def test_no_way_round_leads_up_to_it_and_is_reported_with_the_reason(config):
    cycles, route, wall = Cycles(make_local_planner(CARS["2ws"], config)), line(), window((2.2, 0, 2.4, 4))
    result, pose = cycles.step(route, wall, START), np.array(START)
    assert result.reason is Reason.PATH_PARTIAL
    for _ in range(4):
        if result.path is None:
            break
        assert result.path.end[0] + 0.405 < 2.2 - 0.3
        pose = result.path.end
        result = cycles.step(route, wall, pose)
    assert result.reason is Reason.PATH_BLOCKED
    assert result.text


@pytest.mark.parametrize("config", OURS, ids=name)
def test_what_is_free_of_a_blocked_path_is_given(config):
    cycles, route = Cycles(make_local_planner(CARS["2ws"], config)), line()
    first = cycles.step(route, window(), START)
    wall = first.path.end[0] - 0.2
    result = cycles.step(route, window((wall, 0, wall + 0.08, 4)), START)
    if first.path.length > 1.0:
        assert result.reason is Reason.PATH_PARTIAL
        assert result.path.end[0] + 0.405 < wall - 0.1
    assert not result.complete


@pytest.mark.parametrize("config", OURS, ids=name)
def test_a_truck_in_an_obstacle_is_reported(config):
    result = make_local_planner(CARS["4ws"], config).plan(
        line(), window((0.7, 1.9, 0.9, 2.1)), START, LocalPlannerState()
    )
    assert result.reason is Reason.START_BLOCKED


@pytest.mark.parametrize("config", OURS, ids=name)
def test_backward_routes_stay_backward_and_end_at_the_goal(config):
    x = np.arange(2.6, 1.2, -0.08)
    route = PosePath(np.column_stack((x, 2 + 0.1 * np.sin(x), np.zeros(len(x)))), -np.ones(len(x)))
    cycles = Cycles(make_local_planner(CARS["4ws"], config))
    result, pose = cycles.step(route, window(), route.poses[0]), route.poses[0]
    for _ in range(60):
        assert (result.path.segments[:, 0] < 0).all()
        if result.complete:
            break
        pose = result.path.part(0.0, 0.1).end
        result = cycles.step(route, window(), pose)
    assert result.complete
    assert np.hypot(*(result.path.end - route.poses[-1])[:2]) < 0.05


def test_a_free_path_is_kept_and_a_blocked_one_is_not():
    cycles, route = Cycles(make_local_planner(CARS["4ws"], RsbandConfig())), line()
    first = cycles.step(route, window(), START)
    same = cycles.step(route, window(), (0.9, 2.0, 0.0))
    assert same.statistics["kept"] == 1.0
    assert same.path.length == pytest.approx(first.path.length - 0.1, abs=1e-3)
    other = cycles.step(route, window((1.4, 1.9, 1.5, 2.1)), (0.9, 2.0, 0.0))
    assert other.statistics["kept"] == 0.0
    assert other.path is not None


def test_another_guide_starts_afresh():
    cycles = Cycles(make_local_planner(CARS["4ws"], RsbandConfig()))
    cycles.step(line(), window(), START)
    result = cycles.step(line(y=2.4), window(), (0.8, 2.4, 0.0))
    assert result.path.start[1] == pytest.approx(2.4)


def test_the_turning_radius_is_the_trucks_own():
    route = PosePath(np.array([[2.0, 2.0, 0.0], [2.4, 2.4, math.pi / 2]]), np.ones(2))
    tight = make_local_planner(CARS["counter"], RsbandConfig(strategy="start_to_end")).plan(
        route, window(), route.poses[0], LocalPlannerState()
    )
    assert tight.path.greatest_curvature == pytest.approx(1 / CARS["counter"].radius)
    published = make_local_planner(CARS["counter"], PublishedConfig(strategy="start_to_end")).plan(
        route, window(), route.poses[0], LocalPlannerState()
    )
    assert published.path.greatest_curvature == pytest.approx(1.0)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_as_published_finds_open_ways_and_breaks_on_a_blocked_one(strategy):
    planner = make_local_planner(CARS["2ws"], PublishedConfig(strategy=strategy))
    assert planner.plan(line(y=2.6), window(BOX), (0.8, 2.6, 0.0), LocalPlannerState()).path is not None
    blocked = planner.plan(line(), window(BOX), START, LocalPlannerState())
    assert blocked.reason is Reason.PATH_BLOCKED
    assert "band" in blocked.text


def test_published_headings_point_ahead_and_a_last_one_of_zero_is_lost():
    poses = np.array([[0, 0, 0.3], [1, 0, 2.0], [2, 1, 0.0]])
    assert oriented(poses)[:, 2].tolist() == pytest.approx([0.3, math.pi / 4, math.pi / 4])
    poses[2, 2] = 0.1
    assert oriented(poses)[2, 2] == 0.1


@pytest.mark.parametrize("car", CARS)
def test_derivatives_of_the_least_squares_are_exact(car):
    vehicle, field = CARS[car], window(BOX)
    cover, terms = cover_footprint(vehicle.footprint), teb_parameters(vehicle, TebConfig())
    rng = np.random.default_rng(1)
    route = resampled(line(end=3.4), 0.1)
    count = len(route.poses)
    band = np.column_stack((route.poses + rng.normal(0, 0.03, (count, 3)), rng.uniform(0.1, 0.7, count)))
    sense = np.where(np.arange(count) < count // 2, 1.0, -1.0)
    system = NormalEquations(np.zeros((4 * count + WIDTH, WIDTH)), np.zeros(4 * count + WIDTH), np.zeros(WIDTH))
    _assemble(field.data(), cover, terms, band, sense, system)
    gradient = system.gradient.copy()
    for i in range(4, 4 * count):
        change = []
        for step in (1e-6, -1e-6):
            moved = band.copy()
            moved.flat[i] += step
            change.append(0.5 * _assemble(field.data(), cover, terms, moved, sense, system))
        assert (change[0] - change[1]) / 2e-6 == pytest.approx(gradient[i], rel=1e-4, abs=1e-3)


def test_teb_keeps_the_side_of_an_obstacle_it_is_on():
    cycles, route = Cycles(make_local_planner(CARS["4ws"], TebConfig())), line(y=2.1)
    sides = set()
    for x in np.arange(0.8, 1.6, 0.1):
        path = cycles.step(route, window((2.2, 1.9, 2.4, 2.1)), (x, 2.1, 0.0)).path.sample(0.02).poses
        sides.add(float(np.sign(path[np.argmin(np.abs(path[:, 0] - 2.3)), 1] - 2.0)))
    assert len(sides) == 1


def test_a_cusp_is_passed_only_when_it_is_reached():
    route = PosePath(
        np.array([[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [0.5, 0.01, 0], [0, 0.02, 0]]), np.array([1.0, 1, 1, -1, -1])
    )
    assert nearest_pose(route, np.array([0.5, 0.005, 0.0])) == 1
    assert nearest_pose(route, np.array([0.95, 0.0, 0.0])) == 2
    path = MotionPath(np.zeros(3), np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    rest, far = remaining_path(path, np.array([0.5, 0.02, 0.0]))
    assert rest.length == pytest.approx(1.5)
    assert far == pytest.approx(0.02)


def test_what_follows_a_reached_cusp_no_longer_leads_back_to_it():
    route = PosePath(np.array([[0, 0, 0], [1, 0, 0], [0.5, 0, 0], [0, 0, 0]]), np.array([1.0, 1, -1, -1]))
    rest = remaining_band(route, np.array([0.96, 0.0, 0.0]))
    assert rest.directions.tolist() == [-1.0, -1.0, -1.0]
    assert len(remaining_band(rest, np.array([0.5, 0.0, 0.0])).poses) == 2


def test_the_way_found_is_kept_while_its_end_is_out_of_sight():
    vehicle = CARS["4ws"]
    surveyor = LocalPlannerCore(vehicle, RsbandConfig())
    band = line(begin=1.0, end=6.0)
    path, way, reason = surveyor.search(window(), np.array(START), band, 0, final=False)
    assert reason is Reason.OK
    assert path.end[0] < 4.0 - vehicle.footprint.circumscribed_radius
    assert way.poses[-1].tolist() == band.poses[-1].tolist()


def test_catalog_has_the_kinds_and_refuses_others():
    for kind, model in LOCAL_PLANNERS.settings.items():
        assert model().kind == kind
        assert make_local_planner(CARS["2ws"], model()).vehicle is CARS["2ws"]
    with pytest.raises(InputError, match="rsband, rsband-as-published, teb"):
        make_local_planner(CARS["2ws"], LocalPlannerConfig())


@pytest.mark.parametrize("config", [*OURS, PublishedConfig()], ids=name)
def test_a_pose_that_is_none_is_refused(config):
    with pytest.raises(InputError, match="pose"):
        make_local_planner(CARS["2ws"], config).plan(line(), window(), (math.nan, 0, 0), LocalPlannerState())


def test_route_off_the_window_is_reported():
    far = replace(line(), poses=line().poses + np.array([10.0, 0, 0]))
    for config in (*OURS, PublishedConfig()):
        result = make_local_planner(CARS["4ws"], config).plan(
            far, DistanceField(np.zeros((9, 9), bool), 0.1), START, LocalPlannerState()
        )
        assert result.reason is Reason.PATH_BLOCKED
