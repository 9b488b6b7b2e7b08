"""Decisions about goals, backing out, the way ahead, and the planning step."""

import math
import pathlib
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from monstertruck_kinematics.se2 import placed, points_relative
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint, clearance_to_points
from monstertruck_planners.goals import goal_run
from monstertruck_planners.goals.config import EscapeConfig, PlannerConfig
from monstertruck_planners.goals.escape import blocked_sides, escape
from monstertruck_planners.goals.exchange import PlanTask, RouteAnswer, SeenScan, Setup
from monstertruck_planners.goals.goal_run import Action, Follow, GoalRun, Halt, Observations, Plan, Report
from monstertruck_planners.goals.path_publisher import kept_poses, path_blocked, poses_ahead
from monstertruck_planners.goals.plan_step import PlanningStep, shortened
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.config import HybridConfig, LatticeConfig
from monstertruck_planners.track.segments import check_path
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.plan import GoalPhase, Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalOrder
from monstertruck_schemas.state import Grid

GOAL = (2.0, 0.0, 0.0)
CONFIG = PlannerConfig()
WAY = RouteAnswer(Reason.OK, path=PosePath(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), np.ones(2)), length=2.0)


class SteppedRun:
    """A run that is given facts; time passes by 0.1 s a fact."""

    def __init__(self, config: PlannerConfig = CONFIG) -> None:
        self.config = config
        self.now = 0.0
        self.run, actions = goal_run.begin(1, GOAL, "tester", 0.0)
        self.done: list[Action] = list(actions)

    def step(self, count: int = 1, **observed: Any) -> tuple[Action, ...]:
        actions: list[Action] = []
        for _ in range(count):
            self.now += 0.1
            known: dict[str, Any] = {"armed": True, "at_rest": True, "pose": (0.0, 0.0, 0.0), **observed}
            self.run, some = goal_run.tick(self.run, Observations(now=self.now, **known), self.config)
            actions += some
        self.done += actions
        return tuple(actions)

    def order(self, what: GoalOrder) -> tuple[Action, ...]:
        self.run, actions = goal_run.order(self.run, what, "tester", self.now)
        return actions

    @property
    def phase(self) -> GoalPhase:
        return self.run.phase


def reported(actions: Iterable[Action]) -> list[Reason]:
    return [action.reason for action in actions if isinstance(action, Report)]


def test_a_goal_is_planned_followed_and_reached():
    run = SteppedRun()
    assert run.done == [Report(Reason.GOAL_ACCEPTED, goal_run.Severity.INFO, run.done[0].text), Plan(clear=True)]  # type: ignore[union-attr]
    assert run.step() == ()
    actions = run.step(answer=WAY)
    assert (run.phase, actions[0], reported(actions)) == (GoalPhase.DRIVING, Follow(WAY), [Reason.ROUTE_FOUND])
    assert run.step(10, along=1.0, at_rest=False) == ()
    assert run.step(outcome=Reason.GOAL_REACHED, at_rest=False, pose=GOAL) == (), "still rolling"
    actions = run.step(outcome=Reason.GOAL_REACHED, pose=(1.95, 0.02, 0.05 + math.tau))
    assert (run.run.outcome, run.run.active) == (Reason.GOAL_REACHED, False)
    assert (Halt() in actions, reported(actions)) == (True, [Reason.GOAL_REACHED])
    assert run.step(answer=WAY) == ()


@pytest.mark.parametrize(
    "reason", [Reason.GOAL_BLOCKED, Reason.GOAL_OUTSIDE, Reason.GOAL_UNREACHABLE, Reason.UNSEEN_STOP]
)
def test_a_goal_without_a_way_is_refused_at_once(reason: Reason):
    run = SteppedRun()
    run.step(answer=RouteAnswer(reason, "why"))
    assert (run.run.outcome, run.run.text, run.run.recoveries) == (reason, "why", 0)


def test_an_end_beside_the_goal_is_planned_again_but_not_for_ever():
    run = SteppedRun()
    for _ in range(goal_run.MISSES):
        run.step(answer=WAY)
        assert reported(run.step(outcome=Reason.GOAL_REACHED, pose=(1.7, 0.0, 0.0))) == [Reason.GOAL_MISSED]
        assert run.phase is GoalPhase.PLANNING
    run.step(answer=WAY)
    run.step(outcome=Reason.GOAL_REACHED, pose=(2.0, 0.0, 0.3))
    assert run.run.outcome is Reason.GOAL_MISSED


