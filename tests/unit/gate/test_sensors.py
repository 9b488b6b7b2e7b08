import math

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.sensor import BatteryLevel
from monstertruck_schemas.state import GateMode
from tests.unit.gate.rig import Rig, attitude, battery, health, make_gate, scan, servos, show

STALE = {
    "scan": Reason.SCAN_STALE,
    "attitude": Reason.ATTITUDE_STALE,
    "drive": Reason.DRIVE_STALE,
    "steering": Reason.STEERING_STALE,
}


@pytest.mark.parametrize("sensor", STALE)
def test_a_silent_sensor_stops_within_300_ms_of_its_last_sample(sensor):
    rig = Rig().driving()
    last = rig.now
    rig.silent = {sensor}
    while rig.out.mode is GateMode.DRIVING:
        rig.tick()
    assert rig.now - last <= 0.3 * SECOND
    assert rig.out.speeds[0] == 0.0
    urgent = sensor == "drive"
    assert rig.out.action is (DriveAction.QUICK_STOP if urgent else DriveAction.RUN)
    assert rig.out.reasons == (STALE[sensor],)
    assert len(rig.reported(STALE[sensor])) == 1
    rig.tick(15)
    assert rig.speed == 0.0
    assert rig.travelled < 0.3


@pytest.mark.parametrize("sensor", STALE)
def test_a_sensor_that_comes_back_soon_lets_the_driver_go_on(sensor):
    rig = Rig().driving()
    rig.silent = {sensor}
    rig.tick(30)
    assert rig.out.mode in (GateMode.STOPPING, GateMode.ARMED)
    rig.silent = set()
    rig.tick(3)
    assert rig.out.mode is GateMode.DRIVING


@pytest.mark.parametrize("sensor", STALE)
def test_a_sensor_that_stays_away_disarms(sensor):
    rig = Rig().driving()
    rig.silent = {sensor}
    rig.tick(100)
    assert rig.out.mode is GateMode.DISARMED
    assert rig.out.action is (DriveAction.QUICK_STOP if sensor == "drive" else DriveAction.DISABLE)
    assert STALE[sensor] in rig.out.reasons


@pytest.mark.parametrize(
    ("service", "sensor"), [("lidar", "scan"), ("compass", "attitude"), ("drive", "drive"), ("steering", "steering")]
)
def test_a_sensor_reported_lost_stops_at_once_until_it_delivers_again(service, sensor):
    rig = Rig().driving()
    rig.silent = {sensor}
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, service))
    rig.tick()
    assert rig.out.mode is GateMode.STOPPING
    assert rig.out.reasons == (STALE[sensor],)
    show(rig.gate, health(rig.now - SECOND // 100, ServiceState.STARTING, service))
    rig.silent = set()
    rig.tick(30)
    assert rig.out.mode is GateMode.DRIVING


def test_the_loss_of_a_sensor_counts_under_the_name_of_the_role_that_writes_its_topic():
    rig = Rig()
    rig.gate = make_gate(services={"imu": Reason.ATTITUDE_STALE})
    rig.driving()
    rig.silent = {"attitude"}
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, "compass"))
    rig.tick()
    assert rig.out.mode is GateMode.DRIVING, "not this robot's compass"
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, "imu", reason=Reason.DEVICE_LOST))
    rig.tick()
    assert rig.out.mode is GateMode.STOPPING
    assert rig.out.reasons == (Reason.ATTITUDE_STALE,)


def test_uncritical_sensors_may_be_silent():
    rig = Rig(**{name: {"stale_after": 0.2, "critical": False} for name in ("scan", "attitude", "steering")})
    rig.silent = {"scan", "attitude", "steering"}
    rig.driving()
    assert rig.out.reasons == ()


def test_late_samples_are_no_good_samples():
    rig = Rig().driving()
    rig.silent = {"scan"}
    for _ in range(14):
        late = scan(rig.now - SECOND).model_copy(update={"received": rig.now})
        show(rig.gate, late)
        rig.tick()
    assert rig.out.reasons == (Reason.SCAN_STALE,)


