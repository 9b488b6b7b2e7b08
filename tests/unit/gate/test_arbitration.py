import math
from itertools import pairwise

import pytest

from monstertruck_drivers.maestro.config import ServoConfig
from monstertruck_kinematics.chassis import Dimensions, truck_chassis
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, RequestedTwist, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.config import GateConfig
from monstertruckd.gate.core import Decision
from tests.unit.gate.rig import ANY_GROUND, CHASSIS, DRIVETRAIN, STEERING, TICK, Rig


def seconds(ticks):
    return ticks * TICK / SECOND


def test_starts_disarmed_and_powerless():
    out = Rig().tick()
    assert out.mode is GateMode.DISARMED
    assert out.action is DriveAction.DISABLE
    assert (out.speeds[0], out.front, out.rear, out.speed_limit) == (0, 0, 0, 0)
    assert out.reasons == (Reason.DISARMED,)


def test_arm_drive_and_let_go():
    rig = Rig().armed()
    assert rig.out.action is DriveAction.RUN
    assert rig.out.speeds[0] == 0
    rig.driver = {"speed": 0.2}
    rig.tick(40)
    assert rig.out.mode is GateMode.DRIVING
    assert (rig.out.holder, rig.out.role) == ("ann", Role.GAMEPAD)
    assert rig.out.speeds[0] == pytest.approx(0.2)
    assert rig.out.motor_velocities[0] == pytest.approx(DRIVETRAIN.motor_rate(0.2))
    assert rig.out.lease_left == pytest.approx(0.25)
    assert rig.out.last_seq == rig._seq
    assert rig.out.stopping_distance == pytest.approx(0.2 * 0.08 + 0.04 / 2.0)
    assert [e.reason for e in rig.events] == [Reason.ARMED, Reason.DRIVING]


def test_a_lapsed_lease_stops_within_300_ms_and_stands_within_300_more():
    rig = Rig().driving()
    rig.driver = None
    ticks = 0
    while rig.out.mode is GateMode.DRIVING:
        rig.tick()
        ticks += 1
    assert seconds(ticks) <= 0.3
    assert (rig.out.action, rig.out.speeds[0]) == (DriveAction.RUN, 0.0)
    assert rig.out.mode is GateMode.STOPPING
    assert rig.out.reasons == (Reason.LEASE_EXPIRED,)
    assert rig.out.speed_limit == 0
    assert rig.reported(Reason.LEASE_EXPIRED)
    ticks = 0
    while rig.out.mode is GateMode.STOPPING:
        rig.tick()
        ticks += 1
    assert seconds(ticks) <= 0.3
    assert rig.out.mode is GateMode.ARMED
    assert rig.reported(Reason.STOPPED)


def speed_of(rig):
    vx, vy, _ = rig.out.twist
    return math.copysign(math.hypot(vx, vy), vx)


def let_go(rig):
    """Show a neutral request for a moment, then fall silent until the lease is over."""
    rig.driver = {"speed": 0.0}
    rig.tick(50)
    assert rig.out.mode is GateMode.DRIVING
    rig.driver = None
    while rig.out.mode is GateMode.DRIVING:
        rig.tick()


def test_who_lets_go_of_a_truck_at_rest_does_not_stop_it():
    rig = Rig().driving()
    let_go(rig)
    assert (rig.out.mode, rig.out.holder, rig.out.reasons) == (GateMode.ARMED, None, ())
    assert (rig.out.action, rig.out.speeds[0]) == (DriveAction.RUN, 0.0)
    assert rig.trips == []
    (reported,) = rig.reported(Reason.STOPPED)
    assert (reported.severity, reported.text) == (Severity.INFO, "ann released control")
    assert not rig.reported(Reason.LEASE_EXPIRED)
    rig.driver = {"speed": 0.2}
    rig.tick(5)
    assert rig.out.mode is GateMode.DRIVING, "the same source goes on"
    rig.driver = None
    rig.tick(40)
    assert [trip.reason for trip in rig.trips] == [Reason.LEASE_EXPIRED], "silence while driving is a stop"


