"""Decisions of the gate with everything it says about them: events with severity, text and values, stops, outputs."""

import math

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveForm, Order, Role
from monstertruck_schemas.sensor import BatteryLevel
from monstertruck_schemas.state import GateMode
from tests.unit.gate.rig import TICK, Rig, Robot, health, show

TRACK = {"source": "track", "role": Role.TRACKER, "inside": True}
GOALS = {"source": "goals", "role": Role.TRACKER, "inside": True}
WARNING, INFO, ERROR = Severity.WARNING, Severity.INFO, Severity.ERROR


def said(rig, *, since=0):
    """Reason, severity and text of every event."""
    return [(event.reason, event.severity, event.text) for event in rig.events[since:]]


def newest(rig):
    return rig.events[-1]


# Requests


def test_a_refused_request_is_an_event_about_its_sender():
    rig = Rig().driving(source="ann")
    rig.drive(source="bob", speed=0.1)
    rig.tick()
    event = newest(rig)
    assert (event.reason, event.severity, event.text) == (Reason.BUSY, WARNING, Reason.BUSY.text)
    assert event.values == {"role": "gamepad", "request": "drive", "by": "bob"}
    rig.order(Order.ARM, source="eve", nonce="other")
    rig.tick()
    assert newest(rig).values == {"role": "gamepad", "request": "arm", "by": "eve"}


@pytest.mark.parametrize(
    ("request_", "reason", "reported"),
    [
        ({**GOALS, "speed": 0.0}, Reason.BUSY, False),
        ({**GOALS, "speed": 0.1}, Reason.BUSY, True),
    ],
)
def test_a_planner_that_holds_the_truck_at_rest_while_another_drives_is_no_event(request_, reason, reported):
    rig = Rig().driving(speed=0.1, **TRACK)
    assert rig.drive(**request_) is reason
    rig.tick()
    assert bool(rig.reported(Reason.BUSY)) is reported


def test_an_operator_that_holds_the_truck_at_rest_while_another_drives_is_an_event():
    rig = Rig().driving(source="ann")
    assert rig.drive(source="bob", speed=0.0) is Reason.BUSY
    rig.tick()
    assert rig.reported(Reason.BUSY)


def test_a_planner_that_holds_below_an_operator_is_an_event():
    rig = Rig().driving(source="ann")
    assert rig.drive(**TRACK, speed=0.0) is Reason.LOWER_PRIORITY
    rig.tick()
    assert rig.reported(Reason.LOWER_PRIORITY)


def test_what_is_not_finite_is_named_with_its_value():
    rig = Rig().armed()
    assert rig.drive(speed=math.inf, front=-math.inf) is Reason.NOT_FINITE
    rig.tick()
    assert newest(rig).text == "speed is inf, front is -inf: expected finite numbers"


def test_a_body_says_which_requests_it_takes(monkeypatch):
    robot = Robot("omni")
    robot.tick()
    monkeypatch.setattr(type(robot.chassis), "forms", frozenset({DriveForm.TWIST}))
    assert robot.drive(speed=0.1) is Reason.IMPOSSIBLE_MOTION
    robot.tick()
    assert newest(robot).text == "a request by axles: this body accepts twist"


def test_a_request_of_a_truck_that_is_not_armed_is_refused_for_its_mode():
    rig = Rig()
    rig.tick()
    assert rig.drive() is Reason.DISARMED
    rig.order(Order.ESTOP)
    assert rig.drive() is Reason.ESTOPPED
    assert rig.drive(nonce="other") is Reason.BAD_NONCE


# Orders


def test_an_emergency_stop_is_reported_once_as_an_error_with_who_asked():
    rig = Rig().driving()
    rig.order(Order.ESTOP, source="bob", role=Role.STATION)
    rig.order(Order.ESTOP, source="eve")
    rig.tick()
    (event,) = rig.reported(Reason.ESTOP_REQUESTED)
    assert (event.severity, event.values) == (ERROR, {"role": "station", "by": "bob"})
    assert len(rig.trips) == 1
    trip = rig.trips[0]
    assert (trip.mode, trip.quick, trip.ordered, trip.holder) == (GateMode.ESTOPPED, True, False, "ann")
    assert (trip.causes[0].text, trip.causes[0].source) == ("emergency stop by bob", "bob")
    assert trip.causes[0].since == trip.stamp


def test_a_second_emergency_stop_soon_after_the_reset_is_reported_again():
    rig = Rig()
    for _ in range(2):
        rig.tick()
        rig.order(Order.ESTOP)
        rig.tick()
        rig.order(Order.RESET)
        rig.tick()
    assert len(rig.reported(Reason.ESTOP_REQUESTED)) == 2
    assert [event.text for event in rig.reported(Reason.DISARMED)] == ["emergency stop reset by ann"] * 2


