"""Assisted driving: the nearest free curvature, for operators only, never faster and never out of a standstill."""

import math

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruckd.gate.assist import free_distances, nearest_free
from tests.unit.gate.rig import Rig

FOOTPRINT = Footprint()
FORWARD, BACK = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)
ON = {"assist": {"on": True}}
RIGHT_HALF = tuple((0.9, y) for y in np.arange(-0.6, 0.06, 0.02))
"""A wall ahead that ends a little to the left of the middle."""


def free(*points, twist=FORWARD, margin=0.0):
    return float(free_distances(np.array([twist]), FOOTPRINT, margin, np.array(points).reshape(-1, 2))[0])


def test_a_point_ahead_stops_a_straight_motion_where_the_discs_meet_it():
    _, radius = FOOTPRINT.covering_discs()
    centre = FOOTPRINT.covering_discs()[0].max()
    assert free((1.0, 0.0)) == pytest.approx(1.0 - centre - radius, abs=1e-3)
    assert free((1.0, 0.0), margin=0.1) == pytest.approx(0.9 - centre - radius, abs=1e-3)
    assert free((1.0, radius + 0.01)) == math.inf
    assert free((-1.0, 0.0)) > 100.0
    assert free((-1.0, 0.0), twist=BACK) == pytest.approx(1.0 - centre - radius, abs=1e-3)
    assert free() == math.inf


def test_free_distances_agree_with_a_motion_in_small_steps():
    rng = np.random.default_rng(4)
    places, radius = FOOTPRINT.covering_discs()
    for _ in range(60):
        twist = np.array([rng.choice((-1.0, 1.0)), rng.uniform(-0.3, 0.3), rng.uniform(-2.4, 2.4)])
        point = rng.uniform(-1.2, 1.2, 2)
        if (np.hypot(point[0] - places, point[1]) < radius + 0.01).any():
            continue
        found = free(point, twist=tuple(twist))
        s = np.arange(0.0, 1.5, 0.001)
        yaw = twist[2] * s
        turn = twist[2]
        x = (twist[0] * np.sin(yaw) - twist[1] * (1 - np.cos(yaw))) / turn
        y = (twist[0] * (1 - np.cos(yaw)) + twist[1] * np.sin(yaw)) / turn
        discs = [(x + np.cos(yaw) * d, y + np.sin(yaw) * d) for d in places]
        hit = np.min([np.hypot(dx - point[0], dy - point[1]) for dx, dy in discs], axis=0) < radius
        expected = s[np.argmax(hit)] if hit.any() else math.inf
        assert found == pytest.approx(expected, abs=0.003) or (found > 1.49 and expected == math.inf)


def test_a_body_that_touches_something_may_leave_it():
    beside = (0.0, FOOTPRINT.half_width)
    assert free(beside, twist=(1.0, 0.0, 2.0)) == 0.0 or free(beside, twist=(1.0, 0.3, 0.0)) == 0.0
    assert free(beside, twist=(1.0, -0.3, 0.0)) > 1.0


def test_the_nearest_turn_with_room_enough_is_chosen_else_the_one_with_most_room():
    turns = np.array([-0.4, -0.2, 0.0, 0.2, 0.4])
    assert nearest_free(turns, np.array([9.0, 9.0, 9.0, 9.0, 9.0]), 1.0) == 0.0
    assert nearest_free(turns, np.array([9.0, 0.9, 0.5, 1.1, 9.0]), 1.0) == 0.2
    assert nearest_free(turns, np.array([0.1, 0.2, 0.3, 0.6, 0.5]), 1.0) == 0.2


def test_an_operator_is_steered_round_an_obstacle_and_sees_it():
    rig = Rig(**ON)
    rig.obstacles = RIGHT_HALF
    rig.driving(speed=0.2)
    assert rig.out.front > 0.05
    assert rig.out.rear == pytest.approx(-rig.out.front)
    assert Reason.ASSISTED in rig.out.reasons
    assert rig.out.twist[0] <= 0.2


@pytest.mark.parametrize(
    ("config", "driver"),
    [
        ({}, {"speed": 0.2}),
        (ON, {"speed": 0.2, "role": Role.TRACKER, "inside": True, "source": "tracker"}),
        (
            {**ON, "remote_trackers": ("lab",)},
            {"speed": 0.2, "role": Role.TRACKER, "inside": False, "source": "lab"},
        ),
        (ON, {"speed": 0.2, "unseen": True}),
        (ON, {"speed": 0.0, "front": 0.0}),
        (ON, {"speed": -0.1}),
    ],
    ids=["off", "tracker", "remote tracker", "second control", "standstill", "away"],
)
def test_nothing_else_is_steered(config, driver):
    rig = Rig(**config)
    rig.obstacles = RIGHT_HALF
    rig.armed()
    rig.driver = driver
    rig.tick(30)
    assert rig.out.front == 0.0
    assert Reason.ASSISTED not in rig.out.reasons
    assert driver["speed"] != 0.0 or not any(rig.out.speeds)


def test_on_free_ground_the_motion_is_the_operators():
    rig = Rig(**ON)
    rig.obstacles = ((0.9, -0.6),)
    rig.driving(speed=0.2, front=0.1, rear=-0.1)
    assert (rig.out.front, rig.out.rear) == (pytest.approx(0.1), pytest.approx(-0.1))
    assert Reason.ASSISTED not in rig.out.reasons


def test_before_a_wall_without_a_way_round_the_gate_stops_the_robot():
    rig = Rig(**ON)
    rig.driving(speed=0.2)
    rig.obstacles = tuple((0.33, y) for y in np.arange(-1.2, 1.2, 0.02))
    rig.tick(60)
    assert Reason.OBSTACLE_STOP in rig.out.reasons
    assert rig.speed == 0.0


def test_it_is_switched_while_driving():
    rig = Rig()
    rig.obstacles = RIGHT_HALF
    rig.driving(speed=0.2)
    assert rig.out.front == 0.0
    rig.gate.configure(rig.config.model_copy(update={"assist": rig.config.assist.model_copy(update={"on": True})}))
    rig.tick(20)
    assert rig.out.front > 0.05


def test_a_speed_beyond_all_limits_is_steered_like_the_greatest():
    rig = Rig(**ON)
    rig.obstacles = RIGHT_HALF
    rig.driving(speed=1e200)
    assert rig.out.front > 0.05
    assert rig.out.twist[0] <= rig.config.speed + 1e-9