def test_who_falls_silent_while_the_truck_still_rolls_stops_it():
    rig = Rig(runaway=None).driving()
    for tick in range(70):
        rig.driver = {"speed": 0.0} if tick < 50 else None
        rig.speed = 0.1
        rig.tick()
    assert rig.out.mode is GateMode.STOPPING
    assert [trip.reason for trip in rig.trips] == [Reason.LEASE_EXPIRED]


def test_nobody_for_a_while_disarms():
    rig = Rig().driving()
    rig.driver = None
    rig.tick(round(1.4 / 0.02))
    assert rig.out.mode is GateMode.ARMED
    rig.tick(round(0.4 / 0.02))
    assert rig.out.mode is GateMode.DISARMED
    assert rig.out.action is DriveAction.DISABLE
    assert "1.5 s" in rig.reported(Reason.DISARMED)[0].text


def test_armed_but_never_driven_disarms():
    rig = Rig().armed()
    rig.tick(76)
    assert rig.out.mode is GateMode.DISARMED


def test_a_request_while_stopping_waits_for_standstill():
    rig = Rig().driving()
    rig.driver = None
    while rig.out.mode is not GateMode.STOPPING:
        rig.tick()
    rig.driver = {"speed": 0.2}
    rig.tick()
    assert (rig.out.mode, rig.out.speeds[0]) == (GateMode.STOPPING, 0.0)
    while rig.out.mode is GateMode.STOPPING:
        assert rig.out.speeds[0] == 0.0
        rig.tick()
    rig.tick()
    assert rig.out.mode is GateMode.DRIVING


def test_standstill_needs_a_sample_from_after_the_stop():
    rig = Rig().driving(speed=0.0)
    rig.silent = {"drive"}
    rig.driver = None
    while rig.out.mode is GateMode.DRIVING:
        rig.tick()
    rig.tick()
    assert rig.out.mode is GateMode.STOPPING
    rig.silent = set()
    rig.tick()
    assert rig.out.mode is GateMode.ARMED


def test_motion_limits_hold_on_the_way_up_and_down():
    rig = Rig(obstacle=ANY_GROUND).armed()
    rig.driver = {"speed": 0.21, "front": 0.3, "rear": -0.15}
    speeds, fronts = [0.0], [0.0]
    for _ in range(40):
        rig.tick()
        speeds.append(speed_of(rig))
        fronts.append(rig.out.front)
        assert rig.out.rear == pytest.approx(-rig.out.front / 2)
    # Of the base or the wheels, whichever is faster.
    assert max(b - a for a, b in pairwise(speeds)) == pytest.approx(0.5 * 0.02, rel=2e-3)
    assert max(b - a for a, b in pairwise(fronts)) == pytest.approx(1.0 * 0.02)
    rig.driver = {"speed": -0.1, "front": 0.3, "rear": -0.15}
    before = rig.out.speeds[0]
    rig.tick()
    assert before - rig.out.speeds[0] == pytest.approx(1.0 * 0.02)
    passed = [speed_of(rig) for _ in range(30) if rig.tick()]
    assert 0.0 in passed  # never straight through zero
    assert passed[-1] == pytest.approx(-0.1)


def test_clipping_keeps_the_curvature():
    rig = Rig().driving(speed=0.5, front=0.6, rear=-0.1, ticks=80)
    assert STEERING.curvature(rig.out.front, rig.out.rear) == pytest.approx(STEERING.curvature(0.6, -0.1))
    assert max(abs(rig.out.front), abs(rig.out.rear)) <= 0.436 + 1e-12
    assert rig.out.speeds[0] == pytest.approx(0.21)  # of the wheels
    assert Reason.CLIPPED in rig.out.reasons
    assert len(rig.reported(Reason.CLIPPED)) == 1
    rig.driver = {"speed": 0.1, "front": 9.0, "rear": -9.0}
    rig.tick(40)
    assert (rig.out.front, rig.out.rear) == pytest.approx((0.4095, -0.4095), abs=1e-4)  # servos at 45 degrees
    assert Reason.SERVO_LIMIT in rig.out.reasons