def test_a_goal_where_the_truck_stands_is_reached_without_driving():
    here = (1.0, 1.5, 0.0)
    answer = PlanningStep().step(task(goal=(1.0, 1.5, 1e-9), setup=setup(), grid=hall()))
    assert answer.path is not None
    run = SteppedRun()
    run.run = replace(run.run, goal=here)
    actions = run.step(answer=answer, pose=here)
    assert reported(actions) == [Reason.GOAL_REACHED]
    assert not any(isinstance(action, Follow) for action in actions), "no tracker takes a path without length"
    assert (run.run.outcome, run.run.routes) == (Reason.GOAL_REACHED, 1)


def test_a_goal_is_not_reached_before_its_waypoints_are_passed():
    run = SteppedRun()
    run.run = replace(run.run, via=((1.0, 1.0, None),))
    for _ in range(goal_run.MISSES):
        run.step(answer=WAY)
        assert reported(run.step(outcome=Reason.GOAL_REACHED, pose=GOAL)) == [Reason.GOAL_MISSED]
        assert run.phase is GoalPhase.PLANNING
    run.step(answer=WAY)
    run.step(outcome=Reason.GOAL_REACHED, pose=GOAL)
    assert (run.run.outcome, run.run.text) == (Reason.GOAL_MISSED, "1 waypoint not passed")


def test_a_place_within_the_tolerance_is_corrected_once_then_taken():
    run = SteppedRun()
    for outcome in (Reason.DRIVING, Reason.GOAL_REACHED):
        run.step(answer=WAY)
        run.step(outcome=Reason.GOAL_REACHED, pose=(2.0, 0.0, 0.15))
        assert run.run.outcome is outcome


def test_a_correction_that_ends_worse_is_corrected_again():
    run = SteppedRun()
    for yaw, outcome in ((0.1, Reason.DRIVING), (0.15, Reason.DRIVING), (0.1, Reason.GOAL_REACHED)):
        run.step(answer=WAY)
        run.step(outcome=Reason.GOAL_REACHED, pose=(2.0, 0.0, yaw))
        assert run.run.outcome is outcome


def test_within_the_tolerance_it_has_reached_its_goal_after_the_last_correction_too():
    run = SteppedRun()
    for number, yaw in enumerate((0.1, 0.15, 0.15, 0.15, 0.15, 0.15)):
        run.step(answer=WAY)
        run.step(outcome=Reason.GOAL_REACHED, pose=(2.0, 0.0, yaw))
        assert run.run.outcome is (Reason.GOAL_REACHED if number == 5 else Reason.DRIVING)


def test_an_obstacle_on_the_way_is_planned_round_while_the_truck_drives_on():
    run = SteppedRun()
    run.step(answer=WAY)
    assert run.step(CONFIG.blocked_scans - 1, blocked=True, along=0.2) == ()
    actions = run.step(blocked=True, along=0.3)
    assert (reported(actions), Plan() in actions, Halt() in actions) == ([Reason.PATH_BLOCKED], True, False)


def test_a_keepout_zone_over_the_goal_ends_the_drive_at_once():
    run = SteppedRun()
    run.step(answer=WAY)
    actions = run.step(zone="stairs")
    assert (run.run.outcome, Halt() in actions) == (Reason.KEEPOUT, True)
    assert "zone stairs" in run.run.text


def test_it_is_not_stuck_while_it_lets_people_pass():
    run = SteppedRun()
    run.step(answer=WAY)
    assert run.step(round(3 * CONFIG.stuck / 0.1), yields=True) == ()
    assert run.phase is GoalPhase.DRIVING


def test_before_unseen_ground_it_plans_anew_and_at_last_gives_up():
    run = SteppedRun(PlannerConfig(recovery=("replan",)))
    run.step(answer=WAY)
    for _ in range(goal_run.BLOCKS):
        assert reported(run.step(3, unseen=True)) == [Reason.UNSEEN_STOP]
        assert (run.phase, run.done[-1]) == (GoalPhase.PLANNING, Plan())
        run.step(answer=WAY)
    assert reported(run.step(3, unseen=True)) == [Reason.RECOVERING]
    run.step(answer=WAY)
    run.step(3, unseen=True)
    assert (run.run.outcome, run.run.active) == (Reason.UNSEEN_STOP, False)


