"""Rules of the gate one by one, each at its very limit: what a single wrong sign or comparison would change."""

import math

import pytest

from monstertruck_planners.collision import Footprint, ScanPoints
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.sensor import BatteryLevel, DriveMode
from monstertruck_schemas.state import GateMode
from monstertruck_schemas.topics import COMPASS
from monstertruckd.gate.config import GateConfig, InForce, TiltLimits
from monstertruckd.gate.following import SteeringCheck
from monstertruckd.gate.obstacles import ObstacleGuard
from monstertruckd.gate.sensors import TiltCheck
from tests.unit.gate.rig import (
    ANY_GROUND,
    BODIES,
    CHASSIS,
    TICK,
    Monitor,
    Rig,
    Robot,
    attitude,
    battery,
    check_of,
    feedback,
    health,
    scan,
    servos,
    show,
)

MS = SECOND // 1000
TRACK = {"source": "track", "role": Role.TRACKER, "inside": True}
GOALS = {**TRACK, "source": "goals"}

# Which reasons disarm, and which are a quick stop


def fail_a_service(rig):
    show(rig.gate, health(rig.now, ServiceState.FAILED, "slam"))


def repair_it(rig):
    show(rig.gate, health(rig.now, ServiceState.READY, "slam"))


def set_to(**values):
    def change(rig):
        for name, value in values.items():
            setattr(rig, name, value)

    return change


def kill_the_steering(rig):
    check_of(rig.gate, SteeringCheck)._comparison.contradicts = True


def stall(rig):
    rig.now += 200 * MS


FAULTS = {
    Reason.SCAN_STALE: (set_to(silent={"scan"}), set_to(silent=set()), 14),
    Reason.ATTITUDE_STALE: (set_to(silent={"attitude"}), set_to(silent=set()), 14),
    Reason.STEERING_STALE: (set_to(silent={"steering"}), set_to(silent=set()), 14),
    Reason.DRIVE_STALE: (set_to(silent={"drive"}), set_to(silent=set()), 12),
    Reason.TILT_STOP: (set_to(tilt=0.4), set_to(tilt=0.0), 1),
    Reason.TICK_STALLED: (stall, lambda _: None, 1),
    Reason.DRIVE_FAULT: (set_to(fault=True), set_to(fault=False), 1),
    Reason.BATTERY_CRITICAL: (set_to(level=BatteryLevel.CRITICAL), set_to(level=BatteryLevel.NORMAL), 1),
    Reason.SERVICE_FAILED: (fail_a_service, repair_it, 1),
    Reason.STEERING_DEAD: (kill_the_steering, lambda _: None, 1),
}
DISARM = {Reason.DRIVE_FAULT, Reason.BATTERY_CRITICAL, Reason.SERVICE_FAILED, Reason.STEERING_DEAD}
QUICK = {Reason.DRIVE_STALE, Reason.DRIVE_FAULT, Reason.TICK_STALLED, Reason.SERVICE_FAILED}


@pytest.mark.parametrize("reason", FAULTS)
def test_a_short_fault_disarms_or_does_not_and_is_a_quick_stop_or_is_not(reason):
    begin, end, ticks = FAULTS[reason]
    rig = Rig().driving()
    begin(rig)
    rig.tick(ticks)
    assert rig.out.mode is GateMode.STOPPING
    assert rig.out.reasons[0] is reason
    assert rig.out.speeds[0] == rig.out.speed_limit == 0.0
    assert (rig.out.action is DriveAction.QUICK_STOP) is (reason in QUICK)
    assert (rig.trips[-1].reason, rig.trips[-1].quick) == (reason, reason in QUICK)
    end(rig)
    rig.tick(40)
    assert (rig.out.mode is GateMode.DISARMED) is (reason in DISARM)
    assert rig.out.mode in (GateMode.DISARMED, GateMode.DRIVING)


@pytest.mark.parametrize("reason", FAULTS)
def test_an_armed_truck_is_disarmed_by_the_same_faults(reason):
    begin, _, ticks = FAULTS[reason]
    rig = Rig().armed()
    begin(rig)
    rig.tick(ticks + 1)
    assert (rig.out.mode is GateMode.DISARMED) is (reason in DISARM)


# How old a sample may be


def monitor(chassis=CHASSIS, **config):
    return Monitor(chassis, **config)


