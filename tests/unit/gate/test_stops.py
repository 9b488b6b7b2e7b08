"""Every stop says what tripped, since when, by which figures, and what was behind it."""

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.stop_text import causes_text, stop_lines
from monstertruck_schemas.event import Cause, Event, Measurement, Severity, Stop
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.sensor import BatteryLevel
from monstertruck_schemas.state import GateMode
from tests.unit.gate.rig import TICK, Rig, header, health, scan, show


def event(now, reason, source, text="", severity=Severity.WARNING, **values):
    return Event(**header(now), reason=reason, severity=severity, source=source, text=text, values=values)


def figures(cause):
    return {figure.name: figure for figure in cause.measurements}


def stopped(rig, ticks=60):
    """Tick until the truck is stopped; the stop."""
    before = len(rig.trips)
    for _ in range(ticks):
        rig.tick()
        if len(rig.trips) > before:
            return rig.trips[-1]
    pytest.fail("not stopped")


def test_a_lapsed_lease_names_holder_silence_and_round_trip():
    rig = Rig().driving()
    rig.drive(gate_stamp=rig.now - round(0.18 * SECOND))
    rig.driver = None
    trip = stopped(rig)
    (cause,) = trip.causes
    assert (trip.reason, trip.mode, trip.holder, trip.role) == (
        Reason.LEASE_EXPIRED,
        GateMode.STOPPING,
        "ann",
        Role.GAMEPAD,
    )
    assert not trip.ordered
    assert not trip.quick
    assert trip.speed == pytest.approx(0.2, abs=0.01)
    assert trip.stopping_distance == pytest.approx(0.036, abs=0.005)
    silence = figures(cause)["request age"]
    assert silence.limit == pytest.approx(0.25)
    assert 0.25 < silence.value <= 0.27 + 1e-9
    assert cause.since == trip.stamp - round((silence.value - silence.limit) * SECOND)
    assert figures(cause)["round trip"].value == pytest.approx(0.18)
    assert causes_text(trip.causes, trip.stamp) == (
        "lease of ann expired (for 10 ms, request age 260 ms, limit 250 ms, round trip 180 ms)"
    )


def test_a_planner_has_no_round_trip():
    rig = Rig().driving(source="tracker", role=Role.TRACKER, inside=True)
    rig.driver = None
    assert set(figures(stopped(rig).causes[0])) == {"request age"}


@pytest.mark.parametrize(
    ("sensor", "reason", "source", "limit"),
    [
        ("scan", Reason.SCAN_STALE, "lidar", 0.25),
        ("attitude", Reason.ATTITUDE_STALE, "compass", 0.25),
        ("drive", Reason.DRIVE_STALE, "drive", 0.2),
        ("steering", Reason.STEERING_STALE, "steering", 0.25),
    ],
)
def test_a_silent_sensor_is_named_with_its_age(sensor, reason, source, limit):
    rig = Rig().driving()
    last = rig.now
    rig.silent = {sensor}
    trip = stopped(rig)
    (cause,) = trip.causes
    assert (cause.reason, cause.source, cause.because) == (reason, source, None)
    assert figures(cause)["age"].limit == limit
    assert figures(cause)["age"].value == pytest.approx((trip.stamp - last) / SECOND)
    assert cause.since == last + round(limit * SECOND)
    assert trip.quick is (sensor == "drive")


def test_late_samples_are_why_there_is_no_good_one():
    rig = Rig().driving()
    rig.silent = {"scan"}
    before = len(rig.trips)
    while len(rig.trips) == before:
        show(rig.gate, scan(rig.now - SECOND).model_copy(update={"received": rig.now}))
        rig.tick()
    latency = figures(rig.trips[-1].causes[0])["latency"]
    assert (latency.value, latency.limit) == (1.0, 0.4)
    rig.silent = set()
    rig.tick(40)
    rig.silent = {"scan"}
    assert "latency" not in figures(stopped(rig).causes[0]), "what was refused before the last good sample"