def test_untrusted_pulses_are_no_good_samples():
    rig = Rig().driving()
    rig.silent = {"steering"}
    for _ in range(14):
        show(rig.gate, servos(rig.now, trusted=False))
        rig.tick()
    assert rig.out.reasons == (Reason.STEERING_STALE,)


def test_attitudes_without_a_valid_tilt_are_no_good_samples():
    rig = Rig().driving()
    rig.silent = {"attitude"}
    for _ in range(14):
        show(rig.gate, attitude(rig.now, roll=1.0, tilt_valid=False))
        rig.tick()
    assert rig.out.reasons == (Reason.ATTITUDE_STALE,)


# Tilt


def test_tilt_slows_then_stops_with_hysteresis():
    rig = Rig().driving()
    rig.tilt = 0.22
    rig.tick(20)
    assert rig.out.reasons == (Reason.TILT_SLOW,)
    assert rig.out.speeds[0] == pytest.approx(0.08)
    assert rig.out.speed_limit == pytest.approx(0.08)
    assert rig.reported(Reason.TILT_SLOW)[0].values["tilt"] == pytest.approx(0.22)
    rig.tilt = 0.19
    rig.tick(20)
    assert rig.out.speeds[0] == pytest.approx(0.08)
    rig.tilt = 0.17
    rig.tick(20)
    assert rig.out.speeds[0] == pytest.approx(0.2)
    rig.tilt = 0.36
    rig.tick()
    assert (rig.out.mode, rig.out.speeds[0]) == (GateMode.STOPPING, 0.0)
    assert rig.out.reasons == (Reason.TILT_STOP,)
    rig.tilt = 0.33
    rig.tick(20)
    assert rig.out.mode is GateMode.ARMED
    assert rig.out.speeds[0] == 0.0
    rig.tilt = 0.30
    rig.tick(30)
    assert rig.out.speeds[0] == pytest.approx(0.08)


def test_roll_and_pitch_add_up():
    rig = Rig().driving()
    rig.silent = {"attitude"}
    show(rig.gate, attitude(rig.now, roll=0.16, pitch=-0.16))
    rig.tick()
    assert rig.out.reasons == (Reason.TILT_SLOW,)
    assert math.acos(math.cos(0.16) ** 2) > 0.21


# Battery


def test_a_low_battery_slows_a_critical_one_stops_and_disarms():
    rig = Rig().driving()
    rig.level = BatteryLevel.LOW
    rig.tick(20)
    assert rig.out.speeds[0] == pytest.approx(0.1)
    assert rig.out.reasons == (Reason.BATTERY_LOW,)
    rig.level = BatteryLevel.CRITICAL
    rig.tick()
    assert (rig.out.mode, rig.out.speeds[0]) == (GateMode.STOPPING, 0.0)
    rig.tick(20)
    assert rig.out.mode is GateMode.DISARMED
    rig.level = BatteryLevel.CRITICAL
    rig.driver = None
    rig.tick(20)
    assert rig.order(Order.ARM) is Reason.BATTERY_CRITICAL
    rig.silent = {"battery"}
    rig.tick(200)
    assert rig.order(Order.ARM) is Reason.BATTERY_CRITICAL  # silence heals nothing


def test_a_battery_nobody_measures_any_more_slows():
    rig = Rig().driving()
    rig.silent = {"battery"}
    rig.tick(90)
    assert rig.out.reasons == ()
    rig.tick(30)
    assert rig.out.reasons == (Reason.BATTERY_STALE,)
    assert rig.out.speeds[0] == pytest.approx(0.1)