def test_before_unseen_ground_within_the_tolerance_it_has_arrived():
    run = SteppedRun()
    run.step(answer=WAY)
    assert reported(run.step(3, unseen=True, pose=(1.85, 0.0, 0.1))) == [Reason.GOAL_REACHED]
    assert not run.run.active


def test_what_backs_out_onto_unseen_ground_plans_anew():
    run = SteppedRun()
    run.run = replace(run.run, planned="escape")
    run.step(answer=WAY)
    assert run.phase is GoalPhase.BACKING_OUT
    run.step(3, unseen=True)
    assert (run.phase, run.run.planned) == (GoalPhase.PLANNING, "route")


def test_the_recovery_behaviours_are_tried_in_order_and_then_the_goal_is_given_up():
    run = SteppedRun()
    run.step(answer=WAY)
    stuck = round(CONFIG.stuck / 0.1) + 2
    assert Plan(clear=True) in run.step(stuck)
    run.step(answer=WAY)
    assert Plan("escape") in run.step(stuck)
    run.step(answer=WAY)
    assert run.phase is GoalPhase.BACKING_OUT
    assert Plan() in run.step(outcome=Reason.GOAL_REACHED)
    run.step(answer=WAY)
    run.step(stuck)
    assert run.phase is GoalPhase.WAITING
    assert Plan() in run.step(round(CONFIG.wait / 0.1) + 2)
    run.step(answer=RouteAnswer(Reason.GOAL_UNREACHABLE, "walled in"))
    assert (run.phase, run.run.recoveries) == (GoalPhase.PLANNING, 4)
    run.step(answer=RouteAnswer(Reason.GOAL_UNREACHABLE, "walled in"))
    assert (run.run.outcome, run.run.text) == (Reason.GOAL_UNREACHABLE, "walled in")


def test_the_recovery_behaviours_begin_anew_once_the_truck_is_nearer_to_the_goal_than_ever():
    run = SteppedRun()
    run.step(answer=WAY)
    run.step(round(CONFIG.stuck / 0.1) + 2, left=1.8)
    run.step(answer=WAY)
    assert run.run.next_recovery == 1
    for left in (1.9, 1.8, 1.35):
        run.step(along=2.0 - left, left=left)
        assert run.run.next_recovery == 1
    run.step(along=0.75, left=1.25)
    assert run.run.next_recovery == 0


def test_driving_to_and_fro_between_two_ways_that_are_blocked_ends():
    run = SteppedRun(PlannerConfig(routes=1000))
    for _ in range(12):
        run.step(answer=WAY)
        run.step(5, along=1.0, left=3.0)
        run.step(round(CONFIG.stuck / 0.1) + 2, along=2.0, left=1.0)
        if run.phase is GoalPhase.WAITING:
            run.step(round(CONFIG.wait / 0.1) + 2)
        elif run.run.planned == "escape":
            run.step(answer=RouteAnswer(Reason.STUCK))
            run.step(round(CONFIG.wait / 0.1) + 2)
    assert (run.run.outcome, run.run.recoveries) == (Reason.STUCK, 4)


def test_a_failed_escape_is_the_next_recovery_behaviour():
    run = SteppedRun(PlannerConfig(recovery=("back_out", "wait")))
    run.step(answer=RouteAnswer(Reason.START_BLOCKED))
    run.step(answer=RouteAnswer(Reason.STUCK, "both ends"))
    assert run.phase is GoalPhase.WAITING


def test_a_lost_path_is_planned_anew():
    run = SteppedRun()
    run.step(answer=WAY)
    assert Plan() in run.step(outcome=Reason.PATH_LOST)


