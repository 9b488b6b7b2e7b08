import math

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.requests import MAX_PROGRAMS, MAX_SOURCES
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.state import GateMode
from tests.unit.gate.rig import Rig

TRACKER = {"source": "track", "role": Role.TRACKER}
TRACK = {**TRACKER, "inside": True}
GOALS = {**TRACK, "source": "goals"}
PAD = {"source": "pad", "role": Role.GAMEPAD}


@pytest.mark.parametrize("field", ["speed", "front", "rear"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_non_finite_requests_are_refused_by_name(field, value):
    rig = Rig().driving()
    assert rig.drive(**{field: value}) is Reason.NOT_FINITE
    rig.tick()
    event = rig.reported(Reason.NOT_FINITE)[0]
    assert f"{field} is {value}" in event.text
    assert rig.out.mode is GateMode.DRIVING
    assert rig.out.speeds[0] == pytest.approx(0.2)


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


@pytest.mark.parametrize("kind", ["drive", "order"])
def test_junk_names_lock_nobody_out(kind):
    rig = Rig().armed()
    for i in range(3 * MAX_SOURCES):
        if kind == "drive":
            rig.drive(source=f"junk{i}", role=Role.STATION, lease=0.01)
            rig.tick()
        else:
            rig.order(Order.DISARM, source=f"junk{i}")
    rig.tick(10)
    rig.driver = None
    rig.order(Order.ARM)
    assert rig.drive(source="new") is Reason.OK
    for order in (Order.DISARM, Order.ESTOP, Order.RESET, Order.ARM):
        rig.tick(30)
        assert rig.order(order, source="newer") is Reason.OK


def test_the_source_heard_least_recently_is_forgotten_first():
    rig = Rig().armed()
    rig.order(Order.DISARM, source="early", seq=7)
    rig.order(Order.DISARM, source="busy", seq=7)
    for i in range(MAX_SOURCES - 2):
        rig.order(Order.DISARM, source=f"junk{i}")
    rig.order(Order.DISARM, source="busy", seq=8)
    rig.order(Order.DISARM, source="one-more")
    assert rig.order(Order.DISARM, source="busy", seq=8) is Reason.BAD_SEQUENCE
    assert rig.order(Order.DISARM, source="early", seq=7) is Reason.OK


def test_a_source_whose_lease_runs_is_not_forgotten():
    rig = Rig().driving(source="ann")
    seq = 1000
    rig.drive(source="ann", seq=seq)
    for i in range(2 * MAX_SOURCES):
        last = rig.drive(source=f"junk{i}", lease=0.25)
    assert last is Reason.BUSY
    assert rig.drive(source="ann", seq=seq) is Reason.BAD_SEQUENCE
    rig.tick()
    assert rig.out.holder == "ann"


def test_programs_of_one_owner_never_take_all_places():
    rig = Rig().armed()
    for i in range(MAX_SOURCES):
        rig.drive(0.0, source=f"eve:{i}", role=Role.STATION, lease=0.25)
    assert rig.drive(0.1, source="ann", role=Role.GAMEPAD) is Reason.OK


def test_an_owners_program_heard_least_recently_is_forgotten_first():
    rig = Rig().armed()
    rig.order(Order.DISARM, source="ann", seq=7)
    for i in range(MAX_PROGRAMS + 1):
        rig.order(Order.DISARM, source=f"eve:{i}", seq=7)
    assert rig.order(Order.DISARM, source="ann", seq=7) is Reason.BAD_SEQUENCE
    assert rig.order(Order.DISARM, source="eve:1", seq=7) is Reason.BAD_SEQUENCE
    assert rig.order(Order.DISARM, source="eve:0", seq=7) is Reason.OK


def test_nobody_outside_drives_as_the_tracker():
    rig = Rig().armed()
    assert rig.drive(**TRACKER) is Reason.BAD_ROLE
    assert rig.drive(**PAD, inside=True) is Reason.BAD_ROLE
    rig.tick(2)
    assert rig.out.mode is GateMode.ARMED
    remote = Rig(remote_trackers=("track",)).armed()
    assert remote.drive(**TRACKER) is Reason.OK
    assert remote.drive(source="other", role=Role.TRACKER) is Reason.BAD_ROLE


def test_a_planners_name_used_outside_changes_nothing_for_it():
    rig = Rig().driving(**TRACK)
    assert rig.drive(speed=0.0, source="track", role=Role.STATION, seq=10**9) is Reason.OK
    assert rig.drive(**TRACK) is Reason.LOWER_PRIORITY  # authentic still, though a station took over
    rig.tick()
    assert rig.out.role is Role.STATION


def test_a_request_that_was_long_on_its_way_moves_nothing():
    rig = Rig().driving()
    old = {"gate_stamp": rig.now - 6 * SECOND // 10}
    assert rig.drive(**old) is Reason.LEASE_EXPIRED
    assert rig.drive(gate_stamp=None) is Reason.LEASE_EXPIRED
    assert rig.drive(gate_stamp=rig.now + SECOND) is Reason.LEASE_EXPIRED
    rig.driver = old
    rig.tick(20)
    assert rig.out.mode is GateMode.STOPPING
    rig.tick(100)
    assert rig.out.mode is GateMode.DISARMED
    rig.driver = None
    old = {"gate_stamp": rig.now - 6 * SECOND // 10}
    rig.tick(100)
    old = {"gate_stamp": rig.now - 6 * SECOND // 10}
    assert rig.order(Order.ARM, **old) is Reason.LEASE_EXPIRED
    rig.tick()
    late = "the request came more than 0.5 s after its sender had heard the gate: the link or a computer is slow"
    assert rig.reported(Reason.LEASE_EXPIRED)[-1].text == late, "not that no request was fresh"
    assert rig.order(Order.ESTOP, gate_stamp=None) is Reason.OK
    assert rig.order(Order.RESET, **old) is Reason.LEASE_EXPIRED
    assert rig.order(Order.RESET, gate_stamp=rig.now - 4 * SECOND // 10) is Reason.OK
    assert rig.order(Order.DISARM, gate_stamp=None) is Reason.OK


@pytest.mark.parametrize("stop", [Order.ESTOP, Order.STOP, Order.DISARM])
def test_who_does_not_know_of_anothers_stop_starts_nothing(stop):
    rig = Rig(latched=stop is Order.ESTOP)
    rig.tick(5)
    start, known = Order.RESET if stop is Order.ESTOP else Order.ARM, rig.now
    rig.tick()
    assert rig.order(stop, source="bob") is Reason.OK
    rig.tick()
    assert rig.order(start, source="ann", gate_stamp=known) is Reason.BAD_SEQUENCE
    rig.tick()
    assert rig.events[-1].text == "bob has ordered a stop in the meantime"
    assert rig.order(start, source="bob", gate_stamp=known) is Reason.OK, "its own orders have their sequence"
    assert rig.order(stop, source="bob") is Reason.OK
    assert rig.order(start, source="ann", gate_stamp=rig.now) is Reason.OK


def test_of_two_who_stop_each_has_to_know_of_the_other():
    rig = Rig()
    rig.tick(5)
    before = rig.now
    rig.tick()
    rig.order(Order.STOP, source="ann")
    between = rig.now
    rig.tick()
    rig.order(Order.STOP, source="bob")
    rig.tick()
    assert rig.order(Order.ARM, source="ann", gate_stamp=between) is Reason.BAD_SEQUENCE
    assert rig.order(Order.ARM, source="bob", gate_stamp=before) is Reason.BAD_SEQUENCE
    assert rig.order(Order.ARM, source="bob", gate_stamp=between) is Reason.OK


def test_who_stops_twice_has_to_know_of_the_other_stop_alone():
    rig = Rig()
    rig.tick(5)
    before = rig.now
    rig.tick()
    rig.order(Order.STOP, source="ann")
    between = rig.now
    for _ in range(2):
        rig.tick()
        rig.order(Order.STOP, source="bob")
    rig.tick()
    assert rig.order(Order.ARM, source="bob", gate_stamp=before) is Reason.BAD_SEQUENCE
    rig.tick()
    assert rig.events[-1].text == "ann has ordered a stop in the meantime"
    assert rig.order(Order.ARM, source="bob", gate_stamp=between) is Reason.OK


def test_planners_need_no_gate_stamp():
    assert Rig().armed().drive(**TRACK, gate_stamp=None) is Reason.OK


def test_a_flood_of_names_does_not_become_one_of_events():
    rig = Rig().armed()
    for i in range(1000):
        rig.drive(source=f"junk{i}", role=Role.TRACKER)
    rig.tick()
    assert 1 <= len(rig.reported(Reason.BAD_ROLE)) <= 64
    rig.tick(60)
    rig.drive(source="later", role=Role.TRACKER)
    rig.tick()
    assert rig.reported(Reason.BAD_ROLE)[-1].values["by"] == "later"


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


def test_a_planner_that_keeps_the_truck_standing_neither_disturbs_nor_delays_another():
    rig = Rig().driving(**TRACK)
    assert rig.drive(speed=0.0, **GOALS) is Reason.BUSY
    rig.tick(60)
    assert (rig.out.holder, rig.reported(Reason.BUSY)) == ("track", [])
    rig.driver = None
    for _ in range(14):
        rig.drive(speed=0.0, **GOALS)
        rig.tick()
    assert (rig.out.mode, rig.out.holder) == (GateMode.DRIVING, "goals")
    assert rig.drive(**TRACK) is Reason.OK
    rig.tick()
    assert rig.out.holder == "track"


def test_keyboard_ranks_between_gamepad_and_station():
    rig = Rig().driving(source="keys", role=Role.KEYBOARD)
    assert rig.drive(source="desk", role=Role.STATION) is Reason.LOWER_PRIORITY
    assert rig.drive(**PAD) is Reason.OK


def test_anybody_may_stop():
    for role in Role:
        rig = Rig().driving()
        assert rig.order(Order.STOP, source="cy", role=role, nonce="any") is Reason.OK
        rig.tick()
        assert (rig.out.mode, rig.out.speeds[0]) == (GateMode.STOPPING, 0.0)
        assert "cy" in rig.reported(Reason.STOPPED)[0].text


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


def test_a_source_first_heard_after_a_stop_must_be_neutral_once():
    rig = Rig(disarm_after=10.0).driving()
    rig.order(Order.STOP, source="ann")
    rig.driver = None
    rig.tick(20)
    new = {"source": "bob", "role": Role.GAMEPAD}
    for _ in range(60):  # longer than any lease: silence is no proof of a stick at rest that nobody has seen
        assert rig.drive(**new) is Reason.NOT_ARMED_SPEED
        rig.tick()
        assert rig.out.holder is None
    rig.tick(60)
    assert rig.drive(**new) is Reason.NOT_ARMED_SPEED
    rig.drive(speed=0.0, **new)
    assert rig.drive(**new) is Reason.OK
    rig.tick()
    assert rig.out.holder == "bob"


def test_arming_again_ends_what_a_stop_asks_of_new_sources():
    rig = Rig().driving()
    rig.order(Order.STOP, source="ann")
    rig.driver = None
    rig.tick(20)
    assert rig.order(Order.ARM) is Reason.OK
    assert rig.drive(source="bob") is Reason.OK


def test_names_heard_after_a_stop_are_bounded():
    rig = Rig(disarm_after=10.0).driving()
    rig.order(Order.STOP, source="ann")
    rig.tick(20)
    for number in range(200):
        rig.drive(speed=0.0, source=f"junk{number}", lease=0.01)
        rig.tick()
    assert len(rig.gate._sources._released) <= 64


def test_armed_on_hold_the_planners_wait_and_operators_drive():
    rig = Rig().armed()
    assert rig.order(Order.DISARM) is Reason.OK
    rig.driver = TRACK
    rig.tick(2)
    assert rig.out.waiting == ("track",), "who would set off is known before"
    assert rig.order(Order.ARM, hold=True) is Reason.OK
    rig.tick(40)
    assert (rig.out.mode, rig.out.holder, rig.out.speeds[0]) == (GateMode.ARMED, None, 0.0)
    assert rig.out.waiting == ("track",)
    assert rig.drive(**TRACK) is Reason.LOWER_PRIORITY
    assert rig.drive(source="desk", role=Role.STATION, speed=0.1) is Reason.OK
    rig.tick()
    assert (rig.out.holder, rig.out.waiting) == ("desk", ())
    rig.order(Order.STOP, source="desk")
    rig.tick(60)
    assert rig.order(Order.ARM) is Reason.OK
    rig.tick(2)
    assert rig.out.holder == "track"


def test_a_planner_that_asks_for_standstill_waits_for_nothing():
    rig = Rig()
    rig.tick(2)
    rig.drive(speed=0.0, **TRACK)
    rig.drive(speed=0.1)
    assert rig.tick().waiting == (), "and an operator's stick is no planner"


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
    rig.order(Order.STOP, **TRACKER)
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


def test_a_name_whose_lease_runs_is_not_taken_over():
    rig = Rig().driving(source="ann", instance="a")
    for other in ("b", None):
        assert rig.drive(source="ann", instance=other) is Reason.BUSY
    assert rig.drive(source="ann", instance="a", seq=2**62) is Reason.BUSY
    assert rig.drive(source="ann", instance="a") is Reason.OK
    rig.driver = None
    rig.tick(round(50 * 0.3))  # its lease has expired
    assert rig.drive(source="ann", instance="b") is Reason.OK


@pytest.mark.parametrize("kind", ["drive", "order"])
def test_a_huge_sequence_number_locks_its_source_out_for_no_longer_than_requests_may_be_late(kind):
    rig = Rig().armed()

    def ask(**more):
        rig.driver = None
        return (
            rig.drive(source="ann", speed=0.0, **more)
            if kind == "drive"
            else rig.order(Order.ARM, source="ann", **more)
        )

    assert ask(seq=2**62) is Reason.OK
    assert ask() is Reason.BAD_SEQUENCE
    rig.tick(round(50 * 2.1))
    rig.order(Order.ARM, source="bob")
    assert ask() is Reason.OK
