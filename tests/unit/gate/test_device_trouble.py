"""Trouble of drive and steering: a shaft that does not turn, a controller that restarts, short faults that repeat."""

import pytest

from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode
from tests.unit.gate.rig import Rig, feedback, health


def held(rig, ticks):
    """The shaft does not turn, whatever is commanded."""
    for _ in range(ticks):
        rig.speed = 0.0
        rig.tick()


@pytest.mark.parametrize("speed", [0.2, -0.1])
def test_a_blocked_shaft_stops_and_disarms_within_a_second(speed):
    rig = Rig().driving(speed=speed)
    held(rig, 50)
    assert rig.trips[0].reason is Reason.SHAFT_BLOCKED
    assert rig.out.mode is GateMode.DISARMED
    rig.driver = None
    rig.tick(60)
    assert rig.order(Order.ARM) is Reason.OK


def test_a_slow_shaft_is_not_blocked():
    rig = Rig().driving(speed=0.2)
    for _ in range(100):
        rig.speed = 0.03
        rig.tick()
    assert Reason.SHAFT_BLOCKED not in {trip.reason for trip in rig.trips}


def test_the_blocked_shafts_current_is_in_the_stops_causes():
    rig = Rig().driving(speed=0.2)
    rig.gate.observe_drive(feedback(rig.now, 0.0).model_copy(update={"current": 2.0}))
    held(rig, 50)
    figures = {figure.name: figure.value for figure in rig.trips[0].causes[0].measurements}
    assert figures["motor current"] == 2.0


def test_a_drive_controller_that_restarted_disarms():
    rig = Rig().driving(speed=0.2)
    rig.gate.observe_health(health(rig.now, ServiceState.BACKOFF, "drive", reason=Reason.DEVICE_RESTARTED))
    rig.tick(3)
    rig.gate.observe_health(health(rig.now, ServiceState.READY, "drive"))
    rig.tick(60)
    assert rig.out.mode is GateMode.DISARMED
    assert Reason.DEVICE_RESTARTED in {trip.reason for trip in rig.trips} | {
        cause.reason for trip in rig.trips for cause in trip.causes
    }


def test_one_that_was_unplugged_for_a_moment_does_not():
    rig = Rig().driving(speed=0.2)
    rig.gate.observe_health(health(rig.now, ServiceState.BACKOFF, "drive", reason=Reason.DEVICE_LOST))
    rig.tick(3)
    rig.gate.observe_health(health(rig.now, ServiceState.READY, "drive"))
    rig.tick(60)
    assert rig.out.mode is GateMode.DRIVING


@pytest.mark.parametrize(("faults", "mode"), [(3, GateMode.DRIVING), (4, GateMode.DISARMED)])
def test_short_faults_that_repeat_disarm(faults, mode):
    rig = Rig().driving(speed=0.2)
    for _ in range(faults):
        rig.silent = {"drive"}
        rig.tick(15)
        rig.silent = set()
        rig.tick(60)
    assert rig.out.mode is mode
    assert (Reason.FAULTS_REPEAT in {event.reason for event in rig.events}) is (mode is GateMode.DISARMED)
