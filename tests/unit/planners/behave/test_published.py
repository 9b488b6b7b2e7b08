"""The published ways of following a wall: their formulas, a lap in a hall, and bad inputs."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from monstertruck_planners.behave.wall.config import WallPdConfig, WallSwitchingConfig
from monstertruck_planners.behave.wall.published import (
    SonarMonitor,
    WallPd,
    WallSwitching,
    ramp,
    wall_angle,
    wall_distance,
)
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.behave.wall_kit import PLACES, Robot, beam, drive, rectangle, sonars

HALL = rectangle(4.0, 3.0)
LONG_WALL = [(-10.0, 0.35, 30.0, 0.35)]


@pytest.mark.parametrize("heading", [-0.3, -0.1, 0.0, 0.1, 0.3])
def test_angle_and_distance_of_a_wall_are_exact_with_the_offset_of_the_sonars(heading):
    ranges = {}
    for name in ("l", "fl"):
        px, py, angle = PLACES[name]
        c, s = math.cos(-heading), math.sin(-heading)
        ranges[name] = beam(LONG_WALL, c * px - s * py, s * px + c * py, angle - heading)
    assert wall_angle(ranges["fl"], ranges["l"], 0.05) == pytest.approx(heading, abs=1e-9)
    side = 0.35 - 0.05 * math.cos(-heading)
    assert wall_distance(ranges["fl"], ranges["l"], 0.05) == pytest.approx(side, abs=1e-9)
    published = wall_angle(ranges["fl"], ranges["l"])
    assert (published == pytest.approx(heading, abs=1e-9)) == (heading == 0.0)


def test_the_ramp_is_the_published_cubic():
    up = ramp(2.0, 0.0, 0.2, 0.5)
    for t in np.linspace(0.0, 0.5, 11):
        assert up.at(2.0 + t) == pytest.approx(2.4 * t**2 - 3.2 * t**3)
    assert up.at(1.0) == 0.0
    assert up.at(9.0) == pytest.approx(0.2)


def test_yaw_rate_is_twelve_times_the_error_and_its_plain_difference():
    behaviour = WallPd(WallPdConfig())
    robot = Robot(LONG_WALL, (0.0, 0.0, 0.0))
    first = behaviour.step(robot.inputs(), behaviour.begin(), 0.0)
    assert first.phase == "follow"
    robot.pose = (0.02, -0.01, 0.0)
    second = behaviour.step(robot.inputs(), first.state, 0.1)
    assert second.motion.wz == pytest.approx(12 * 0.01 + 11.3 * 0.01)


def test_a_robot_that_is_late_swings_along_the_wall_and_with_its_lead_it_does_not():
    left = []
    for lead in (0.0, 0.3):
        robot = Robot(LONG_WALL, (0.0, 0.05, 0.0), ahead=0.05, late=2)
        run = drive(WallPd(WallPdConfig(offset=0.05, lead=lead)), robot, 20.0)
        left.append(np.abs(run.poses[100:, 1]).max())
    assert left[1] < 0.005 < 0.012 < left[0]


def test_following_that_begins_with_the_diagonal_sonar_in_a_gap_goes_along_the_wall():
    walls = [(-10.0, 0.35, 0.0, 0.35), (0.4, 0.35, 30.0, 0.35), (0.0, 0.35, 0.0, 1.85), (0.4, 0.35, 0.4, 1.85)]
    for start in (-0.35, -0.25, -0.15):
        robot = Robot(walls, (start, 0.0, 0.0), ahead=0.05)
        run = drive(WallPd(WallPdConfig(offset=0.05, gap=0.6, aligned=0.0, seen=0.6)), robot, 8.0)
        assert run.poses[-1, 0] > 1.0
        assert np.abs(run.poses[:, 1]).max() < 0.035


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("make", ["pd", "switching"])
def test_a_lap_of_a_hall_ends_with_its_reason_and_without_contact(side, make):
    sense = 1.0 if side == "left" else -1.0
    if make == "pd":
        behaviour = WallPd(WallPdConfig(side=side, offset=0.05))
    else:
        behaviour = WallSwitching(WallSwitchingConfig(side=side))
    run = drive(behaviour, Robot(HALL, (-0.5, 0.6 * sense, 0.0)), 200.0)
    assert run.outcome is Reason.BEHAVIOUR_DONE
    assert run.clearance > 0.15
    turned = np.unwrap(run.poses[:, 2])[-1]
    assert -sense * turned > 5.0  # with the wall on the left it turns right
    v = run.motions()[:, 0]
    assert v.min() > -1e-9
    assert v.max() == pytest.approx(0.2)


def test_a_wall_on_the_right_is_the_mirror_image_of_one_on_the_left():
    runs = {}
    for side, sense in (("left", 1.0), ("right", -1.0)):
        start = (-0.5, 0.6 * sense, 0.2 * sense)
        runs[side] = drive(WallPd(WallPdConfig(side=side)), Robot(HALL, start), 30.0)
    left, right = runs["left"].motions(), runs["right"].motions()
    assert left == pytest.approx(right * (1.0, -1.0), abs=1e-9)


@pytest.mark.parametrize(("ahead", "least", "most"), [(0.0, 0.015, 0.045), (0.05, 0.0, 0.007)])
def test_a_step_of_the_distance_is_damped_by_a_sonar_ahead_of_the_axle(ahead, least, most):
    run = drive(WallPd(WallPdConfig(offset=0.05)), Robot(LONG_WALL, (0.0, -0.05, 0.0), ahead=ahead), 8.0)
    assert least < np.abs(run.poses[50:, 1]).max() < most
    assert run.clearance > 0.2


def test_missing_echoes_are_bridged_for_a_short_time_only():
    robot = Robot(LONG_WALL, (0.0, 0.0, 0.0), dropped=5)
    held = drive(WallPd(WallPdConfig()), robot, 10.0)
    assert np.abs(held.motions()[:, 1]).max() < 0.05
    robot = Robot(LONG_WALL, (0.0, 0.0, 0.0), dropped=5)
    bare = drive(WallPd(WallPdConfig(hold=0.0)), robot, 1.0)
    assert np.abs(bare.motions()[:, 1]).max() > 10.0


@pytest.mark.parametrize("name", ["l", "fl", "f"])
def test_a_dead_sonar_stops_with_its_name(name):
    run = drive(WallPd(WallPdConfig()), Robot(HALL, (-0.5, 1.0, 0.0), dead=(name,)), 20.0)
    assert run.outcome is Reason.INPUT_STALE
    assert f"sonar {name} " in run.steps[-1].text
    assert len(run.steps) < 10
    assert run.steps[-1].motion is None


@pytest.mark.parametrize("make", [WallPd(WallPdConfig()), WallSwitching(WallSwitchingConfig())])
def test_a_sonar_that_is_stuck_is_noticed_when_the_robot_turns(make):
    run = drive(make, Robot(HALL, (-0.5, 1.0, 0.0), stuck={"fr": 1.234}), 60.0)
    assert run.outcome is Reason.INPUT_CONTRADICTORY
    assert "sonar fr" in run.steps[-1].text
    assert run.clearance > 0.2


def test_a_stalled_motor_is_noticed():
    run = drive(WallPd(WallPdConfig()), Robot(HALL, (-0.5, 1.0, 0.0), stalled=True), 20.0)
    assert run.outcome is Reason.STUCK
    assert len(run.steps) < 25


def test_a_robot_that_turns_once_around_without_a_wall_to_follow_gives_up():
    post = [(0.35, -0.1, 0.35, 0.1)]
    run = drive(WallPd(WallPdConfig()), Robot(post, (0.0, 0.0, 0.0)), 60.0)
    assert run.outcome is Reason.STUCK
    assert "a full circle" in run.steps[-1].text


def test_a_robot_that_stands_still_does_not_make_a_constant_range_wrong():
    monitor = SonarMonitor()
    for i in range(100):
        monitor = monitor.observe(sonars({"l": 0.3}), ("l",), 0.0, i * 0.1)
    assert monitor.fault(0.0, 10.0) is None
    assert monitor.fault(1.0, 10.0) is not None


def test_a_range_at_the_sonars_limit_may_repeat():
    monitor = SonarMonitor()
    for i in range(100):
        monitor = monitor.observe(sonars({"l": 0.03, "fl": 3.0, "f": None}), ("l", "fl", "f"), i * 0.1, i * 0.1)
    assert monitor.fault(10.0, 10.0) is None


@pytest.mark.parametrize("field", ["distance", "speed", "turn_rate", "ramp", "trigger"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_settings_that_make_no_sense_are_refused(field, value):
    with pytest.raises(ValidationError, match=field):
        WallPdConfig(**{field: value})


@pytest.mark.parametrize(("gap", "heading", "astray"), [(0.0, 0.0, True), (0.6, 0.0, False), (0.6, -0.15, False)])
def test_a_gap_is_passed_straight_on_if_that_is_asked_for(gap, heading, astray):
    recess = [(0.0, 0.35, 0.0, 1.85), (0.0, 1.85, 0.4, 1.85), (0.4, 1.85, 0.4, 0.35)]
    walls = [(-10.0, 0.35, 0.0, 0.35), (0.4, 0.35, 9.0, 0.35), *recess]
    robot = Robot(walls, (-1.0, 0.0, heading), ahead=0.05)
    done = drive(WallPd(WallPdConfig(offset=0.05, gap=gap)), robot, 12.0)
    assert (np.abs(done.poses[:, 1]).max() > 0.04) == astray


def test_turning_away_goes_on_until_the_robot_is_along_the_wall_if_that_is_asked_for():
    corner = [(-9.0, 0.35, 2.0, 0.35), (2.0, 0.35, 1.0, -3.0)]
    angles = {}
    for aligned in (None, 0.0):
        behaviour = WallPd(WallPdConfig(offset=0.05, seen=0.6, free=0.5, aligned=aligned))
        done = drive(behaviour, Robot(corner, (1.0, 0.0, 0.0), ahead=0.05), 30.0)
        phases = [step.phase for step in done.steps]
        begun = phases.index("follow", phases.index("turn_away"))
        angles[aligned] = math.atan2(-3.35, -1.0) - done.poses[begun, 2]
    assert abs(math.remainder(angles[0.0], math.tau)) < 0.05
    assert abs(math.remainder(angles[None], math.tau)) > 0.1


def test_a_gap_just_after_following_began_is_passed_along_the_line_of_its_wall():
    recess = [(0.0, 0.35, 0.0, 1.85), (0.0, 1.85, 0.4, 1.85), (0.4, 1.85, 0.4, 0.35)]
    walls = [(-10.0, 0.35, 0.0, 0.35), (0.4, 0.35, 9.0, 0.35), *recess]
    done = drive(WallPd(WallPdConfig(offset=0.05, gap=0.6)), Robot(walls, (-0.35, -0.05, 0.15), ahead=0.05), 8.0)
    behind = done.poses[done.poses[:, 0] > 0.6, 1]
    assert np.abs(behind).max() < 0.012
