"""Routes that reverse only onto ground that was seen, or that their own way shows."""

import math
from typing import Any

import numpy as np
import pytest

from monstertruck_kinematics.se2 import Pose2, points_relative
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import DistanceField, Footprint, rectangle_distance
from monstertruck_planners.goals.config import EscapeConfig, PlannerConfig
from monstertruck_planners.goals.escape import escape
from monstertruck_planners.goals.exchange import PlanTask, RouteAnswer, SeenGround, Setup
from monstertruck_planners.goals.plan_step import PlanningStep
from monstertruck_planners.goals.unseen import BESIDE, SOON, Unseen, unseen_around
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.api import RouteMap, Vehicle
from monstertruck_planners.route.config import HybridConfig, LatticeConfig
from monstertruck_planners.route.hybrid import HybridPlanner
from monstertruck_planners.route.motion import MotionPath
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Grid
from monstertruckd.gate.scan_memory import DRIFT

PACE = 0.1

FOOTPRINT = Footprint()
BACK = FOOTPRINT.half_length - FOOTPRINT.offset
LIDAR = (0.14, 0.0, 0.0)
FIELD = (-math.radians(120), math.radians(120))
HERE = (2.0, 1.5, 0.0)


def grid(cells: np.ndarray, origin: tuple[float, float], frame: str) -> Grid:
    rows, columns = cells.shape
    return Grid(
        stamp=0, received=0, seq=0, frame=frame, resolution=0.05, width=columns, height=rows,
        origin=Pose2D(x=origin[0], y=origin[1], yaw=0.0), cells=cells.astype(np.int8).reshape(-1),
    )  # fmt: skip


def survey(*, age: int = 0, pose: Pose2 = HERE) -> SeenGround:
    """What a lidar of 240 degrees has seen of open ground since it was switched on there: all but what is behind."""
    middle = (np.arange(64) + 0.5 - 32) * 0.05
    x, y = np.meshgrid(middle, middle)
    seen = np.abs(np.arctan2(y, x - LIDAR[0])) < FIELD[1]
    beyond = np.maximum(np.abs(x - FOOTPRINT.offset) - FOOTPRINT.half_length, np.abs(y) - FOOTPRINT.half_width)
    return SeenGround(grid(np.where(seen | (beyond < BESIDE), age, -1), (-1.6, -1.6), "base"), pose, FIELD, 4.0)


def planned(
    goal: Pose2, seen: SeenGround | None, *, room: np.ndarray | None = None, pose: Pose2 = HERE, route: Any = None
) -> tuple[RouteAnswer, PlanningStep]:
    cells = np.zeros((60, 100)) if room is None else room
    config = PlannerConfig(route=route or HybridConfig(margin=0.04, effort=3000, reverse_cost=2.0))
    setup = Setup(config, FourWheelSteering(), FOOTPRINT, LIDAR, seen_for=30.0)
    step = PlanningStep()
    none = np.empty((0, 2))
    return step.step(PlanTask("route", pose, goal, none, setup, grid(cells, (0.0, 0.0), "map"), ground_seen=seen)), step


def backed_onto(path: PosePath | None, seen: SeenGround) -> np.ndarray:
    unseen = unseen_around(seen, 30.0, LIDAR, FOOTPRINT)
    assert path is not None
    return unseen.met(path, DistanceField(np.zeros((60, 100), np.bool_), 0.05))


@pytest.mark.parametrize("route", [None, LatticeConfig(effort=6000)])
def test_a_goal_behind_is_reached_by_way_of_ground_that_is_seen(route):
    goal = (1.0, 1.5, 0.0)
    free, _ = planned(goal, None, route=route)
    assert free.path is not None
    assert free.path.directions[0] < 0
    assert len(backed_onto(free.path, survey()))
    answer, _ = planned(goal, survey(), route=route)
    assert answer.reason is Reason.OK, answer.text
    assert not len(backed_onto(answer.path, survey()))
    assert answer.path is not None
    assert answer.path.directions[0] > 0, "forward first"


def test_where_the_body_stood_and_what_was_seen_lately_may_be_reversed_onto():
    everywhere = SeenGround(grid(np.zeros((64, 64)), (-1.6, -1.6), "base"), HERE, FIELD, 4.0)
    for seen, goal in ((everywhere, (1.2, 1.5, 0.0)), (survey(pose=(1.7, 1.5, 0.0)), (1.7, 1.5, 0.0))):
        answer, _ = planned(goal, seen)
        assert answer.reason is Reason.OK
        if seen is everywhere:
            assert answer.path is not None
            assert (answer.path.directions < 0).all()


