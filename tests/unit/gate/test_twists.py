"""Requests by twist through the gate: what each body does of them, under the limits that hold for every form."""

import math

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveForm
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.motion import Motion
from tests.unit.gate.rig import ANY_GROUND, BODIES, Rig, Robot

SPOT, SIDE = {"wz": 0.5}, {"vy": 0.1}


@pytest.mark.parametrize("kind", ["differential", "skid_steer", "omni", "mecanum", "wheels"])
@pytest.mark.parametrize("turn", [0.5, -0.5])
def test_bodies_that_can_turn_on_the_spot(kind, turn):
    robot = Robot(kind, obstacle=ANY_GROUND).driving(wz=turn, ticks=150)
    vx, vy, wz = robot.made
    assert (vx, wz) == pytest.approx((0.0, turn), abs=1e-9)
    assert vy == pytest.approx(0.03 * turn if kind == "skid_steer" else 0.0, abs=1e-9)  # round the sides' ICRs
    assert (Reason.CLIPPED in robot.out.reasons) == (kind == "skid_steer")
    assert (robot.out.form, robot.out.front, robot.out.rear) == (DriveForm.TWIST, 0.0, 0.0)


@pytest.mark.parametrize("kind", ["omni", "mecanum", "wheels"])
@pytest.mark.parametrize("side", [0.1, -0.1])
def test_bodies_that_can_move_sideways(kind, side):
    robot = Robot(kind, obstacle=ANY_GROUND).driving(vy=side, ticks=200)
    assert robot.made == pytest.approx((0.0, side, 0.0), abs=1e-9)
    assert robot.out.reasons == ()


@pytest.mark.parametrize(
    ("kind", "asked", "why"),
    [
        ("truck", SPOT, "this body cannot turn on the spot"),
        ("truck", SIDE, "this body cannot move sideways"),
        ("truck", {"vx": 0.01, "wz": 0.5}, "this body cannot turn on the spot"),
        ("ackermann", SPOT, "this body cannot turn on the spot"),
        ("ackermann", SIDE, "this body cannot move sideways"),
        ("ackermann", {"vx": 0.2, "vy": 0.1}, "vy is 0.1: more than the 0 of its turn"),
        ("differential", SIDE, "this body cannot move sideways"),
        ("synchro", SPOT, "wz is 0.5: expected 0, because this body keeps its heading"),
        ("synchro", SIDE, "this body cannot move sideways"),
    ],
)
def test_what_a_body_cannot_do_is_refused_with_the_reason_and_moves_nothing(kind, asked, why):
    robot = Robot(kind).armed()
    assert robot.twist(**asked) is Reason.IMPOSSIBLE_MOTION
    robot.tick(5)
    assert robot.out.mode is GateMode.ARMED
    [event] = robot.reported(Reason.IMPOSSIBLE_MOTION)
    assert why in event.text


def test_a_form_that_a_body_does_not_take_is_refused(monkeypatch):
    robot = Robot("differential").armed()
    monkeypatch.setattr(type(robot.chassis), "forms", frozenset({"axles"}))
    assert robot.twist(vx=0.1) is Reason.IMPOSSIBLE_MOTION
    robot.tick()
    assert "a request by twist: this body accepts axles" in robot.reported(Reason.IMPOSSIBLE_MOTION)[0].text
    assert robot.drive(speed=0.1) is Reason.OK


@pytest.mark.parametrize("kind", ["truck", "ackermann"])
def test_a_twist_steers_axles(kind):
    robot = Robot(kind).driving(vx=0.15, wz=0.1, ticks=100)
    vx, vy, wz = robot.made
    assert (vx, wz) == pytest.approx((0.15, 0.1), rel=0.02)
    assert vy == pytest.approx(0.0 if kind == "truck" else 0.016, abs=1e-3)  # the car's base is not on its rear axle
    assert (Reason.CLIPPED in robot.out.reasons) == (kind == "ackermann")


def test_a_turn_tighter_than_the_truck_can_is_clipped_to_its_tightest():
    robot = Robot("truck").driving(vx=0.1, wz=0.6, ticks=150)
    assert Reason.CLIPPED in robot.out.reasons
    assert (robot.out.front, robot.out.rear) == pytest.approx((0.4095, -0.4095), abs=1e-4)
    vx, _, wz = robot.out.twist
    assert vx == pytest.approx(0.1)
    assert wz < 0.6


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_refused_by_name(number):
    robot = Robot("mecanum").armed()
    assert robot.twist(vx=0.1, wz=number) is Reason.NOT_FINITE
    robot.tick()
    assert f"wz is {number}: expected finite numbers" in robot.reported(Reason.NOT_FINITE)[0].text