def test_time_counts_only_while_the_truck_could_drive():
    run = SteppedRun(PlannerConfig(timeout=5.0, unarmed_timeout=20.0))
    run.step(answer=WAY)
    run.step(190, armed=False)
    assert run.run.active
    for i in range(60):
        run.step(along=0.05 * i)
    assert run.run.outcome is Reason.GOAL_TIMEOUT
    waiting = SteppedRun(PlannerConfig(unarmed_timeout=20.0))
    waiting.step(answer=WAY)
    waiting.step(210, armed=False, held="battery critical")
    assert waiting.run.outcome is Reason.DISARMED
    assert waiting.run.text == "not armed for 20 s: battery critical"
    placeless = SteppedRun(PlannerConfig(unarmed_timeout=20.0))
    placeless.step(answer=WAY)
    placeless.step(210, armed=False, pose=None)
    assert (placeless.run.outcome, placeless.run.text) == (Reason.NO_MAP, "no fresh pose for 20 s")


def test_orders_pause_resume_and_cancel():
    run = SteppedRun()
    run.step(answer=WAY)
    assert run.order(GoalOrder.RESUME) == ()
    assert Halt() in run.order(GoalOrder.PAUSE)
    assert run.step(1000) == ()
    assert Plan() in run.order(GoalOrder.RESUME)
    assert run.phase is GoalPhase.PLANNING
    assert Halt() in run.order(GoalOrder.CANCEL)
    assert run.run.outcome is Reason.CANCELLED
    assert run.order(GoalOrder.CANCEL) == ()


def test_somebody_elses_path_is_left_alone():
    run, _ = goal_run.begin(1, GOAL, "tester", 0.0)
    ended, actions = goal_run.displaced(run, "another path")
    assert (ended.outcome, Halt() in actions) == (Reason.CANCELLED, False)


def test_routes_are_limited():
    run = SteppedRun(PlannerConfig(routes=2))
    for _ in range(2):
        run.step(answer=WAY)
        run.step(outcome=Reason.PATH_LOST)
    assert isinstance(run.run, GoalRun)
    assert run.run.outcome is Reason.STUCK


# Backing out

BODY, TRUCK = Footprint(), FourWheelSteering()
WALL_AHEAD = np.column_stack((np.full(21, 0.35), np.linspace(-0.3, 0.3, 21)))
WALL_LEFT = np.column_stack((np.linspace(-0.3, 0.3, 21), np.full(21, 0.25)))


@pytest.mark.parametrize(
    ("points", "sides"),
    [
        (WALL_AHEAD, (True, False, False, False)),
        (-WALL_AHEAD, (False, True, False, False)),
        (WALL_LEFT, (False, False, True, False)),
        (-WALL_LEFT, (False, False, False, True)),
        (np.array([[0.35, 0.07]]), (True, False, False, False)),  # between the package's three samples of a side
        (np.empty((0, 2)), (False, False, False, False)),
    ],
)
def test_blocked_sides_are_found_anywhere_along_them(points, sides):
    found = blocked_sides(BODY, points, 0.15)
    assert (found.front, found.rear, found.left, found.right) == sides
    assert found.any is any(sides)


def test_it_backs_out_from_a_wall_ahead_and_crabs_away_from_one_beside():
    back = escape(EscapeConfig(), TRUCK, BODY, WALL_AHEAD, crab=True, rear=True)
    assert back is not None
    assert (back.direction, back.poses[-1, 0]) == (-1, pytest.approx(-0.5))
    for direction, walls in ((1, WALL_LEFT), (-1, np.vstack((WALL_LEFT, WALL_AHEAD)))):
        aside = escape(EscapeConfig(), TRUCK, BODY, walls, crab=True, rear=True)
        assert aside is not None
        assert (aside.direction, aside.steering) == (direction, "crab")
        assert aside.poses[-1, 1] < -0.1, "to the right"
        assert np.all(aside.poses[:, 2] == 0.0)
        beside = math.hypot(*aside.poses[-1, :2])
        assert beside == pytest.approx(0.5), "the whole way: cos b, not sqrt(1 / (1 + tan b))"


def test_the_way_out_ends_before_the_next_obstacle_and_both_ends_blocked_is_none():
    behind = -WALL_AHEAD - [0.2, 0.0]
    out = escape(EscapeConfig(), TRUCK, BODY, np.vstack((WALL_AHEAD, behind)), crab=False, rear=True)
    assert out is not None
    assert 0.1 < -out.poses[-1, 0] < 0.3
    assert clearance_to_points(BODY, out.poses, behind).min() > 0.0
    assert escape(EscapeConfig(), TRUCK, BODY, np.vstack((WALL_AHEAD, -WALL_AHEAD)), crab=True, rear=True) is None


