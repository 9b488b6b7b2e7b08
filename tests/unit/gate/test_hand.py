"""What the radio control of the operator beside the robot makes the gate do."""

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.sensor import HandControls
from monstertruck_schemas.state import GateMode
from monstertruckd.bus.access import EVERYTHING
from monstertruckd.gate.hand import HandConfig, HandPolicy

MS = SECOND // 1000


def controls(now, **values):
    plain = {"speed": 0.0, "steer": 0.0, "arm": False, "drive": True, "lost": False, "link_quality": 1.0}
    return HandControls(stamp=now, received=now, seq=0, **(plain | values))


def test_off_then_on_arms_once_and_the_sticks_drive():
    policy = HandPolicy(HandConfig())
    assert policy.step(controls(0), GateMode.DISARMED, 0).orders == ()
    armed = policy.step(controls(1, arm=True), GateMode.DISARMED, 1)
    assert (armed.orders, armed.drives) == ((Order.ARM,), True)
    again = policy.step(controls(2, arm=True), GateMode.DISARMED, 2)
    assert (again.orders, again.drives) == ((), True)


def test_a_switch_that_is_on_from_the_beginning_does_not_arm():
    policy = HandPolicy(HandConfig())
    assert policy.step(controls(0, arm=True), GateMode.DISARMED, 0).orders == ()


@pytest.mark.parametrize("mode", [GateMode.ARMED, GateMode.DRIVING])
def test_off_stops_and_disarms_whoever_has_armed_and_again_until_it_stands(mode):
    policy = HandPolicy(HandConfig())
    stop = (Order.STOP, Order.DISARM)
    assert policy.step(controls(0), mode, 0).orders == stop
    assert policy.step(controls(50 * MS), mode, 50 * MS).orders == ()
    assert policy.step(controls(250 * MS), mode, 250 * MS).orders == stop
    assert policy.step(controls(300 * MS), GateMode.DISARMED, 300 * MS).orders == ()


@pytest.mark.parametrize(
    ("seen", "why"),
    [
        (None, "no data from the receiver"),
        (controls(0, arm=True), "silent for more than 0.25 s"),
        (controls(SECOND, arm=True, lost=True), "has lost the transmitter"),
        (controls(SECOND, arm=True, link_quality=0.2), "link quality 20%: at least 30% is needed"),
    ],
)
def test_the_loss_of_the_transmitter_is_a_stop_and_the_switch_must_be_seen_off_again(seen, why):
    policy = HandPolicy(HandConfig())
    policy.step(controls(0), GateMode.DISARMED, 0)
    policy.step(controls(1, arm=True), GateMode.DISARMED, 1)
    found = policy.step(seen, GateMode.DRIVING, SECOND)
    assert found.orders == (Order.STOP, Order.DISARM)
    assert not found.drives
    assert why in found.lost
    back = policy.step(controls(2 * SECOND, arm=True), GateMode.DISARMED, 2 * SECOND)
    assert back.orders == ()
    policy.step(controls(3 * SECOND), GateMode.DISARMED, 3 * SECOND)
    assert policy.step(controls(3 * SECOND, arm=True), GateMode.DISARMED, 3 * SECOND).orders == (Order.ARM,)


def test_an_unknown_quality_is_no_loss_and_the_drive_switch_lets_others_drive():
    policy = HandPolicy(HandConfig())
    policy.step(controls(0), GateMode.DISARMED, 0)
    found = policy.step(controls(1, arm=True, drive=False, link_quality=None), GateMode.DISARMED, 1)
    assert (found.orders, found.drives, found.lost) == ((Order.ARM,), False, None)


def test_the_emergency_stop_switch_holds_the_robot_though_another_client_resets_it():
    policy = HandPolicy(HandConfig())
    assert policy.step(controls(0, estop=True), GateMode.DRIVING, 0).orders[0] is Order.ESTOP
    assert Order.ESTOP not in policy.step(controls(1, estop=True), GateMode.ESTOPPED, 1).orders
    found = policy.step(controls(2, estop=True, arm=True), GateMode.DISARMED, 2)
    assert (found.orders, found.drives) == ((Order.ESTOP,), False)
    policy.step(controls(3), GateMode.DISARMED, 3)
    assert policy.step(controls(4, arm=True), GateMode.DISARMED, 4).orders == (Order.ARM,)


def test_nobody_outside_can_claim_to_be_the_hand():
    assert EVERYTHING.capped(Role.HAND) is Role.GAMEPAD
    assert EVERYTHING.capped(Role.KEYBOARD) is Role.KEYBOARD