SAMPLES = {
    Reason.SCAN_STALE: (lambda m, at: show(m, scan(at)), 250),
    Reason.ATTITUDE_STALE: (lambda m, at: show(m, attitude(at)), 250),
    Reason.STEERING_STALE: (lambda m, at: show(m, servos(at)), 250),
    Reason.DRIVE_STALE: (lambda m, at: show(m, feedback(at)), 200),
}


@pytest.mark.parametrize("reason", SAMPLES)
def test_a_sample_is_fresh_to_the_end_of_its_time_and_no_longer(reason):
    observe, limit = SAMPLES[reason]
    sensors = monitor()
    observe(sensors, SECOND)
    last = SECOND + limit * MS
    assert reason not in sensors.assess(last).blocks
    assert reason in sensors.assess(last + 1).blocks
    stale = sensors.staleness(reason, last + 50 * MS)
    assert (stale.since, stale.age, stale.limit) == (last, pytest.approx(limit / 1000 + 0.05), limit / 1000)


@pytest.mark.parametrize("reason", SAMPLES)
def test_the_newest_sample_counts_from_when_it_arrived(reason):
    observe, limit = SAMPLES[reason]
    sensors = monitor()
    observe(sensors, SECOND)
    observe(sensors, 2 * SECOND)
    assert reason not in sensors.assess(2 * SECOND + limit * MS).blocks


@pytest.mark.parametrize(("late", "valid"), [(400, True), (401, False), (-400, True), (-401, False)])
def test_a_sample_may_be_so_late_and_no_later(late, valid):
    sensors = monitor()
    message = scan(10 * SECOND).model_copy(update={"received": 10 * SECOND + late * MS})
    show(sensors, message)
    assert (sensors.scans[0] is message) is valid


def test_a_sample_of_the_instant_of_the_loss_is_from_before_it():
    sensors = monitor()
    show(sensors, scan(SECOND))
    show(sensors, health(SECOND, ServiceState.BACKOFF, "lidar"))
    assert Reason.SCAN_STALE in sensors.assess(SECOND).blocks
    show(sensors, health(SECOND, ServiceState.READY, "lidar"))
    show(sensors, scan(SECOND + 1))
    assert Reason.SCAN_STALE not in sensors.assess(SECOND + 1).blocks


def test_an_earlier_loss_does_not_replace_a_later_one():
    sensors = monitor(BODIES["differential"])
    for shaft in range(2):
        show(sensors, feedback(3 * SECOND), shaft)
    show(sensors, health(3 * SECOND, ServiceState.BACKOFF, "drive"))
    show(sensors, health(2 * SECOND, ServiceState.BACKOFF, "drive_2"))
    assert sensors.speed(3 * SECOND) is None


def test_what_stops_the_truck_is_reported_in_this_order():
    sensors = monitor(battery={"stale_after": 1.0, "critical": True})
    show(sensors, health(0, ServiceState.FAILED, "slam"))
    assert sensors.assess(SECOND).blocks == (
        Reason.SERVICE_FAILED,
        Reason.DRIVE_STALE,
        Reason.STEERING_STALE,
        Reason.SCAN_STALE,
        Reason.ATTITUDE_STALE,
        Reason.BATTERY_STALE,
    )


def test_standstill_is_a_sample_slower_than_its_limit_taken_since():
    sensors = monitor()
    show(sensors, feedback(SECOND, 0.0099))
    assert sensors.at_rest(SECOND, SECOND)
    assert not sensors.at_rest(SECOND, SECOND + 1)
    for speed in (0.0101, -0.0101):
        show(sensors, feedback(SECOND, speed))
        assert not sensors.at_rest(SECOND)


# Tilt


@pytest.mark.parametrize(("limit", "reason"), [(0.21, Reason.TILT_SLOW), (0.35, Reason.TILT_STOP)])
def test_a_tilt_counts_from_its_limit_on_and_until_it_is_less_by_the_hysteresis(limit, reason):
    sensors = monitor()

    def tilted(angle):
        show(sensors, attitude(SECOND, pitch=-angle))
        found = sensors.assess(SECOND)
        return reason in found.blocks or reason in found.limits

    assert not tilted(limit - 0.001)
    assert tilted(limit + 0.001)
    assert tilted(limit - 0.034)
    assert not tilted(limit - 0.036)
    assert not tilted(limit - 0.034)