def test_crab_goes_as_fast_as_straight_and_a_curve_as_fast_as_the_wheels_may():
    assert Rig(obstacle=ANY_GROUND).driving(speed=0.21, front=0.3, rear=0.3).out.speeds[0] == pytest.approx(0.21)
    rig = Rig(obstacle=ANY_GROUND).driving(speed=0.21, front=0.4, rear=-0.4, ticks=80)
    assert rig.out.speeds[0] == pytest.approx(0.21)
    assert speed_of(rig) < 0.2


def test_reversing_has_its_own_limit():
    assert Rig(obstacle=ANY_GROUND).driving(speed=-0.2, ticks=60).out.speeds[0] == pytest.approx(-0.15)


def test_servo_angles_belong_to_the_axle_angles():
    rig = Rig().driving(front=0.2, rear=-0.1)
    assert CHASSIS.steering(*rig.out.servos) == pytest.approx((0.2, -0.1))


@pytest.mark.parametrize("form", ["axles", "twist"])
def test_a_servo_at_the_end_of_its_pulses_is_reported_and_the_curvature_is_what_it_reaches(form):
    """Pulses of 1088 to 1840 us, centre 1439.2: 33.5 degrees of servo to the left, 38.2 to the right."""
    reach = (ServoConfig(channel=0).reach,) * 2
    chassis = truck_chassis(Dimensions(DriveTrain(), servo_ranges=reach))

    def asked(front, rear):
        if form == "axles":
            return {"speed": 0.1, "front": front, "rear": rear}
        vx, vy, wz = STEERING.body_twist(0.1, front, rear)
        return {"speed": 0.0, "twist": RequestedTwist(vx=vx, vy=vy, wz=wz)}

    for front, rear, curvature in ((0.4, -0.4, 2.305), (-0.42, 0.42, -2.472)):
        rig = Rig(chassis=chassis).driving(ticks=80, **asked(front, rear))
        assert Reason.SERVO_LIMIT in rig.out.reasons
        assert Reason.CLIPPED in rig.out.reasons
        assert len(rig.reported(Reason.SERVO_LIMIT)) == 1
        assert chassis.bicycle.curvature(rig.out.front, rig.out.rear) == pytest.approx(curvature, abs=2e-3)
        for servo in rig.out.servos:
            assert reach[0][0] - 1e-4 <= servo <= reach[0][1] + 1e-4
    rig = Rig(chassis=chassis).driving(ticks=80, **asked(0.33, -0.33))
    assert Reason.SERVO_LIMIT not in rig.out.reasons
    assert (rig.out.front, rig.out.rear) == pytest.approx((0.33, -0.33))


# Orders


def test_estop_latches_whoever_asks():
    rig = Rig().driving()
    assert rig.order(Order.ESTOP, source="cy", role=Role.TRACKER, nonce="wrong") == Reason.OK
    rig.tick()
    assert rig.out.mode is GateMode.ESTOPPED
    assert rig.out.action is DriveAction.QUICK_STOP
    assert rig.out.reasons[0] is Reason.ESTOPPED
    assert rig.reported(Reason.ESTOP_REQUESTED)[0].values == {"role": "tracker", "by": "cy"}
    assert rig.reported(Reason.ESTOP_REQUESTED)[0].severity is Severity.ERROR
    rig.tick(100)
    assert rig.out.mode is GateMode.ESTOPPED
    assert rig.out.action is DriveAction.QUICK_STOP
    assert rig.drive() is Reason.ESTOPPED
    rig.driver = None
    assert rig.order(Order.ARM) is Reason.ESTOPPED
    rig.order(Order.ESTOP)
    rig.tick()
    assert len(rig.reported(Reason.ESTOP_REQUESTED)) == 1


