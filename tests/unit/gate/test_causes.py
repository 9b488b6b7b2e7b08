"""Causes, outages and the log of stops, each asked alone."""

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.event import Cause, Event, Severity
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.sensor import BatteryLevel, DriveMode
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.stops import HUB_EVENTS, Outages, StopLog, lease_cause
from tests.unit.gate.rig import SERVICES, Rig, feedback, header, health, show

NOW = 100 * SECOND
MS = SECOND // 1000
SILENT = {Reason.SCAN_STALE}


def cause(reason=Reason.SCAN_STALE, source="lidar", since=NOW):
    return Cause(reason=reason, source=source, since=since, text=reason.text)


def event(reason, source="usb", severity=Severity.WARNING, at=NOW, text="", **values):
    return Event(**header(at), reason=reason, severity=severity, source=source, text=text, values=values)


def outages(*tables):
    found = Outages(SERVICES)
    for name, state, since, more in tables:
        found.observe(
            HealthTable(**header(NOW), services=(ServiceHealth(name=name, state=state, since=since, **more),))
        )
    return found


LOST = ("lidar", ServiceState.BACKOFF, NOW - SECOND, {"reason": Reason.DEVICE_LOST})


def behind(found, *causes):
    return [(each.reason, each.source, each.because) for each in found.explain(causes or (cause(),))]


# Outages


@pytest.mark.parametrize("state", [ServiceState.BACKOFF, ServiceState.FAILED])
def test_an_outage_is_behind_the_silence_of_its_sensor(state):
    found = outages(("lidar", state, NOW - SECOND, {"reason": Reason.DEVICE_LOST}))
    assert behind(found) == [(Reason.SCAN_STALE, "lidar", 1), (Reason.DEVICE_LOST, "lidar", None)]
    assert behind(found, cause(Reason.ATTITUDE_STALE, "compass")) == [(Reason.ATTITUDE_STALE, "compass", None)]


@pytest.mark.parametrize("state", [s for s in ServiceState if s not in (ServiceState.BACKOFF, ServiceState.FAILED)])
def test_a_service_that_starts_or_runs_has_no_outage(state):
    found = outages(("lidar", state, NOW, {"reason": Reason.DEVICE_LOST}))
    assert behind(found) == [(Reason.SCAN_STALE, "lidar", None)]


@pytest.mark.parametrize(("ended", "counts"), [(NOW, True), (NOW + 1, True), (NOW - 1, False)])
def test_an_outage_counts_for_what_began_before_its_end(ended, counts):
    found = outages(LOST, ("lidar", ServiceState.READY, ended, {}))
    assert (len(behind(found)) == 2) is counts


@pytest.mark.parametrize("state", [state for state in ServiceState if state is not ServiceState.READY])
def test_an_outage_goes_on_until_the_service_is_ready(state):
    found = outages(LOST, ("lidar", state, NOW - 1, {"reason": Reason.DEVICE_TIMEOUT}))
    assert behind(found)[1][0] is Reason.DEVICE_LOST


def test_the_end_of_an_outage_is_its_first_ready_and_the_next_failure_begins_another():
    late = ("lidar", ServiceState.READY, NOW + SECOND, {})
    found = outages(LOST, ("lidar", ServiceState.READY, NOW - 1, {}), late)
    assert len(behind(found)) == 1
    again = ("lidar", ServiceState.BACKOFF, NOW, {"reason": Reason.DEVICE_TIMEOUT})
    found = outages(LOST, ("lidar", ServiceState.READY, NOW - 1, {}), again)
    assert behind(found)[1][0] is Reason.DEVICE_TIMEOUT
    found = outages(LOST, again)
    assert behind(found)[1][0] is Reason.DEVICE_LOST, "the first failure of an outage"


def test_the_outage_of_any_service_of_a_sensor_counts():
    found = outages(("drive_2", ServiceState.BACKOFF, NOW - 1, {"reason": Reason.DEVICE_LOST}))
    assert behind(found, cause(Reason.DRIVE_STALE, "drive"))[1] == (Reason.DEVICE_LOST, "drive_2", None)


@pytest.mark.parametrize(
    ("detail", "text"),
    [
        ("lidar on port 2: vanished", "lidar on port 2: vanished"),
        ("vanished", "lidar: vanished"),
        ("", f"lidar: {Reason.DEVICE_LOST.text}"),
    ],
)
def test_an_outage_is_reported_with_the_name_of_its_service_once(detail, text):
    found = outages(("lidar", ServiceState.BACKOFF, NOW, {"reason": Reason.DEVICE_LOST, "detail": detail}))
    found_cause = found.explain((cause(),))[1]
    assert (found_cause.text, found_cause.since) == (text, NOW)


