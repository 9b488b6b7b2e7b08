"""What holds for every tracker."""

import math
import sys
from itertools import pairwise, product

import numpy as np
import pytest
from pydantic import ValidationError

from monstertruck_planners.route.motion import MotionPath
from monstertruck_planners.track.axle_errors import AxleError, AxleErrors
from monstertruck_planners.track.catalog import TRACKERS, build_tracker
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.mpc import Solver
from monstertruck_planners.track.path_tracker import TruckState
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.reasons import Reason
from tests.long_kit import mostly_long
from tests.unit.planners.kit import STEERING, TRACKER, Follower, circle, figure_eight, path, straight

KINDS = list(TRACKERS)
EXACT = ["lqr", "mpc"]
MODES = ["front", "rear", "counter", "hybrid"]


def there_and_back():
    out = circle(1.0, turns=0.25)
    return path(np.concatenate((out, out[::-1][1:])), [1] * len(out) + [-1] * (len(out) - 1))


@pytest.mark.parametrize(
    ("kind", "mode", "direction"),
    mostly_long(
        product(("pure_pursuit", *EXACT), MODES, (1, -1)),
        {
            ("pure_pursuit", "front", 1), ("pure_pursuit", "counter", -1), ("lqr", "rear", 1), ("lqr", "front", -1),
            ("mpc", "hybrid", 1), ("mpc", "rear", -1),
        },
    ),
)  # fmt: skip
def test_a_straight_path_is_reached_from_beside_it(kind, mode, direction):
    route = straight(2.5, 0.1) * (direction, 1)
    truck = Follower(path(route, [direction] * len(route)), pose=(0.0, 0.12, 0.05), kind=kind, steering=mode)
    assert truck.run() is Reason.GOAL_REACHED
    assert truck.cross_track(after=1.9).max() < 0.015
    assert truck.pose[0] == pytest.approx(direction * 2.5, abs=0.04)
    assert max(max(abs(c.front), abs(c.rear)) for c in truck.log) <= 0.4 + 1e-9


@pytest.mark.parametrize(
    ("kind", "mode", "direction"),
    mostly_long(
        product(EXACT, ("front", "counter", "hybrid"), (1, -1)),
        {("lqr", "front", 1), ("lqr", "hybrid", -1), ("mpc", "counter", 1), ("mpc", "front", -1)},
    ),
)
def test_curves_leave_no_error(kind, mode, direction):
    route = circle(1.2, turns=0.4) * (direction, 1)
    truck = Follower(path(route, [direction] * len(route)), kind=kind, steering=mode)
    assert truck.run() is Reason.GOAL_REACHED
    assert truck.cross_track(after=1.5).max() < 0.012


@pytest.mark.parametrize("mode", ["front", "counter", "hybrid"])
@pytest.mark.parametrize("kind", EXACT)
def test_a_known_slip_of_the_axles_leaves_no_error_and_no_oscillation(kind, mode):
    slip = AxleErrors(AxleError(compliance=0.06), AxleError(compliance=0.04))
    limits = {"speed": 1.5, "acceleration": 1.2, "lateral_acceleration": 1.5}
    truck = Follower(path(circle(2.0, turns=1.0)), errors=slip, kind=kind, steering=mode, **limits)
    truck.tracker.axle_errors.errors = slip
    assert truck.run() is Reason.GOAL_REACHED
    assert max(c.speed for c in truck.log) > 1.4
    assert truck.cross_track(after=5.0).max() < 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_a_cusp_is_driven_to_a_full_stop_and_the_direction_changes_once(kind):
    truck = Follower(there_and_back(), kind=kind, dead_time=0.05, lag=0.1)
    signs = [0.0]
    while truck.step().outcome is Reason.DRIVING:
        assert len(truck.log) < 2000
        if truck.speed and math.copysign(1, truck.speed) != signs[-1]:
            signs.append(math.copysign(1, truck.speed))
    assert signs == [0.0, 1.0, -1.0]
    runs = [c.progress.run for c in truck.log]
    change = runs.index(1)
    assert truck.log[change - 1].speed == 0.0
    assert sorted(runs) == runs
    assert truck.cross_track().max() < (0.2 if kind == "fuzzy" else 0.05)