def test_estop_is_cleared_by_reset_with_neutral_stick_then_arm():
    rig = Rig(latched=True)
    rig.driver = {"speed": 0.1}
    rig.tick(5)
    assert rig.out.mode is GateMode.ESTOPPED
    assert rig.order(Order.RESET) is Reason.NOT_ARMED_SPEED  # stick
    rig.driver = {"speed": 0.0}
    rig.speed = 0.1
    rig.tick()
    assert rig.order(Order.RESET) is Reason.NOT_ARMED_SPEED  # rolling
    rig.tick(20)
    assert rig.order(Order.RESET, role=Role.TRACKER) is Reason.BAD_ROLE
    assert rig.order(Order.RESET, role=Role.ESTOP) is Reason.BAD_ROLE
    assert rig.order(Order.RESET) is Reason.OK
    rig.tick()
    assert rig.out.mode is GateMode.DISARMED
    assert "reset by ann" in rig.reported(Reason.DISARMED)[0].text
    assert rig.order(Order.ARM) is Reason.OK
    assert rig.order(Order.RESET) is Reason.OK  # nothing to reset
    rig.tick()
    assert rig.out.mode in (GateMode.ARMED, GateMode.DRIVING)


def test_a_refused_reset_says_what_is_not_at_rest():
    rig = Rig(latched=True)
    rig.order(Order.ESTOP)
    rig.speed = 0.1
    rig.tick()
    assert rig.decide(Order.RESET) == Decision(Reason.NOT_ARMED_SPEED, "the robot moves at 0.10 m/s")
    rig.tick(20)
    rig.drive(speed=0.1, source="bob")
    text = "motion is requested by bob: expected a neutral stick"
    assert rig.decide(Order.RESET, source="eve") == Decision(Reason.NOT_ARMED_SPEED, text)
    rig.drive(speed=0.0, source="bob")
    rig.silent = {"drive"}
    rig.tick(15)
    refused = rig.decide(Order.RESET)
    assert refused.reason is Reason.DRIVE_STALE, "whether it is at rest is not known"
    assert "drive" in refused.text


def test_arming_is_refused_while_moving_pushed_or_blocked():
    rig = Rig()
    rig.tick()
    assert rig.order(Order.ARM, role=Role.TRACKER) is Reason.BAD_ROLE
    rig.speed = 0.1
    rig.tick()
    assert rig.order(Order.ARM) is Reason.NOT_ARMED_SPEED
    rig.tick(10)
    rig.drive(speed=0.1)
    assert rig.order(Order.ARM, source="bob") is Reason.NOT_ARMED_SPEED
    rig.tick(15)  # the stick's lease is over
    rig.silent = {"scan"}
    rig.tick(15)
    assert rig.order(Order.ARM) is Reason.SCAN_STALE
    rig.silent = set()
    rig.tick()
    assert rig.order(Order.ARM) is Reason.OK
    assert [e.values["request"] for e in rig.reported(Reason.NOT_ARMED_SPEED)] == ["arm", "arm"]


def test_a_waiting_tracker_does_not_hinder_arming():
    rig = Rig()
    rig.driver = {"speed": 0.2, "source": "track", "role": Role.TRACKER, "inside": True}
    rig.tick(5)
    assert rig.drive(**rig.driver) is Reason.DISARMED
    assert rig.order(Order.ARM, role=Role.STATION) is Reason.OK
    rig.tick(2)
    assert rig.out.mode is GateMode.DRIVING


def test_a_tracker_that_drove_just_now_does_not_hinder_the_reset():
    rig = Rig(latched=True)
    rig.driver = {"speed": 0.2, "source": "track", "role": Role.TRACKER, "inside": True}
    rig.tick(5)
    assert rig.order(Order.RESET) is Reason.OK
    rig.tick()
    assert rig.out.mode is GateMode.DISARMED