def test_hubs_and_their_current_explain_the_loss_of_what_they_name():
    assert {Reason.HUB_LOST, Reason.OVER_CURRENT} == HUB_EVENTS
    for reason in HUB_EVENTS:
        found = outages(LOST)
        found.observe(event(reason, roles="camera,lidar", text="hub 1"))
        assert behind(found)[2] == (reason, "usb", None)
        assert found.explain((cause(),))[2].text == "hub 1"
    found = outages(LOST)
    found.observe(event(Reason.HUB_LOST, roles="camera"))
    found.observe(event(Reason.DEVICE_LOST, roles="lidar"))
    found.observe(event(Reason.HUB_LOST))
    assert len(behind(found)) == 2


@pytest.mark.parametrize(("at", "counts"), [(-SECOND - SECOND, True), (-SECOND - SECOND - 1, False), (0, True)])
def test_a_hub_explains_what_was_lost_at_about_its_time(at, counts):
    found = outages(LOST)
    found.observe(event(Reason.HUB_LOST, at=NOW + at, roles="lidar"))
    assert (len(behind(found)) == 3) is counts


def test_a_link_explains_a_lapsed_lease_and_nothing_else():
    found = outages()
    lapsed = cause(Reason.LEASE_EXPIRED, "ann")
    assert len(behind(found, lapsed)) == 1
    found.observe(event(Reason.LINK_DOWN, "link"))
    assert behind(found, lapsed) == [(Reason.LEASE_EXPIRED, "ann", 1), (Reason.LINK_DOWN, "link", None)]
    assert found.explain((lapsed,))[1].text == Reason.LINK_DOWN.text
    assert len(behind(found)) == 1
    found.observe(event(Reason.LINK_DOWN, "usb", Severity.INFO))
    assert len(behind(found, lapsed)) == 2
    found.observe(event(Reason.OK, "link", Severity.INFO))
    assert len(behind(found, lapsed)) == 1


def test_causes_that_share_what_is_behind_them_are_linked_to_one():
    found = outages(LOST)
    found.observe(event(Reason.HUB_LOST, roles="lidar"))
    twice = (cause(), cause(Reason.ATTITUDE_STALE, "compass"), cause())
    assert [each.because for each in found.explain(twice)] == [3, None, 3, 4, None]


# The log of stops


def add(log, at=NOW, causes=None, **more):
    log.add(
        at,
        GateMode.STOPPING,
        causes or [cause()],
        **({"ordered": False, "quick": False, "driver": None, "speed": 0.1, "stopping_distance": 0.02} | more),
    )


def test_stops_are_numbered_kept_until_they_are_read_and_read_once():
    log = StopLog(outages())
    assert log.drain(NOW, SILENT) == ()
    add(log)
    add(log, ordered=True, quick=True)
    first, second = log.drain(NOW, SILENT)
    assert (first.number, second.number) == (1, 2)
    assert (first.ordered, first.quick, second.ordered, second.quick) == (False, False, True, True)
    assert (first.holder, first.role, first.speed, first.stopping_distance) == (None, None, 0.1, 0.02)
    assert first.reason is Reason.SCAN_STALE
    assert log.drain(NOW, SILENT) == ()


LIDAR_LOST = HealthTable(
    **header(NOW),
    services=(ServiceHealth(name="lidar", state=ServiceState.BACKOFF, since=NOW, reason=Reason.DEVICE_LOST),),
)


def test_a_stop_is_read_before_what_became_known_of_it():
    found = outages()
    log = StopLog(found)
    add(log)
    found.observe(LIDAR_LOST)
    assert [len(trip.causes) for _ in range(3) for trip in log.drain(NOW, SILENT)] == [1, 2]


@pytest.mark.parametrize(("later", "reported"), [(3 * SECOND, True), (3 * SECOND + 1, False)])
def test_what_becomes_known_soon_after_a_stop_is_added_to_it_once(later, reported):
    found = outages()
    log = StopLog(found)
    add(log)
    log.drain(NOW, SILENT)
    found.observe(LIDAR_LOST)
    again = log.drain(NOW + later, SILENT)
    assert [(trip.number, len(trip.causes)) for trip in again] == ([(1, 2)] if reported else [])
    assert log.drain(NOW + later, SILENT) == ()


def test_the_newest_stop_in_a_line():
    log = StopLog(outages())
    assert log.summary(NOW) == ""
    add(log, causes=[cause(since=NOW - 20 * MS)])
    assert log.summary(NOW + 5 * SECOND) == "stopped 5.0 s ago: no fresh lidar scan (for 20 ms)"


# Causes with their figures


def figures(found):
    return {figure.name: figure for figure in found.measurements}


