"""Trouble of drive and steering: a shaft that does not turn, a controller that restarts, short faults that repeat."""

import math

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.sensor import DriveMode
from monstertruck_schemas.state import GateMode
from monstertruck_schemas.topics import DRIVES
from monstertruckd.gate.config import ShaftCheckConfig
from monstertruckd.gate.following import ShaftCheck, ShaftComparison
from tests.unit.gate.rig import ANY_GROUND, Rig, Robot, check_of, feedback, health, show


def held(rig, ticks):
    """The shaft does not turn, whatever is commanded."""
    for _ in range(ticks):
        rig.speed = 0.0
        rig.tick()


@pytest.mark.parametrize("speed", [0.2, -0.1])
def test_a_blocked_shaft_stops_and_disarms_within_a_second(speed):
    rig = Rig(obstacle=ANY_GROUND).driving(speed=speed)
    held(rig, 50)
    assert rig.trips[0].reason is Reason.SHAFT_BLOCKED
    assert rig.out.mode is GateMode.DISARMED
    rig.driver = None
    rig.tick(60)
    assert rig.order(Order.ARM) is Reason.OK


@pytest.mark.parametrize("mode", [DriveMode.STARTING, DriveMode.DISABLED, DriveMode.QUICK_STOP])
def test_a_shaft_whose_controller_never_enables_is_blocked(mode, monkeypatch):
    """With another one that drives, the body would turn on the spot."""
    robot = Robot("differential").driving(ticks=2, speed=0.2)
    observe = robot.gate.observe

    def second_never_enables(message, topic):
        observe(feedback(robot.now, 0.0, mode=mode) if topic is DRIVES[1] else message, topic)

    monkeypatch.setattr(robot.gate, "observe", second_never_enables)
    robot.tick(70)
    assert robot.trips == []
    robot.tick(20)
    assert robot.trips[0].reason is Reason.SHAFT_BLOCKED
    robot.driver = None
    robot.tick(60)
    assert robot.out.mode is GateMode.DISARMED


def test_it_can_be_configured_not_to_look():
    rig = Rig(blocked=None).driving(speed=0.2)
    held(rig, 50)
    assert rig.out.mode is GateMode.DRIVING
    assert rig.trips == []


def test_a_slow_shaft_is_not_blocked():
    rig = Rig().driving(speed=0.2)
    for _ in range(100):
        rig.speed = 0.03
        rig.tick()
    assert Reason.SHAFT_BLOCKED not in {trip.reason for trip in rig.trips}


def test_the_blocked_shafts_current_is_in_the_stops_causes():
    rig = Rig().driving(speed=0.2)
    show(rig.gate, feedback(rig.now, 0.0).model_copy(update={"current": 2.0}))
    held(rig, 50)
    figures = {figure.name: figure.value for figure in rig.trips[0].causes[0].measurements}
    assert figures["motor current"] == 2.0


@pytest.mark.parametrize("reason", [Reason.DEVICE_RESTARTED, Reason.DEVICE_STOPPED])
def test_a_drive_controller_that_restarted_or_was_stopped_by_another_disarms(reason):
    rig = Rig().driving(speed=0.2)
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, "drive", reason=reason))
    rig.tick(3)
    show(rig.gate, health(rig.now, ServiceState.READY, "drive"))
    rig.tick(60)
    assert rig.out.mode is GateMode.DISARMED
    assert reason in {trip.reason for trip in rig.trips} | {cause.reason for trip in rig.trips for cause in trip.causes}


@pytest.mark.parametrize("state", [ServiceState.STARTING, ServiceState.READY])
@pytest.mark.parametrize("reason", [Reason.DEVICE_RESTARTED, Reason.DEVICE_STOPPED])
def test_it_disarms_although_its_service_is_started_again_before_the_next_tick(reason, state):
    rig = Rig().driving(speed=0.2)
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, "drive", reason=reason))
    show(rig.gate, health(rig.now, state, "drive"))
    rig.tick(60)
    assert reason in {cause.reason for cause in rig.trips[0].causes}
    assert rig.out.mode is GateMode.DISARMED
    rig.driver = None
    rig.tick(60)
    assert rig.order(Order.ARM) is Reason.OK


def test_one_that_was_unplugged_for_a_moment_does_not():
    rig = Rig().driving(speed=0.2)
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, "drive", reason=Reason.DEVICE_LOST))
    rig.tick(3)
    show(rig.gate, health(rig.now, ServiceState.READY, "drive"))
    rig.tick(60)
    assert rig.out.mode is GateMode.DRIVING


@pytest.mark.parametrize(("faults", "mode"), [(3, GateMode.DRIVING), (4, GateMode.DISARMED)])
def test_short_faults_that_repeat_disarm(faults, mode):
    rig = Rig().driving(speed=0.2)
    for _ in range(faults):
        rig.silent = {"drive"}
        rig.tick(15)
        rig.silent = set()
        rig.tick(60)
    assert rig.out.mode is mode
    assert (Reason.FAULTS_REPEAT in {event.reason for event in rig.events}) is (mode is GateMode.DISARMED)