@pytest.mark.parametrize(("kind", "fastest"), [("mecanum", 0.15), ("wheels", 0.21)])
def test_huge_twists_are_clipped_in_their_direction(kind, fastest):
    robot = Robot(kind, obstacle=ANY_GROUND).driving(vx=1e308, vy=1e308, wz=-1e308, ticks=400)
    assert Reason.CLIPPED in robot.out.reasons
    # Mecanum wheels push against each other: the forward part is less than half of their speed.
    assert max(map(abs, robot.out.speeds)) == pytest.approx(fastest, rel=1e-3)
    assert np.array(robot.made) / robot.made[0] == pytest.approx([1.0, 1.0, -1.0], abs=1e-6)


def test_no_wheel_is_faster_than_allowed_on_the_spot_and_sideways():
    for asked in ({"wz": 5.0}, {"vy": 0.5}, {"vx": -0.5}):
        robot = Robot("mecanum", obstacle=ANY_GROUND).driving(**asked, ticks=100)
        assert max(map(abs, robot.shafts)) == pytest.approx(0.15)  # not ahead: the limit of reverse
        assert Reason.CLIPPED in robot.out.reasons
    assert max(Robot("mecanum").driving(vx=0.5, ticks=100).shafts) == pytest.approx(0.21)


@pytest.mark.parametrize("kind", ["differential", "omni", "mecanum", "wheels"])
def test_no_wheel_accelerates_faster_than_allowed_from_any_motion_to_any_other(kind):
    robot, rng = Robot(kind, obstacle=ANY_GROUND).armed(), np.random.default_rng(5)
    before = np.array(robot.out.speeds)
    for _ in range(12):
        vx, vy, wz = rng.uniform((-0.1, -0.1, -0.5), (0.2, 0.1, 0.5)).tolist()
        robot.driver = {"vx": vx, "vy": 0.0 if kind == "differential" else vy, "wz": wz}
        for _ in range(rng.integers(5, 60)):
            angles = np.array(robot.servos)
            robot.tick()
            now = np.array(robot.out.speeds)
            turned = np.abs(np.array(robot.servos) - angles).max()
            assert turned <= 1.0 * 0.02 + 1e-9
            # A wheel that turns changes the part of its velocity that it rolls.
            assert np.abs(now - before).max() <= 1.0 * 0.02 + 0.21 * turned + 1e-9
            before = now


def test_a_reversal_of_turning_passes_through_standstill():
    robot = Robot("differential").driving(wz=0.8, ticks=80)
    robot.driver = {"wz": -0.8}
    turns = [robot.tick().twist[2] for _ in range(80)]
    assert 0.0 in turns
    assert turns[-1] == pytest.approx(-0.8)


def test_wheels_turn_at_standstill_before_they_drive_elsewhere():
    robot = Robot("wheels", obstacle=ANY_GROUND).driving(vx=0.15, ticks=60)
    robot.driver = SIDE
    moved = []
    for _ in range(150):
        robot.tick()
        angle = abs(robot.servos[0])
        moved.append((angle, max(map(abs, robot.shafts))))
    assert moved[-1] == pytest.approx((math.pi / 2, 0.1))
    assert all(speed == 0.0 for angle, speed in moved if 0.01 < angle < math.pi / 2 - 0.36)


def test_wheels_do_not_turn_aside_under_a_body_that_still_rolls():
    robot = Robot("wheels", runaway=None, obstacle=ANY_GROUND).driving(vx=0.15, ticks=60)
    robot.driver = SIDE
    robot.tick()
    while any(robot.out.speeds):
        robot.tick()
    robot.shafts = [0.1] * len(robot.shafts)
    robot._obey = lambda: None
    before = robot.out.servos
    robot.tick(10)
    assert robot.out.servos == before
    robot.shafts = [0.0] * len(robot.shafts)
    robot.tick(10)
    assert robot.out.servos != before


def test_a_body_that_is_to_turn_brakes_for_what_is_ahead_while_it_still_drives_there():
    robot = Robot("differential").driving(vx=0.2, ticks=60)
    robot.driver = {"wz": 0.5}
    robot.obstacles = [(Footprint().half_length + 0.03, 0.0)]
    robot.tick()
    assert robot.out.action is DriveAction.QUICK_STOP