def test_a_battery_that_was_never_measured_slows_until_it_is():
    rig = Rig(battery_measured=True)
    rig.silent = {"battery"}
    rig.driving()
    assert rig.out.reasons == (Reason.BATTERY_STALE,)
    assert rig.out.speed_limit == rig.out.speeds[0] == pytest.approx(0.1)
    show(rig.gate, battery(rig.now, BatteryLevel.UNKNOWN))
    rig.tick()
    assert rig.out.reasons == (Reason.BATTERY_STALE,), "a reading without a level is none"
    rig.silent = set()
    rig.tick(20)
    assert rig.out.reasons == ()
    assert rig.out.speeds[0] == pytest.approx(0.2)


def test_a_faulty_battery_sensor_counts_as_silence():
    rig = Rig(battery={"stale_after": 0.5, "critical": True}).driving()
    rig.silent = {"battery"}
    for _ in range(30):
        show(rig.gate, battery(rig.now, BatteryLevel.SENSOR_FAULT, None))
        rig.tick()
    assert rig.out.reasons == (Reason.BATTERY_STALE,)
    assert rig.out.speeds[0] == 0.0


def test_a_truck_without_battery_monitor_drives():
    rig = Rig()
    rig.silent = {"battery"}
    assert rig.driving().out.reasons == ()


# Drive and services


def test_a_drive_fault_stops_quickly_and_disarms():
    rig = Rig().driving()
    rig.fault = True
    rig.tick()
    assert (rig.out.mode, rig.out.action) == (GateMode.STOPPING, DriveAction.QUICK_STOP)
    assert rig.out.reasons == (Reason.DRIVE_FAULT,)
    assert rig.reported(Reason.DRIVE_FAULT)[0].values["drive_fault_code"] is None
    rig.fault = False
    rig.tick(20)
    assert rig.out.mode is GateMode.DISARMED


def test_a_fault_while_armed_disarms():
    rig = Rig().armed()
    rig.fault = True
    rig.tick()
    assert rig.out.mode is GateMode.DISARMED
    assert rig.reported(Reason.DRIVE_FAULT)


def test_a_failed_service_stops_unless_it_is_tolerated():
    rig = Rig().driving()
    show(rig.gate, health(rig.now, ServiceState.FAILED, "recorder"))
    rig.tick()
    assert rig.out.mode is GateMode.DRIVING
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, "scan"))
    rig.tick()
    assert rig.out.mode is GateMode.DRIVING
    show(rig.gate, health(rig.now, ServiceState.FAILED, "odometry"))
    rig.tick()
    assert (rig.out.mode, rig.out.action) == (GateMode.STOPPING, DriveAction.QUICK_STOP)
    assert "odometry" in rig.reported(Reason.SERVICE_FAILED)[0].text


def test_several_reasons_are_reported_worst_first():
    rig = Rig().driving()
    rig.silent = {"scan", "drive"}
    rig.level = BatteryLevel.LOW
    rig.tick(14)
    assert rig.out.reasons == (Reason.DRIVE_STALE, Reason.SCAN_STALE, Reason.BATTERY_LOW)


# Obstacles


def wall(x):
    return tuple((x, y / 50) for y in range(-10, 11))


def test_free_ground_ahead_limits_nothing():
    rig = Rig()
    rig.obstacles = wall(1.5)
    assert rig.driving().out.reasons == ()


def test_the_truck_slows_down_and_stops_before_a_wall():
    rig = Rig().driving()
    start, gap, slowed = rig.travelled, 0.8, False
    for _ in range(400):
        rig.obstacles = wall(0.245 + gap - (rig.travelled - start))
        rig.tick()
        slowed |= Reason.OBSTACLE_SLOW in rig.out.reasons
    assert slowed
    assert Reason.OBSTACLE_STOP in rig.out.reasons
    assert rig.out.mode is GateMode.DRIVING
    left = gap - (rig.travelled - start)
    assert 0.04 < left < 0.12
    assert len(rig.reported(Reason.OBSTACLE_STOP)) == 1