def test_frames_there_and_back():
    at = (1.0, -2.0, 2.1)
    points = np.array([[0.3, 0.4], [-1.0, 2.0]])
    flat = np.column_stack((points, np.zeros(2)))
    assert np.allclose(points_relative(placed(flat, at)[:, :2], at), points)


def test_the_way_ahead_is_blocked_by_what_stands_on_it_only():
    path = PosePath(np.column_stack((np.linspace(1.0, 5.0, 81), np.ones(81), np.zeros(81))), np.ones(81))
    at = (2.0, 1.0, 0.0)
    way = poses_ahead(path, 1.0, 1.5, at)
    assert way[0].tolist() == list(at)
    assert way[-1, 0] == pytest.approx(3.5, abs=0.06)
    assert path_blocked(BODY, way, np.array([[1.0, 0.1]]), at)
    assert not path_blocked(BODY, way, np.array([[1.0, 0.3], [2.5, 0.0]]), at)
    assert not path_blocked(BODY, way, np.empty((0, 2)), at)
    none, travelled = np.zeros(0, np.intp), path.travelled
    assert travelled[kept_poses(travelled, 1.0, 0.2, none)][[0, -1]] == pytest.approx([1.0, 1.2], abs=0.06)
    assert kept_poses(travelled, 0.0, 0.0, none) == slice(0, 2)
    assert len(travelled[kept_poses(travelled, travelled[-1] + 1.0, 0.0, none)]) == 2


# Planning


def hall(shut: bool = False) -> Grid:
    cells = np.zeros((60, 120), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    if shut:
        cells[:, 60] = 100
    return Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=0.05, width=120, height=60,
        origin=Pose2D(x=0.0, y=0.0, yaw=0.0), cells=cells.ravel(),
    )  # fmt: skip


def setup(**config: Any) -> Setup:
    settings = {"route": HybridConfig(effort=2000, margin=0.04), **config}
    return Setup(PlannerConfig(**settings), TRUCK, BODY)


def task(goal=(4.5, 1.5, 0.0), points=(), **fields: Any) -> PlanTask:
    fields = {"what": "route", "pose": (1.0, 1.5, 0.0), **fields}
    return PlanTask(goal=goal, points=np.array(points, dtype=np.float64).reshape(-1, 2), **fields)


@pytest.mark.parametrize("route", [HybridConfig(effort=2000, margin=0.04), LatticeConfig(effort=2000, margin=0.04)])
def test_routes_round_what_the_scan_shows_until_that_is_forgotten(route):
    step = PlanningStep()
    straight = step.step(task(setup=setup(route=route), grid=hall()))
    assert straight.path is not None
    assert straight.length == pytest.approx(3.5, abs=0.05)
    post = [(2.75, y) for y in np.arange(1.3, 1.75, 0.05)]
    assert straight.path is not None
    round_it = step.step(task(points=post))
    assert round_it.length > straight.length + 0.02
    assert round_it.path is not None
    assert clearance_to_points(BODY, round_it.path.poses, np.array(post)).min() > 0.0
    assert step.step(task()).length > straight.length + 0.02, "remembered"
    assert step.step(task(clear=True)).length == pytest.approx(straight.length, abs=0.05)


def test_what_scans_on_the_way_showed_counts_though_the_newest_does_not():
    step = PlanningStep()
    straight = step.step(task(setup=setup(), grid=hall()))
    post = np.array([(2.75, y) for y in np.arange(1.3, 1.75, 0.05)])
    sensor = np.array([1.0, 1.5])
    round_it = step.step(task(seen=(SeenScan(post, sensor),)))
    assert round_it.path is not None
    assert round_it.length > straight.length + 0.02
    assert clearance_to_points(BODY, round_it.path.poses, post).min() > 0.0
    beyond = np.array([(5.95, y) for y in np.arange(0.5, 2.5, 0.01)])
    gone = step.step(task(seen=(SeenScan(post, sensor), SeenScan(beyond, sensor)), afresh=True))
    assert gone.length == pytest.approx(straight.length, abs=0.05), "a later one saw through"