@pytest.mark.parametrize("name", ["slow", "stop"])
def test_a_tilt_at_its_very_limit_counts(name):
    limits, sensors = TiltLimits(), monitor()
    show(sensors, attitude(SECOND))
    limit, reason = getattr(limits, name), Reason[f"TILT_{name.upper()}"]
    for angle, counts in (
        (math.nextafter(limit, 0.0), False),
        (limit, True),
        (limit - limits.hysteresis, True),
        (math.nextafter(limit - limits.hysteresis, 0.0), False),
    ):
        sensors.samples.tilt = angle
        check_of(sensors, TiltCheck).observe(sensors.attitude, COMPASS)
        found = sensors.assess(SECOND)
        assert (reason in found.blocks or reason in found.limits) is counts


# Requests


@pytest.mark.parametrize("axle", ["front", "rear"])
@pytest.mark.parametrize("side", [1, -1])
def test_either_axle_beyond_its_limit_is_clipped_at_it(axle, side):
    rig = Rig(angle=0.3)
    rig.driving(speed=0.1, **{axle: side * 0.31})
    assert Reason.CLIPPED in rig.out.reasons
    assert getattr(rig.out, axle) == pytest.approx(side * 0.3, abs=1e-6)
    inside = Rig(angle=0.3)
    inside.driving(speed=0.1, **{axle: side * 0.29})
    assert Reason.CLIPPED not in inside.out.reasons


@pytest.mark.parametrize(("speed", "limit"), [(0.21, 0.21), (-0.15, 0.15)])
def test_each_direction_is_clipped_at_its_own_limit(speed, limit):
    at, beyond = (Rig(obstacle=ANY_GROUND).driving(speed=share * speed) for share in (1.0, 1.01))
    assert Reason.CLIPPED not in at.out.reasons
    assert Reason.CLIPPED in beyond.out.reasons
    assert abs(beyond.out.speeds[0]) == pytest.approx(limit)
    assert beyond.out.speed_limit == pytest.approx(limit)


def test_a_change_of_direction_passes_through_standstill():
    rig = Rig(deceleration=0.5, acceleration=0.5).driving(speed=0.2)
    rig.driver = {"speed": -0.1}
    speeds = []
    for _ in range(60):
        rig.tick()
        speeds.append(rig.out.speeds[0])
    assert 0.0 in speeds
    assert speeds == sorted(speeds, reverse=True)
    assert speeds[-1] == pytest.approx(-0.1)


# Who drives


def test_the_one_who_drives_goes_on_driving_among_equals():
    rig = Rig().driving(source="ann", speed=0.1)
    rig.driver = None
    for _ in range(20):
        rig.drive(source="ann", speed=0.1)
        assert rig.drive(source="bob", speed=0.1) is Reason.BUSY
        rig.tick()
        assert rig.out.holder == "ann"
    for _ in range(20):  # whatever the order in which they ask
        rig.drive(source="bob", speed=0.1)
        rig.drive(source="ann", speed=0.1)
        rig.tick()
        assert rig.out.holder == "ann"


def test_an_operator_at_rest_still_drives_before_one_that_moves():
    rig = Rig().driving(source="ann", speed=0.0)
    assert rig.drive(source="bob", speed=0.1) is Reason.BUSY
    rig.tick()
    assert rig.out.holder == "ann"


def test_of_the_planners_the_one_that_moves_drives():
    rig = Rig().armed()
    rig.drive(speed=0.0, **TRACK)
    rig.tick()
    assert rig.out.holder == "track"
    assert rig.drive(speed=0.1, **GOALS) is Reason.OK
    rig.tick()
    assert rig.out.holder == "goals"


@pytest.mark.parametrize(
    ("first", "then"), [(Role.GAMEPAD, Role.KEYBOARD), (Role.KEYBOARD, Role.STATION), (Role.STATION, Role.TRACKER)]
)
@pytest.mark.parametrize("how", ["drives", "stops"])
def test_whoever_drove_or_stopped_keeps_lower_roles_out_until_armed(first, then, how):
    rig = Rig(disarm_after=10.0).armed()
    lower = {"source": "low", "role": then, "inside": then is Role.TRACKER}
    if how == "drives":
        rig.drive(source="high", role=first, speed=0.0)
        rig.tick()
        assert rig.out.holder == "high"
    else:
        rig.order(Order.STOP, source="high", role=first)
    rig.tick(60)
    assert rig.out.mode is GateMode.ARMED
    rig.drive(speed=0.0, **lower)
    assert rig.drive(speed=0.1, **lower) is Reason.LOWER_PRIORITY
    rig.tick()
    assert rig.out.holder is None
    assert rig.drive(source="same", role=first, speed=0.0) is Reason.OK
    rig.tick(60)
    assert rig.order(Order.ARM) is Reason.OK
    assert rig.drive(speed=0.1, **lower) is Reason.OK