def at_the_cusp(off, clearance, kind="lqr"):
    """Command for a truck that came to rest beside the cusp of a path."""
    out = straight(1.0)
    route = path(np.concatenate((out, out[::-1][1:])), [1] * 21 + [-1] * 20)
    route = route.model_copy(update={"clearance": np.full(41, clearance)})
    truck = Follower(route, kind=kind)
    progress = type(truck.progress)(0, 0.999)
    return truck.tracker.control(TruckState(off, 0.0), truck.path, progress, 0.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("off", "clearance", "outcome"),
    [
        ((0.998, 0.01, 0.0), 0.04, Reason.DRIVING),
        ((0.998, 0.03, 0.0), 0.04, Reason.CUSP_MISSED),
        ((0.998, 0.0, 0.1), 0.04, Reason.CUSP_MISSED),
        ((0.998, 0.03, 0.1), 0.2, Reason.DRIVING),
        ((0.998, 0.3, 0.0), math.inf, Reason.DRIVING),
        ((0.998, 0.005, 0.01), 0.0, Reason.DRIVING),
    ],
)
def test_a_cusp_is_met_as_near_as_the_clearance_there_asks_for(kind, off, clearance, outcome):
    command = at_the_cusp(off, clearance, kind)
    assert command.outcome is outcome
    assert command.progress.run == (outcome is Reason.DRIVING)
    assert command.speed <= 0.0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("at", "outcome"),
    [
        ((1.998, 0.015, 0.1), Reason.GOAL_REACHED),
        ((1.998, 0.065, 0.0), Reason.GOAL_MISSED),
        ((1.998, 0.0, 0.25), Reason.GOAL_MISSED),
        ((2.1, 0.0, 0.0), Reason.GOAL_MISSED),
    ],
)
def test_the_end_is_judged_by_position_and_heading(kind, at, outcome):
    truck = Follower(path(straight(2.0)), kind=kind)
    progress = type(truck.progress)(0, 1.999)
    rolling = truck.tracker.control(TruckState(at, 0.03), truck.path, progress, 0.0)
    assert (rolling.outcome, rolling.speed) == (Reason.DRIVING if at[0] < 2.02 else outcome, 0.0)
    command = truck.tracker.control(TruckState(at, 0.0), truck.path, rolling.progress, 0.05)
    assert (command.outcome, command.speed) == (outcome, 0.0)
    later = truck.tracker.control(TruckState((2.0, 0.0, 0.0), 0.0), truck.path, command.progress, 0.1)
    assert later.outcome is outcome, "judged once"


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_said_of_the_end_is_true(kind):
    truck = Follower(path(figure_eight(1.5)), kind=kind, pose=(0.0, 0.0, math.pi / 4))
    outcome = truck.run()
    end = truck.path.runs[-1].at(truck.path.length)
    near = math.dist(truck.pose[:2], end.point) <= truck.config.goal_tolerance
    turned = abs(math.remainder(truck.pose[2] - end.tangent, math.tau)) <= truck.config.goal_yaw_tolerance
    assert outcome is (Reason.GOAL_REACHED if near and turned else Reason.GOAL_MISSED)
    assert kind == "fuzzy" or outcome is Reason.GOAL_REACHED


def test_many_short_runs_add_no_error_up():
    """Eleven cusps of a turn on the spot, by arcs of nearly the least radius."""
    motion = MotionPath(np.zeros(3), np.array([[0.12 * (-1) ** i, 2.2 * (-1) ** i, 0.0] for i in range(12)]))
    truck = Follower(motion.message(stamp=0, frame="odom", step=0.05), kind="lqr")
    assert truck.run() is Reason.GOAL_REACHED
    assert len(truck.path.runs) == 12
    assert math.dist(truck.pose[:2], motion.end[:2]) < 0.01
    assert abs(math.remainder(truck.pose[2] - motion.end[2], math.tau)) < 0.05