def test_what_no_scan_sees_behind_the_truck_is_not_forgotten():
    step = PlanningStep()
    post = [(0.4, y) for y in np.arange(1.3, 1.75, 0.05)]
    wall = [(1.33, y) for y in np.arange(1.2, 1.8, 0.05)]
    step.step(task(setup=setup(), grid=hall(), points=post))
    out = step.step(task(what="escape", points=wall, clear=True))
    assert out.path is not None
    assert 0.04 < 1.0 - out.path.poses[-1, 0] < 0.35, "not through the post"
    gone = step.step(task(what="escape", pose=(3.0, 1.5, 0.0), points=[(x + 2.0, y) for x, y in wall], clear=True))
    assert gone.path is not None
    back = step.step(task(what="escape", points=wall))
    assert back.path is not None
    assert 0.04 < 1.0 - back.path.poses[-1, 0] < 0.35, "cleared from afar, and seen through by no scan"


def test_what_was_cleared_from_afar_is_driven_at_forward_and_not_backed_into():
    """A corridor of 0.7 m with a box across it: none can turn."""
    grid = hall()
    cells = grid.cells.reshape(60, 120).copy()
    cells[:23] = cells[37:] = 100
    grid = grid.model_copy(update={"cells": cells.ravel()})
    box = [(2.5, y) for y in np.arange(1.2, 1.85, 0.05)]
    forward = PlanningStep()
    assert forward.step(task(setup=setup(), grid=grid, points=box)).reason is Reason.GOAL_UNREACHABLE
    assert forward.step(task(clear=True)).reason is Reason.GOAL_UNREACHABLE, "near, it counts"
    forward.step(task(clear=True, pose=(0.5, 1.5, 0.0)))
    assert forward.step(task(clear=True, pose=(0.5, 1.5, 0.0))).reason is Reason.OK
    backward = PlanningStep()
    there = {"pose": (4.8, 1.5, 0.0), "goal": (1.0, 1.5, 0.0)}
    assert backward.step(task(setup=setup(), grid=grid, points=box, **there)).reason is Reason.GOAL_UNREACHABLE
    assert backward.step(task(clear=True, **there)).reason is Reason.GOAL_UNREACHABLE
    ahead = [(5.7, 1.5)]
    assert backward.step(task(points=ahead, **there)).reason is Reason.GOAL_UNREACHABLE, "nor later"
    seen_through = [(0.2, y) for y in np.arange(1.0, 2.0, 0.01)]
    assert backward.step(task(points=seen_through, **there)).reason is Reason.OK


def test_what_a_scan_sees_through_is_forgotten():
    step = PlanningStep()
    straight = step.step(task(setup=setup(), grid=hall()))
    post = [(2.75, y) for y in np.arange(1.3, 1.75, 0.05)]
    assert step.step(task(points=post)).length > straight.length + 0.02
    far = [(5.95, y) for y in np.arange(0.05, 2.95, 0.02)]
    assert step.step(task(points=far, afresh=True)).length == pytest.approx(straight.length, abs=0.05)


def test_a_valid_route_is_kept():
    step = PlanningStep()
    assert not step.step(task(setup=setup(), grid=hall())).kept
    again = step.step(task(pose=(1.5, 1.52, 0.02)))
    assert again.kept
    assert again.path is not None
    assert np.allclose(again.path.poses[0], (1.5, 1.52, 0.02))


def test_a_map_that_cannot_be_read_is_named_until_there_is_another_one(tmp_path: pathlib.Path):
    (tmp_path / "map.yaml").write_text("image: [")
    step = PlanningStep()
    answer = step.step(task(setup=setup(map=tmp_path / "map.yaml")))
    assert (answer.reason, answer.path) == (Reason.BAD_INPUT, None)
    assert str(tmp_path / "map.yaml") in answer.text
    assert step.step(task(grid=hall())).reason is Reason.OK


def test_goals_without_a_way_and_what_is_missing():
    step = PlanningStep()
    with pytest.raises(InputError, match="setup"):
        step.step(task())
    assert step.step(task(setup=setup())).reason is Reason.NO_MAP
    assert step.step(task(grid=hall(shut=True))).reason is Reason.GOAL_UNREACHABLE
    assert step.step(task((9.0, 1.5, 0.0))).reason is Reason.GOAL_OUTSIDE
    assert step.step(task((5.95, 1.5, 0.0))).reason is Reason.GOAL_BLOCKED
    assert step.step(task((math.nan, 1.5, 0.0))).reason is Reason.NOT_FINITE


