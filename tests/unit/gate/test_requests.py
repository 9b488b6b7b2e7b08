import math

import pytest

from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.sources import MAX_SOURCES
from tests.unit.gate.rig import Rig

TRACK = {"source": "track", "role": Role.TRACKER}
PAD = {"source": "pad", "role": Role.GAMEPAD}


@pytest.mark.parametrize("field", ["speed", "front", "rear"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_non_finite_requests_are_refused_by_name(field, value):
    rig = Rig().driving()
    assert rig.drive(**{field: value}) is Reason.NOT_FINITE
    rig.tick()
    event = rig.told(Reason.NOT_FINITE)[0]
    assert f"{field} is {value}" in event.text
    assert rig.out.mode is GateMode.DRIVING
    assert rig.out.speed == pytest.approx(0.2)


def test_non_finite_requests_do_not_renew_the_lease():
    rig = Rig().driving()
    rig.driver = {"speed": math.nan}
    rig.tick(14)
    assert rig.out.mode is GateMode.STOPPING


def test_another_runs_nonce_is_refused():
    rig = Rig().armed()
    assert rig.drive(nonce="run-0") is Reason.BAD_NONCE
    assert rig.order(Order.ARM, nonce="run-0") is Reason.BAD_NONCE
    rig.tick(2)
    assert rig.out.mode is GateMode.ARMED


def test_sequences_must_grow_for_each_source_and_kind():
    rig = Rig().armed()
    assert rig.drive(seq=1000) is Reason.OK
    assert rig.drive(seq=1000) is Reason.BAD_SEQUENCE
    assert rig.drive(seq=999) is Reason.BAD_SEQUENCE
    assert rig.drive(speed=0.0, seq=1001) is Reason.OK
    assert rig.order(Order.ARM, seq=1002) is Reason.OK
    assert rig.order(Order.ARM, seq=1002) is Reason.BAD_SEQUENCE
    assert rig.drive(source="bob", seq=5) is Reason.BUSY  # authentic, but ann drives
    assert rig.drive(source="bob", seq=5) is Reason.BAD_SEQUENCE


def test_the_estop_role_cannot_drive():
    assert Rig().armed().drive(role=Role.ESTOP) is Reason.BAD_ROLE


def test_junk_names_run_out():
    rig = Rig().armed()
    for i in range(MAX_SOURCES + 1):
        last = rig.drive(source=f"junk{i}", role=Role.TRACKER)
    assert last is Reason.BUSY
    assert rig.drive(source="junk0", role=Role.TRACKER) is not Reason.BUSY


def test_the_gate_caps_leases_but_keeps_shorter_ones():
    rig = Rig(leases={"station": 0.1}).armed()
    rig.drive(lease=2.0, role=Role.STATION)
    rig.tick()
    assert rig.out.lease_left == pytest.approx(0.08)
    rig.drive(lease=0.03, role=Role.STATION)
    rig.tick(2)
    assert rig.out.mode is GateMode.STOPPING


def test_an_operator_takes_over_from_the_tracker_at_once():
    rig = Rig().driving(**TRACK)
    rig.drive(speed=0.1, **PAD)
    rig.tick()
    assert rig.out.holder == "pad"
    assert rig.drive(**TRACK) is Reason.LOWER_PRIORITY


def test_the_tracker_goes_on_only_after_a_new_arm_order():
    rig = Rig().driving(**TRACK)
    for _ in range(5):
        rig.drive(speed=0.1, **PAD)
        rig.tick()
    rig.tick(40)  # the operator lets go; the tracker keeps asking
    assert rig.out.mode is GateMode.ARMED
    assert rig.drive(**TRACK) is Reason.LOWER_PRIORITY
    assert rig.order(Order.ARM, role=Role.STATION, source="desk") is Reason.OK
    rig.tick(2)
    assert (rig.out.mode, rig.out.holder) == (GateMode.DRIVING, "track")


def test_a_higher_role_may_take_over_again_and_again():
    rig = Rig().driving(source="desk", role=Role.STATION)
    rig.driver = None
    rig.tick(30)
    assert rig.out.mode is GateMode.ARMED
    rig.drive(**PAD)
    rig.tick()
    assert rig.out.holder == "pad"


def test_equals_wait_for_each_other():
    rig = Rig().driving()
    assert rig.drive(source="bob") is Reason.BUSY
    rig.tick()
    assert rig.out.holder == "ann"
    rig.driver = None
    for _ in range(14):
        rig.drive(source="bob")
        rig.tick()
    assert (rig.out.mode, rig.out.holder) == (GateMode.DRIVING, "bob")  # same role: handed over without a gap


def test_keyboard_ranks_between_gamepad_and_station():
    rig = Rig().driving(source="keys", role=Role.KEYBOARD)
    assert rig.drive(source="desk", role=Role.STATION) is Reason.LOWER_PRIORITY
    assert rig.drive(**PAD) is Reason.OK


def test_anybody_may_stop():
    for role in Role:
        rig = Rig().driving()
        assert rig.order(Order.STOP, source="cy", role=role, nonce="any") is Reason.OK
        rig.tick()
        assert (rig.out.mode, rig.out.speed) == (GateMode.STOPPING, 0.0)
        assert "cy" in rig.told(Reason.STOPPED)[0].text


def test_after_a_stop_the_stick_must_return_to_neutral():
    rig = Rig().driving()
    rig.order(Order.STOP, source="ann")
    rig.tick(20)
    assert rig.out.mode is GateMode.ARMED
    assert rig.drive() is Reason.NOT_ARMED_SPEED
    rig.drive(speed=0.0)
    rig.tick()
    assert rig.out.mode is GateMode.DRIVING


def test_after_a_stop_a_silent_stick_is_as_good_as_neutral():
    rig = Rig().driving()
    rig.order(Order.STOP, source="ann")
    rig.driver = None
    rig.tick(20)
    rig.drive()
    rig.tick()
    assert rig.out.mode is GateMode.DRIVING


def test_an_operators_stop_keeps_the_tracker_out_until_armed_again():
    rig = Rig().driving(**TRACK)
    rig.order(Order.STOP, source="desk", role=Role.STATION)
    rig.tick(20)
    rig.drive(speed=0.0, **TRACK)
    assert rig.drive(**TRACK) is Reason.LOWER_PRIORITY
    assert rig.order(Order.ARM, source="desk", role=Role.STATION) is Reason.OK
    rig.tick(2)
    assert rig.out.holder == "track"


def test_a_trackers_own_stop_does_not_lock_it_out():
    rig = Rig().driving(**TRACK)
    rig.order(Order.STOP, **TRACK)
    rig.tick(20)
    rig.drive(speed=0.0, **TRACK)
    rig.tick()
    assert rig.out.holder == "track"


def test_a_stop_while_at_rest_is_accepted_silently():
    rig = Rig().armed()
    assert rig.order(Order.STOP) is Reason.OK
    rig.tick()
    assert rig.out.mode is GateMode.ARMED


def test_a_blocked_truck_says_why_it_does_not_move():
    rig = Rig().driving()
    rig.silent = {"attitude"}
    rig.tick(14)
    assert rig.drive() is Reason.ATTITUDE_STALE
