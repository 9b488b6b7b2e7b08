"""The gate's events and modes, asked of the log and the state machine themselves."""

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.arbitration import EventLog, GateEvent, GateStateMachine, Source
from tests.unit.gate.rig import NONCE, header

NOW = 10 * SECOND
INFO, WARNING = Severity.INFO, Severity.WARNING


def emit(log, at=0.0, source="", **more):
    log.emit(NOW + round(at * SECOND), Reason.BUSY, WARNING, source=source, **more)


def test_an_event_has_its_reasons_text_unless_there_is_a_better_one():
    log = EventLog(1.0)
    log.emit(NOW, Reason.BUSY, WARNING)
    log.emit(NOW, Reason.STOPPED, INFO, "by the wall", {"speed": 0.1}, source="ann")
    assert log.drain() == (
        GateEvent(Reason.BUSY, WARNING, Reason.BUSY.text, {}),
        GateEvent(Reason.STOPPED, INFO, "by the wall", {"speed": 0.1, "by": "ann"}),
    )
    assert log.drain() == ()


def test_repetitions_are_counted_until_the_interval_is_over():
    log = EventLog(1.0)
    emit(log)
    emit(log, 0.5)
    emit(log, 0.999)
    assert len(log.drain()) == 1
    emit(log, 1.0)
    (again,) = log.drain()
    assert again.values == {"repeated": 2}
    emit(log, 2.0)
    assert log.drain()[0].values == {}, "none in between"


def test_another_reason_or_source_is_no_repetition():
    log = EventLog(1.0)
    emit(log)
    emit(log, source="ann")
    emit(log, source="bob")
    log.emit(NOW, Reason.STOPPED, INFO)
    assert len(log.drain()) == 4


def test_a_transition_is_never_suppressed_and_tells_how_often_it_was():
    log = EventLog(1.0)
    emit(log)
    emit(log, 0.1)
    emit(log, 0.2, always=True)
    emit(log, 0.3, always=True)
    first, second, third = log.drain()
    assert (first.values, second.values, third.values) == ({}, {"repeated": 1}, {})
    emit(log, 1.2)
    assert log.drain() == (), "the interval counts from the transition"
    emit(log, 1.3)
    assert log.drain()[0].values == {"repeated": 1}


def test_so_many_names_are_reported_within_one_interval_and_transitions_always():
    log = EventLog(1.0)
    for number in range(64 + 5):
        emit(log, source=f"s{number}")
    assert len(log.drain()) == 64
    emit(log, 0.5, source="late")
    assert log.drain() == ()
    emit(log, 0.5, source="s0")
    emit(log, 0.5, source="stop", always=True)
    assert [event.values["by"] for event in log.drain()] == ["stop"]
    emit(log, 0.999, source="late")
    assert log.drain() == ()
    emit(log, 1.0, source="late")
    assert [event.values["by"] for event in log.drain()] == ["late"], "names of the interval before make place"
    emit(log, 1.0, source="s0")
    assert log.drain()[0].values == {"by": "s0"}, "forgotten with its count"


def test_what_is_known_is_counted_however_many_names_there_are():
    log = EventLog(1.0)
    for number in range(64):
        emit(log, source=f"s{number}")
    emit(log, 0.5, source="s0")
    emit(log, 0.6, source="s0")
    log.drain()
    emit(log, 1.0, source="s0")
    assert log.drain()[0].values == {"by": "s0", "repeated": 2}


def source(name="ann", inside=False):
    request = DriveRequest(
        **header(NOW), nonce=NONCE, source=name, role=Role.GAMEPAD, lease=1.0, speed=0.1, front=0.0, gate_stamp=NOW
    )
    return Source(request, NOW + SECOND, NOW, inside)


def machine(latched=False):
    log = EventLog(1.0)
    return GateStateMachine(log, latched=latched), log


@pytest.mark.parametrize("latched", [True, False])
def test_it_begins_latched_or_disarmed(latched):
    states, _ = machine(latched)
    reason = Reason.ESTOPPED if latched else Reason.DISARMED
    assert states.mode is (GateMode.ESTOPPED if latched else GateMode.DISARMED)
    assert (states.reasons, states.active, states.disarm_at_rest) == ((reason,), False, False)
    assert (states.holder_key, states.holder_name, states.since, states.driven) == (None, None, 0, 0)


