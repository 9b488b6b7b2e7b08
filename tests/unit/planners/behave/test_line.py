"""Method 3: laps of a hall, gaps, ramps, and bad inputs."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from monstertruck_planners.behave.api import Inputs, RequestedMotion
from monstertruck_planners.behave.wall import line
from monstertruck_planners.behave.wall.config import WallLineConfig
from monstertruck_planners.behave.wall.echoes import Cone, WallEstimate
from monstertruck_planners.behave.wall.line import STANDSTILL, WallLine
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import IMU, ODOMETRY, SONAR, TRANSFORMS
from tests.unit.planners.behave.wall_kit import PERIOD, Robot, drive, frames, rectangle, turning

HALL = rectangle(4.0, 3.0)
LIMITS = 0.6 + 1e-6, 4.8 + 1e-6


def follower(**settings):
    return WallLine(WallLineConfig(rate=10.0, beam=True, lead=0.0, **settings))


@pytest.mark.parametrize(
    ("side", "heading"), [("left", 0.3), ("right", 2.0), pytest.param("left", -2.5, marks=pytest.mark.long)]
)
def test_a_lap_of_a_hall_ends_with_its_reason_and_keeps_the_distance(side, heading):
    done = drive(follower(side=side, lap_length=6.0), Robot(HALL, (0.1, -0.1, heading), bias=0.01), 300.0)
    assert done.outcome is Reason.BEHAVIOUR_DONE
    assert done.clearance > 0.3
    assert done.steps[-1].text.startswith("1 lap, ")
    errors = [step.values["error"] for step in done.steps if step.phase == "follow"]
    assert abs(np.median(errors)) < 0.003
    assert {step.phase for step in done.steps} == {"settle", "search", "brake", "turn", "follow", "stop"}


def test_a_lap_that_began_just_before_a_corner_ends_though_the_odometry_has_drifted():
    robot = Robot(HALL, (0.8, 0.8, math.pi / 2 - 0.2), creep=-3e-4)
    done = drive(follower(lap_length=6.0), robot, 100.0)
    assert done.outcome is Reason.BEHAVIOUR_DONE
    assert done.steps[-1].text.startswith("1 lap, ")


def test_a_lap_is_complete_at_any_place_that_it_comes_back_to():
    robot, behaviour = Robot([(-9.0, 0.35, 9.0, 0.35)], (0.0, 0.0, 0.0)), follower(lap_length=6.0)
    post, later = (0.0, -0.2, -0.1, 1.2), (0.5, -0.1, 0.0, 0.0)
    state = behaviour.begin()._replace(phase="follow", wall=WallEstimate(math.pi / 2, 0.35), travelled=9.0, seen=9.0)
    first = behaviour.step(robot.inputs(), state._replace(places=np.array([post])), 0.0)
    assert (first.phase, first.state.laps) == ("follow", 0)  # it heads another way than along the post
    done = behaviour.step(robot.inputs(), state._replace(places=np.array([post, later])), 0.0)
    assert (done.phase, done.state.laps) == ("stop", 1)


@pytest.mark.parametrize("begins", [0.2, -9.0])
def test_the_line_stays_where_the_side_sonar_looks_through_an_opening(begins):
    robot, behaviour = Robot([(begins, 0.35, 9.0, 0.35)], (0.0, 0.0, 0.0)), follower()
    slanting = WallEstimate(math.pi / 2 + 0.1, 0.35)
    state = behaviour.begin()._replace(phase="follow", wall=slanting, places=np.zeros((1, 4)))
    step = behaviour.step(robot.inputs(), state, 0.0)
    assert (step.state.wall == slanting) is (begins > 0.0)


def test_at_its_own_rate_no_step_fits_two_lines(monkeypatch):
    fits = []
    for name in ("search", "refine"):
        fit = getattr(line, name)
        monkeypatch.setattr(line, name, lambda *args, fit=fit: fits.append(fit) or fit(*args))
    robot, behaviour, counts = Robot(HALL, (0.9, 0.8, 0.7)), WallLine(WallLineConfig(beam=True)), []
    state = behaviour.begin()
    for i in range(60):
        before = len(fits)
        step = behaviour.step(robot.inputs(), state, i * PERIOD)
        state, robot.motion = step.state, step.motion or RequestedMotion()
        counts.append(len(fits) - before)
        robot.move()
    assert len(fits) > 20
    assert max(counts) == 1
    assert state.phase == "turn"


def test_it_stands_clear_of_a_wall_beside_the_one_it_drives_to():
    walls = [(-5.0, 1.0, 1.0, 1.0), (1.0, 1.0, 1.0, -5.0)]
    robot, behaviour = Robot(walls, (-0.6, 0.45 - 0.6 * math.tan(0.45), 0.45)), follower()
    state = behaviour.begin()
    for i in range(120):
        step = behaviour.step(robot.inputs(), state, i * PERIOD)
        state, robot.motion = step.state, step.motion or RequestedMotion()
        if state.phase == "turn":
            break
        robot.move()
    assert state.phase == "turn"
    assert robot.clearance > 0.3


def test_it_turns_to_the_wall_found_before_although_the_search_misses_it():
    near, far = WallEstimate(math.pi / 2, 0.35), [WallEstimate(0.1, 1.91), WallEstimate(-0.93, 2.12)]
    echoes = turning([near, *far], Cone(0.435, 0.45), np.linspace(1.0, -0.36, 40))
    inputs, behaviour = Robot([], (0.0, 0.0, 0.0)).inputs(), WallLine(WallLineConfig())
    messages = {topic.name: inputs.of(topic) for topic in (ODOMETRY, IMU, TRANSFORMS)}
    messages[SONAR.name] = inputs.of(SONAR).model_copy(update={"field_of_view": 0.87})
    state = behaviour.begin()._replace(phase="turn", ahead=near, echoes=echoes)
    step = behaviour.step(Inputs(messages), state, 0.0)
    assert step.state.ahead.distance(0.0, 0.0) == pytest.approx(0.35, abs=1e-3)


def test_every_ramp_keeps_acceleration_and_jerk_at_100_hz_and_speeds_do_not_jump():
    done = drive(follower(lap_length=6.0), Robot(HALL, (0.1, -0.1, 0.3)), 300.0)
    for ramp in {ramp for step in done.steps for ramp in (step.state.v, step.state.w)}:
        t = np.arange(0.0, ramp.shape.duration, 0.01)
        a = np.array([ramp.shape.acceleration(at) for at in t])
        assert np.abs(a).max(initial=0.0) <= LIMITS[0]
        assert np.abs(np.diff(a) / 0.01).max(initial=0.0) <= LIMITS[1]
    motions = done.motions()
    assert np.abs(np.diff(motions, axis=0)).max() < 0.8 * PERIOD
    assert motions[:, 0].max() < 0.3


def test_it_drives_straight_past_a_door_and_looks_for_another_wall_where_one_ends():
    door = [(-9.0, 0.35, 1.0, 0.35), (1.9, 0.35, 6.0, 0.35)]
    done = drive(follower(), Robot(door, (-1.0, 0.0, 0.4)), 50.0)
    phases = [step.phase for step in done.steps]
    first = phases.index("follow")
    assert "search" in phases[first:]
    gone = first + phases[first:].index("search")
    assert done.poses[gone, 0] > 6.0
    beside = done.poses[(done.poses[:, 0] > 1.0) & (done.poses[:, 0] < 1.9) & (np.arange(len(phases)) < gone)]
    assert np.abs(beside[:, 1]).max() < 0.02


def test_it_gives_up_where_there_is_no_wall():
    done = drive(follower(search=2.0), Robot([(90.0, -1.0, 90.0, 1.0)], (0.0, 0.0, 0.0)), 30.0)
    assert done.outcome is Reason.STUCK
    assert "no wall within 2 m" in done.steps[-1].text


def test_a_silent_sonar_and_a_stalled_motor_end_it_with_their_reason():
    robot = Robot(HALL, (0.1, -0.1, 0.3), dead=("fl",))
    done = drive(follower(), robot, 5.0)
    assert (done.outcome, done.steps[-1].text) == (Reason.INPUT_STALE, "sonar fl has not answered for 0.5 s")
    done = drive(follower(), Robot(HALL, (0.1, -0.1, 0.3), stalled=True), 5.0)
    assert done.outcome is Reason.STUCK
    assert len(done.steps) * PERIOD < 2.5


def test_a_sonar_that_stays_the_same_ends_it():
    done = drive(follower(), Robot(HALL, (0.1, -0.1, 0.3), stuck={"l": 0.4}), 5.0)
    assert done.outcome is Reason.INPUT_CONTRADICTORY
    assert "sonar l measured a constant 0.400 m" in done.steps[-1].text


def test_yaw_that_nobody_asked_for_ends_it():
    behaviour, robot = follower(), Robot(HALL, (0.1, -0.1, 0.3))
    state = behaviour.begin()
    for i in range(60):
        robot.bias = 0.8 if i >= 20 else 0.0
        step = behaviour.step(robot.inputs(), state, i * PERIOD)
        state, robot.motion = step.state, step.motion or RequestedMotion()
        if step.outcome is not Reason.DRIVING:
            break
        robot.move()
    assert step.outcome is Reason.STUCK
    assert "check for a stalled motor" in step.text
    assert 20 < i < 28


def test_without_a_mount_it_does_not_start():
    robot = Robot(HALL, (0.0, 0.0, 0.0))
    inputs = robot.inputs()
    lacking = Inputs(
        {
            **{topic.name: inputs.of(topic) for topic in (SONAR, ODOMETRY, IMU)},
            TRANSFORMS.name: frames(left_out=("fr",)),
        }
    )
    behaviour = follower()
    step = behaviour.step(lacking, behaviour.begin(), 0.0)
    assert step.outcome is Reason.INPUT_CONTRADICTORY
    assert step.text == "state/transforms has no frame sonar_fr: expected the mounts of l, fl, f, fr"


def test_the_gyroscopes_bias_is_measured_at_rest():
    behaviour, robot = follower(), Robot(HALL, (0.1, -0.1, 0.3), bias=0.02)
    done = drive(behaviour, robot, 3.0)
    assert done.steps[-1].state.bias[0] == pytest.approx(0.02)
    assert abs(math.remainder(robot.pose[2] - 0.3, math.tau)) < 0.01


@pytest.mark.parametrize("wrong", [{"speed": 0.4}, {"acceleration": 0.7}, {"jerk": 5.0}, {"rate": 5.0}, {"seen": 1}])
def test_settings_beyond_the_ramps_limits_are_refused(wrong):
    with pytest.raises(ValidationError):
        WallLineConfig(**wrong)


def test_it_stops_by_its_ramp_where_the_wall_ahead_is_heard_no_longer_while_it_brakes():
    behaviour, robot = follower(), Robot(HALL, (0.1, -0.1, 0.3))
    state = behaviour.begin()
    for i in range(120):
        if state.phase == "brake":
            robot.stuck = {"f": None, "fl": None, "fr": None}
        step = behaviour.step(robot.inputs(), state, i * PERIOD)
        state, robot.motion = step.state, step.motion or RequestedMotion()
        if state.phase == "turn":
            break
        robot.move()
    assert state.phase == "turn"
    assert abs(step.motion.vx) < 0.02


@pytest.mark.parametrize("goes", [True, False])
def test_it_follows_its_wall_on_after_braking_for_what_has_gone_from_the_far_side(goes):
    wall, person = (-9.0, 0.35, 9.0, 0.35), (1.5, -0.2, 1.5, -0.6)
    robot, behaviour, phases = Robot([wall, person], (0.0, 0.0, 0.1)), follower(), []
    state = behaviour.begin()._replace(
        phase="follow", wall=WallEstimate(math.pi / 2, 0.35), places=np.array([[0.0, *robot.pose]])
    )
    for i in range(200):
        if goes and state.phase == "brake":
            robot.walls = [wall]
        step = behaviour.step(robot.inputs(), state, i * PERIOD)
        state, robot.motion = step.state, step.motion or RequestedMotion()
        phases.append(state.phase)
        if state.phase == "turn":
            break
        robot.move()
    assert "brake" in phases
    assert ("turn" in phases) is not goes
    assert (robot.pose[0] > 3.0) is goes


@pytest.mark.parametrize("heard", [True, False])
def test_a_front_sonar_that_hears_nothing_is_made_up_for_by_the_diagonal_one(heard):
    corner = [(-9.0, 0.35, 2.0, 0.35), (2.0, 0.35, 3.5, -3.0)]
    robot = Robot(corner, (0.5, 0.0, 0.1))
    robot.stuck = {"f": None, "fr": None}
    behaviour, state, clearance = follower(), None, math.inf
    state = behaviour.begin()._replace(
        phase="follow", wall=WallEstimate(math.pi / 2, 0.35), places=np.array([[0.0, *robot.pose]])
    )
    for i in range(200):
        if state.phase == "brake" and not heard:  # the corner is beyond the diagonal sonar where the robot stands
            robot.stuck = {"f": None, "fr": None, "fl": None}
        step = behaviour.step(robot.inputs(), state, i * PERIOD)
        state, robot.motion = step.state, step.motion or RequestedMotion()
        clearance = min(clearance, robot.clearance)
        if state.phase == "turn" or step.outcome is not Reason.DRIVING:
            break
        robot.move()
    assert state.phase == "turn"
    assert clearance > 0.16


def along(walls, far, steps):
    """Outcome beside a wall, and the way driven; ``far`` changes what the sonars measure, by the number of the step."""
    robot, behaviour = Robot(walls, (0.0, 0.0, 0.1)), follower()
    state = behaviour.begin()._replace(
        phase="follow", wall=WallEstimate(math.pi / 2, 0.35), places=np.array([[0.0, *robot.pose]])
    )
    for i in range(steps):
        robot.stuck = far(i)
        step = behaviour.step(robot.inputs(), state, i * PERIOD)
        state, robot.motion = step.state, step.motion or RequestedMotion()
        if step.outcome is not Reason.DRIVING:
            break
        robot.move()
    return step, robot.pose[0]


def test_a_sonar_that_measures_another_wall_than_its_neighbour_ends_it():
    step, way = along([(-9.0, 0.35, 9.0, 0.35)], lambda i: {"fl": 2.0 + 0.002 * i}, 100)
    assert step.outcome is Reason.INPUT_CONTRADICTORY
    assert step.text == "sonar fl does not detect the wall that its neighbour measures"
    assert 1.1 < way < 1.4


def test_the_end_of_a_short_wall_is_no_fault_of_the_sonar_that_looks_past_it_first():
    step, way = along([(-0.1, 0.35, 0.3, 0.35), (-9.0, 1.5, 9.0, 1.5)], lambda _: {}, 45)
    assert step.outcome is Reason.DRIVING
    assert way > 0.45


def test_it_does_not_turn_away_from_what_is_too_near():
    robot = Robot(HALL, (0.0, 0.0, 0.0))
    robot.stuck = {"fl": 0.15}
    behaviour = follower()
    state = behaviour.step(robot.inputs(), behaviour.begin(), 0.0).state
    step = behaviour.step(robot.inputs(), state._replace(phase="turn", w=STANDSTILL), PERIOD)
    assert step.outcome is Reason.STUCK
    assert step.text == "sonar fl measures 0.15 m: too close to turn away"