def test_a_reset_without_an_emergency_stop_changes_nothing():
    rig = Rig().armed()
    assert rig.order(Order.RESET) is Reason.OK
    rig.tick()
    assert rig.out.mode is GateMode.ARMED
    assert not rig.reported(Reason.DISARMED)


def test_a_stop_order_is_a_transition_with_who_gave_it():
    rig = Rig().driving()
    since = len(rig.events)
    rig.order(Order.STOP, source="bob")
    rig.tick()
    assert said(rig, since=since)[0] == (Reason.STOPPED, WARNING, "stop ordered by bob")
    trip = rig.trips[-1]
    assert (trip.reason, trip.ordered, trip.quick, trip.holder) == (Reason.STOPPED, True, False, "ann")
    rig.order(Order.STOP, source="bob")
    rig.tick()
    assert len(rig.trips) == 1, "it is being stopped already"


def test_disarming_says_who_and_when():
    rig = Rig().driving()
    since = len(rig.events)
    rig.order(Order.DISARM, source="bob")
    rig.driver = None
    rig.tick()
    assert said(rig, since=since)[0] == (Reason.DISARMED, WARNING, "disarmed by bob")
    rig.tick(40)
    assert rig.out.mode is GateMode.DISARMED
    armed = Rig().armed()
    armed.order(Order.DISARM, source="bob")
    armed.tick()
    assert said(armed)[-1] == (Reason.DISARMED, INFO, "disarmed by bob")


def test_disarming_a_disarmed_truck_says_nothing():
    rig = Rig()
    rig.tick()
    assert rig.order(Order.DISARM) is Reason.OK
    rig.tick()
    assert rig.events == []


def test_an_order_that_is_given_by_no_operator_is_refused():
    rig = Rig()
    rig.tick(2)
    for order in (Order.ARM, Order.RESET):
        assert rig.order(order, role=Role.TRACKER) is Reason.BAD_ROLE
        assert rig.order(order, role=Role.ESTOP) is Reason.BAD_ROLE
    assert rig.order(Order.DISARM, role=Role.TRACKER) is Reason.OK


# The story of a drive


def test_a_drive_is_distinguished_from_arming_to_rest():
    rig = Rig().armed()
    rig.drive(speed=0.1)
    rig.tick(20)
    rig.tick(60)
    assert said(rig) == [
        (Reason.ARMED, INFO, Reason.ARMED.text),
        (Reason.DRIVING, INFO, Reason.DRIVING.text),
        (Reason.LEASE_EXPIRED, WARNING, "no fresh request from ann"),
        (Reason.STOPPED, INFO, Reason.STOPPED.text),
    ]
    assert rig.events[0].values == {"by": "ann"}
    assert rig.events[1].values == {"role": "gamepad", "by": "ann"}
    rig.tick(80)
    assert said(rig)[-1] == (Reason.DISARMED, INFO, "no driver for 1.5 s")


def test_a_change_of_drivers_is_reported():
    rig = Rig().driving(speed=0.1, **TRACK)
    rig.driver = {"source": "ann", "speed": 0.1}
    rig.tick(3)
    assert [event.values["by"] for event in rig.reported(Reason.DRIVING)] == ["track", "ann"]
    assert rig.trips == []


def test_letting_go_of_a_truck_at_rest_is_a_release():
    rig = Rig().armed()
    rig.drive(speed=0.0)
    rig.tick(20)
    assert said(rig)[-1] == (Reason.STOPPED, INFO, "ann released control")
    assert rig.trips == []
    assert rig.out.mode is GateMode.ARMED


def test_falling_silent_at_rest_before_an_obstacle_is_no_release():
    rig = Rig().armed()
    rig.obstacles = tuple((0.285, y / 100) for y in range(-15, 16, 3))
    rig.drive(speed=0.1)
    rig.tick(20)
    assert rig.trips[-1].reason is Reason.LEASE_EXPIRED


def test_falling_silent_while_the_command_still_moves_is_no_release():
    rig = Rig().driving(speed=0.2)
    rig.driver = None
    rig.drive(speed=0.0, lease=0.05)
    for _ in range(5):
        rig.speed = 0.0
        rig.tick()
    assert rig.trips[-1].reason is Reason.LEASE_EXPIRED


def test_a_release_needs_rest_measured_after_the_last_request():
    rig = Rig(drive={"stale_after": 5.0, "critical": True}).armed()
    rig.silent = {"drive"}
    rig.tick()
    rig.drive(speed=0.0, lease=0.1)
    rig.tick(10)
    assert rig.trips[-1].reason is Reason.LEASE_EXPIRED