def test_the_route_around_unseen_ground_ends_its_reverse_motions_before_the_edge():
    """Otherwise the next routes back onto the edge again, and it drives to a viewpoint instead of to the goal."""
    goal = (1.4, 1.5, math.pi)
    answer, _ = planned(goal, survey())
    assert answer.path is not None
    assert (answer.path.directions < 0).any()
    assert not len(backed_onto(answer.path, survey()))
    assert math.dist(answer.path.poses[-1, :2], goal[:2]) < 0.05


def test_before_a_wall_with_nothing_seen_behind_the_goal_is_refused_with_place_and_remedy():
    room = np.full((60, 100), 0)
    room[:, 47:] = 100  # x = 2.35: the bumper is nearer than the margin
    room[:22] = room[38:] = 100
    answer, _ = planned((1.0, 1.5, 0.0), survey(), room=room)
    assert answer.reason is Reason.UNSEEN_STOP
    assert "no sensor has seen, at 1." in answer.text
    assert "second control" in answer.text
    free, _ = planned((1.0, 1.5, 0.0), None, room=room)
    assert free.reason is Reason.OK, "there is a way"


def test_from_where_no_way_to_the_goal_is_seen_it_drives_to_a_place_that_shows_one():
    """The goal's own ground lies in what is not seen: it cannot be entered from the front, for a wall is behind it."""
    room = np.zeros((60, 100))
    room[:, :12] = 100  # x = 0.6
    goal = (1.0, 1.5, 0.0)
    answer, _ = planned(goal, survey(pose=(1.35, 1.5, 0.0)), room=room, pose=(1.35, 1.5, 0.0))
    assert answer.reason is Reason.OK, answer.text
    assert not len(backed_onto(answer.path, survey(pose=(1.35, 1.5, 0.0))))


def path(*legs: tuple[float, float]) -> PosePath:
    """A path straight on from HERE: metres along, and the direction, of every leg."""
    xs, directions = [0.0], [legs[0][1]]
    for length, direction in legs:
        steps = np.arange(1, round(length / 0.05) + 1) * 0.05 * direction
        xs += (xs[-1] + steps).tolist()
        directions += [direction] * len(steps)
    poses = np.array([(HERE[0] + x, HERE[1], 0.0) for x in xs])
    return PosePath(poses, np.array(directions))


@pytest.mark.parametrize(
    ("legs", "met"),
    [
        ([(1.0, 1.0)], False),
        ([(0.1, -1.0)], True),
        ([(0.5, 1.0), (0.5, -1.0)], False),
        ([(0.5, 1.0), (0.6, -1.0)], True),
    ],
)
def test_a_path_backs_onto_unseen_ground_beyond_where_it_began(legs, met):
    assert bool(len(backed_onto(path(*legs), survey()))) is met


@pytest.mark.parametrize(
    ("behind", "beside", "met"), [(0.8, 0.0, True), (1.2, 0.0, False), (-1.0, 0.8, False), (-1.0, -0.2, True)]
)
def test_a_reverse_motion_ends_where_the_gate_would_stop_before_unseen_ground(behind, beside, met):
    """The gate looks along the motion: ground beside the body does not stop it, ground within its padding does."""
    assert BESIDE == DRIFT
    assert FOOTPRINT.padding > 0.2 * DRIFT
    side = 0.0 if behind > 0 else FOOTPRINT.half_width
    places = np.array([(HERE[0] - 0.2 - BACK - behind * DRIFT, HERE[1] + side + beside * DRIFT)])
    unseen = Unseen(places, np.zeros(1), LIDAR, FIELD, 4.0, FOOTPRINT)
    free = DistanceField(np.zeros((60, 100), np.bool_), 0.05)
    assert bool(len(unseen.met(path((0.2, -1.0)), free))) is met


def test_ground_ceases_to_be_seen_before_a_path_comes_to_it():
    """All of it counts for some time more; what the path itself covers counts longer."""
    seen = SeenGround(grid(np.full((64, 64), 80), (-1.6, -1.6), "base"), HERE, FIELD, 4.0)
    left = 30.0 * 0.2
    assert left > SOON
    assert not len(backed_onto(path((0.05, -1.0)), seen))
    assert len(backed_onto(path(((left - SOON) * PACE + 0.2, -1.0)), seen))