def test_a_lost_hub_is_behind_the_lost_lidar_behind_the_stop():
    rig = Rig().driving()
    rig.silent = {"scan"}
    lost = rig.now
    show(rig.gate, health(lost, ServiceState.BACKOFF, "lidar", reason=Reason.DEVICE_LOST, detail="port vanished"))
    trip = stopped(rig)
    assert [cause.reason for cause in trip.causes] == [Reason.SCAN_STALE, Reason.DEVICE_LOST]
    assert trip.causes[0].because == 1
    assert trip.causes[0].since == lost
    rig.tick(5)
    assert len(rig.trips) == 1, "no news"
    reported = rig.now
    show(rig.gate, event(reported, Reason.HUB_LOST, "usb", "hub 1-2 vanished: lidar, camera", roles="lidar,camera"))
    rig.tick()
    better = rig.trips[-1]
    assert (better.number, better.stamp) == (trip.number, trip.stamp)
    assert [(cause.reason, cause.because) for cause in better.causes] == [
        (Reason.SCAN_STALE, 1),
        (Reason.DEVICE_LOST, 2),
        (Reason.HUB_LOST, None),
    ]
    assert causes_text(better.causes, better.stamp) == (
        "no fresh lidar scan (for 20 ms, age 20 ms, limit 250 ms), because lidar: port vanished (for 20 ms), "
        "because hub 1-2 vanished: lidar, camera"
    )
    rig.tick(200)
    show(rig.gate, event(rig.now, Reason.HUB_LOST, "usb", "again", roles="lidar"))
    rig.tick()
    assert len(rig.trips) == 2, "long after a stop nothing is added to it"


def test_one_hub_behind_two_sensors_comes_once():
    rig = Rig().driving()
    rig.silent = {"drive", "steering"}
    show(rig.gate, event(rig.now, Reason.HUB_LOST, "usb", "hub 1-1 vanished", roles="drive,steering"))
    for name in ("drive", "steering"):
        show(rig.gate, health(rig.now, ServiceState.BACKOFF, name, reason=Reason.DEVICE_LOST))
    trip = stopped(rig)
    assert [(cause.source, cause.because) for cause in trip.causes] == [
        ("drive", 2),
        ("steering", 4),
        ("drive", 3),
        ("usb", None),
        ("steering", 3),
    ]
    assert causes_text(trip.causes, trip.stamp).count("hub 1-1") == 2, "each chain is reported to its end"


def test_an_outage_that_is_over_is_not_behind_a_later_silence():
    rig = Rig().driving()
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, "lidar", reason=Reason.DEVICE_LOST))
    show(rig.gate, health(rig.now, ServiceState.READY, "lidar"))
    rig.tick(60)
    rig.silent = {"scan"}
    assert [cause.reason for cause in stopped(rig).causes] == [Reason.SCAN_STALE]


@pytest.mark.parametrize("fresh", [True, False])
def test_what_befell_a_device_after_it_had_been_heard_again_is_not_behind_its_silence(fresh: bool):
    rig = Rig().driving()
    rig.silent = {"scan"}
    first = stopped(rig)
    rig.silent = set() if fresh else {"scan"}
    rig.tick(20)
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, "lidar", reason=Reason.DEVICE_RESTARTED))
    rig.tick(5)
    found = [cause.reason for cause in rig.trips[-1].causes]
    assert rig.trips[-1].number == first.number
    assert found == [Reason.SCAN_STALE] if fresh else [Reason.SCAN_STALE, Reason.DEVICE_RESTARTED]


def test_only_the_first_failure_of_an_outage_is_behind_it():
    rig = Rig().driving()
    rig.silent = {"scan"}
    for reason in (Reason.DEVICE_LOST, Reason.DEVICE_TIMEOUT):
        show(rig.gate, health(rig.now, ServiceState.BACKOFF, "lidar", reason=reason))
    assert [cause.reason for cause in stopped(rig).causes] == [Reason.SCAN_STALE, Reason.DEVICE_LOST]