def test_the_wheels_turn_before_the_truck_rolls():
    truck = Follower(path(circle(0.8, turns=0.25)), kind="lqr", dead_time=0.05, lag=0.1)
    first = [truck.step() for _ in range(12)]
    moving = next(i for i, command in enumerate(first) if command.speed)
    assert moving > 0
    assert truck.front == pytest.approx(first[moving].front, abs=0.06)


@pytest.mark.parametrize("kind", KINDS)
def test_noise_about_a_cusp_does_not_change_the_direction_again(kind):
    truck = Follower(there_and_back(), kind=kind)
    end = truck.path.runs[0].length
    rng = np.random.default_rng(1)
    progress, runs = truck.path.start, []
    x, y = truck.path.runs[0].at(end).point
    progress = type(progress)(0, end - 0.05)
    for k in range(40):
        near = (x + 0.01 * rng.standard_normal(), y + 0.01 * rng.standard_normal(), math.pi / 2)
        command = truck.tracker.control(TruckState(near, 0.0), truck.path, progress, 0.05 * k)
        progress = command.progress
        runs.append(progress.run)
    assert sorted(runs) == runs
    assert runs[-1] == 1
    assert command.speed <= 0.0 or command.outcome is Reason.GOAL_REACHED


@pytest.mark.parametrize("kind", KINDS)
def test_a_pose_that_is_no_number_stops(kind):
    truck = Follower(path(straight(2.0)), kind=kind)
    truck.step()
    command = truck.tracker.control(TruckState((math.nan, 0.0, 0.0), 0.1), truck.path, truck.progress, 0.1)
    assert (command.outcome, command.speed) == (Reason.NOT_FINITE, 0.0)
    assert math.isfinite(command.front + command.rear + command.cross_track)
    assert truck.step().outcome is Reason.DRIVING


