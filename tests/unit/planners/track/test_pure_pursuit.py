import math

import numpy as np
import pytest

from monstertruck_planners.track.config import PurePursuitConfig
from monstertruck_planners.track.path_tracker import TruckState
from monstertruck_planners.track.segments import PathProgress
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.kit import STEERING, Follower, circle, figure_eight, path, straight

MODES = ["counter", "front"]


@pytest.mark.parametrize("mode", MODES)
def test_a_straight_path_is_reached_from_beside_it(mode):
    truck = Follower(path(straight(4.0)), pose=(0.0, 0.2, 0.1), steering=mode)
    assert truck.run() is Reason.GOAL_REACHED
    assert truck.cross_track(after=2.0).max() < 0.01
    assert truck.pose[0] == pytest.approx(4.0, abs=0.04)
    assert truck.log[-1].speed == 0.0


@pytest.mark.parametrize("mode", MODES)
def test_a_lap_ends_where_it_began(mode):
    truck = Follower(path(circle(1.0), closed=True), steering=mode)
    assert truck.run() is Reason.GOAL_REACHED
    assert truck.cross_track().max() < 0.06
    assert math.hypot(truck.pose[0], truck.pose[1]) < 0.06
    assert truck.along()[-1] == pytest.approx(truck.path.length, abs=0.03)
    assert len(truck.log) * 0.05 == pytest.approx(truck.path.length / 0.18, rel=0.1)


@pytest.mark.parametrize("mode", MODES)
def test_a_crossing_is_driven_straight_over(mode):
    truck = Follower(path(figure_eight(3.0), closed=True), pose=(0.0, 0.0, math.pi / 4), steering=mode)
    assert truck.run() is Reason.GOAL_REACHED
    along = truck.along()
    assert (np.diff(along) >= 0).all()
    assert np.diff(along).max() < 0.05  # never a jump to the other branch
    assert truck.cross_track().max() < 0.12


@pytest.mark.parametrize("mode", MODES)
def test_backward_paths_are_driven_backward(mode):
    route = straight(3.0) * (-1, 1)
    truck = Follower(path(route, [-1] * len(route)), pose=(0.0, 0.1, 0.1), steering=mode, lookahead=0.5)
    assert truck.run() is Reason.GOAL_REACHED
    assert truck.pose[0] == pytest.approx(-3.0, abs=0.04)
    assert min(c.speed for c in truck.log) == pytest.approx(-0.12)
    assert truck.cross_track(after=2.0).max() < 0.02
    assert abs(math.remainder(truck.pose[2], math.tau)) < 0.05


@pytest.mark.parametrize("mode", MODES)
def test_backward_curves(mode):
    route = circle(1.2, turns=0.5) * (-1, 1)
    truck = Follower(path(route, [-1] * len(route)), steering=mode)
    assert truck.run() is Reason.GOAL_REACHED
    assert truck.cross_track().max() < 0.08


def test_the_direction_changes_at_standstill():
    out = straight(1.0)
    route = np.concatenate((out, out[::-1][1:]))
    truck = Follower(path(route, [1] * 21 + [-1] * 20))
    assert truck.run() is Reason.GOAL_REACHED
    assert truck.pose[0] == pytest.approx(0.0, abs=0.04)
    speeds = np.array([c.speed for c in truck.log])
    turn = int(np.argmax(speeds < 0))
    assert abs(speeds[turn - 1]) <= 0.03 + 1e-9
    assert (speeds[turn:] <= 0).all()


def test_a_truck_still_rolling_the_other_way_is_stopped_first():
    truck = Follower(path(straight(2.0)))
    assert truck.tracker.control(TruckState((0.5, 0.0, 0.0), -0.1), truck.path, truck.progress, 0.0).speed == 0.0


def test_only_the_front_axle_steers_in_front_mode():
    truck = Follower(path(circle(1.0), closed=True), steering="front")
    truck.run(10.0)
    assert {c.rear for c in truck.log} == {0.0}
    assert max(abs(c.front) for c in truck.log) > 0.2