def test_disarm_stops_first():
    rig = Rig().driving()
    assert rig.order(Order.DISARM) is Reason.OK
    rig.tick()
    assert (rig.out.mode, rig.out.speeds[0]) == (GateMode.STOPPING, 0.0)
    rig.order(Order.DISARM)  # again while stopping
    rig.tick(20)
    assert rig.out.mode is GateMode.DISARMED
    rig.order(Order.DISARM)  # nothing to do
    rig.driver = None
    rig.tick(20)
    rig.armed()
    rig.order(Order.DISARM)
    rig.tick()
    assert rig.out.mode is GateMode.DISARMED
    assert rig.reported(Reason.DISARMED)


def test_arming_twice_is_no_harm():
    rig = Rig().armed()
    assert rig.order(Order.ARM) is Reason.OK
    rig.tick()
    assert len(rig.reported(Reason.ARMED)) == 1


def test_arming_while_stopping_is_refused():
    rig = Rig().driving()
    rig.order(Order.STOP)
    rig.driver = None
    rig.tick()
    assert rig.out.mode is GateMode.STOPPING
    assert rig.order(Order.ARM) is Reason.NOT_ARMED_SPEED


# Shutdown and the process's own trouble


def test_shutdown_is_a_quick_stop_for_good():
    rig = Rig().driving()
    out = rig.gate.neutral(rig.now)
    assert (out.action, out.speeds[0], out.motor_velocities[0]) == (DriveAction.QUICK_STOP, 0.0, 0.0)
    assert out.mode is GateMode.DISARMED
    assert Reason.SHUTDOWN in out.reasons
    assert out.events[-1].reason is Reason.DISARMED
    rig.driver = None
    rig.tick(20)
    assert rig.out.action is DriveAction.QUICK_STOP
    assert rig.order(Order.ARM) is Reason.SHUTDOWN


def test_shutdown_keeps_an_emergency_stop():
    rig = Rig(latched=True)
    assert rig.gate.neutral(rig.now).mode is GateMode.ESTOPPED


def test_a_stalled_tick_stops_quickly_and_recovers():
    rig = Rig().driving()
    rig.now += round(0.2 * SECOND)
    rig.tick()
    assert (rig.out.mode, rig.out.action) == (GateMode.STOPPING, DriveAction.QUICK_STOP)
    assert rig.reported(Reason.TICK_STALLED)
    rig.tick(24)
    assert rig.out.mode is GateMode.ARMED
    rig.tick(3)
    assert rig.out.mode is GateMode.DRIVING


def test_a_drive_that_outlived_the_daemon_is_stopped_while_disarmed():
    rig = Rig()
    rig.speed = 0.2
    rig.tick()
    assert rig.out.action is DriveAction.QUICK_STOP
    rig.tick(10)
    assert rig.out.action is DriveAction.DISABLE


def test_a_truck_without_a_drive_counts_as_standing():
    rig = Rig(drive={"stale_after": 0.2, "critical": False})
    rig.silent = {"drive"}
    rig.tick()
    assert rig.out.action is DriveAction.DISABLE
    assert rig.order(Order.ARM) is Reason.OK


def test_equal_events_are_counted_not_repeated():
    rig = Rig()
    rig.driver = {"speed": 0.1}
    rig.tick(120)
    refusals = rig.reported(Reason.DISARMED)
    assert len(refusals) == 3
    assert refusals[1].values["repeated"] == 49
    assert refusals[0].values == {"role": "gamepad", "request": "drive", "by": "ann"}


@pytest.mark.parametrize(
    ("bad", "hint"),
    [
        ({"quick_deceleration": 0.9}, "quick_deceleration"),
        ({"tick_stall": 0.01}, "tick_stall"),
        ({"standstill": 0.3}, "standstill"),
        ({"disarm_after": 0.2}, "disarm_after"),
        ({"tilt": {"slow": 0.4, "stop": 0.3}}, "slow < stop"),
        ({"tilt": {"slow": 0.02}}, "hysteresis"),
        ({"angle": math.nan}, "angle"),
        ({"leases": {"tracker": 3.0}}, "tracker"),
    ],
)
def test_contradictory_configs_are_refused(bad, hint):
    with pytest.raises(ValueError, match=hint):
        GateConfig.model_validate(bad)
