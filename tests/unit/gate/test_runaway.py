"""Motion that nobody commanded: what is found, what is not, and what the gate does about it."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.sensor import (
    DriveMode,
    Imu,
    StabiliserFeedback,
    StabiliserJoint,
    TorqueState,
    Vector3,
    WheelEncoders,
)
from monstertruck_schemas.state import Consistency, GateMode, UnshownMotion
from monstertruckd.gate.config import GateConfig, RunawayConfig
from monstertruckd.gate.runaway import MAX_ORDERS, BodyWatch, RunawayKind, ShaftBounds, ShaftWatch
from tests.unit.gate.rig import DRIVETRAIN, Rig, feedback, header

CONFIG, GATE = RunawayConfig(), GateConfig()
TICK, PERIOD = SECOND // 50, SECOND // 20
METRES = DRIVETRAIN.distance(1.0)


class Shaft:
    """A shaft with its controller: takes orders after a while, ramps, is read every 50 ms."""

    def __init__(self, reaction=0.05, deceleration=2.0, current=0.1):
        self.watch = ShaftWatch("drive")
        self.now = SECOND
        self.speed = self.position = self.target = 0.0
        self.mode, self.current = DriveMode.ENABLED, current
        self.disobeys = lambda target, _speed: target
        self.reads = lambda speed: speed
        self.found = []
        self._reaction, self._deceleration = reaction, deceleration
        self._orders = []
        self._read_at = 0

    def run(self, seconds, order=0.0, period=PERIOD):
        """Order a speed for a time; returns what was found, with the seconds since the beginning."""
        began = self.now
        for _ in range(round(seconds * SECOND / TICK)):
            self.now += TICK
            self.watch.bounds.order(self.now, order)
            self._orders.append((self.now + round(self._reaction * SECOND), order))
            while self._orders and self._orders[0][0] <= self.now:
                self.target = self._orders.pop(0)[1]
            self._move(TICK / SECOND)
            if self.now - self._read_at >= period:
                self._read_at = self.now
                self._read(began)
        return self.found

    def _move(self, dt):
        if self.mode is DriveMode.ENABLED:
            wanted = self.disobeys(self.target, self.speed)
            change = wanted - self.speed
            step = self._deceleration * dt
            self.speed += min(max(change, -step), step)
        self.position += self.speed * dt

    def _read(self, began):
        read = feedback(self.now, self.reads(self.speed), self.mode, current=self.current, position=self.position)
        found = self.watch.observe(read, METRES, CONFIG, GATE.reaction, GATE.deceleration, GATE.standstill)
        if found is not None:
            self.found.append((found.kind, round((self.now - began) / SECOND, 3)))


# Bounds


def test_an_order_is_in_force_until_the_drive_was_heard_after_the_reaction_time():
    bounds = ShaftBounds()
    bounds.order(0, 0.2)
    bounds.order(SECOND, 0.0)
    bounds.follow(SECOND, SECOND + PERIOD, 0.08, 1.0)
    assert (bounds.low, bounds.high) == (0.0, 0.2)
    bounds.follow(SECOND + PERIOD, 3 * SECOND, 0.08, 1.0)
    assert bounds.high == 0.2, "what was not heard for two seconds may not have received anything"
    bounds.follow(3 * SECOND, 3 * SECOND + PERIOD, 0.08, 1.0)
    assert bounds.high == pytest.approx(0.2 - 0.05)
    bounds.follow(3 * SECOND + PERIOD, 4 * SECOND, 0.08, 1.0)
    assert (bounds.low, bounds.high) == (0.0, 0.0)


def test_an_order_backwards_leaves_the_way_down_to_the_ramp():
    bounds = ShaftBounds()
    bounds.begin(0.2)
    bounds.order(SECOND, -0.1)
    bounds.follow(2 * SECOND, 2 * SECOND + PERIOD, 0.08, 1.0)
    assert (bounds.low, bounds.high) == pytest.approx((-0.1, 0.15))
    assert bounds.ordered == -0.1


def test_orders_that_pile_up_while_the_drive_is_silent_are_merged_and_lose_nothing():
    bounds = ShaftBounds()
    for step in range(10 * MAX_ORDERS):
        bounds.order(step * TICK, 0.2 if step == 3 else -0.001 * (step % 7))
    assert len(bounds._orders) == MAX_ORDERS
    bounds.follow(0, 10 * MAX_ORDERS * TICK, 0.08, 1.0)
    assert (bounds.low, bounds.high) == pytest.approx((-0.006, 0.2))


# Runaways


@pytest.mark.parametrize("ordered", [0.3, 0.15, -0.15])
def test_a_shaft_that_ignores_slower_targets_is_found_within_half_a_second(ordered):
    shaft = Shaft()
    assert shaft.run(2.0, ordered) == []
    shaft.disobeys = lambda target, speed: target if abs(target) > abs(speed) else speed
    (first, *_) = shaft.run(0.6, 0.0)
    assert first[0] is RunawayKind.DOES_NOT_STOP
    assert first[1] <= 0.45


@pytest.mark.parametrize("creep", [0.03, 0.12, -0.12])
def test_a_shaft_that_creeps_is_found_within_half_a_second(creep):
    shaft = Shaft()
    shaft.run(1.0)
    shaft.disobeys = lambda _target, _speed: creep
    (first, *_) = shaft.run(0.6)
    assert first[0] is RunawayKind.NO_ORDER
    assert first[1] <= 0.45


def test_a_creep_too_slow_for_the_velocity_is_found_by_the_position():
    shaft = Shaft()
    shaft.run(1.0)
    shaft.disobeys = lambda _target, _speed: 0.005
    ((kind, at), *_) = shaft.run(4.0)
    assert kind is RunawayKind.NO_ORDER
    assert at == pytest.approx(CONFIG.distance / 0.004, abs=0.2)


@pytest.mark.parametrize(
    ("ordered", "made", "kind"),
    [
        (0.1, 0.2, RunawayKind.TOO_FAST),
        (0.1, -0.1, RunawayKind.OPPOSITE),
        (-0.1, 0.05, RunawayKind.OPPOSITE),
    ],
)
def test_a_shaft_that_turns_faster_or_the_other_way_is_found_within_half_a_second(ordered, made, kind):
    shaft = Shaft()
    shaft.run(1.0, ordered)
    shaft.disobeys = lambda _target, _speed: made
    (first, *_) = shaft.run(0.6, ordered)
    assert first[0] is kind
    assert first[1] <= 0.45


@pytest.mark.parametrize("ordered", [0.0, 0.15])
def test_a_position_that_runs_while_the_velocity_reads_zero_is_found(ordered):
    shaft = Shaft()
    shaft.run(1.0, ordered)
    shaft.reads = lambda _speed: 0.0
    shaft.disobeys = lambda target, _speed: target or 0.12
    (first, *_) = shaft.run(0.6, ordered)
    assert first[0] is RunawayKind.VELOCITY_LIES
    assert first[1] <= 0.45


def test_a_motor_that_is_off_and_draws_no_current_is_pushed_not_running_away():
    shaft = Shaft()
    shaft.run(1.0)
    shaft.mode, shaft.current, shaft.speed = DriveMode.DISABLED, 0.01, 0.4
    assert shaft.run(3.0) == []
    assert not shaft.watch.driven


@pytest.mark.parametrize("current", [0.08, -0.3, None])
def test_a_motor_that_is_off_but_draws_current_or_may_do_so_is_running_away(current):
    shaft = Shaft(current=current)
    shaft.mode, shaft.speed = DriveMode.DISABLED, 0.2
    assert shaft.run(1.0)


def test_the_current_of_another_mode_shows_nothing():
    shaft = Shaft(current=0.4)
    shaft.run(1.0, 0.2)
    shaft.mode, shaft.current = DriveMode.FAULT, None
    assert shaft.run(1.0) == [], "it coasts, and its current has not been read yet"


@pytest.mark.parametrize(("share", "pulls"), [(0.95, False), (1.0, False), (1.01, True), (-1.01, True)])
def test_a_current_above_that_of_an_idle_motor_may_move_the_body(share, pulls):
    shaft = Shaft(current=share * CONFIG.idle_current)
    shaft.run(0.2)
    assert shaft.watch.pulls(CONFIG, fresh=True) is pulls


def test_the_bounds_of_a_shaft_that_was_never_ordered_are_standstill():
    bounds = ShaftBounds()
    assert (bounds.low, bounds.high, bounds.furthest, bounds.rearmost, bounds.ordered) == (0.0,) * 5


@pytest.mark.parametrize(("share", "found"), [(0.95, False), (1.0, True), (-1.0, True)])
def test_a_body_moves_from_the_speed_of_standstill_on(share, found):
    watch, results = BodyWatch("imu", 0.5), []
    for tick in range(600):
        speed = share * GATE.standstill
        results.append(watch.observe(tick * TICK, speed, CONFIG, GATE.standstill, standing=True, driven=True))
    assert any(results) is found


# What is none


@settings(max_examples=60, deadline=None)
@given(
    orders=st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(0.05, 1.5)), min_size=1, max_size=8),
    reaction=st.floats(0.0, 0.08),
    deceleration=st.floats(1.0, 6.0),
    period=st.integers(1, 20),
)
@example(orders=[(0.0, 0.75)] * 2 + [(0.0, 0.71875), (0.28125, 1.0625)], reaction=0.0, deceleration=1.0, period=17)
def test_an_obedient_shaft_is_never_found(orders, reaction, deceleration, period):
    shaft = Shaft(reaction, deceleration)
    for order, seconds in orders:
        shaft.run(seconds, order, period * TICK)
    shaft.run(1.0, 0.0, period * TICK)
    assert shaft.found == []


def test_a_shaft_that_turns_slower_than_ordered_or_stands_is_no_runaway():
    shaft = Shaft()
    shaft.disobeys = lambda target, _speed: 0.3 * target
    shaft.run(2.0, 0.2)
    shaft.disobeys = lambda _target, _speed: 0.0
    shaft.run(2.0, 0.2)
    assert shaft.found == []


def test_a_motor_found_turning_by_a_new_daemon_has_its_ramp_to_stop():
    shaft = Shaft()
    shaft.speed = 0.2
    assert shaft.run(2.0) == []


# The gate


def runaway(rig, speed=0.15, ticks=40):
    """The drive keeps a speed despite all commands; ticks until the gate reports it."""
    rig.driver = None
    for tick in range(ticks):
        rig.speed = speed
        rig.tick()
        if rig.reported(Reason.UNCOMMANDED_MOTION):
            return (tick + 1) / 50
    return None


def test_a_drive_that_does_not_stop_after_an_emergency_stop_loses_its_power_stage():
    rig = Rig().driving()
    rig.order(Order.ESTOP)
    took = runaway(rig)
    assert took <= 0.5
    (event,) = rig.reported(Reason.UNCOMMANDED_MOTION)
    assert event.severity is Severity.ERROR
    assert "power stage off" in event.text
    assert f"drive {RunawayKind.DOES_NOT_STOP} at 0.15" in event.text
    assert event.values["speed"] == pytest.approx(0.15)
    assert rig.out.action is DriveAction.DISABLE
    assert rig.trips[-1].reason is Reason.UNCOMMANDED_MOTION
    assert rig.out.reasons[:2] == (Reason.ESTOPPED, Reason.UNCOMMANDED_MOTION)
    assert not rig.out.port_off


def test_a_drive_that_still_turns_without_its_power_stage_loses_its_port():
    rig = Rig().driving()
    rig.order(Order.ESTOP)
    runaway(rig)
    rig.events.clear()
    assert runaway(rig) <= 0.5
    assert rig.out.port_off
    assert "by hand" in rig.reported(Reason.UNCOMMANDED_MOTION)[0].text


def test_a_drive_that_runs_by_itself_while_driving_gets_a_quick_stop_first_and_the_emergency_stop_latches():
    rig = Rig().driving()
    rig.driver = {"speed": 0.1}
    rig.tick(100)
    for _ in range(25):
        rig.speed = 0.2
        rig.tick()
        if rig.out.mode is GateMode.ESTOPPED:
            break
    assert (rig.out.mode, rig.out.action, rig.out.speeds) == (GateMode.ESTOPPED, DriveAction.QUICK_STOP, (0.0,))
    rig.driver = None
    rig.tick(1)
    rig.speed = 0.0
    rig.tick(50)
    assert rig.out.action is DriveAction.QUICK_STOP, "it obeyed"


@pytest.mark.parametrize("mode", [GateMode.DISARMED, GateMode.ARMED, GateMode.STOPPING])
def test_it_is_found_in_every_mode(mode):
    rig = Rig()
    if mode is not GateMode.DISARMED:
        rig.armed()
    if mode is GateMode.STOPPING:
        rig.driver = {"speed": 0.2}
        rig.tick(60)
        rig.order(Order.STOP)
    rig.tick(0 if mode is GateMode.STOPPING else 20)
    assert rig.out is None or rig.out.mode is not GateMode.ESTOPPED
    assert runaway(rig, 0.2) <= 0.5
    assert rig.out.mode is GateMode.ESTOPPED


def test_arming_waits_for_an_operator_who_clears_it_and_clearing_for_standstill():
    rig = Rig().driving()
    rig.order(Order.ESTOP)
    runaway(rig)
    assert rig.order(Order.RESET) is Reason.NOT_ARMED_SPEED
    assert rig.order(Order.ARM) is Reason.ESTOPPED
    rig.mode, rig.current, rig.speed = DriveMode.DISABLED, 0.0, 0.0
    rig.tick(20)
    assert rig.out.action is DriveAction.DISABLE
    assert rig.order(Order.RESET) == "ok"
    rig.tick(2)
    assert rig.out.reasons == (Reason.DISARMED,)
    assert rig.order(Order.ARM) == "ok"


def test_a_stop_is_over_only_when_standstill_is_measured():
    rig = Rig().driving()
    rig.driver = None
    rig.order(Order.ESTOP)
    rig.speed = 0.2
    rig.tick()
    assert rig.out.mode is GateMode.ESTOPPED
    assert rig.out.stopping
    rig.speed = 0.005
    rig.tick()
    assert not rig.out.stopping


def test_a_disarmed_truck_whose_drive_falls_silent_is_still_stopping():
    rig = Rig().armed()
    rig.silent = {"drive"}
    rig.tick(2)
    rig.order(Order.DISARM)
    rig.tick(100)
    assert rig.out.mode is GateMode.DISARMED
    assert rig.out.stopping
    rig.silent = set()
    rig.tick()
    assert not rig.out.stopping


def test_a_truck_that_was_never_armed_is_not_stopping_nor_is_one_that_is_pushed():
    rig = Rig()
    rig.mode, rig.current = DriveMode.DISABLED, 0.0
    for speed in (0.0, 0.3, 0.0):
        rig.speed = speed
        rig.tick(20)
        assert not rig.out.stopping
    assert rig.out.mode is GateMode.DISARMED


# The second source


def turned(rig, wheel, wz=0.0):
    """Free wheels turn by an angle (rad), and the body at a rate (rad/s)."""
    angle = {"left": wheel, "right": wheel}
    rig.gate.observe(WheelEncoders(**header(rig.now), **angle), topics.ENCODERS)
    rate, force = Vector3(x=0.01, y=0.0, z=wz), Vector3(x=0.0, y=0.0, z=9.81)
    imu = Imu(**header(rig.now), angular_velocity=rate, linear_acceleration=force)
    rig.gate.observe(imu, topics.IMU)


def moved(rig, speed, wz=0.0, ticks=60):
    """Seconds until motion of the body is found."""
    for tick in range(ticks):
        turned(rig, (tick + 1) * speed / 50 / 0.075, wz)
        rig.tick()
        if rig.out.mode is GateMode.ESTOPPED and rig.reported(Reason.UNCOMMANDED_MOTION):
            return (tick + 1) / 50
    return None


@pytest.mark.parametrize(("speed", "wz"), [(0.2, 0.0), (-0.2, 0.0), (0.0, 1.0)])
def test_a_body_that_moves_while_its_drive_reads_standstill_is_found(speed, wz):
    rig = Rig().armed()
    rig.current = 0.3
    rig.driver = {"speed": 0.0}
    rig.tick(30)
    assert moved(rig, speed, wz) <= 0.5
    text = rig.reported(Reason.UNCOMMANDED_MOTION)[0].text
    assert "reports standstill while" in text
    assert text.endswith("power stage off"), "a drive that reads standstill cannot confirm a quick stop"


def test_a_body_that_moves_after_a_stop_is_found_after_days_as_well():
    rig = Rig()
    rig.now = 10**6 * SECOND
    rig.driving()
    rig.current = 0.3
    rig.tick(5)
    rig.silent = {"drive"}
    rig.order(Order.ESTOP)
    assert moved(rig, 0.2) <= 1.0


def test_a_body_that_moves_after_a_stop_while_the_drive_is_lost_is_found():
    rig = Rig().driving()
    rig.current = 0.3
    rig.tick(5)
    rig.silent = {"drive"}
    rig.order(Order.ESTOP)
    assert moved(rig, 0.2) <= 1.0


def test_a_robot_that_falls_over_or_slides_down_is_moved_by_its_weight():
    rig = Rig().armed()
    rig.current, rig.driver, rig.tilt = 0.3, {"speed": 0.0}, 0.5
    rig.tick(30)
    assert moved(rig, 0.5, 2.0) is None


def test_while_a_robot_falls_its_last_tilt_holds():
    """Its acceleration hides the tilt from the sensor, which goes on to deliver."""
    rig = Rig().armed()
    rig.current, rig.driver, rig.tilt = 0.3, {"speed": 0.0}, 0.5
    rig.tick(30)
    rig.tilt_valid = False
    rig.tick(100)
    assert moved(rig, 0.5, 2.0) is None


def test_a_tilt_that_is_no_longer_measured_hides_no_motion():
    rig = Rig().armed()
    rig.current, rig.driver, rig.tilt = 0.3, {"speed": 0.0}, 0.5
    rig.tick(30)
    rig.silent = {"attitude"}
    rig.tick(100)
    assert moved(rig, 0.2) is not None


def test_an_emergency_stopped_truck_whose_motor_draws_no_current_may_be_carried():
    rig = Rig().driving()
    rig.current = 0.0
    rig.driver = None
    rig.order(Order.ESTOP)
    rig.tick(50)
    assert moved(rig, 0.5, 2.0) is None


def test_free_wheels_that_roll_as_ordered_and_unwind_after_a_stop_are_none():
    rig = Rig().driving()
    rig.current = 0.3
    angle = 0.0
    for tick in range(150):
        speed = 0.2 if tick < 100 else max(0.0, 0.2 - 0.02 * (tick - 100))
        rig.driver = {"speed": 0.2} if tick < 100 else {"speed": 0.0}
        angle += speed / 50 / 0.075
        turned(rig, angle)
        rig.tick()
    assert not rig.reported(Reason.UNCOMMANDED_MOTION)


def shown(rig, since, distance, turn=0.0):
    """The scans prove that the body has moved since ``since``, ns."""
    motion = UnshownMotion(since=since, stamp=rig.now, distance=distance, turn=turn)
    rig.gate.observe(Consistency(**header(rig.now), measures=("wheels", "scans"), unshown=motion), topics.CONSISTENCY)


@pytest.mark.parametrize(("distance", "turn"), [(0.2, 0.0), (0.0, 1.0)])
@pytest.mark.parametrize("current", [0.3, 0.0])
def test_motion_that_the_scans_alone_show_is_found_if_a_motor_may_make_it(distance, turn, current):
    rig = Rig().armed()
    rig.current, rig.driver = current, {"speed": 0.0}
    rig.tick(30)
    since = rig.now
    rig.tick(25)
    shown(rig, since, distance / 2, turn / 2)
    rig.tick()
    events = rig.reported(Reason.UNCOMMANDED_MOTION)
    assert bool(events) is (current > 0)
    assert (rig.out.mode is GateMode.ESTOPPED) is (current > 0)
    if current:
        assert events[0].text.startswith("lidar reports standstill while the body moves")


def test_short_motions_of_the_scans_that_follow_each_other_count_together():
    """A robot that turns about one wheel moves little before its points prove it."""
    rig = Rig().armed()
    rig.current, rig.driver = 0.3, {"speed": 0.0}
    rig.tick(30)
    for apart in (5, 0):
        since = rig.now
        for _ in range(3):
            rig.tick(15)
            stamp = rig.now
            shown(rig, since + apart, 0.006)
            since = stamp
        rig.tick()
        assert bool(rig.reported(Reason.UNCOMMANDED_MOTION)) is (apart == 0)


def test_a_motion_of_the_scans_that_is_published_again_counts_once():
    """The lidar falls silent after a short motion that the points prove."""
    rig = Rig().armed()
    rig.current, rig.driver = 0.3, {"speed": 0.0}
    rig.tick(30)
    motion = UnshownMotion(since=rig.now - SECOND, stamp=rig.now, distance=0.006, turn=0.0)
    for _ in range(5):
        rig.gate.observe(Consistency(**header(rig.now), measures=("wheels",), unshown=motion), topics.CONSISTENCY)
        rig.tick(50)
    assert not rig.reported(Reason.UNCOMMANDED_MOTION)


@pytest.mark.parametrize("late", [0, 25])
def test_a_motion_that_the_scans_prove_late_is_taken_to_go_on(late):
    rig = Rig().armed()
    rig.current, rig.driver = 0.3, {"speed": 0.0}
    rig.tick(50)
    motion = UnshownMotion(since=rig.now - SECOND // 2, stamp=rig.now, distance=0.006, turn=0.0)
    rig.tick(late)
    rig.gate.observe(Consistency(**header(rig.now), measures=("wheels",), unshown=motion), topics.CONSISTENCY)
    rig.tick()
    assert bool(rig.reported(Reason.UNCOMMANDED_MOTION)) is bool(late)


@pytest.mark.parametrize("braking", [True, False])
def test_a_motion_whose_scans_span_the_braking_is_none_without_an_order(braking):
    """The body coasts on for some millimetres after the motor has stopped."""
    rig = Rig().driving()
    rig.current = 0.3
    rig.tick(10)
    braked = rig.now
    rig.driver = {"speed": 0.0}
    rig.order(Order.ESTOP)
    rig.tick(9)
    stood = rig.now
    rig.tick(5)
    shown(rig, braked if braking else stood, 0.03)
    rig.tick()
    assert bool(rig.reported(Reason.UNCOMMANDED_MOTION)) is not braking


@pytest.mark.parametrize("current", [0.3, None])
def test_a_drive_that_reads_rest_need_not_obey_any_further_if_its_current_shows_what_pulls(current):
    rig = Rig().driving()
    rig.current = current
    rig.tick(10)
    rig.driver = {"speed": 0.0}
    rig.order(Order.ESTOP)
    rig.tick(9)
    since = rig.now
    rig.tick(5)
    shown(rig, since, 0.015)
    rig.tick()
    assert bool(rig.reported(Reason.UNCOMMANDED_MOTION)) is (current is not None)


@pytest.mark.parametrize("current", [0.3, None])
@pytest.mark.parametrize("later", [0, 12])
def test_a_motion_from_before_the_power_stage_was_switched_on_is_none_of_a_motor(current, later):
    """Scans that change while the robot waits, for instance those of a faulty lidar."""
    rig = Rig().armed()
    rig.current, rig.driver, rig.mode = current and 0.0, {"speed": 0.0}, DriveMode.DISABLED
    rig.tick(30)
    since = rig.now
    rig.tick(30)
    shown(rig, since, 0.03)
    rig.mode, rig.current = DriveMode.ENABLED, current
    rig.tick(later)
    shown(rig, since, 0.03)
    rig.tick(3)
    assert not rig.reported(Reason.UNCOMMANDED_MOTION)
    since = rig.now
    rig.tick(30)
    shown(rig, since, 0.03)
    rig.tick()
    assert rig.reported(Reason.UNCOMMANDED_MOTION)


def test_a_motion_that_is_proven_before_the_current_is_measured_is_judged_by_it():
    rig = Rig().armed()
    rig.current, rig.driver = 0.3, {"speed": 0.0}
    rig.tick(30)
    rig.mode, rig.current = DriveMode.QUICK_STOP, None
    since = rig.now
    rig.tick(10)
    shown(rig, since, 0.02)
    rig.tick(2)
    assert not rig.reported(Reason.UNCOMMANDED_MOTION)
    rig.current = 0.3
    rig.tick(3)
    assert rig.reported(Reason.UNCOMMANDED_MOTION)


def test_one_motion_of_the_scans_takes_one_step():
    """The power stage is off as soon as it is found; the window of the next proof holds motion from before."""
    rig = Rig().armed()
    rig.current, rig.driver = 0.3, {"speed": 0.0}
    rig.tick(30)
    since = rig.now
    rig.tick(10)
    shown(rig, since, 0.02)
    rig.tick(3)
    shown(rig, since, 0.025)
    rig.tick()
    (step,) = {event.text for event in rig.reported(Reason.UNCOMMANDED_MOTION)}
    assert step.endswith("power stage off")


def test_motion_from_before_the_drives_obeyed_does_not_count():
    rig = Rig().driving()
    rig.current = 0.3
    since = rig.now
    rig.tick(40)
    rig.driver = {"speed": 0.0}
    rig.tick(30)
    shown(rig, since, 0.012 * (rig.now - since) / SECOND)
    rig.tick()
    assert not rig.reported(Reason.UNCOMMANDED_MOTION)


def test_a_joint_that_strays_keeps_the_robot_from_being_armed_until_an_operator_clears_it():
    rig = Rig().armed()
    joint = StabiliserJoint(torque=TorqueState.HOLDING)
    stray = joint.model_copy(update={"torque": TorqueState.LIMP, "strays": 1})
    for pitch in (joint, stray, stray):
        message = StabiliserFeedback(**header(rig.now), pitch_joint=pitch, roll_joint=joint)
        rig.gate.observe(message, topics.STABILISER)
        rig.tick()
    event = rig.reported(Reason.UNCOMMANDED_MOTION)[-1]
    assert event.text == "stabiliser moved away from its target by itself; quick stop"
    assert rig.out.action is DriveAction.QUICK_STOP
    assert rig.out.mode is GateMode.ESTOPPED
    assert rig.order(Order.ARM) is Reason.ESTOPPED
    rig.order(Order.RESET)
    rig.tick(2)
    assert Reason.UNCOMMANDED_MOTION not in rig.out.reasons
    rig.tick(60)
    assert rig.order(Order.ARM) is Reason.OK


def test_it_can_be_configured_not_to_look():
    rig = Rig(runaway=None).driving()
    rig.order(Order.ESTOP)
    assert runaway(rig) is None
