"""Each of the ten families drives straight, arc, turn on the spot and sideways where it can, judged by the world."""

import math

import numpy as np
import pytest

from monstertruck_schemas.reasons import Reason
from tests.daemon.move_kit import arrived, drive_move
from tests.long_kit import mostly_long

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

STRAIGHT = {"length": 0.5}
BACK = {"length": -0.3, "profile": "cubic"}
LEFT = {"radius": 0.9, "angle": 0.6, "profile": "cubic"}
RIGHT = {"radius": -0.9, "length": 0.5, "profile": "ramp"}
SPOT = {"radius": 0.0, "angle": 0.9, "profile": "ramp"}
SIDE = {"length": -0.3, "bearing": math.pi / 2}
MOVES = {"straight": STRAIGHT, "back": BACK, "left": LEFT, "right": RIGHT, "spot": SPOT, "side": SIDE}
ROLLS = ("truck", "ackermann", "bicycle", "tricycle")
CAN = {
    **dict.fromkeys(ROLLS, "straight back left right"),
    "differential": "straight back left right spot",
    "skid_steer": "straight back left right spot",
    "independent": "straight back left right spot side",
    "omni": "straight back left right spot side",
    "mecanum": "straight back left right spot side",
    "synchro": "straight back",
}
REAR = {"ackermann": -0.16, "bicycle": -0.16, "tricycle": -0.16, "skid_steer": -0.03}
"""x of the point of base that the radius is measured at, m: abeam of the turning centre."""
CASES = [(name, move) for name, can in CAN.items() for move in can.split()]
CANNOT = [(name, move) for name, can in CAN.items() for move in MOVES if move not in can.split()]
KEPT = {
    ("truck", "left"), ("truck", "back"), ("ackermann", "right"), ("bicycle", "straight"), ("tricycle", "back"),
    ("differential", "spot"), ("skid_steer", "left"), ("independent", "side"), ("omni", "right"), ("mecanum", "spot"),
    ("synchro", "straight"),
}  # fmt: skip
"""Every body, every move."""
REFUSED = {("truck", "spot"), ("differential", "side"), ("synchro", "left")}
WHY = {
    "spot": "cannot turn on the spot",
    "side": "cannot move sideways",
    ("synchro", "spot"): "this body keeps its heading",
    ("synchro", "left"): "this body keeps its heading",
    ("synchro", "right"): "this body keeps its heading",
}


def expected(name: str, move: str) -> tuple[float, float, float]:
    """Where base is afterwards, in its own frame before: forward, sideways (m), turned (rad)."""
    settings, x = MOVES[move], REAR.get(name, 0.0)
    radius, length = settings.get("radius"), settings.get("length")
    if radius is None:
        bearing = settings.get("bearing", 0.0)
        return length * math.cos(bearing), length * math.sin(bearing), 0.0
    turn = settings.get("angle") if length is None else length / radius
    # base turns about (x, radius)
    c, s = math.cos(turn), math.sin(turn)
    return x + c * -x + s * radius, radius + s * -x - c * radius, turn


@pytest.mark.parametrize(("name", "move"), mostly_long(CASES, KEPT))
def test_a_body_moves_as_commanded(name: str, move: str):
    moved = drive_move(name, **MOVES[move])
    assert arrived(moved), (moved.end.outcome, moved.end.text)
    assert moved.moved[:2] == pytest.approx(expected(name, move)[:2], abs=0.015)
    assert moved.moved[2] == pytest.approx(expected(name, move)[2], abs=0.03)
    apart, turned = moved.drift
    assert apart < 0.015
    assert turned < 0.015
    assert np.abs(np.diff(moved.truth[-10:, 1:3], axis=0)).max() < 1e-3


@pytest.mark.parametrize(("name", "move"), mostly_long(CANNOT, REFUSED))
def test_what_a_body_cannot_do_is_refused_with_the_reason_and_nothing_moves(name: str, move: str):
    moved = drive_move(name, **MOVES[move])
    assert moved.refused is not None
    assert moved.refused.refusal is Reason.IMPOSSIBLE_MOTION
    assert WHY.get((name, move), WHY.get(move)) in str(moved.refused)
    assert max(map(abs, moved.moved)) < 1e-3


def test_its_clock_stands_while_the_gate_slows_it_and_it_still_arrives():
    moved = drive_move("differential", length=0.6, overlay={"gate": {"speed": 0.06, "reverse_speed": 0.06}})
    assert arrived(moved)
    assert moved.end.values["stood"] > 4.0
    assert moved.moved[0] == pytest.approx(0.6, abs=0.015)
    fastest = np.abs(moved.truth[:, 4]).max()
    assert fastest < 0.07


@pytest.mark.parametrize("name", ["truck", "mecanum"])
def test_a_planner_does_not_back_a_robot_into_ground_that_no_sensor_has_seen(name: str):
    moved = drive_move(name, overlay={"gate": {"obstacle": {"unseen": "stop"}}}, **BACK)
    assert moved.end.outcome is Reason.UNSEEN_STOP
    assert max(map(abs, moved.moved)) < 0.05


def test_an_obstacle_ends_it_with_the_gates_reason_before_contact():
    moved = drive_move("differential", length=4.8, limit=90.0)
    assert moved.end.outcome is Reason.OBSTACLE_STOP
    assert not moved.truth[:, 5].any()
    assert moved.moved[0] > 1.0