def test_counter_mode_steers_both_axles_alike():
    truck = Follower(path(circle(1.0), closed=True))
    truck.run(10.0)
    assert all(c.rear == pytest.approx(-c.front) for c in truck.log)


@pytest.mark.parametrize(("mode", "direction"), [("counter", 1), ("counter", -1), ("front", 1)])
def test_the_arc_passes_through_its_goal(mode, direction):
    truck = Follower(
        path(straight(3.0) * (direction, 1), [direction] * 61), steering=mode, pose=(0.0, 0.1, 0.05), angle=0.6
    )
    command = truck.step()
    goal = (direction * 0.4, 0.0)
    twist = STEERING.body_twist(direction * 1.0, command.front, command.rear)
    poses = [STEERING.integrate((0.0, 0.1, 0.05), *twist, s) for s in np.linspace(0.3, 0.5, 400)]
    assert min(math.hypot(x - goal[0], y - goal[1]) for x, y, _ in poses) < 1e-3


def test_errors_are_signed():
    truck = Follower(path(straight(2.0)))
    left = truck.tracker.control(TruckState((1.0, 0.1, 0.2), 0.1), truck.path, PathProgress(0, 0.9), 0.0)
    assert left.cross_track == pytest.approx(0.1)
    assert left.heading_error == pytest.approx(0.2)
    assert left.front < 0 < left.rear
    back = Follower(path(straight(2.0), [-1] * 41), pose=(0.0, 0.0, math.pi))
    wrong = back.tracker.control(TruckState((1.0, 0.1, math.pi - 0.2), -0.1), back.path, PathProgress(0, 0.9), 0.0)
    assert wrong.cross_track == pytest.approx(0.1)
    assert wrong.heading_error == pytest.approx(-0.2)


def test_progress_never_goes_back():
    truck = Follower(path(straight(2.0)))
    command = truck.tracker.control(TruckState((0.5, 0.0, 0.0), 0.1), truck.path, PathProgress(0, 0.8), 0.0)
    assert command.progress.s == pytest.approx(0.8)


def test_a_truck_far_off_is_lost():
    truck = Follower(path(straight(2.0)))
    command = truck.tracker.control(TruckState((1.0, 0.6, 0.0), 0.1), truck.path, PathProgress(0, 0.9), 0.0)
    assert (command.outcome, command.speed) == (Reason.PATH_LOST, 0.0)


def test_it_slows_down_before_the_end():
    truck = Follower(path(straight(2.0)))
    truck.run()
    speeds = {round(truck.path.along(c.progress), 2): c.speed for c in truck.log}
    assert max(speeds.values()) == pytest.approx(0.18)
    late = [v for s, v in speeds.items() if 1.95 < s < 1.97]
    assert late
    assert max(late) < 0.12


def test_narrow_places_slow_it_down():
    truck = Follower(path(straight(2.0)))
    for clearance, speed in ((1.0, 0.18), (0.06, 0.09), (0.0, 0.03), (-0.1, 0.03)):
        truck.clearance = clearance
        assert truck.step().speed == pytest.approx(speed, abs=1e-6)


def test_angles_stay_within_the_limit():
    truck = Follower(path(circle(0.3), closed=True), angle=0.25)
    truck.run(20.0)
    assert max(max(abs(c.front), abs(c.rear)) for c in truck.log) <= 0.25 + 1e-9


@pytest.mark.parametrize("bad", [{"min_speed": 0.2}, {"goal_tolerance": 0.5}, {"steering": "sideways"}])
def test_contradictory_configs_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        PurePursuitConfig(**bad)


@pytest.mark.parametrize("direction", [1, -1])
def test_crabbing_keeps_the_heading(direction):
    x = np.arange(0.0, 2.0, 0.05)
    route = np.column_stack((direction * x, 0.3 * np.sin(1.2 * x)))
    truck = Follower(path(route, [direction] * len(route)), steering="crab", dead_time=0.0)
    assert truck.run() is Reason.GOAL_REACHED
    assert truck.cross_track().max() < 0.05
    assert truck.pose[2] == pytest.approx(0.0, abs=1e-12)
    assert all(c.front == pytest.approx(c.rear, abs=1e-12) for c in truck.log)