def test_a_failed_service_is_named_with_what_it_failed_of():
    rig = Rig().driving()
    show(
        rig.gate, health(rig.now, ServiceState.FAILED, "tracker", reason=Reason.INTERNAL, detail="unexpected exception")
    )
    trip = stopped(rig)
    assert [(cause.reason, cause.source, cause.because) for cause in trip.causes] == [
        (Reason.SERVICE_FAILED, "tracker", 1),
        (Reason.INTERNAL, "tracker", None),
    ]
    assert causes_text(trip.causes, trip.stamp).startswith(
        "a service failed: tracker, because tracker: unexpected exception"
    )
    assert trip.quick


def test_a_link_that_is_down_is_behind_a_lapsed_lease_until_it_is_fine():
    rig = Rig().driving()
    show(rig.gate, event(rig.now, Reason.LINK_DOWN, "link", "wlan0: link is down"))
    rig.driver = None
    assert [cause.reason for cause in stopped(rig).causes] == [Reason.LEASE_EXPIRED, Reason.LINK_DOWN]
    show(rig.gate, event(rig.now, Reason.OK, "link", "wlan0: link is good", Severity.INFO))
    rig.tick(80)
    rig.driving()
    rig.driver = None
    assert [cause.reason for cause in stopped(rig).causes] == [Reason.LEASE_EXPIRED]


def test_tilt_fault_battery_and_stall_have_their_figures():
    rig = Rig().driving()
    rig.tilt = 0.4
    tilt = figures(stopped(rig).causes[0])["tilt"]
    assert (tilt.value, tilt.limit, tilt.unit) == (pytest.approx(0.4), 0.35, "rad")

    rig = Rig().driving()
    rig.level = BatteryLevel.CRITICAL
    assert figures(stopped(rig).causes[0])["voltage"].value == 23.0

    rig = Rig().driving()
    rig.fault = True
    cause = stopped(rig).causes[0]
    assert cause.reason is Reason.DRIVE_FAULT
    assert figures(cause)["fault code"].value is None

    rig = Rig().driving()
    rig.now += round(0.2 * SECOND)
    pause = figures(stopped(rig).causes[0])["pause"]
    assert (pause.value, pause.limit) == (pytest.approx(0.22), 0.15)


def test_an_obstacle_that_stops_the_truck_is_a_stop_once():
    rig = Rig().driving()
    rig.obstacles = ((0.3, 0.0),)
    trip = stopped(rig)
    (cause,) = trip.causes
    assert (cause.reason, trip.mode) == (Reason.OBSTACLE_STOP, GateMode.DRIVING)
    free = figures(cause)["free distance"]
    assert free.limit == 0.05
    assert 0 <= free.value < 0.3
    rig.tick(50)
    assert len(rig.trips) == 1


def test_orders_are_stops_by_somebody():
    rig = Rig().driving()
    rig.order(Order.STOP, source="bob")
    trip = stopped(rig)
    assert (trip.ordered, trip.reason, trip.causes[0].source, trip.holder) == (True, Reason.STOPPED, "bob", "ann")
    rig = Rig().driving()
    rig.order(Order.DISARM, source="bob")
    assert (stopped(rig).ordered, rig.trips[-1].reason) == (True, Reason.DISARMED)
    rig = Rig().driving()
    rig.order(Order.ESTOP, source="cy", role=Role.TRACKER)
    trip = stopped(rig)
    assert (trip.ordered, trip.quick, trip.mode, trip.reason) == (
        False,
        True,
        GateMode.ESTOPPED,
        Reason.ESTOP_REQUESTED,
    )
    rig.order(Order.ESTOP, source="cy")
    rig.tick()
    assert len(rig.trips) == 1