def test_the_limit_of_reverse_holds_from_the_first_tick():
    rig = Rig(obstacle=ANY_GROUND).armed()
    rig.driver = {"speed": -0.2}
    assert Reason.CLIPPED in rig.tick().reasons
    rig = Rig(obstacle=ANY_GROUND).armed()
    rig.driver = {"speed": 0.2}
    assert Reason.CLIPPED not in rig.tick().reasons


def test_wheels_turn_no_further_than_they_must():
    robot = Robot("wheels", obstacle=ANY_GROUND).driving(vx=0.001, vy=0.1, ticks=200)
    assert all(angle == pytest.approx(1.5608, abs=1e-3) for angle in robot.servos)
    robot.driver = {"vx": -0.001, "vy": 0.1}
    robot.tick(20)
    assert all(angle == pytest.approx(1.5808, abs=1e-3) for angle in robot.servos)  # not half a turn back
    assert robot.made == pytest.approx((-0.001, 0.1, 0.0), abs=1e-4)


@pytest.mark.parametrize("kind", ["differential", "mecanum", "wheels"])
def test_an_obstacle_that_a_corner_would_touch_stops_turning_on_the_spot(kind):
    free = Robot(kind, obstacle=ANY_GROUND).driving(wz=0.5, ticks=100)
    assert free.out.reasons == ()
    # Left of the front: a turn to the left brings the corner there, one to the right takes it away.
    near = Robot(kind).armed()
    near.obstacles = ((0.16, 0.24),)
    near.driver = {"wz": 0.5}
    near.tick(100)
    assert Reason.OBSTACLE_STOP in near.out.reasons
    assert near.out.twist == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("side", [1, -1])
def test_an_obstacle_to_one_side_stops_sideways_motion_to_that_side_only(side):
    robot = Robot("mecanum", obstacle=ANY_GROUND).armed()
    robot.obstacles = ((0.2, 0.25 * side),)
    robot.driver = {"vy": 0.1 * side}
    robot.tick(100)
    assert Reason.OBSTACLE_STOP in robot.out.reasons
    robot.driver = {"vy": -0.1 * side}
    robot.tick(100)
    assert robot.out.twist == pytest.approx((0.0, -0.1 * side, 0.0))


def test_neutral_twists_release_the_truck():
    robot = Robot("differential").driving(wz=0.5, ticks=60)
    robot.driver = {"wz": 0.0}
    robot.tick(60)
    robot.driver = None
    robot.tick(80)
    assert robot.out.mode is GateMode.ARMED
    assert robot.trips == []


@pytest.mark.parametrize("kind", ["ackermann", "truck", "synchro"])
def test_a_change_of_rounding_in_the_turn_alone_is_no_motion_of_its_own(kind: str):
    motion = Motion(InForce(GateConfig()), BODIES[kind])
    motion.twist = motion.along((0.1, 0.0, 0.0))
    vx, vy, wz = motion.twist
    target = (vx, vy + 1e-18, wz + 1e-17)
    motion.accelerate(target, 0.02)
    assert motion.twist == pytest.approx(target, abs=1e-12)


TINY = 1e-310
"""Its reciprocal is infinite."""


@pytest.mark.parametrize("kind", ["truck", "ackermann", "skid_steer", "wheels"])
def test_a_motion_too_slow_to_have_a_direction_is_none(kind):
    robot = Robot(kind).armed()
    slow = [TINY] * len(robot.shafts)
    asks = (lambda: robot.drive(speed=TINY), lambda: robot.twist(vx=-TINY), lambda: robot.roll(*slow))
    for ask in asks:
        assert ask() is Reason.OK
        assert max(map(abs, robot.tick().speeds)) < 1e-300


def test_what_rounding_leaves_of_a_motion_that_ends_is_not_taken_for_a_direction():
    robot = Robot("ackermann").armed()
    assert robot.twist(vx=-0.1, wz=-1.57) is Reason.OK
    robot.tick(11)
    assert robot.roll(0.436) is Reason.OK  # passes through standstill
    robot.tick(12)
    assert robot.out.mode is GateMode.DRIVING


@pytest.mark.parametrize("kind", ["differential", "skid_steer"])
def test_an_angle_that_is_taken_although_it_is_off_by_rounding_does_no_harm(kind):
    robot = Robot(kind).armed()
    assert robot.drive(speed=0.2, front=0.1, rear=1e-6) is Reason.OK
    robot.tick(3)
    assert robot.out.mode is GateMode.DRIVING
