"""The monitor of the sensors alone: which samples count, for how long, and what they stop or slow."""

import math

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.sensor import BatteryLevel, DriveMode
from monstertruckd.gate.samples import STALE_SENSORS, STALE_TOPICS
from monstertruckd.gate.sensors import ServiceCheck
from tests.unit.gate.rig import (
    BODIES,
    CHASSIS,
    SERVICES,
    Monitor,
    attitude,
    battery,
    check_of,
    feedback,
    header,
    health,
    scan,
    servos,
    show,
)

MS = SECOND // 1000
NOW = 10 * SECOND
LATE = 400 * MS
"""The greatest latency."""
OBSERVE = {
    Reason.SCAN_STALE: (lambda sensors, message: show(sensors, message), scan),
    Reason.ATTITUDE_STALE: (lambda sensors, message: show(sensors, message), attitude),
    Reason.STEERING_STALE: (lambda sensors, message: show(sensors, message), servos),
    Reason.DRIVE_STALE: (lambda sensors, message: show(sensors, message), feedback),
    Reason.BATTERY_STALE: (lambda sensors, message: show(sensors, message), battery),
}


def monitor(chassis=CHASSIS, *, battery_measured=True, services=SERVICES, **config):
    return Monitor(chassis, battery_measured=battery_measured, services=services, **config)


def complete(sensors, at=NOW):
    """A monitor with a sample of every sensor."""
    for observe, sample in OBSERVE.values():
        observe(sensors, sample(at))
    return sensors


def test_topics_and_sensors_by_the_reason_of_their_silence():
    assert {
        **dict.fromkeys(topics.SCANS, Reason.SCAN_STALE),
        topics.COMPASS: Reason.ATTITUDE_STALE,
        topics.STEERING: Reason.STEERING_STALE,
        **dict.fromkeys(topics.DRIVES, Reason.DRIVE_STALE),
    } == STALE_TOPICS
    assert STALE_SENSORS == {
        Reason.SCAN_STALE: DeviceRole.LIDAR,
        Reason.ATTITUDE_STALE: DeviceRole.COMPASS,
        Reason.DRIVE_STALE: DeviceRole.DRIVE,
        Reason.STEERING_STALE: DeviceRole.STEERING,
        Reason.BATTERY_STALE: DeviceRole.BATTERY,
    }


def counts(sensors, message):
    """Whether a scan is valid."""
    show(sensors, message)
    return sensors.scans[0] is message


def test_nothing_stops_or_slows_a_truck_whose_sensors_are_well():
    found = complete(monitor()).assess(NOW)
    assert (found.blocks, found.limits) == ((), {})
    assert found.values == {"tilt": 0.0, "battery_voltage": 23.0}


# Samples


@pytest.mark.parametrize("reason", OBSERVE)
def test_a_sample_as_late_as_allowed_counts_and_a_later_one_does_not_and_is_explained(reason):
    observe, sample = OBSERVE[reason]
    sensors = monitor()
    observe(sensors, sample(NOW).model_copy(update={"received": NOW + LATE + 1}))
    stale = sensors.staleness(reason, NOW + LATE + 1)
    assert (stale.since, stale.age) == (None, None)
    assert stale.refused is not None
    assert (stale.refused.name, stale.refused.unit, stale.refused.limit) == ("latency", "s", 0.4)
    assert stale.refused.value == pytest.approx(0.4)
    observe(sensors, sample(NOW).model_copy(update={"received": NOW + LATE}))
    counted = sensors.staleness(reason, NOW + LATE + 20 * MS)
    assert counted.refused is None
    assert counted.age == pytest.approx(0.02)


def test_a_scan_without_any_range_counts_on_open_ground_only():
    blind = scan(NOW, unknown=((-120.0, 120.0, 0),))
    sensors = monitor()
    assert not counts(sensors, blind)
    assert sensors.scans[0] is None
    refused = sensors.staleness(Reason.SCAN_STALE, NOW).refused
    assert (refused.name, refused.value, refused.limit) == ("beams with a range", 0.0, 1.0)
    assert counts(sensors, scan(NOW))
    open_ground = monitor(obstacle={"open_ground": True})
    assert counts(open_ground, blind)
    assert counts(open_ground, scan(NOW))
    assert open_ground.scans[0] is not None


def test_a_scan_counts_up_to_the_tilt_allowed():
    sensors = monitor()
    assert counts(sensors, level := scan(NOW, tilt=0.35))
    assert not counts(sensors, scan(NOW, tilt=0.351))
    assert sensors.scans[0] is level
    refused = sensors.staleness(Reason.SCAN_STALE, NOW).refused
    assert (refused.name, refused.value, refused.unit, refused.limit) == ("scan plane tilt", 0.351, "rad", 0.35)