def test_whoever_drove_for_a_single_tick_keeps_lower_roles_out_too():
    rig = Rig().armed()
    rig.drive(source="high", role=Role.GAMEPAD, speed=0.0, lease=0.03)
    rig.tick()
    assert rig.out.holder == "high"
    rig.tick(2)
    assert (rig.out.mode, rig.out.holder) == (GateMode.ARMED, None)
    assert rig.drive(source="low", role=Role.STATION, speed=0.0) is Reason.LOWER_PRIORITY


def test_an_order_to_arm_while_somebody_drives_lets_lower_roles_drive_afterwards():
    rig = Rig().armed()
    rig.drive(source="high", role=Role.GAMEPAD, speed=0.0)
    rig.tick()
    assert rig.order(Order.ARM) is Reason.OK
    rig.drive(source="high", role=Role.GAMEPAD, speed=0.0)
    rig.tick()
    assert rig.out.holder == "high"
    rig.tick(20)
    assert rig.drive(source="low", role=Role.STATION, speed=0.0) is Reason.OK


def test_who_drives_after_such_an_order_keeps_them_out_again():
    rig = Rig().armed()
    rig.drive(source="high", role=Role.GAMEPAD, speed=0.0)
    rig.tick()
    assert rig.order(Order.ARM) is Reason.OK
    for speed in (0.1, 0.0):
        for _ in range(30):
            rig.drive(source="high", role=Role.GAMEPAD, speed=speed, lease=0.1)
            rig.tick()
    for _ in range(20):
        assert rig.drive(source="tracker", role=Role.TRACKER, inside=True) is Reason.LOWER_PRIORITY
        rig.tick()
    assert (rig.out.mode, rig.out.holder) == (GateMode.ARMED, None)


@pytest.mark.parametrize("role", [Role.GAMEPAD, Role.KEYBOARD, Role.STATION])
def test_a_lease_runs_to_its_last_instant(role):
    rig = Rig(leases={role.value: 0.2}).armed()
    rig.drive(role=role, lease=1.0, speed=0.1)
    rig.tick()
    granted = rig.now - TICK + SECOND // 5
    while rig.now < granted:
        rig.tick()
    assert rig.now == granted
    assert (rig.out.mode, rig.out.lease_left) == (GateMode.DRIVING, 0.0)
    rig.tick()
    assert rig.out.mode is GateMode.STOPPING


