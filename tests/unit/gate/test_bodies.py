"""The gate in front of bodies that are not the truck."""

import pytest

from monstertruck_kinematics.chassis import Dimensions, differential_chassis
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.sensor import DriveMode
from monstertruck_schemas.state import GateMode
from tests.unit.gate.rig import ANY_GROUND, DRIVETRAIN, Rig, attitude, feedback, health, make_gate, scan, show

DIFFERENTIAL = differential_chassis(Dimensions(DRIVETRAIN))


class TwoWheels(Rig):
    """A differential drive: no servos, two motors; ``dead`` ones do not report, ``broken`` ones are in fault."""

    def __init__(self, **config):
        super().__init__(**config)
        self.gate = make_gate(chassis=DIFFERENTIAL, **config)
        self.speeds = [0.0, 0.0]
        self.dead = set()
        self.broken = set()

    def sense(self):
        show(self.gate, scan(self.now))
        show(self.gate, attitude(self.now))
        for shaft, speed in enumerate(self.speeds):
            if shaft not in self.dead:
                mode = DriveMode.FAULT if shaft in self.broken else DriveMode.ENABLED
                show(self.gate, feedback(self.now, speed, mode, 0x2310 if shaft in self.broken else None), shaft)

    def _obey(self):
        self.speeds = list(self.out.speeds) if self.out.action is DriveAction.RUN else [0.0, 0.0]


def test_a_turn_is_two_wheel_speeds_and_no_servo():
    rig = TwoWheels().driving(speed=0.1, front=0.3)
    assert rig.out.speeds == pytest.approx(DIFFERENTIAL.shaft_speeds(0.1, 0.3, 0.0))
    assert rig.out.motor_velocities == pytest.approx([DRIVETRAIN.motor_rate(speed) for speed in rig.out.speeds])
    assert rig.out.servos == (0.0, 0.0)
    assert rig.out.reasons == ()


def test_no_wheel_is_faster_than_allowed_and_the_curvature_stays():
    rig = TwoWheels(obstacle=ANY_GROUND).driving(speed=0.3, front=0.4, ticks=80)
    left, right = rig.out.speeds
    assert max(left, right) == pytest.approx(0.21)
    whole = DIFFERENTIAL.shaft_speeds(1.0, 0.4, 0.0)
    assert left / right == pytest.approx(whole[0] / whole[1])
    assert Reason.CLIPPED in rig.out.reasons


@pytest.mark.parametrize("rear", [0.2, -0.2])
def test_crab_and_counter_steer_are_refused_by_name_and_move_nothing(rear):
    rig = TwoWheels().armed()
    assert rig.drive(speed=0.1, front=0.2, rear=rear) is Reason.IMPOSSIBLE_MOTION
    rig.tick(5)
    assert rig.out.mode is GateMode.ARMED
    [event] = rig.reported(Reason.IMPOSSIBLE_MOTION)
    assert f"rear is {rear}: expected 0" in event.text


@pytest.mark.parametrize("shaft", [0, 1])
def test_one_silent_shaft_stops_all(shaft):
    rig = TwoWheels().driving(speed=0.15)
    rig.dead = {shaft}
    rig.tick(20)
    assert Reason.DRIVE_STALE in rig.out.reasons
    assert rig.out.reasons.count(Reason.DRIVE_STALE) == 1
    assert (rig.out.action, rig.out.speeds) == (DriveAction.QUICK_STOP, (0.0, 0.0))


def test_one_fault_stops_and_disarms():
    rig = TwoWheels().driving(speed=0.15)
    rig.broken = {1}
    rig.tick()
    assert rig.out.action is DriveAction.QUICK_STOP
    assert rig.reported(Reason.DRIVE_FAULT)[0].values["drive_fault_code"] == 0x2310
    rig.tick(50)
    assert rig.out.mode is GateMode.DISARMED


def test_it_stands_only_when_both_wheels_do():
    rig = TwoWheels()
    rig.tick(2)
    rig.speeds = [0.0, 0.05]
    rig.sense()
    assert rig.order(Order.ARM) is Reason.NOT_ARMED_SPEED
    rig.speeds = [0.0, 0.0]
    rig.sense()
    assert rig.order(Order.ARM) is Reason.OK


def test_a_lost_second_shaft_counts_until_it_delivers_again():
    rig = TwoWheels().driving(speed=0.15)
    show(rig.gate, health(rig.now, ServiceState.BACKOFF, "drive_2"))
    rig.tick(sense=False)
    assert Reason.DRIVE_STALE in rig.out.reasons
    rig.tick(2)
    assert Reason.DRIVE_STALE not in rig.out.reasons


def test_the_tightest_turn_is_that_of_the_largest_angle():
    rig = TwoWheels().driving(speed=0.1, front=1.2, ticks=80)
    assert (rig.out.front, rig.out.rear) == (pytest.approx(0.436), 0.0)