def test_an_order_to_disarm_a_truck_that_stops_is_no_second_stop():
    rig = Rig().driving(speed=0.2)
    rig.order(Order.STOP)
    rig.tick()
    assert rig.out.mode is GateMode.STOPPING
    rig.order(Order.DISARM)
    rig.driver = None
    rig.tick(60)
    assert rig.out.mode is GateMode.DISARMED
    assert [trip.reason for trip in rig.trips] == [Reason.STOPPED]


def test_shutting_down_while_driving_is_a_stop():
    rig = Rig().driving()
    assert [trip.reason for trip in rig.gate.neutral(rig.now).trips] == [Reason.SHUTDOWN]
    starting = Rig().driving(ticks=1)
    assert [trip.reason for trip in starting.gate.neutral(starting.now).trips] == [Reason.SHUTDOWN]
    still = Rig().armed()
    assert still.gate.neutral(still.now).trips == ()


def test_stops_are_numbered():
    rig = Rig().driving()
    for _ in range(2):
        rig.silent = {"scan"}
        rig.tick(20)
        rig.silent = set()
        rig.tick(30)
    assert [trip.number for trip in rig.trips] == [1, 2]


def test_a_refused_arming_says_what_is_missing():
    rig = Rig()
    rig.tick(2)
    rig.silent = {"scan"}
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, "lidar", reason=Reason.DEVICE_LOST, detail="unplugged"))
    rig.tick(50)
    assert rig.order(Order.ARM) is Reason.SCAN_STALE
    assert rig.tick().events[0].text == (
        "no fresh lidar scan (for 1.0 s, age 1.0 s, limit 250 ms), because lidar: unplugged (for 1.0 s)"
    )


def test_arming_an_emergency_stopped_truck_is_refused_with_who_stopped_it():
    rig = Rig().driving()
    rig.order(Order.ESTOP, source="cy")
    rig.driver = None
    rig.tick(100)
    rig.order(Order.ARM, source="bob")
    assert rig.tick().events[0].text == "stopped 2.0 s ago: emergency stop by cy"
    latched = Rig(latched=True)
    latched.order(Order.ARM)
    assert latched.tick().events[0].text == Reason.ESTOPPED.text, "who did it in the run before is not known"


# In words


def cause(reason=Reason.SCAN_STALE, since=0, because=None, *figures):
    return Cause(reason=reason, source="x", since=since, text=reason.text, because=because, measurements=tuple(figures))


def test_chains_that_lead_nowhere_or_back_end():
    assert causes_text([cause(because=7)], 0) == "no fresh lidar scan"
    there_and_back = [cause(because=1), cause(Reason.HUB_LOST, 0, 2), cause(Reason.DEVICE_LOST, 0, 1)]
    assert causes_text(there_and_back, 0).count("because") == 2


def test_a_story_counts_from_now_and_its_causes_from_the_stop():
    stop = Stop(
        **header(10 * SECOND),
        number=1,
        reason=Reason.SCAN_STALE,
        mode=GateMode.STOPPING,
        quick=True,
        holder="ann",
        speed=-0.12,
        causes=(
            cause(Reason.SCAN_STALE, 10 * SECOND - TICK, 1, Measurement(name="age", unit="s", limit=0.25)),
            cause(Reason.DEVICE_LOST, 8 * SECOND, None, Measurement(name="volts", value=4.1234, unit="V", age=0.05)),
        ),
        black_box="blackbox-000001-scan_stale.mcap",
        text="",
    )
    assert stop_lines(stop, 310 * SECOND) == [
        "quick stop at 0.12 m/s 5 min ago, driver ann",
        "no fresh lidar scan (for 20 ms, age unknown, limit 250 ms)",
        "  because device unplugged or its port disappeared (for 2.0 s, volts 4.12 V, 50 ms old)",
        "black box blackbox-000001-scan_stale.mcap",
    ]