def test_a_blocked_truck_is_stopped_for_what_blocks_it_and_not_released():
    rig = Rig().driving(speed=0.0)
    rig.silent = {"scan"}
    rig.driver = None
    rig.tick(15)
    assert rig.trips[-1].reason in (Reason.SCAN_STALE, Reason.LEASE_EXPIRED)
    both = Rig().driving(speed=0.1)
    both.driver = None
    both.tilt = 0.4
    both.tick()
    assert both.trips[-1].reason is Reason.TILT_STOP
    assert not both.reported(Reason.LEASE_EXPIRED)


# Blocks


def test_a_block_is_reported_every_time_while_driving_and_once_a_second_while_armed():
    driving = Rig(disarm_after=10.0).driving(speed=0.1)
    for _ in range(2):
        driving.tilt = 0.4
        driving.tick(2)
        driving.tilt = 0.0
        driving.tick(12)
        assert driving.out.mode is GateMode.DRIVING
    assert len(driving.reported(Reason.TILT_STOP)) == 2
    armed = Rig(disarm_after=10.0).armed()
    for _ in range(2):
        armed.tilt = 0.4
        armed.tick(2)
        armed.tilt = 0.0
        armed.tick(2)
    assert len(armed.reported(Reason.TILT_STOP)) == 1


def test_a_limit_is_reported_when_it_begins_with_its_measurements():
    rig = Rig().driving(speed=0.1)
    rig.tilt = 0.25
    rig.tick(10)
    rig.tilt = 0.0
    rig.tick(5)
    rig.tilt = 0.25
    rig.tick(5)
    (event,) = rig.reported(Reason.TILT_SLOW)
    assert event.severity is WARNING
    assert event.values["tilt"] == pytest.approx(0.25)


def test_nothing_is_reported_of_a_disarmed_truck():
    rig = Rig()
    rig.tilt = 0.4
    rig.tick(3)
    assert rig.events == []
    assert rig.out.reasons == (Reason.DISARMED, Reason.TILT_STOP)


def test_a_failed_service_is_named_in_its_event():
    rig = Rig().driving()
    show(rig.gate, health(rig.now, ServiceState.FAILED, "slam"))
    rig.tick()
    assert rig.reported(Reason.SERVICE_FAILED)[0].text == f"{Reason.SERVICE_FAILED.text}: slam"
    rig.driver = None
    rig.tick(60)
    assert rig.reported(Reason.DISARMED)[-1].text == Reason.SERVICE_FAILED.text


def test_another_reason_says_no_more_than_itself():
    rig = Rig().driving()
    rig.tilt = 0.5
    rig.tick()
    assert rig.reported(Reason.TILT_STOP)[0].text == Reason.TILT_STOP.text


@pytest.mark.parametrize(("apart", "disarms"), [(2.5, True), (10 / 3, True), (10 / 3 + 0.001, False)])
def test_so_many_short_faults_within_their_time_disarm(apart, disarms):
    rig = Rig().driving()
    rig.events.clear()
    for number in range(4):
        assert not rig.gate._states.disarm_at_rest
        rig.gate._count_short_fault(round(number * apart * SECOND))
    assert rig.gate._states.disarm_at_rest is disarms
    rig.tick()
    reported = [(reason, severity, text) for reason, severity, text in said(rig) if reason is Reason.FAULTS_REPEAT]
    assert reported == ([(Reason.FAULTS_REPEAT, WARNING, "4 stops for stale sensors within 10 s: disarmed")] * disarms)


def test_short_faults_before_the_truck_was_disarmed_do_not_count():
    rig = Rig().driving()
    for number in range(3):
        rig.gate._count_short_fault(number)
    rig.order(Order.DISARM)
    rig.driver = None
    rig.tick(60)
    assert rig.out.mode is GateMode.DISARMED
    rig.gate._count_short_fault(rig.now)
    assert not rig.gate._states.disarm_at_rest


# What is put out


def test_the_lowest_limit_counts_and_comes_first():
    rig = Rig().armed()
    rig.level, rig.tilt = BatteryLevel.LOW, 0.25
    rig.driver = {"speed": 0.2}
    rig.tick(20)
    assert rig.out.speed_limit == 0.08
    assert rig.out.reasons == (Reason.TILT_SLOW, Reason.BATTERY_LOW, Reason.CLIPPED)[:2] + rig.out.reasons[2:]
    assert rig.out.speeds == pytest.approx((0.08,))