def test_a_truck_that_stands_within_the_margin_may_leave():
    step = PlanningStep()
    assert step.step(task(setup=setup(), grid=hall(), pose=(1.0, 0.25, 0.0))).path is not None


def test_backing_out_sees_the_map_behind_the_truck_too():
    step = PlanningStep()
    wall = [(1.33, y) for y in np.arange(1.2, 1.8, 0.05)]
    out = step.step(task(what="escape", setup=setup(), grid=hall(), points=wall))
    assert out.path is not None
    assert out.path is not None
    assert np.allclose(out.path.poses[-1], (0.5, 1.5, 0.0), atol=0.03)
    near = step.step(task(what="escape", pose=(0.36, 1.5, 0.0), points=[(x - 0.65, y) for x, y in wall]))
    assert (near.path, near.reason) == (None, Reason.STUCK)


def test_waypoints_are_passed_one_by_one_and_asked_for_until_then():
    run = SteppedRun()
    run.run, _ = goal_run.begin(2, GOAL, "tester", 0.0, ((1.0, 0.0, None), (1.5, 0.0, 0.0)))
    run.step(answer=WAY)
    assert run.step(pose=(0.5, 0.0, 0.0)) == ()
    assert reported(run.step(pose=(0.8, 0.1, 0.0), along=0.8)) == [Reason.WAYPOINT_PASSED]
    assert run.run.via == ((1.5, 0.0, 0.0),)
    assert run.step(pose=(1.0, 0.1, 0.0), along=1.0) == ()


def test_a_miss_is_corrected_by_another_route():
    run = SteppedRun()
    run.step(answer=WAY)
    assert Plan(afresh=True) in run.step(outcome=Reason.GOAL_REACHED, pose=(1.85, 0.0, 0.0))


def test_a_route_over_waypoints_passes_them_and_is_kept_only_as_long_as_it_does():
    step = PlanningStep()
    cells = np.zeros((80, 120), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    grid = Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=0.05, width=120, height=80, cells=cells.ravel(),
        origin=Pose2D(x=0.0, y=0.0, yaw=0.0),
    )  # fmt: skip
    setup = Setup(PlannerConfig(route=HybridConfig(effort=500, margin=0.04)), FourWheelSteering(), Footprint())
    at, goal, none = (1.0, 2.0, 0.0), (5.0, 2.0, 0.0), np.empty((0, 2))

    def nearest(answer: Any, x: float, y: float) -> float:
        return float(np.hypot(answer.path.poses[:, 0] - x, answer.path.poses[:, 1] - y).min())

    straight = step.step(PlanTask("route", at, goal, none, setup, grid))
    over = step.step(PlanTask("route", at, goal, none, via=((3.0, 3.0, None),)))
    assert nearest(straight, 3.0, 3.0) > 0.5
    assert (over.kept, nearest(over, 3.0, 3.0) < 0.06) == (False, True)
    assert step.step(PlanTask("route", at, goal, none, via=((3.0, 3.0, None),))).kept
    assert step.step(PlanTask("route", at, goal, none, via=((math.nan, 3.0, None),))).reason is Reason.NOT_FINITE
    blocked = step.step(PlanTask("route", at, goal, none, via=((9.0, 3.0, 0.0),)))
    assert (blocked.reason, "waypoint 1 of 1" in blocked.text) == (Reason.GOAL_OUTSIDE, True)
    lattice = Setup(PlannerConfig(route=LatticeConfig()), FourWheelSteering(), Footprint())
    by_lattice = step.step(PlanTask("route", at, goal, none, lattice, grid, via=((3.0, 3.0, None),)))
    assert nearest(by_lattice, 3.0, 3.0) < CONFIG.waypoint_radius


