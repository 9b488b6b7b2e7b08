"""Yaw against steering: what betrays servos without supply, and what must not be taken for it."""

import math

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.sensor import Attitude, DriveMode
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.config import SteeringCheckConfig
from monstertruckd.gate.following import SteeringCheck, TurnComparison
from tests.unit.gate.rig import Rig, Robot, check_of, header, servos, show

PERIOD = SECOND // 20
SPEED = 0.18
RATE = 0.33
"""Of a truck that steers both axles by 0.3 rad, rad/s."""


def drive(check, seconds, *, turning=1.0, speed=SPEED, heading=0.0, rate=RATE, start=0):
    """Heading (clockwise) of a truck that turns by a share of what is commanded; seconds until found dead."""
    for step in range(round(seconds * SECOND / PERIOD) + 1):
        at = step * PERIOD / SECOND
        measured = (heading - turning * RATE * at) % (2 * math.pi)
        check.observe(start + step * PERIOD, measured, speed, rate)
        if check.contradicts:
            return at
    return None


@pytest.fixture
def check():
    return TurnComparison(SteeringCheckConfig())


@pytest.mark.parametrize("turning", [0.8, 1.0, 1.2])
def test_a_truck_that_turns_about_as_commanded_is_sound(check, turning):
    assert drive(check, 20.0, turning=turning) is None


@pytest.mark.parametrize("turning", [0.0, -0.5, 3.0])
def test_one_that_does_not_is_found_within_a_second_and_a_half(check, turning):
    found = drive(check, 20.0, turning=turning)
    assert found is not None
    assert found < 1.5
    assert check.contradicts


def test_turning_without_being_commanded_to_is_found(check):
    assert drive(check, 5.0, rate=0.0) is not None


def test_standing_still_proves_nothing(check):
    assert drive(check, 5.0, turning=0.0, speed=0.0) is None


def test_a_reset_forgets(check):
    drive(check, 5.0, turning=0.0)
    check.reset()
    assert (check.contradicts, check.difference) == (False, 0.0)
    assert drive(check, 5.0, start=60 * SECOND) is None


def test_a_reset_forgets_what_was_compared_just_before(check):
    found = drive(check, 5.0, turning=0.0)
    check.reset()
    check.observe(round(found * SECOND) + PERIOD, 0.0, SPEED, RATE)
    assert not check.contradicts


def test_a_heading_that_jumps_is_the_compass(check):
    drive(check, 2.0)
    assert drive(check, 3.0, heading=2.0, start=round(2.05 * SECOND)) is None


@pytest.mark.parametrize(("heading", "speed"), [(None, SPEED), (0.0, None)])
def test_what_is_not_known_is_not_judged(check, heading, speed):
    for step in range(200):
        unknown = step % 5 == 0
        check.observe(step * PERIOD, heading if unknown else 0.0, speed if unknown else SPEED, RATE)
    assert not check.contradicts


def test_headings_far_apart_are_not_compared(check):
    for step in range(20):
        check.observe(step * SECOND, 0.0, SPEED, RATE)
    assert not check.contradicts


def turned(check, commanded, measured, seconds=0.4, speed=SPEED):
    """Two headings ``seconds`` apart, the turns between them in rad, left positive."""
    check.observe(0, 1.0, speed, 0.0)
    check.observe(round(seconds * SECOND), 1.0 - measured, speed, commanded / seconds)
    return check.contradicts


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("commanded", "measured"), [(0.2, 0.34 / 0.7), (0.4, 0.14), (0.0, 0.2), (0.1, -0.07)])
def test_the_difference_tolerated_is_a_fixed_part_and_a_share_of_the_larger_turn(sign, commanded, measured):
    outwards = 1e-6 if measured > commanded else -1e-6
    config = SteeringCheckConfig()
    assert turned(TurnComparison(config), sign * commanded, sign * (measured + outwards))
    assert not turned(check := TurnComparison(config), sign * commanded, sign * (measured - outwards))
    assert check.difference == pytest.approx(sign * (measured - commanded), abs=2e-6)


def test_a_heading_may_change_by_a_radian_and_a_half_a_second_before_it_counts_as_a_jump(check):
    assert turned(check, 0.0, 0.599)
    assert not turned(TurnComparison(SteeringCheckConfig()), 0.0, 0.601)


def test_the_window_begins_anew_at_a_jump(check):
    turned(check, 0.1, 0.601)
    assert check.difference == 0.0
    check.observe(round(0.8 * SECOND), 1.0 - 0.601 - 0.05, SPEED, 0.0)
    assert check.difference == pytest.approx(0.05)


def test_what_lies_before_a_jump_is_not_compared_with_what_comes_after(check):
    stamp, heading = 0, 0.0

    def turn(by, steps):
        nonlocal stamp, heading
        for _ in range(steps):
            stamp, heading = stamp + PERIOD, heading - by / steps
            check.observe(stamp, heading % (2 * math.pi), SPEED, 0.0)

    turn(0.13, 10)
    turn(0.0, 45)
    turn(1.0, 1)
    turn(-0.13, 10)
    assert check.difference == pytest.approx(-0.13)
    assert not check.contradicts