@pytest.mark.parametrize("mode", ["disarmed", "armed", "driving", "stopping", "blocked", "estopped"])
def test_a_speed_is_allowed_only_to_a_truck_that_may_drive(mode):
    rig = Rig()
    rig.tick(2)
    if mode == "armed":
        rig.armed()
    elif mode != "disarmed":
        rig.driving()
    if mode == "stopping":
        rig.order(Order.STOP)
    elif mode == "blocked":
        rig.driver = None
        rig.order(Order.STOP)
        rig.tick(40)
        assert rig.out.mode is GateMode.ARMED
        rig.tilt = 0.4
    elif mode == "estopped":
        rig.order(Order.ESTOP)
    rig.tick()
    assert rig.out.speed_limit == (0.21 if mode in ("armed", "driving") else 0.0)


def test_who_drives_is_put_out_with_lease_and_number():
    rig = Rig().armed()
    assert (rig.out.holder, rig.out.role, rig.out.lease_left, rig.out.last_seq, rig.out.form) == (None,) * 5
    rig.drive(speed=0.1, lease=0.2)
    number = rig._seq
    rig.tick()
    assert (rig.out.holder, rig.out.role, rig.out.last_seq) == ("ann", Role.GAMEPAD, number)
    assert rig.out.lease_left == pytest.approx(0.18)
    assert rig.out.form in tuple(DriveForm)


def test_planners_wait_only_while_nobody_drives():
    rig = Rig()
    rig.tick()
    rig.drive(speed=0.1, **TRACK)
    rig.tick()
    assert rig.out.waiting == ("track",)
    rig.order(Order.ARM)
    rig.drive(speed=0.1, **TRACK)
    rig.tick()
    assert (rig.out.holder, rig.out.waiting) == ("track", ())


def test_a_motor_that_turns_while_disarmed_is_stopped_quickly_and_one_at_rest_is_off():
    rig = Rig()
    rig.speed = 0.1
    rig.tick()
    assert rig.out.action is DriveAction.QUICK_STOP
    rig.speed = 0.0
    rig.tick()
    assert rig.out.action is DriveAction.DISABLE
    assert Rig(latched=True).tick().action is DriveAction.QUICK_STOP


# The end


@pytest.mark.parametrize(("driven", "rolling", "stops"), [(True, 0.1, 1), (False, 0.0, 0), (False, 0.1, 1)])
def test_shutting_down_is_a_stop_if_anything_moves(driven, rolling, stops):
    rig = Rig().driving(speed=0.1) if driven else Rig().armed()
    rig.driver, rig.speed = None, rolling
    rig.sense()
    out = rig.gate.neutral(rig.now)
    assert len(out.trips) == stops
    assert [trip.reason for trip in out.trips] == [Reason.SHUTDOWN] * stops
    assert (out.mode, out.action, out.reasons) == (
        GateMode.DISARMED,
        DriveAction.QUICK_STOP,
        (Reason.DISARMED, Reason.SHUTDOWN),
    )
    assert [event.text for event in out.events if event.reason is Reason.DISARMED] == [Reason.SHUTDOWN.text]
    assert set(out.speeds) == {0.0}


def test_after_the_end_nothing_arms_the_truck():
    rig = Rig().armed()
    rig.gate.neutral(rig.now)
    assert rig.order(Order.ARM) is Reason.SHUTDOWN
    rig.tick()
    assert rig.out.action is DriveAction.QUICK_STOP
    assert Reason.SHUTDOWN in rig.out.reasons


def test_shutting_down_a_disarmed_truck_says_nothing():
    rig = Rig()
    rig.tick()
    out = rig.gate.neutral(rig.now)
    assert (out.events, out.trips, out.mode) == ((), (), GateMode.DISARMED)


def test_the_first_tick_is_one_period_and_no_pause():
    rig = Rig()
    rig.now = 100 * SECOND
    rig.tick()
    assert Reason.TICK_STALLED not in rig.out.reasons
    assert rig.order(Order.ARM) is Reason.OK
    assert TICK == SECOND // 50


def test_every_ordered_stop_is_reported_however_soon_it_follows_another():
    rig = Rig()
    rig.driving(speed=0.1, role=Role.STATION)
    for _ in range(2):
        rig.order(Order.STOP, role=Role.STATION)
        rig.driver = None
        rig.drive(speed=0.0, role=Role.STATION)
        rig.tick(15)
        rig.driver = {"speed": 0.1, "role": Role.STATION}
        rig.tick(5)
        assert rig.out.mode is GateMode.DRIVING
    assert [event.text for event in rig.reported(Reason.STOPPED)].count("stop ordered by ann") == 2


def test_an_order_to_arm_is_refused_for_the_first_of_several_reasons():
    rig = Rig()
    rig.silent = {"scan", "steering"}
    rig.tick(40)
    blocks = rig.gate._checks.blocks(rig.now)
    assert len(blocks) > 1
    assert rig.order(Order.ARM) is blocks[0]
