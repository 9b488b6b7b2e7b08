"""Requests by shaft speeds, open loop: every shaft turns as asked, under the limits that hold for every form."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_planners.collision import Footprint
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveForm, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.config import GateConfig
from tests.unit.gate.rig import ANY_GROUND, BODIES, Robot

RADIUS = 0.075
CONFIG = GateConfig()
KINDS = [kind for kind in BODIES if len(BODIES[kind].shafts) > 1]


def test_shafts_turn_as_asked_and_the_motion_is_the_predicted_one():
    robot = Robot("differential").armed()
    robot.driver = (0.5, 1.0)
    robot.tick(60)
    assert robot.out.speeds == pytest.approx((0.5 * RADIUS, 1.0 * RADIUS))
    assert robot.out.twist == pytest.approx(robot.chassis.twist(robot.out.speeds))
    assert (robot.out.form, robot.out.reasons) == (DriveForm.SHAFTS, ())


def test_the_truck_keeps_its_steering():
    robot = Robot("truck").driving(speed=0.1, front=0.2, rear=-0.2, ticks=60)
    steered = robot.servos
    robot.driver = (1.0,)
    robot.tick(120)
    assert robot.servos == steered
    assert robot.out.speeds == pytest.approx((RADIUS,))


@pytest.mark.parametrize("rates", [(1.0,), (1.0, 1.0, 1.0), (1.0,) * 5])
def test_another_number_of_shafts_is_refused(rates):
    robot = Robot("differential").armed()
    assert robot.roll(*rates) is Reason.IMPOSSIBLE_MOTION
    robot.tick()
    assert "expected 2 (left, right)" in robot.reported(Reason.IMPOSSIBLE_MOTION)[0].text
    assert robot.out.mode is GateMode.ARMED


def test_shafts_that_push_against_each_other_are_refused():
    robot = Robot("mecanum").armed()
    assert robot.roll(1.0, -1.0, -1.0, 1.0) is Reason.OK, "sideways"
    assert robot.roll(1.0, 1.0, -1.0, -1.0) is Reason.IMPOSSIBLE_MOTION
    robot.tick()
    assert "work against each other" in robot.reported(Reason.IMPOSSIBLE_MOTION)[0].text


def test_wheels_of_one_side_may_differ_a_little_and_each_turns_as_asked():
    robot = Robot("skid_wheels").armed()
    robot.driver = (1.0, 1.2, 0.95, 1.2)
    robot.tick(60)
    assert robot.out.speeds == pytest.approx([RADIUS * rate for rate in robot.driver])
    assert robot.roll(1.0, 1.2, 0.0, 1.2) is Reason.IMPOSSIBLE_MOTION
    robot.tick()
    assert "front left" in robot.reported(Reason.IMPOSSIBLE_MOTION)[0].text


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_refused_by_name(number):
    robot = Robot("differential").armed()
    assert robot.roll(0.1, number) is Reason.NOT_FINITE
    robot.tick()
    assert f"shafts[1] is {number}" in robot.reported(Reason.NOT_FINITE)[0].text


@pytest.mark.parametrize("inside", [True, False])
def test_planners_and_trackers_have_no_open_loop(inside):
    robot = Robot("differential", remote_trackers=("far",)).armed()
    assert robot.roll(0.5, 0.5, source="far", role=Role.TRACKER, inside=inside) is Reason.BAD_ROLE
    robot.tick(5)
    assert robot.out.mode is GateMode.ARMED


def test_a_wall_ahead_stops_open_loop_as_every_form():
    robot = Robot("differential").armed()
    robot.driver = (1.5, 1.5)
    robot.tick(40)
    robot.obstacles = [(Footprint().half_length + 0.06, 0.0)]
    robot.tick(60)
    assert Reason.OBSTACLE_STOP in robot.out.reasons
    assert not any(robot.out.speeds)


def test_open_loop_and_back_pass_through_standstill():
    robot = Robot("mecanum").driving(vx=0.1, ticks=60)
    robot.driver = (1.0, 1.2, 1.0, 1.2)
    speeds = [max(map(abs, robot.tick().speeds)) for _ in range(120)]
    assert 0.0 in speeds
    assert speeds[-1] == pytest.approx(1.2 * RADIUS)
    robot.driver = {"vx": 0.1}
    assert 0.0 in [max(map(abs, robot.tick().speeds)) for _ in range(120)]
    assert robot.out.form is DriveForm.TWIST


@settings(max_examples=25, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    asked=st.lists(
        st.tuples(st.lists(st.floats(-50.0, 50.0), min_size=4, max_size=4), st.integers(1, 25)), min_size=1, max_size=4
    ),
)
def test_nothing_passes_a_limit(kind, asked):
    robot = Robot(kind, obstacle=ANY_GROUND).armed()
    before = np.array(robot.out.speeds)
    for rates, ticks in asked:
        robot.driver = tuple(rates[: len(robot.chassis.shafts)])
        for _ in range(ticks):
            robot.tick()
            now = np.array(robot.out.speeds)
            vx, vy, _ = robot.out.twist
            assert max(np.abs(now).max(), math.hypot(vx, vy)) <= CONFIG.speed + 1e-9
            if vx < 0.0:
                assert np.abs(now).max() <= CONFIG.reverse_speed + CONFIG.deceleration * 0.02 + 1e-9
            # Standstill at once is commanded only where the controllers' own ramp follows.
            if now.any():
                assert np.abs(now - before).max() <= CONFIG.deceleration * 0.02 + 1e-9
            before = now