def test_a_late_scan_stays_refused_for_its_latency_whatever_else_is_wrong_with_it():
    late = scan(NOW, unknown=((-120.0, 120.0, 0),), tilt=1.0).model_copy(update={"received": NOW + SECOND})
    sensors = monitor()
    assert not counts(sensors, late)
    assert sensors.staleness(Reason.SCAN_STALE, NOW).refused.name == "latency"
    tilted = scan(NOW, unknown=((-120.0, 120.0, 0),), tilt=0.1)
    assert not counts(sensors, tilted)
    assert sensors.staleness(Reason.SCAN_STALE, NOW).refused.name == "beams with a range"


@pytest.mark.parametrize("level", BatteryLevel)
def test_a_battery_reading_counts_unless_its_level_is_not_known(level):
    sensors = monitor()
    show(sensors, battery(NOW, level))
    counts = level not in (BatteryLevel.UNKNOWN, BatteryLevel.SENSOR_FAULT)
    assert (sensors.battery is not None) is counts


def test_steering_feedback_that_is_not_trusted_changes_nothing():
    sensors = monitor()
    show(sensors, servos(NOW, 0.1, -0.1))
    angles, sample = sensors.angles, sensors.steering
    assert angles == CHASSIS.steering(0.1, -0.1)
    show(sensors, servos(NOW + 1, 0.2, 0.2, trusted=False))
    assert (sensors.angles, sensors.steering) == (angles, sample)
    show(sensors, servos(NOW, 0.2, 0.2).model_copy(update={"received": NOW + SECOND}))
    assert (sensors.angles, sensors.steering) == (angles, sample)


@pytest.mark.parametrize(("roll", "pitch"), [(0.1, 0.0), (0.0, -0.1), (0.1, 0.1)])
def test_the_tilt_is_the_angle_to_the_vertical(roll, pitch):
    sensors = monitor()
    show(sensors, attitude(NOW, roll=roll, pitch=pitch))
    assert sensors.tilt == pytest.approx(math.acos(math.cos(roll) * math.cos(pitch)))
    assert sensors.assess(NOW).values["tilt"] == sensors.tilt
    for bad in (attitude(NOW, roll=1.0, tilt_valid=False), attitude(0, roll=1.0)):
        show(sensors, bad.model_copy(update={"received": NOW}))
        assert sensors.tilt < 0.2


# Losses


def lost(name, since, state=ServiceState.BACKOFF, **more):
    return HealthTable(**header(NOW), services=(ServiceHealth(name=name, state=state, since=since, **more),))


@pytest.mark.parametrize("state", [state for state in ServiceState if state is not ServiceState.READY])
def test_whatever_a_lost_device_sent_before_does_not_count(state):
    sensors = complete(monitor())
    show(sensors, lost("lidar", NOW - 1, state))
    assert Reason.SCAN_STALE not in sensors.assess(NOW).blocks
    show(sensors, lost("lidar", NOW, state))
    assert Reason.SCAN_STALE in sensors.assess(NOW).blocks
    stale = sensors.staleness(Reason.SCAN_STALE, NOW + 10 * MS)
    assert (stale.since, stale.age) == (NOW, pytest.approx(0.01))
    show(sensors, scan(NOW + 1))
    assert Reason.SCAN_STALE not in sensors.assess(NOW + 1).blocks
    assert sensors.staleness(Reason.SCAN_STALE, NOW + 2).since == NOW + 2, "the loss before the sample is no cause"


def test_a_device_that_is_well_loses_nothing():
    sensors = complete(monitor())
    show(sensors, lost("lidar", NOW + SECOND, ServiceState.READY))
    assert sensors.assess(NOW).blocks == ()


def test_a_loss_at_the_very_beginning_counts():
    sensors = monitor()
    show(sensors, lost("lidar", 0))
    show(sensors, scan(0))
    assert not sensors.scan_fresh(0)
    show(sensors, scan(1))
    assert sensors.scan_fresh(1)


def test_a_sample_of_the_first_instant_counts_without_a_loss():
    sensors = complete(monitor(), 0)
    assert sensors.assess(0).blocks == ()
    assert sensors.staleness(Reason.SCAN_STALE, 0).since == 0


def test_a_lost_sensor_without_a_sample_is_stale_since_its_loss():
    sensors = monitor()
    show(sensors, lost("lidar", 7 * SECOND))
    stale = sensors.staleness(Reason.SCAN_STALE, NOW)
    assert (stale.since, stale.age, stale.limit) == (7 * SECOND, None, 0.25)


def test_a_sensor_stale_before_its_loss_is_stale_since_then():
    sensors = monitor()
    show(sensors, scan(SECOND))
    show(sensors, lost("lidar", 2 * SECOND))
    assert sensors.staleness(Reason.SCAN_STALE, NOW).since == SECOND + 250 * MS