def test_a_sudden_obstacle_is_a_quick_stop_in_the_same_tick():
    rig = Rig().driving()
    rig.obstacles = wall(0.27)
    rig.tick()
    assert (rig.out.action, rig.out.speeds[0]) == (DriveAction.QUICK_STOP, 0.0)
    assert rig.out.reasons[0] is Reason.OBSTACLE_STOP
    rig.tick(10)
    assert rig.speed == 0.0
    assert rig.out.action is DriveAction.RUN  # at rest the power stage stays on
    assert rig.out.mode is GateMode.DRIVING


def test_the_way_back_is_free():
    rig = Rig().driving()
    rig.obstacles = wall(0.27)
    rig.tick(20)
    rig.driver = {"speed": -0.1}
    rig.tick(20)
    assert rig.out.speeds[0] == pytest.approx(-0.1)


def test_the_sweep_follows_the_commanded_arc():
    beside = ((0.33, 0.25), (0.34, 0.26), (0.35, 0.27))
    straight = Rig()
    straight.obstacles = beside
    assert Reason.OBSTACLE_SLOW not in straight.driving(ticks=60).out.reasons
    turning = Rig()
    turning.obstacles = beside
    turning.driving(ticks=60, front=0.4, rear=-0.4)
    assert {Reason.OBSTACLE_SLOW, Reason.OBSTACLE_STOP} & set(turning.out.reasons)


def test_the_sweep_also_follows_the_angles_the_servos_have():
    rig = Rig()
    rig.obstacles = ((0.33, 0.25), (0.34, 0.26), (0.35, 0.27))
    rig.silent = {"steering"}
    for _ in range(2):
        show(rig.gate, servos(rig.now, 9.0, -0.6))
        rig.tick()
    rig.order(Order.ARM)
    rig.driver = {"speed": 0.2}
    for _ in range(20):
        show(rig.gate, servos(rig.now, 9.0, -0.6))
        rig.tick()
    assert {Reason.OBSTACLE_SLOW, Reason.OBSTACLE_STOP} & set(rig.out.reasons)


def test_an_old_scan_asks_for_more_room():
    fresh, old = Rig(), Rig(scan={"stale_after": 0.5})
    speeds = []
    for rig, age in ((fresh, 0.0), (old, 0.3)):
        rig.driving()
        rig.silent = {"scan"}
        for _ in range(60):
            seen = scan(rig.now - round(age * SECOND), *wall(0.245 + 0.2))
            show(rig.gate, seen.model_copy(update={"received": rig.now}))
            rig.tick()
        speeds.append(rig.out.speeds[0])
    assert speeds[1] < speeds[0] < 0.2


@pytest.mark.parametrize(("tilt", "counts"), [(None, True), (0.3, True), (0.36, False), (math.pi / 2, False)])
def test_a_scan_from_a_tilted_plane_does_not_count(tilt, counts):
    rig = Rig()
    rig.driving()
    rig.silent = {"scan"}
    for _ in range(30):
        show(rig.gate, scan(rig.now, tilt=tilt))
        rig.tick()
    assert (Reason.SCAN_STALE in rig.out.reasons) is not counts


def test_a_resting_stick_is_not_checked():
    rig = Rig()
    rig.obstacles = wall(0.25)
    assert rig.driving(speed=0.0).out.reasons == ()


def test_a_silent_drive_does_not_hide_a_wall():
    rig = Rig(drive={"stale_after": 0.2, "critical": False})
    rig.silent = {"drive"}
    rig.driving()
    rig.obstacles = wall(0.27)
    rig.tick()
    assert rig.out.reasons == (Reason.OBSTACLE_STOP,)
    assert rig.out.speeds[0] == 0.0


def test_an_overcharged_battery_does_not_hinder_driving():
    rig = Rig(battery={"stale_after": 0.5, "critical": True}).driving()
    rig.level = BatteryLevel.OVERCHARGED
    rig.tick(60)
    assert rig.out.reasons == ()