def test_walls_hide_ground_from_a_path():
    """It turns to look at what was behind it; a wall before that hides it."""
    turned = np.array([(HERE[0], HERE[1], yaw) for yaw in np.linspace(0.0, math.pi / 2, 10)])
    back = np.array([(HERE[0] - x, HERE[1], 0.0) for x in (0.05, 0.1, 0.15)])
    looking = PosePath(np.vstack((turned, back)), np.array([1.0] * 10 + [-1.0] * 3))
    places = np.array([(HERE[0] - BACK - 0.11, HERE[1])])
    unseen = Unseen(places, np.zeros(1), (0.0, 0.0, 0.0), FIELD, 4.0, FOOTPRINT)
    free = np.zeros((60, 100), np.bool_)
    assert not len(unseen.met(looking, DistanceField(free, 0.05)))
    free[25:35, 36] = True  # between the body's middle and its end
    assert len(unseen.met(looking, DistanceField(free, 0.05)))


def test_it_does_not_back_out_onto_unseen_ground():
    config, near = EscapeConfig(), np.array([(FOOTPRINT.half_length + 0.02, 0.0)])
    geometry = FourWheelSteering()
    free = escape(config, geometry, FOOTPRINT, near, crab=True, rear=True)
    assert free is not None
    assert free.direction < 0
    behind = np.array([(-BACK - x, y / 20) for x in (0.2, 0.22) for y in range(-4, 5)])
    short = escape(config, geometry, FOOTPRINT, near, crab=True, rear=True, unseen=behind)
    assert short is not None
    assert 0.1 < len(short.poses) * 0.02 <= 0.24 < len(free.poses) * 0.02
    assert (
        escape(config, geometry, FOOTPRINT, near, crab=True, rear=True, unseen=behind + np.array((0.19, 0.0))) is None
    )


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_closed_ground_is_driven_onto_forward_only(direction):
    closed = np.zeros((60, 100), np.bool_)
    closed[:, 50:] = True
    vehicle = Vehicle.truck()
    planner = HybridPlanner(vehicle, HybridConfig())
    start = np.array([1.5, 1.5, 0.0 if direction > 0 else math.pi])
    onto = MotionPath(start, np.array([[direction, 0.0, 0.0]]))
    for unseen, free in ((None, True), (closed, direction > 0)):
        route_map = RouteMap.from_cells(np.zeros((60, 100), np.int8), 0.05, unseen=unseen)
        assert planner.free(route_map, onto) is free
        assert (planner.leaving(route_map, onto) is not None) is free


def test_closed_ground_beside_the_track_does_not_hold_a_truck():
    """Its cells are counted by their middle: the ones next to where it stood do not matter."""
    closed = np.ones((60, 100), np.bool_)
    centres = (np.stack(np.meshgrid(np.arange(100), np.arange(60)), axis=2).reshape(-1, 2) + 0.5) * 0.05
    track = np.array([(x, 1.5, 0.0) for x in np.arange(1.0, 2.01, 0.05)])
    closed.reshape(-1)[(rectangle_distance(FOOTPRINT, track, centres) < 0.0).any(axis=0)] = False
    route_map = RouteMap.from_cells(np.zeros((60, 100), np.int8), 0.05, unseen=closed)
    back = MotionPath(np.array([2.0, 1.5, 0.0]), np.array([[-1.0, 0.0, 0.0]]))
    assert HybridPlanner(Vehicle.truck(), HybridConfig()).free(route_map, back)
    assert points_relative(centres[:1], HERE).shape == (1, 2)


def test_the_path_of_a_braking_truck_begins_where_it_comes_to_rest():
    start = (HERE[0] + 0.1, HERE[1], 0.2)
    config = PlannerConfig(route=HybridConfig(margin=0.04, effort=3000))
    setup = Setup(config, FourWheelSteering(), FOOTPRINT, LIDAR, seen_for=30.0)
    open_ground = grid(np.zeros((60, 100)), (0.0, 0.0), "map")
    task = PlanTask("route", HERE, (3.5, 1.5, 0.0), np.empty((0, 2)), setup, open_ground, start=start)
    path = PlanningStep().step(task).path
    assert path is not None
    assert path.poses[0] == pytest.approx(start)