def test_the_speed_is_not_known_from_the_instant_of_the_loss():
    sensors = complete(monitor())
    assert sensors.speed(NOW) == 0.0
    show(sensors, lost("drive", NOW))
    assert sensors.speed(NOW) is None
    show(sensors, feedback(NOW + 1, 0.1))
    assert sensors.speed(NOW + 1) == pytest.approx(0.1)
    show(sensors, feedback(NOW + 1, 0.2))
    assert sensors.speed(NOW + 1) == pytest.approx(0.2), "a newer sample in the same instant"
    assert sensors.speed(NOW + 1 + 201 * MS) is None


@pytest.mark.parametrize(
    ("name", "reason", "blocks"),
    [
        ("drive", Reason.DEVICE_RESTARTED, True),
        ("drive", Reason.DEVICE_STOPPED, True),
        ("drive_2", Reason.DEVICE_RESTARTED, True),
        ("lidar", Reason.DEVICE_RESTARTED, False),
        ("slam", Reason.DEVICE_RESTARTED, False),
        ("drive", Reason.DEVICE_LOST, False),
    ],
)
def test_a_drive_that_restarted_or_was_stopped_stops_the_truck_until_its_service_is_ready(name, reason, blocks):
    sensors = complete(monitor(), NOW)
    tables = (
        ServiceHealth(name="lidar", state=ServiceState.READY, since=0),
        ServiceHealth(name=name, state=ServiceState.BACKOFF, since=0, reason=reason),
    )
    show(sensors, HealthTable(**header(NOW), services=tables))
    assert (reason in sensors.assess(NOW).blocks) is blocks
    sensors.tick(NOW)
    assert (reason in sensors.assess(NOW).blocks) is blocks
    show(sensors, lost(name, 0, ServiceState.READY))
    sensors.tick(NOW)
    assert reason not in sensors.assess(NOW).blocks


def test_a_drives_restart_that_a_later_table_takes_back_stops_the_truck_until_a_tick_has_judged_it():
    sensors = complete(monitor(), NOW)
    restarted = ServiceHealth(name="drive", state=ServiceState.BACKOFF, since=0, reason=Reason.DEVICE_RESTARTED)
    show(sensors, HealthTable(**header(NOW), services=(restarted,)))
    show(sensors, lost("drive", 0, ServiceState.STARTING))
    assert Reason.DEVICE_RESTARTED in sensors.assess(NOW).blocks
    sensors.tick(NOW)
    assert Reason.DEVICE_RESTARTED in sensors.assess(NOW).blocks, "this tick judges it"
    sensors.tick(NOW)
    assert Reason.DEVICE_RESTARTED not in sensors.assess(NOW).blocks


def test_only_failed_services_that_nobody_tolerates_stop_the_truck():
    states = {"slam": ServiceState.FAILED, "recorder": ServiceState.FAILED, "plan": ServiceState.BACKOFF}
    table = tuple(ServiceHealth(name=name, state=state, since=0) for name, state in states.items())
    sensors = complete(monitor())
    show(sensors, HealthTable(**header(NOW), services=table))
    assert check_of(sensors, ServiceCheck)._failed == ("slam",)
    assert sensors.assess(NOW).blocks == (Reason.SERVICE_FAILED,)


# What is critical


@pytest.mark.parametrize("sensor", ["drive", "steering", "scan", "attitude", "battery"])
def test_only_a_critical_sensor_stops_by_its_silence(sensor):
    reasons = {"drive": Reason.DRIVE_STALE, "steering": Reason.STEERING_STALE, "scan": Reason.SCAN_STALE}
    reasons |= {"attitude": Reason.ATTITUDE_STALE, "battery": Reason.BATTERY_STALE}
    for critical in (True, False):
        sensors = monitor(**{sensor: {"stale_after": 1.0, "critical": critical}})
        assert (reasons[sensor] in sensors.assess(NOW).blocks) is critical


def test_a_body_without_servos_misses_no_steering():
    assert Reason.STEERING_STALE not in monitor(BODIES["differential"]).assess(NOW).blocks
    assert Reason.STEERING_STALE in monitor().assess(NOW).blocks


def test_a_robot_without_a_compass_expects_no_attitude_and_has_no_tilt():
    sensors = complete(monitor(attitude=None))
    show(sensors, attitude(NOW, roll=0.5))
    found = sensors.assess(NOW + 3600 * SECOND)
    assert Reason.ATTITUDE_STALE not in found.blocks
    assert Reason.TILT_STOP not in sensors.assess(NOW).blocks
    assert not sensors.samples.tips(NOW)
    assert "tilt" not in sensors.assess(NOW).values


