"""A basic move: signs, profiles, a clock that waits, and what is refused; on a robot that follows requests late."""

import itertools
import math
import re

import pytest

from monstertruck_kinematics.chassis import (
    Dimensions,
    differential_chassis,
    omni_chassis,
    synchro_chassis,
    truck_chassis,
)
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.se2 import integrate
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_planners.behave.api import BehaviourBody, Inputs
from monstertruck_planners.behave.move import Move, MoveConfig
from monstertruck_schemas.base import Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import GATE, ODOMETRY
from tests.unit.planners.behave.wall_kit import odometry

SIZE = Dimensions(DriveTrain())
DIFFERENTIAL = BehaviourBody(differential_chassis(SIZE), 0.4)
PERIOD = 0.05


def gate(twist, reasons=()):
    return GateState(
        stamp=0, received=0, seq=0, mode=GateMode.DRIVING, nonce="n", speed_limit=1.0, reasons=reasons,
        twist=Twist2D(vx=twist[0], vy=twist[1], wz=twist[2]),
    )  # fmt: skip


def drive(body=DIFFERENTIAL, *, seconds=60.0, slow=lambda t: 1.0, reasons=(), **settings):
    """Steps until the end; the robot does what was asked for 0.1 s ago, times ``slow``."""
    move = Move(MoveConfig(**settings), body)
    state, pose, asked, rows = move.begin(), (0.3, -0.2, 3.0), [(0.0, 0.0, 0.0)] * 3, []
    for i in range(round(seconds / PERIOD)):
        t = i * PERIOD
        commanded = tuple(slow(t) * part for part in asked[-1])
        twist = tuple(slow(t) * part for part in asked[-3])
        pose = integrate(pose, *twist, PERIOD)
        yaw = math.remainder(pose[2], math.tau)
        measured = odometry(x=pose[0], y=pose[1], yaw=yaw, vx=twist[0], wz=twist[2], now=0)
        step = move.step(Inputs({ODOMETRY.name: measured, GATE.name: gate(commanded, reasons)}), state, t)
        state = step.state
        rows.append((t, step, pose))
        if step.outcome is not Reason.DRIVING:
            break
        asked.append((step.motion.vx, step.motion.vy, step.motion.wz))
    return rows


def moved(rows):
    x, y, yaw = rows[-1][2]
    c, s = math.cos(3.0), math.sin(3.0)
    return c * (x - 0.3) + s * (y + 0.2), c * (y + 0.2) - s * (x - 0.3), yaw - 3.0


@pytest.mark.parametrize("profile", ["trapezoid", "cubic", "ramp"])
@pytest.mark.parametrize(
    ("settings", "end"),
    [
        ({"length": 0.8}, (0.8, 0.0, 0.0)),
        ({"length": -0.5}, (-0.5, 0.0, 0.0)),
        ({"length": 0.02}, (0.02, 0.0, 0.0)),
        ({"radius": 0.5, "angle": 1.0}, (0.5 * math.sin(1.0), 0.5 - 0.5 * math.cos(1.0), 1.0)),
        ({"radius": -0.5, "length": 0.5}, (0.5 * math.sin(1.0), -0.5 + 0.5 * math.cos(1.0), -1.0)),
        ({"radius": 0.5, "length": -0.5}, (-0.5 * math.sin(1.0), 0.5 - 0.5 * math.cos(1.0), -1.0)),
        ({"radius": 0.0, "angle": -4.0}, (0.0, 0.0, -4.0)),
    ],
)
def test_signs_are_those_of_rep_103_and_the_end_is_reached(profile, settings, end):
    rows = drive(profile=profile, **settings)
    assert rows[-1][1].outcome is Reason.BEHAVIOUR_DONE
    assert moved(rows) == pytest.approx(end, abs=0.015)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"length": 0.02}, r"0\.0\d\d m, turned -?0\.000 rad"),
        ({"radius": 0.0, "angle": 0.5}, r"turned 0\.[45]\d\d rad"),
    ],
)
def test_its_end_says_how_far_it_went_and_turned(settings, said):
    assert re.fullmatch(said, drive(**settings)[-1][1].text)