def test_the_modes_of_a_drive():
    states, log = machine()
    states.arm(NOW, "ann")
    assert (states.mode, states.since, states.driven, states.reasons) == (GateMode.ARMED, NOW, NOW, ())
    states.drive(NOW + 1, ann := source())
    assert (states.mode, states.since, states.driven) == (GateMode.DRIVING, NOW + 1, NOW + 1)
    states.drive(NOW + 2, ann)
    assert (states.since, states.driven, states.holder_key, states.holder_name) == (
        NOW + 1,
        NOW + 2,
        (False, "ann"),
        "ann",
    )
    states.drive(NOW + 3, source("ann", inside=True))
    assert (states.since, states.holder_key) == (NOW + 1, (True, "ann"))
    states.stop(NOW + 4, [Reason.SCAN_STALE, Reason.TILT_STOP, Reason.SCAN_STALE])
    assert (states.mode, states.holder) == (GateMode.STOPPING, None)
    assert states.reasons == (Reason.SCAN_STALE, Reason.TILT_STOP)
    states.rest(NOW + 5)
    assert (states.mode, states.reasons) == (GateMode.ARMED, ())
    states.drive(NOW + 6, ann)
    states.release(NOW + 7)
    assert (states.mode, states.holder, states.driven) == (GateMode.ARMED, None, NOW + 6)
    states.disarm(NOW + 8, "enough")
    assert (states.mode, states.active) == (GateMode.DISARMED, False)
    reported = [(event.reason, event.severity, event.text, event.values.get("by")) for event in log.drain()]
    assert reported == [
        (Reason.ARMED, INFO, Reason.ARMED.text, "ann"),
        (Reason.DRIVING, INFO, Reason.DRIVING.text, "ann"),
        (Reason.DRIVING, INFO, Reason.DRIVING.text, "ann"),
        (Reason.STOPPED, INFO, Reason.STOPPED.text, None),
        (Reason.DRIVING, INFO, Reason.DRIVING.text, "ann"),
        (Reason.DISARMED, INFO, "enough", None),
    ], "letting go right after a stop is not reported again"


def test_every_rest_and_disarming_is_reported_however_soon():
    states, log = machine()
    for _ in range(3):
        states.arm(NOW, "ann")
        states.drive(NOW, source())
        states.stop(NOW, [Reason.TILT_STOP])
        states.rest(NOW)
        states.disarm(NOW, "")
    reasons = [event.reason for event in log.drain()]
    assert reasons == [Reason.ARMED, Reason.DRIVING, Reason.STOPPED, Reason.DISARMED] * 3


def test_a_release_is_reported_with_who_let_go():
    states, log = machine()
    states.arm(NOW, "ann")
    states.drive(NOW, source())
    states.release(NOW)
    assert log.drain()[-1].text == "ann released control"


def test_arming_an_armed_truck_restarts_its_time_and_keeps_an_order_to_disarm():
    states, log = machine()
    states.disarm_at_rest = True
    states.arm(NOW, "ann")
    assert not states.disarm_at_rest
    states.disarm_at_rest = True
    states.arm(NOW + 1, "ann")
    assert (states.mode, states.since, states.driven, states.disarm_at_rest) == (GateMode.ARMED, NOW, NOW + 1, True)
    assert len(log.drain()) == 1
    states.disarm(NOW, "")
    assert not states.disarm_at_rest


def test_a_latched_stop_says_so_whatever_stopped_the_truck_before():
    states, _ = machine()
    states.arm(NOW, "ann")
    states.stop(NOW, [Reason.TILT_STOP])
    states.latch(NOW + 1)
    assert (states.mode, states.since, states.reasons) == (GateMode.ESTOPPED, NOW + 1, (Reason.ESTOPPED,))


def test_what_lasts_is_one_event_until_it_pauses():
    log = EventLog(1.0)
    for tick in range(200):
        log.emit(NOW + tick * SECOND // 50, Reason.LOWER_PRIORITY, WARNING, source="tracker", lasting=True)
    assert [event.values for event in log.drain()] == [{"by": "tracker"}]
    log.emit(NOW + 6 * SECOND, Reason.LOWER_PRIORITY, WARNING, source="tracker", lasting=True)
    assert [event.values for event in log.drain()] == [{"by": "tracker", "repeated": 199}]