@pytest.mark.parametrize("kind", KINDS)
def test_a_truck_far_off_is_lost(kind):
    truck = Follower(path(straight(2.0)), kind=kind)
    command = truck.tracker.control(TruckState((1.0, 0.6, 0.0), 0.1), truck.path, truck.progress, 0.0)
    assert (command.outcome, command.speed) == (Reason.PATH_LOST, 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_hopeless_starts_stay_within_the_limits(kind):
    truck = Follower(path(straight(3.0)), pose=(0.0, 0.45, 2.0), kind=kind, angle=0.25)
    for _ in range(40):
        truck.step()
    assert max(max(abs(c.front), abs(c.rear)) for c in truck.log) <= 0.25 + 1e-9
    assert all(math.isfinite(c.front + c.rear + c.speed) for c in truck.log)


@pytest.mark.parametrize("kind", KINDS)
def test_equal_runs_are_equal(kind):
    logs = []
    for _ in range(2):
        truck = Follower(path(figure_eight(1.5), closed=True), kind=kind, steering="hybrid")
        logs.append([truck.step() for _ in range(60)])
    assert logs[0] == logs[1]


@pytest.mark.parametrize("kind", KINDS)
def test_it_slows_down_on_slopes_and_rough_ground(kind):
    speeds = []
    for more in ({}, {"tilt": 0.15}, {"roughness": 0.075}, {"tilt": 0.5}):
        truck = Follower(path(straight(4.0)), kind=kind)
        state = TruckState((0.5, 0.0, 0.0), 0.1, **more)
        speeds.append(truck.tracker.control(state, truck.path, truck.progress, 0.0).speed)
    assert speeds == pytest.approx([0.18, 0.09, 0.09, 0.03])


def test_it_brakes_before_a_curve():
    x = straight(1.0, 0.025)
    route = np.concatenate((x, circle(0.5, 0.5, 0.025)[1:] + x[-1]))
    truck = Follower(path(route), kind="lqr", speed=0.5, lateral_acceleration=0.1, steering="counter")
    truck.run()
    inside = [c.speed for c in truck.log if 1.1 < truck.path.along(c.progress) < 2.0]
    assert max(inside) < 0.24
    assert max(c.speed for c in truck.log) > 0.35


@pytest.mark.parametrize("kind", ["pure_pursuit", *EXACT])
def test_the_path_says_where_to_crab(kind):
    """1 m straight, then sideways at 15 degrees with the heading kept, then straight again."""
    out, aside = straight(1.0), straight(1.5) @ np.array([[math.cos(0.26), math.sin(0.26)], [0.0, 1.0]])
    points = np.concatenate((out, out[-1] + aside[1:], out[-1] + aside[-1] + straight(1.0)[1:]))
    steering = ["counter"] * len(out) + ["crab"] * (len(aside) - 1) + ["counter"] * 20
    truck = Follower(path(points, steering=steering), kind=kind)
    assert truck.run() is Reason.GOAL_REACHED
    crabbing = [c for c in truck.log if 1.3 < truck.path.along(c.progress) < 2.2]
    assert all(c.front == pytest.approx(c.rear, abs=0.05) and c.front > 0.1 for c in crabbing)
    assert max(abs(c.heading_error) for c in crabbing) < 0.1
    assert truck.cross_track().max() < 0.06
    stops = [b.progress.run for a, b in pairwise(truck.log) if a.progress.run != b.progress.run and a.speed == 0.0]
    assert stops == [1, 2], "it stands while the wheels turn"


@pytest.mark.parametrize("kind", EXACT)
def test_a_wrong_heading_is_put_right_while_the_path_crabs(kind):
    way = straight(3.0) @ np.array([[math.cos(0.2), math.sin(0.2)], [0.0, 1.0]])
    truck = Follower(path(way, steering=["crab"] * len(way)), pose=(0.0, 0.0, 0.15), kind=kind)
    assert truck.run() is Reason.GOAL_REACHED
    assert abs(truck.log[-1].heading_error) < 0.06
    assert abs(truck.log[-1].cross_track) < 0.02


@pytest.mark.parametrize("kind", EXACT)
def test_where_the_curve_changes_sides_the_truck_waits_for_its_axles(kind):
    turn = MotionPath(np.zeros(3), np.array([[1.0, 2.0, 0.0], [0.3, -2.0, 0.0]]))
    truck = Follower(path(turn.sample(0.05).poses[:, :2]), kind=kind, steering_rate=0.5, speed=0.2)
    assert truck.run() is Reason.GOAL_REACHED
    bend = [c for c in truck.log if 0.95 < truck.path.along(c.progress) < 1.05]
    assert min(c.speed for c in bend) < 0.1
    assert abs(truck.log[-1].heading_error) < 0.05


@pytest.mark.parametrize("kind", EXACT)
def test_hybrid_corrects_sideways_with_less_turning(kind):
    turned = {}
    for mode in ("counter", "hybrid"):
        truck = Follower(path(straight(3.0)), pose=(0.0, 0.1, 0.0), kind=kind, steering=mode)
        assert truck.run() is Reason.GOAL_REACHED
        turned[mode] = max(abs(c.heading_error) for c in truck.log)
    assert turned["hybrid"] < 0.5 * turned["counter"]


@pytest.mark.parametrize("kind", EXACT)
def test_knowing_dead_time_and_lag_helps(kind):
    found = []
    for known in (0.0, 0.15):
        truck = Follower(path(figure_eight(2.0)), pose=(0, 0, 0.75), kind=kind, speed=0.6, dead_time=known, lag=known)
        truck.tracker.estimator.observe = lambda *_, **__: False  # only what is configured counts
        delayed = Delayed(truck)
        found.append(delayed.run())
    assert found[1] < 0.7 * found[0]


class Delayed:
    """0.15 s dead time and as much lag between a tracker and its truck."""

    def __init__(self, truck):
        self.truck, self.waiting, self.angles = truck, [(0.0, 0.0)] * 3, (0.0, 0.0)

    def run(self):
        truck, errors = self.truck, []
        for k in range(300):
            command = truck.tracker.control(TruckState(truck.pose, 0.6), truck.path, truck.progress, 0.05 * k)
            if command.outcome is not Reason.DRIVING:
                break
            truck.progress = command.progress
            errors.append(command.cross_track)
            self.waiting.append((command.front, command.rear))
            wanted = self.waiting.pop(0)
            for _ in range(5):
                share = 1 - math.exp(-0.01 / 0.15)
                self.angles = tuple(a + share * (w - a) for a, w in zip(self.angles, wanted, strict=True))
                truck.pose = STEERING.integrate(truck.pose, *STEERING.body_twist(0.6, *self.angles), 0.01)
        return float(np.abs(errors[20:]).max())


def test_kinds_are_kept_apart_and_unknown_keys_refused():
    assert TRACKER.validate_python({"kind": "mpc"}).kind == "mpc"
    for bad, hint in (({"kind": "magic"}, "kind"), ({"kind": "lqr", "lookahead": 0.4}, "lookahead"), ({}, "kind")):
        with pytest.raises(ValidationError, match=hint):
            TRACKER.validate_python(bad)
    assert {TRACKER.validate_python({"kind": kind}).kind for kind in TRACKERS} == set(TRACKERS)


def test_a_config_without_kind_has_no_tracker():
    with pytest.raises(InputError, match=r"no kind 'None': expected one of pure_pursuit"):
        build_tracker(TrackerConfig(), STEERING)


def test_a_missing_solver_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "monstertruck_planners.track.mpc", None)
    with pytest.raises(InputError, match=r"kind mpc: .*: needs the extra \[planning\]"):
        build_tracker(TRACKER.validate_python({"kind": "mpc"}), STEERING)