def causes(rig, *reasons, since=None):
    return rig.gate._checks.describe(reasons, rig.now, since or {})


def test_a_cause_counts_from_when_the_gate_saw_it():
    rig = Rig()
    rig.tick(2)
    assert causes(rig, Reason.TILT_STOP)[0].since == rig.now
    assert causes(rig, Reason.TILT_STOP, since={Reason.TILT_STOP: 7})[0].since == 7
    (found,) = causes(rig, Reason.SHUTDOWN)
    assert (found.source, found.text, found.measurements) == ("gate", Reason.SHUTDOWN.text, ())


def test_one_cause_for_every_failed_service():
    rig = Rig()
    show(
        rig.gate,
        HealthTable(
            **header(rig.now),
            services=tuple(
                ServiceHealth(name=name, state=ServiceState.FAILED, since=0) for name in ("slam", "recorder", "plan")
            ),
        ),
    )
    found = causes(rig, Reason.SERVICE_FAILED, since={Reason.SERVICE_FAILED: 5})
    assert [(each.source, each.since) for each in found] == [("slam", 5), ("plan", 5)]


def test_a_sensor_that_never_spoke_is_silent_since_the_gate_noticed():
    rig = Rig()
    (found,) = causes(rig, Reason.SCAN_STALE, since={Reason.SCAN_STALE: 9})
    assert (found.since, found.source, figures(found)["age"].value) == (9, "lidar", None)


@pytest.mark.parametrize(("offset", "since"), [(0, 0), (300 * MS, 250 * MS)])
def test_a_lease_that_has_not_lapsed_yet_counts_from_now(offset, since):
    rig = Rig().armed()
    rig.drive(speed=0.1)
    rig.tick()
    source = rig.gate._states.holder
    at = source.arrived + offset
    found = lease_cause(source, at)
    assert found.since == source.arrived + since
    assert found.text == "lease of ann expired"
    assert figures(found)["request age"].value == pytest.approx(offset / SECOND)


def test_a_request_without_a_stamp_of_the_gate_has_no_round_trip():
    rig = Rig().armed()
    rig.drive(speed=0.1)
    rig.tick()
    source = rig.gate._states.holder
    source.request = source.request.model_copy(update={"gate_stamp": None})
    assert set(figures(lease_cause(source, rig.now))) == {"request age"}


def test_figures_of_faults_battery_tilt_current_and_turn():
    rig = Rig().armed()
    show(rig.gate, feedback(rig.now - 20 * MS, 0.0, DriveMode.FAULT, 0x2310))
    fault = figures(causes(rig, Reason.DRIVE_FAULT)[0])["fault code"]
    assert (fault.value, fault.age) == (float(0x2310), pytest.approx(0.02))
    show(rig.gate, feedback(rig.now))
    assert figures(causes(rig, Reason.DRIVE_FAULT)[0]) == {}
    rig.level = BatteryLevel.CRITICAL
    rig.sense()
    voltage = figures(causes(rig, Reason.BATTERY_CRITICAL)[0])["voltage"]
    assert (voltage.value, voltage.unit, voltage.age) == (23.0, "V", 0.0)
    assert figures(causes(Rig(), Reason.BATTERY_CRITICAL)[0]) == {}
    tilt = figures(causes(Rig(), Reason.TILT_STOP)[0])["tilt"]
    assert (tilt.value, tilt.age) == (0.0, None)
    turn = figures(causes(rig, Reason.STEERING_DEAD)[0])["yaw difference"]
    assert (turn.value, turn.unit, turn.limit) == (0.0, "rad", 0.14)
    assert figures(causes(Rig(turning=None), Reason.STEERING_DEAD)[0]) == {}
    assert figures(causes(rig, Reason.SHAFT_BLOCKED)[0])["motor current"].unit == "A"
    assert figures(causes(Rig(blocked=None), Reason.SHAFT_BLOCKED)[0]) == {}
    free = figures(causes(rig, Reason.OBSTACLE_STOP)[0])["free distance"]
    assert (free.unit, free.limit, free.age) == ("m", 0.05, 0.0)
    pause = figures(causes(rig, Reason.TICK_STALLED)[0])["pause"]
    assert (pause.value, pause.unit, pause.limit) == (0.0, "s", 0.15)


def test_the_driver_of_a_stop_is_named_with_its_role():
    rig = Rig().driving(source="bob", role=Role.STATION)
    show(rig.gate, health(rig.now, ServiceState.FAILED, "slam"))
    rig.tick()
    assert (rig.trips[-1].holder, rig.trips[-1].role) == ("bob", Role.STATION)
    assert rig.trips[-1].stopping_distance == pytest.approx(0.2 * 0.08 + 0.2**2 / 2, rel=0.05)