def zigzag(runs: int, poses: int = 3) -> RouteAnswer:
    """A drive to and fro, each run of so many poses."""
    x = np.concatenate([[0.0], *(np.linspace(0, 0.1, poses)[1:] if i % 2 == 0 else np.linspace(0.1, 0, poses)[1:]
                                 for i in range(runs))])  # fmt: skip
    directions = np.concatenate(([1.0], np.repeat([1.0 if i % 2 == 0 else -1.0 for i in range(runs)], poses - 1)))
    path = PosePath(np.column_stack((x, 0 * x, 0 * x)), directions, ("counter",) * len(x))
    return RouteAnswer(Reason.OK, path=path, length=0.1 * runs)


@pytest.mark.parametrize(
    ("answer", "length"), [(zigzag(64), 6.4), (zigzag(65), 6.4), (zigzag(200), 6.4), (zigzag(10, 1000), 0.5005)]
)
def test_a_route_too_long_for_one_path_is_driven_in_parts_that_the_tracker_takes(answer: RouteAnswer, length: float):
    part = shortened(answer)
    assert part.complete is (answer.length == pytest.approx(length))
    assert part.length == pytest.approx(length, abs=1e-3)
    assert part.path is not None
    check_path(
        Path(
            stamp=0,
            received=0,
            seq=0,
            frame="map",
            poses=part.path.poses.ravel(),
            directions=part.path.directions,
            steering=part.path.steering,
        )
    )


@pytest.mark.parametrize("outcome", [Reason.GOAL_REACHED, Reason.GOAL_MISSED])
def test_at_the_end_of_a_part_the_rest_is_planned(outcome: Reason):
    run = SteppedRun()
    run.step(answer=replace(WAY, complete=False, text="the first 2.00 m of 9.00"))
    assert Plan() in run.step(outcome=outcome, pose=(2.0, 0.0, 0.0))
    assert run.run.misses == 0


def test_a_missed_cusp_is_planned_anew_from_there():
    run = SteppedRun()
    run.step(answer=WAY)
    actions = run.step(outcome=Reason.CUSP_MISSED, pose=(1.0, 0.1, 0.0))
    assert Plan() in actions
    assert reported(actions) == [Reason.CUSP_MISSED]


def test_an_end_off_the_path_is_judged_by_the_goal():
    run = SteppedRun()
    run.step(answer=WAY)
    run.step(outcome=Reason.GOAL_MISSED, pose=(1.97, 0.0, 0.0))
    assert run.run.outcome is Reason.GOAL_REACHED


@pytest.mark.parametrize("goal", [(1e308, 1.0, 0.0), (2.0, 1.5, 1e308), (-1e5, 1.0, 0.0)])
def test_goals_beyond_all_bounds_are_refused(goal: Any):
    step, none = PlanningStep(), np.empty((0, 2))
    cells = np.zeros((60, 80), np.int8)
    grid = Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=0.05, width=80, height=60, cells=cells.ravel(),
        origin=Pose2D(x=0.0, y=0.0, yaw=0.0),
    )  # fmt: skip
    with np.errstate(all="raise"):
        answer = step.step(PlanTask("route", (2.0, 1.5, 0.0), goal, none, Setup(PlannerConfig(), TRUCK, BODY), grid))
        assert answer.reason is Reason.BAD_INPUT
        over = PlanTask("route", (2.0, 1.5, 0.0), (1.0, 1.5, 0.0), none, via=(goal,))
        assert step.step(over).reason is Reason.BAD_INPUT


def test_cusps_keep_the_distance_that_the_gate_asks_for_where_they_can():
    """Turning round in a corridor 1 m wide: the way with a cusp more keeps away from the walls."""
    cells = np.full((48, 160), 100, np.int8)
    cells[4:-4, 4:-4] = 0
    grid = Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=0.025, width=160, height=48, cells=cells.ravel(),
        origin=Pose2D(x=0.0, y=0.0, yaw=0.0),
    )  # fmt: skip
    least = {}
    for asked in (0.0, 0.07):
        setup = Setup(PlannerConfig(route=HybridConfig(effort=5000, margin=0.04)), TRUCK, BODY, cusp_clearance=asked)
        task = PlanTask("route", (2.0, 0.6, 0.0), (2.0, 0.6, math.pi), np.empty((0, 2)), setup, grid)
        answer = PlanningStep().step(task)
        assert answer.path is not None
        assert answer.path.clearance is not None
        least[asked] = answer.path.clearance[answer.path.stops].min()
    assert least[0.0] < 0.07 <= least[0.07] + 1e-9