def feasible_plan(rng, last, most, step):
    plan = np.empty(15)
    for k in range(15):
        last = plan[k] = np.clip(last + rng.uniform(-step, step), -most, most)
    return plan


def test_plans_of_mpc_keep_the_limits_exactly_and_no_other_is_better():
    config = TRACKER.validate_python({"kind": "mpc", "angle": 0.3, "steering_rate": 1.0})
    solver, rng = Solver(15, 1, config, 0.1), np.random.default_rng(5)
    at_limit = 0
    for _ in range(30):
        half, wanted, last = rng.normal(size=(15, 15)), rng.uniform(-0.6, 0.6, 15), rng.uniform(-0.3, 0.3, 1)
        quadratic, linear = half.T @ half, -(half.T @ half) @ wanted
        plan = solver.solve(quadratic, linear, last)
        changes = np.diff(plan, prepend=last)
        assert max(np.abs(plan).max() - 0.3, np.abs(changes).max() - 0.1) < 1e-9
        at_limit += np.count_nonzero((np.abs(plan) > 0.3 - 1e-9) | (np.abs(changes) > 0.1 - 1e-9)) > 3
        smooth = np.eye(15) - np.eye(15, k=-1)
        weight = 1.0 / (0.1 * config.rate_scale**2)
        slope = quadratic @ plan + linear + weight * smooth.T @ (smooth @ plan - np.append(last, np.zeros(14)))
        others = np.array([feasible_plan(rng, last[0], 0.3, 0.1) for _ in range(50)])
        assert ((others - plan) @ slope).min() > -1e-4, "no way down from it"
    assert at_limit > 20


def test_a_planned_crab_is_driven_as_planned():
    rows = [[0.8, 0.0, 0.0], [0.9, 0.0, 0.3], [0.8, 1.2, 0.0], [-0.6, 0.0, -0.25]]
    motion = MotionPath(np.zeros(3), np.array(rows))
    truck = Follower(motion.message(stamp=0, frame="odom", step=0.025), kind="mpc")
    assert truck.run() is Reason.GOAL_REACHED
    assert truck.cross_track().max() < 0.05
    assert truck.pose == pytest.approx(tuple(motion.end), abs=0.06)