def test_stops_for_a_driver_who_falls_silent_are_no_faults():
    rig = Rig()
    rig.armed()
    for _ in range(6):
        rig.driver = {"speed": 0.1, "lease": 0.2}
        rig.tick(20)
        assert rig.out.mode is GateMode.DRIVING
        rig.driver = None
        rig.tick(60)
        assert rig.out.mode is GateMode.ARMED
    assert not rig.reported(Reason.FAULTS_REPEAT)


# The check of the shafts alone


def shown(check, at, shaft=0, commanded=0.2, measured=0.0, mode=DriveMode.ENABLED, current=None):
    """Whether a shaft is blocked after feedback of it, ``at`` seconds."""
    message = feedback(round(at * SECOND), mode=mode).model_copy(update={"current": current})
    check.observe(message, shaft, commanded, measured)
    return check.blocked is not None


def shafts(**config):
    return ShaftComparison(ShaftCheckConfig(**config))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_shaft_is_blocked_after_its_time_and_stays_so_until_the_reset(sign):
    check = shafts()
    assert not shown(check, 1.0, commanded=sign * 0.2)
    assert not shown(check, 1.599, commanded=sign * 0.2)
    assert shown(check, 1.6, commanded=sign * 0.2)
    assert shown(check, 1.7, commanded=sign * 0.2, measured=sign * 0.2)
    check.reset()
    assert check.blocked is None
    assert not shown(check, 1.8, commanded=sign * 0.2), "the time begins anew"
    assert not shown(check, 2.399, commanded=sign * 0.2)
    assert shown(check, 2.4, commanded=sign * 0.2)
    check.reset()
    assert not shown(check, 2.5, commanded=sign * 0.2), "of a shaft that was held until the reset, too"


@pytest.mark.parametrize(
    ("commanded", "measured", "turns"),
    [
        (0.2, 0.1, True),
        (0.2, 0.0999, False),
        (-0.2, -0.1, True),
        (-0.2, -0.0999, False),
        (0.2, -0.2, False),
        (-0.2, 0.2, False),
        (0.03, 0.0, False),
        (-0.03, 0.0, False),
        (0.0299, 0.0, True),
        (-0.0299, 0.0, True),
        (0.0, 0.0, True),
    ],
)
def test_a_shaft_turns_at_a_share_of_its_command_or_needs_not(commanded, measured, turns):
    check = shafts(share=0.5)
    shown(check, 1.0, commanded=commanded, measured=measured)
    assert shown(check, 1.7, commanded=commanded, measured=measured) is not turns


@pytest.mark.parametrize(
    ("mode", "within"),
    [
        (DriveMode.ENABLED, 0.6),
        (DriveMode.STARTING, 1.5),
        (DriveMode.DISABLED, 1.5),
        (DriveMode.QUICK_STOP, 1.5),
        (DriveMode.FAULT, math.inf),
    ],
)
def test_a_controller_has_its_time_to_enable_and_in_fault_another_reason_to_stand(mode, within):
    check = shafts()
    shown(check, 1.0, mode=mode)
    for after in (0.59, 0.6, 1.49, 1.5):
        assert shown(check, 1.0 + after, mode=mode) is (after >= within)


def test_a_controller_that_was_enabled_late_has_its_time_to_turn_the_shaft():
    check = shafts()
    shown(check, 1.0, mode=DriveMode.STARTING)
    shown(check, 2.4, mode=DriveMode.ENABLED)
    assert not shown(check, 2.99)
    assert shown(check, 3.0)


def test_a_shaft_that_turned_in_between_begins_anew():
    check = shafts()
    shown(check, 1.0)
    shown(check, 1.5, measured=0.2)
    assert not shown(check, 1.7)
    assert not shown(check, 2.29)
    assert shown(check, 2.3)


def test_every_shaft_has_its_own_time_and_the_first_blocked_one_is_named():
    check = shafts()
    shown(check, 1.0, shaft=1)
    shown(check, 1.3, shaft=0)
    assert shown(check, 1.6, shaft=1, current=2.5)
    shown(check, 1.9, shaft=0, current=1.5)
    assert (check.blocked, check.current) == (1, 2.5)
    assert shown(check, 2.0, shaft=1)
    assert check.current == 2.5, "the newest one measured"


def test_nothing_blocked_has_no_current():
    check = shafts()
    shown(check, 1.0, current=2.5)
    assert check.current is None


def test_of_two_shafts_the_second_one_alone_stops_the_robot():
    robot = Robot("differential").armed()
    robot.driver = {"vx": 0.15}
    robot.tick(40)
    obey = robot._obey

    def held_second():
        obey()
        robot.shafts[1] = 0.0

    robot._obey = held_second
    robot.tick(40)
    assert robot.reported(Reason.SHAFT_BLOCKED)
    assert check_of(robot.gate, ShaftCheck)._comparison.blocked in (1, None)
    assert robot.trips[-1].reason is Reason.SHAFT_BLOCKED