def test_headings_half_a_second_apart_are_compared_and_no_further(check):
    assert turned(check, 0.0, 0.4, 0.5)
    check = TurnComparison(SteeringCheckConfig())
    assert not turned(check, 0.0, 0.4, 0.5 + 2e-9)
    check.observe(round(0.9 * SECOND), 1.0 - 0.4 - 0.1, SPEED, 0.0)
    assert check.difference == pytest.approx(0.1)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_truck_is_checked_from_its_least_speed_on(sign):
    assert turned(TurnComparison(SteeringCheckConfig()), 0.0, 0.5, speed=sign * 0.03)
    assert not turned(TurnComparison(SteeringCheckConfig()), 0.0, 0.5, speed=sign * 0.0299)


def test_what_lies_before_a_heading_that_is_not_known_is_forgotten(check):
    check.observe(0, 1.0, SPEED, 0.0)
    check.observe(SECOND // 10, None, SPEED, 0.0)
    check.observe(SECOND // 5, 0.7, SPEED, 0.0)
    assert check.difference == 0.0
    assert not check.contradicts


def test_turns_are_compared_over_the_window_and_not_longer(check):
    assert check.difference == 0.0
    drive(check, 1.0, turning=1.2)
    assert check.difference == pytest.approx(0.2 * RATE * 1.0)
    drive(check, 6.0, turning=1.2, start=60 * SECOND)
    assert check.difference == pytest.approx(0.2 * RATE * 2.0)
    check.reset()
    assert check.difference == 0.0
    check.observe(66 * SECOND, 0.0, SPEED, RATE)
    assert check.difference == 0.0, "a reset forgets the window"


def test_dead_steering_stays_so_until_the_reset(check):
    drive(check, 5.0, turning=0.0)
    drive(check, 5.0, start=60 * SECOND)
    assert check.contradicts


def test_headings_out_of_order_are_not_compared(check):
    check.observe(SECOND, 1.0, SPEED, 0.0)
    check.observe(SECOND - 1, 0.2, SPEED, 0.0)
    check.observe(SECOND - 1, 0.9, SPEED, 0.0)
    assert not check.contradicts
    assert check.difference == 0.0


class Straight(Rig):
    """A truck whose servos turn on paper alone: it drives straight on."""

    def sense(self):
        super().sense()
        if self.out is not None:
            show(self.gate, servos(self.now, *self.out.servos))


def test_the_gate_stops_for_dead_steering_and_has_to_be_armed_again():
    rig = Straight().armed()
    rig.driver = {"speed": 0.2, "front": 0.3, "rear": -0.3}
    rig.tick(150)
    assert rig.reported(Reason.STEERING_DEAD)
    assert rig.out.mode is GateMode.DISARMED
    assert rig.speed == 0
    assert rig.travelled < 0.5
    rig.driver = None
    rig.tick(30)
    assert rig.out.reasons == (Reason.DISARMED,)
    assert rig.order(Order.ARM) == "ok"


def test_it_can_be_configured_not_to_look():
    rig = Straight(turning=None).armed()
    rig.driver = {"speed": 0.2, "front": 0.3, "rear": -0.3}
    rig.tick(150)
    assert rig.out.mode is GateMode.DRIVING


@pytest.mark.parametrize("speed", [0.0, 0.2])
def test_a_disarmed_truck_may_be_carried_or_pushed_about(speed):
    rig = Rig()
    rig.silent = {"attitude"}
    rig.mode, rig.current = DriveMode.DISABLED, 0.0
    for step in range(100):
        rig.speed = speed
        rig.tick()
        show(rig.gate, Attitude(**header(rig.now), heading=step * 0.02, roll=0.0, pitch=0.0))
    rig.silent, rig.speed = set(), 0.0
    rig.sense()
    assert rig.order(Order.ARM) == "ok"


@pytest.mark.parametrize(
    ("changes", "armed", "steering", "judged"),
    [
        ({}, True, True, True),
        ({"tilt_valid": False}, True, True, False),
        ({"heading_disturbed": True}, True, True, False),
        ({}, False, True, False),
        ({}, True, False, False),
    ],
)
def test_a_heading_is_judged_if_it_and_the_steering_are_known_while_the_truck_is_armed(
    changes, armed, steering, judged, monkeypatch
):
    rig = Rig()
    if armed:
        rig.armed()
    if not steering:
        rig.now += SECOND
    headings = []
    turns = check_of(rig.gate, SteeringCheck)._comparison
    monkeypatch.setattr(turns, "observe", lambda _stamp, heading, *_: headings.append(heading))
    show(rig.gate, Attitude(**header(rig.now), **({"heading": 0.5, "roll": 0.0, "pitch": 0.0} | changes)))
    assert headings == ([0.5] if judged and armed else [None])


@pytest.mark.parametrize("kind", ["ackermann", "wheels"])
def test_every_body_that_servos_steer_is_checked(kind):
    robot = Robot(kind).armed()
    robot.turns = False
    robot.driver = {"vx": 0.15, "wz": 0.2}
    robot.tick(200)
    assert robot.reported(Reason.STEERING_DEAD)


def test_a_body_that_nothing_steers_is_not():
    robot = Robot("differential").armed()
    robot.turns = False
    robot.driver = {"wz": 0.4}
    robot.tick(200)
    assert not robot.reported(Reason.STEERING_DEAD)