@pytest.mark.parametrize(("order", "needs"), [(Order.ARM, True), (Order.RESET, True), (Order.DISARM, False)])
def test_only_what_may_set_the_truck_in_motion_must_be_fresh(order, needs):
    rig = Rig()
    rig.tick(40)
    stale = rig.order(order, gate_stamp=rig.now - SECOND // 2 - 1)
    assert stale is (Reason.LEASE_EXPIRED if needs else Reason.OK)
    assert rig.order(order, gate_stamp=rig.now - SECOND // 2) is Reason.OK


# Arming, stopping, disarming


def test_a_truck_that_is_being_stopped_or_rolls_or_is_asked_to_move_is_not_armed():
    rig = Rig().driving()
    rig.order(Order.STOP)
    rig.tick(2)
    assert rig.out.mode is GateMode.STOPPING
    rig.driver = None
    assert rig.order(Order.ARM) is Reason.NOT_ARMED_SPEED
    rig = Rig()
    rig.speed = 0.05
    rig.sense()
    assert rig.order(Order.ARM) is Reason.NOT_ARMED_SPEED


def test_a_stopping_truck_at_rest_is_not_armed_before_the_gate_has_seen_it_rest():
    rig = Rig().driving()
    rig.order(Order.STOP)
    rig.driver, rig.speed = None, 0.0
    rig.now += SECOND
    rig.sense()
    assert rig.gate.mode is GateMode.STOPPING
    assert rig.order(Order.ARM) is Reason.NOT_ARMED_SPEED


def test_a_disarm_order_while_stopping_counts_at_rest_and_not_later():
    rig = Rig().driving()
    rig.order(Order.STOP)
    rig.tick()
    assert rig.order(Order.DISARM) is Reason.OK
    assert rig.gate.mode is GateMode.STOPPING
    rig.driver = None
    rig.tick(40)
    assert rig.out.mode is GateMode.DISARMED
    assert rig.order(Order.ARM) is Reason.OK
    rig.tick(20)
    assert rig.out.mode is GateMode.ARMED, "the order does not count twice"


@pytest.mark.parametrize("check", ["turning", "blocked"])
def test_a_truck_without_one_of_the_checks_is_armed_driven_and_disarmed_all_the_same(check):
    rig = Rig(**{check: None}).driving()
    assert rig.order(Order.DISARM) is Reason.OK
    rig.driver = None
    rig.tick(40)
    assert rig.out.mode is GateMode.DISARMED
    assert rig.order(Order.ARM) is Reason.OK


def test_a_disarm_order_while_driving_stops_by_the_ordinary_ramp_first():
    rig = Rig().driving()
    assert rig.order(Order.DISARM) is Reason.OK
    rig.tick()
    assert (rig.out.mode, rig.out.action, rig.out.speeds[0]) == (GateMode.STOPPING, DriveAction.RUN, 0.0)
    assert rig.trips[-1].ordered
    rig.tick(40)
    assert rig.out.mode is GateMode.DISARMED
    assert len(rig.trips) == 1


def test_an_armed_truck_nobody_drives_disarms_after_its_time_and_arming_anew_restarts_it():
    rig = Rig(disarm_after=1.0).armed()
    armed = rig.gate._states.driven
    rig.tick(30)
    assert rig.order(Order.ARM) is Reason.OK
    assert rig.gate._states.driven == armed + 31 * TICK
    while rig.now < armed + 31 * TICK + SECOND:
        rig.tick()
        assert rig.out.mode is GateMode.ARMED
    rig.tick()
    assert rig.out.mode is GateMode.DISARMED


def test_a_long_pause_between_ticks_does_not_make_the_command_jump():
    rig = Rig(tick_stall=0.5).armed()
    rig.drive(speed=0.2)
    rig.tick()
    before = rig.out.speeds[0]
    rig.now += 9 * TICK
    rig.drive(speed=0.2)
    rig.tick()
    assert rig.out.mode is GateMode.DRIVING
    assert rig.out.speeds[0] - before == pytest.approx(0.5 * 2 * 0.02), "two ticks' worth, not ten"


def test_a_pause_is_a_stall_beyond_its_limit_and_lasts_its_dwell():
    rig = Rig().driving()
    rig.now += 130 * MS
    rig.tick()
    assert rig.out.mode is GateMode.DRIVING, "150 ms between two ticks are none"
    rig.now += 131 * MS
    rig.tick()
    stalled = rig.now
    assert rig.out.reasons == (Reason.TICK_STALLED,)
    while rig.now < stalled + SECOND // 2 - TICK:
        rig.tick()
        assert Reason.TICK_STALLED in rig.out.reasons
    rig.tick()
    assert Reason.TICK_STALLED not in rig.out.reasons


# Shafts


def test_every_shaft_counts_for_speed_rest_and_faults():
    sensors = monitor(BODIES["differential"])
    show(sensors, feedback(SECOND, 0.1), 0)
    assert sensors.speed(SECOND) is None
    show(sensors, feedback(SECOND - 10 * MS, -0.2), 1)
    assert sensors.speed(SECOND) == pytest.approx(-0.2)
    assert sensors.shaft_speeds(SECOND) == pytest.approx((0.1, -0.2))
    show(sensors, feedback(SECOND, 0.0), 0)
    assert not sensors.at_rest(SECOND)
    show(sensors, feedback(SECOND - 10 * MS, 0.0), 1)
    assert sensors.at_rest(SECOND, SECOND - 10 * MS)
    assert not sensors.at_rest(SECOND, SECOND - 9 * MS), "the oldest sample counts"
    show(sensors, feedback(SECOND, 0.0, DriveMode.FAULT, 0x1000), 1)
    assert sensors.assess(SECOND).blocks[0] is Reason.DRIVE_FAULT
    assert sensors.assess(SECOND).values["drive_fault_code"] == 0x1000


@pytest.mark.parametrize("shaft", [0, 1])
def test_the_age_of_the_drive_is_that_of_its_oldest_shaft(shaft):
    sensors = monitor(BODIES["differential"])
    show(sensors, feedback(SECOND), shaft)
    show(sensors, feedback(SECOND + 150 * MS), 1 - shaft)
    assert sensors.staleness(Reason.DRIVE_STALE, SECOND + 250 * MS).age == pytest.approx(0.25)
    assert Reason.DRIVE_STALE in sensors.assess(SECOND + 201 * MS).blocks


# Obstacles

FOOTPRINT = Footprint()
FRONT = FOOTPRINT.half_length
STRAIGHT = ((1.0, 0.0, 0.0),)


def guard(**config):
    return ObstacleGuard(InForce(GateConfig(**config)), FOOTPRINT, [ScanPoints((0.14, 0.0, 0.0))])


def free_to(wall, now=SECOND, **config):
    checked = guard(**config)
    checked.observe(scan(now, (FRONT + wall, 0.0)))
    return checked


@pytest.mark.parametrize("wall", [0.1, 0.2, 0.3])
def test_the_free_distance_ends_before_the_obstacle(wall):
    # A point of the sweep every 18 mm, padded by the clearance to all sides, and the beam nearest to the wall.
    free = free_to(wall).free_distance(STRAIGHT)
    assert wall - 0.02 - 0.02 <= free <= wall - 0.02 + 0.002


def test_an_obstacle_beyond_reach_is_none():
    config = GateConfig()
    reach = 0.05 + 0.21 * (0.25 + 0.4 + 0.08) + 0.21**2 / (2 * 0.15)
    assert guard()._reach == pytest.approx(reach)
    assert free_to(reach + 0.05).free_distance(STRAIGHT) == math.inf
    assert free_to(reach - 0.02).free_distance(STRAIGHT) < reach
    assert config.obstacle.ahead == 0.05


@pytest.mark.parametrize(("side", "clear"), [(0.0, False), (0.02 - 0.006, False), (0.02 + 0.006, True)])
@pytest.mark.parametrize("sign", [1, -1])
def test_what_is_passed_keeps_its_clearance(side, clear, sign):
    checked = guard()
    checked.observe(scan(SECOND, (0.4, sign * (FOOTPRINT.half_width + side))))
    assert (checked.free_distance(STRAIGHT) == math.inf) is clear


@pytest.mark.parametrize("age", [0.0, 0.2])
@pytest.mark.parametrize("free", [0.1, 0.2, 0.35])
def test_the_allowed_speed_stops_in_what_is_free_after_delay_and_braking(age, free):
    checked = free_to(1.0)
    allowed = checked.allowed_speed(free, SECOND + round(age * SECOND))
    delay = age + 0.08
    assert allowed * delay + allowed**2 / (2 * 0.15) == pytest.approx(free - 0.05)


def test_what_lies_within_the_distance_kept_allows_nothing_and_nothing_in_reach_everything():
    checked = free_to(1.0)
    assert checked.allowed_speed(0.05, SECOND) == 0.0
    assert checked.allowed_speed(0.0, SECOND) == 0.0
    assert checked.allowed_speed(math.inf, SECOND) == math.inf


@pytest.mark.parametrize("age", [0.0, 0.2])
@pytest.mark.parametrize("speed", [0.2, -0.2])
def test_an_obstacle_is_too_near_if_delay_and_braking_need_more(age, speed):
    checked = free_to(1.0)
    needed = 0.2 * (age + 0.08) + 0.2**2 / (2 * 1.0)
    now = SECOND + round(age * SECOND)
    assert checked.too_near(needed - 1e-6, speed, now)
    assert not checked.too_near(needed + 1e-6, speed, now)


def test_the_nearest_of_all_ways_counts():
    checked = guard()
    checked.observe(scan(SECOND, (FRONT + 0.2, 0.0)))
    assert checked.free_distance(((-1.0, 0.0, 0.0),)) == math.inf
    assert checked.free_distance((*STRAIGHT, (-1.0, 0.0, 0.0))) < 0.2


def test_a_new_scan_replaces_the_old_one():
    checked = free_to(0.2)
    assert checked.free_distance(STRAIGHT) < 0.2
    checked.observe(scan(SECOND + TICK))
    assert checked.free_distance(STRAIGHT) == math.inf


def test_driving_on_needs_twice_the_speed_at_which_it_stopped():
    def at(wall, rig):
        rig.obstacles = tuple((FRONT + wall, y / 100) for y in range(-15, 16, 5))
        rig.tick()
        return Reason.OBSTACLE_STOP in rig.out.reasons

    def allowed(crawl):
        return crawl * 0.08 + crawl**2 / 0.3 + 0.05 + 0.02

    rig = Rig(acceleration=0.5).armed()
    rig.driver = {"speed": 0.1}
    assert not at(allowed(0.02) + 0.02, rig)
    assert at(allowed(0.02) - 0.002, rig)
    assert at(allowed(0.04) - 0.002, rig), "twice as much"
    assert not at(allowed(0.04) + 0.02, rig)


def test_a_motor_that_claims_any_speed_does_not_end_the_gate():
    rig = Rig().armed()
    show(rig.gate, feedback(rig.now).model_copy(update={"velocity": 1e300}))
    rig.tick(sense=False)
    assert math.isfinite(rig.out.stopping_distance)


def test_the_stopping_distance_counts_reaction_and_braking_at_the_greater_speed():
    rig = Rig().driving(speed=0.2)
    rig.tick()
    assert rig.out.stopping_distance == pytest.approx(0.2 * 0.08 + 0.2**2 / 2)
    rig.order(Order.STOP)
    rig.tick()
    assert rig.out.speeds[0] == 0.0
    measured = 0.2
    assert rig.out.stopping_distance == pytest.approx(measured * 0.08 + measured**2 / 2, rel=0.01)


@pytest.mark.parametrize("speed", [0.1, -0.1])
def test_an_obstacle_behind_a_stopped_truck_is_no_emergency(speed):
    rig = Rig().driving(speed=speed)
    rig.obstacles = ((FRONT + 0.03, 0.0),)
    rig.tick()
    assert (rig.out.action is DriveAction.QUICK_STOP) is (speed > 0)


def test_steering_turns_at_its_rate_and_only_while_driving():
    rig = Rig(steering_rate=0.5).armed()
    rig.driver = {"speed": 0.1, "front": 0.3}
    rig.tick(1)
    first = rig.out.front
    rig.tick(10)
    assert rig.out.front - first == pytest.approx(0.5 * 0.2, rel=0.1)
    held = rig.out.front
    rig.driver = None
    rig.order(Order.STOP)
    rig.tick(20)
    assert rig.out.front == pytest.approx(held, abs=0.011)


def test_speed_grows_and_falls_at_its_own_rates():
    rig = Rig(acceleration=0.25, deceleration=1.0, quick_deceleration=1.2).armed()
    rig.driver = {"speed": 0.2}
    rig.tick(2)
    before = rig.out.speeds[0]
    rig.tick(10)
    assert rig.out.speeds[0] - before == pytest.approx(0.25 * 0.2)
    rig.tick(60)
    rig.driver = {"speed": 0.1}
    rig.tick(2)
    assert rig.out.speeds[0] == pytest.approx(0.2 - 1.0 * 0.04)


def test_a_robot_of_two_shafts_is_shown_its_second_speed():
    robot = Robot("differential", obstacle=ANY_GROUND)
    robot.armed()
    robot.driver = {"vx": 0.1, "wz": 0.2}
    robot.tick(60)
    left, right = robot.out.speeds
    assert right - left == pytest.approx(0.2 * 0.26, rel=0.01)
    assert robot.out.twist == pytest.approx((0.1, 0.0, 0.2))


def test_servos_follow_the_linkage():
    rig = Rig().driving(speed=0.1, front=0.2, rear=-0.1, ticks=60)
    assert rig.gate._chassis.steering(*rig.out.servos) == pytest.approx((rig.out.front, rig.out.rear), abs=1e-3)


def test_a_battery_that_is_low_or_critical_at_its_very_sample():
    sensors = monitor()
    show(sensors, battery(SECOND, BatteryLevel.LOW, 21.5))
    found = sensors.assess(SECOND)
    assert (found.limits, found.values["battery_voltage"]) == ({Reason.BATTERY_LOW: 0.1}, 21.5)
    assert Reason.BATTERY_STALE not in sensors.assess(3 * SECOND).limits
    assert sensors.assess(3 * SECOND + 1).limits == {Reason.BATTERY_LOW: 0.1, Reason.BATTERY_STALE: 0.1}