@pytest.mark.parametrize("profile", ["trapezoid", "cubic", "ramp"])
def test_the_speed_grows_and_falls_within_the_acceleration(profile):
    rows = drive(profile=profile, length=1.0, speed=0.2, acceleration=0.3)
    speeds = [step.motion.vx for _, step, _ in rows if step.motion is not None and step.state.phase == "drive"]
    assert max(speeds) == pytest.approx(0.2, abs=1e-3)
    assert max(abs(b - a) for a, b in itertools.pairwise(speeds)) <= 0.3 * PERIOD + 1e-3


@pytest.mark.parametrize("profile", ["trapezoid", "cubic", "ramp"])
def test_it_waits_for_a_robot_that_is_held_up_and_goes_on_where_it_is(profile):
    rows = drive(profile=profile, length=0.6, slow=lambda t: 0.0 if 2.5 < t < 4.5 else 1.0)
    assert rows[-1][1].outcome is Reason.BEHAVIOUR_DONE
    assert moved(rows)[0] == pytest.approx(0.6, abs=0.01)
    assert rows[-1][1].state.stood > (0.0 if profile == "ramp" else 1.0)
    free = drive(profile=profile, length=0.6)
    assert rows[-1][0] - free[-1][0] == pytest.approx(2.0, abs=0.8)


def test_a_robot_that_does_not_move_any_more_is_stuck_for_what_the_gate_says():
    rows = drive(length=0.6, slow=lambda t: 0.0 if t > 2.5 else 1.0, reasons=(Reason.OBSTACLE_STOP,))
    end = rows[-1][1]
    assert end.outcome is Reason.STUCK
    assert re.fullmatch(r"0\.\d{3} m left and no progress for 3\.\d s: obstacle within the stopping distance", end.text)
    assert end.motion is None


def test_wheels_that_are_never_steered_to_the_move_end_it():
    truck = BehaviourBody(truck_chassis(SIZE), 0.4)
    move = Move(MoveConfig(radius=1.0, length=0.5), truck)
    state = move.begin()
    for i in range(200):
        straight = Inputs(
            {ODOMETRY.name: odometry(x=0.0, y=0.0, yaw=0.0, vx=0.0, wz=0.0, now=0), GATE.name: gate((0.01, 0.0, 0.0))}
        )
        step = move.step(straight, state, i * PERIOD)
        state = step.state
        if step.outcome is not Reason.DRIVING:
            break
        assert 0.0 < step.motion.vx < 0.01
    assert step.outcome is Reason.NOT_OBEYED


@pytest.mark.parametrize(
    ("body", "settings", "why"),
    [
        (truck_chassis(SIZE), {"radius": 0.0, "angle": 1.0}, "cannot turn on the spot"),
        (truck_chassis(SIZE), {"length": 1.0, "bearing": math.pi / 2}, "cannot move sideways"),
        (truck_chassis(SIZE), {"radius": 0.2, "length": 1.0}, r"radius is 0.2 m: this body's axles reach 0\.\d+ m"),
        (
            truck_chassis(SIZE),
            {"length": 1.0, "bearing": 0.9},
            r"bearing is 0.9 rad: this body's axles reach 0\.\d+ rad",
        ),
        (synchro_chassis(SIZE), {"radius": 1.0, "length": 1.0}, "keeps its heading"),
        (differential_chassis(SIZE), {"length": 1.0, "bearing": 1.0}, "cannot move sideways"),
    ],
)
def test_what_the_body_cannot_do_is_refused(body, settings, why):
    with pytest.raises(KinematicsError, match=why):
        Move(MoveConfig(**settings), BehaviourBody(body, 0.4))


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"length": 1.0, "angle": 1.0}, "either a length or an angle"),
        ({"angle": 1.0}, "an angle needs a radius"),
        ({"radius": 0.0, "length": 1.0}, "radius is 0"),
        ({"length": math.nan}, "finite"),
        ({"length": 1.0, "profile": "s"}, "trapezoid"),
    ],
)
def test_settings_that_are_no_move_are_refused(settings, why):
    with pytest.raises(ValueError, match=why):
        MoveConfig(**settings)


def test_a_bearing_may_be_half_a_turn_as_a_person_rounds_it():
    Move(MoveConfig(length=1.0, bearing=3.1416), BehaviourBody(omni_chassis(SIZE), 0.4))


def test_a_template_without_a_move_is_a_configuration_but_no_move():
    with pytest.raises(ValueError, match="either a length or an angle"):
        Move(MoveConfig(speed=0.1), DIFFERENTIAL)