def test_a_stale_attitude_has_no_tilt():
    sensors = monitor(attitude={"stale_after": 0.25, "critical": False})
    show(sensors, attitude(NOW, roll=0.5))
    assert Reason.TILT_STOP in sensors.assess(NOW + 250 * MS).blocks
    found = sensors.assess(NOW + 251 * MS)
    assert Reason.TILT_STOP not in found.blocks
    assert "tilt" not in found.values


def test_a_tilt_slows_or_stops_and_never_both():
    sensors = complete(monitor())
    show(sensors, attitude(NOW, roll=0.22))
    assert sensors.assess(NOW)[:2] == ((), {Reason.TILT_SLOW: 0.08})
    show(sensors, attitude(NOW, roll=0.36))
    assert sensors.assess(NOW)[:2] == ((Reason.TILT_STOP,), {})


# Battery


@pytest.mark.parametrize(("measured", "known"), [(True, False), (False, True), (True, True)])
def test_a_battery_that_is_or_was_measured_slows_by_its_silence(measured, known):
    sensors = complete(monitor(battery_measured=measured))
    if not known:
        sensors.samples.battery = None
    assert sensors.assess(NOW + 3 * SECOND).limits == {Reason.BATTERY_STALE: 0.1}


def test_a_battery_nobody_measures_limits_nothing():
    assert monitor(battery_measured=False).assess(NOW).limits == {}


def test_a_critical_battery_sensor_stops_by_its_silence_and_does_not_slow():
    sensors = complete(monitor(battery={"stale_after": 2.0, "critical": True}))
    found = sensors.assess(NOW + 3 * SECOND)
    assert Reason.BATTERY_STALE in found.blocks
    assert found.limits == {}


def test_a_pack_that_was_critical_stays_so_when_its_sensor_falls_silent():
    sensors = complete(monitor())
    show(sensors, battery(NOW, BatteryLevel.CRITICAL, 19.0))
    found = sensors.assess(NOW + 3 * SECOND)
    assert Reason.BATTERY_CRITICAL in found.blocks
    assert found.values["battery_voltage"] == 19.0


# Shafts


def two_shafts(first=0.0, second=0.0, at=NOW, **config):
    sensors = monitor(BODIES["differential"], **config)
    show(sensors, feedback(at, first), 0)
    show(sensors, feedback(at, second), 1)
    return sensors


def test_the_turn_rate_is_that_of_shafts_and_steering():
    assert two_shafts(-0.1, 0.1).turn_rate(NOW) == pytest.approx(0.2 / 0.26, rel=0.01)
    assert two_shafts(-0.1, 0.1).turn_rate(NOW + SECOND) == 0.0
    steered = complete(monitor())
    show(steered, feedback(NOW, 0.1))
    show(steered, servos(NOW, 0.2, -0.2))
    angles = CHASSIS.steering(0.2, -0.2)
    twist = CHASSIS.twist(CHASSIS.input_speeds((0.1,), *angles), *angles)
    assert abs(twist[2]) > 0.05
    assert steered.turn_rate(NOW) == pytest.approx(twist[2])


@pytest.mark.parametrize("shaft", [0, 1])
def test_the_fault_of_any_shaft_stops_with_its_code(shaft):
    sensors = two_shafts()
    show(sensors, feedback(NOW, 0.0, DriveMode.FAULT, 0x2310), shaft)
    found = sensors.assess(NOW)
    assert found.blocks[0] is Reason.DRIVE_FAULT
    assert found.values["drive_fault_code"] == 0x2310


def test_a_truck_whose_drive_is_not_critical_rests_while_nothing_is_known():
    assert not monitor().at_rest(NOW)
    assert monitor(drive={"stale_after": 0.2, "critical": False}).at_rest(NOW)
    moving = monitor(drive={"stale_after": 0.2, "critical": False})
    show(moving, feedback(NOW, 0.1))
    assert not moving.at_rest(NOW)


def test_standstill_is_less_than_its_speed():
    speed = 0.01
    sensors = monitor(standstill=speed)
    show(sensors, feedback(NOW, speed))
    assert sensors.at_rest(NOW) is (abs(sensors.speed(NOW)) < speed)
    exact = monitor(standstill=abs(sensors.speed(NOW)))
    show(exact, feedback(NOW, speed))
    assert not exact.at_rest(NOW), "at the limit it still moves"


def test_of_several_shafts_one_without_a_sample_has_no_age():
    sensors = monitor(BODIES["differential"])
    show(sensors, feedback(NOW), 0)
    stale = sensors.staleness(Reason.DRIVE_STALE, NOW + SECOND)
    assert (stale.since, stale.age, stale.limit) == (None, None, 0.2)
    assert health(NOW).services[0].since == NOW
