"""Who may drive, asked of the sources themselves: leases, priorities, and what a stop asks of everybody."""

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.requests import MAX_SOURCES
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, DriveRequest, Order, Role
from monstertruckd.gate.arbitration import Sources
from monstertruckd.gate.config import GateConfig
from tests.unit.gate.rig import NONCE, header

NOW = 100 * SECOND
LEASE = SECOND // 4
OUTSIDE = (Role.STATION, Role.KEYBOARD, Role.GAMEPAD)


def request(source="ann", role=Role.GAMEPAD, speed=0.1, at=NOW, seq=0, lease=1.0, **more):
    fields = {**header(at, seq), "nonce": NONCE, "gate_stamp": at, **more}
    return DriveRequest(source=source, role=role, lease=lease, speed=speed, front=0.0, **fields)


class Crowd(Sources):
    """Sources that take requests by name."""

    def __init__(self, **config):
        super().__init__(NONCE, GateConfig(**config))

    def heard(self, source="ann", role=Role.GAMEPAD, speed=0.1, at=NOW, *, inside=False, **more):
        return self.add(request(source, role, speed, at, **more), at, inside=inside)

    def driving(self, at=NOW, holder=None):
        driver = self.driver(at, holder)
        return None if driver is None else driver.request.source


def test_a_lease_counts_to_its_last_instant_everywhere():
    crowd = Crowd()
    crowd.heard()
    for at, alive in ((NOW + LEASE, True), (NOW + LEASE + 1, False)):
        assert bool(crowd.live(at)) is alive
        assert (crowd.driving(at) == "ann") is alive
        assert bool(crowd.requesting_motion(at)) is alive


def test_a_lease_is_the_shorter_of_what_is_asked_and_granted():
    crowd = Crowd(leases={"station": 0.2})
    assert crowd.heard(lease=0.1).deadline == NOW + SECOND // 10
    assert crowd.heard(lease=1.0, role=Role.STATION).deadline == NOW + SECOND // 5


def test_what_lapsed_is_dropped_with_the_next_request():
    crowd = Crowd()
    for name in range(100):
        crowd.heard(f"s{name}", at=NOW + name * LEASE)
    assert len(crowd._drive) == 2, "the newest, and the one whose lease ends in this instant"


@pytest.mark.parametrize("role", OUTSIDE)
def test_operators_may_ask_from_outside(role):
    assert Crowd().accept_request(request(role=role), NOW) is Reason.OK


@pytest.mark.parametrize(
    ("role", "source", "accepted"),
    [
        (Role.TRACKER, "far", True),
        (Role.TRACKER, "ann", False),
        (Role.ESTOP, "far", False),
        (Role.GAMEPAD, "far", True),
    ],
)
def test_only_a_named_tracker_may_ask_from_outside(role, source, accepted):
    crowd = Crowd(remote_trackers=("far",))
    found = crowd.accept_request(request(source, role), NOW)
    assert found is (Reason.OK if accepted else Reason.BAD_ROLE)


@pytest.mark.parametrize("role", [*OUTSIDE, Role.ESTOP])
def test_planners_are_trackers(role):
    assert Crowd().accept_planner_request(request(role=role), NOW) is Reason.BAD_ROLE
    assert Crowd().accept_planner_request(request(role=Role.TRACKER), NOW) is Reason.OK


def test_a_name_belongs_to_one_program_while_its_lease_runs():
    crowd = Crowd()
    crowd.heard("ann", instance="one")
    assert crowd.accept_request(request("ann", instance="one", seq=1), NOW) is Reason.OK
    assert crowd.accept_request(request("ann", instance="two", seq=2), NOW) is Reason.BUSY
    assert crowd.accept_request(request("bob", instance="two", seq=2), NOW) is Reason.OK
    late = NOW + LEASE + 1
    assert crowd.accept_request(request("ann", instance="two", seq=2, at=late), late) is Reason.OK


def test_a_planners_name_is_free_outside():
    crowd = Crowd()
    crowd.heard("track", Role.TRACKER, inside=True, instance="one")
    assert crowd.accept_request(request("track", instance="two"), NOW) is Reason.OK


def test_why_a_request_is_refused_and_its_age():
    old = {"gate_stamp": NOW - SECOND // 2 - 1}
    assert Crowd().accept_request(request(**old), NOW) is Reason.LEASE_EXPIRED
    assert Crowd().accept_request(request(nonce="other", **old), NOW) is Reason.BAD_NONCE
    assert Crowd().accept_request(request(nonce="other"), NOW) is Reason.BAD_NONCE


@pytest.mark.parametrize("order", Order)
def test_only_orders_that_may_move_the_truck_must_be_fresh(order):
    fields = {**header(NOW), "nonce": NONCE, "source": "ann", "role": Role.GAMEPAD, "lease": 1.0, "order": order}
    starts = order in (Order.ARM, Order.RESET)
    late = ControlRequest(**fields, gate_stamp=NOW - SECOND)
    assert Crowd().accept_order(late, NOW) is (Reason.LEASE_EXPIRED if starts else Reason.OK)
    assert Crowd().accept_order(ControlRequest(**fields, gate_stamp=NOW), NOW) is Reason.OK
    strange = ControlRequest(**(fields | {"nonce": "other"}), gate_stamp=NOW - SECOND)
    assert Crowd().accept_order(strange, NOW) is Reason.BAD_NONCE


# Who drives


def test_the_highest_role_drives_whoever_came_first():
    crowd = Crowd()
    assert crowd.driving() is None
    crowd.heard("track", Role.TRACKER, inside=True)
    assert crowd.driving() == "track"
    for name, role in (("s", Role.STATION), ("k", Role.KEYBOARD), ("g", Role.GAMEPAD)):
        crowd.heard(name, role)
        assert crowd.driving() == name
    crowd.heard("t2", Role.TRACKER, inside=True)
    assert crowd.driving(holder=(True, "t2")) == "g", "even if another drives already"


def test_among_equals_the_one_that_drives_goes_on():
    crowd = Crowd()
    crowd.heard("ann", speed=0.0)
    crowd.heard("bob", speed=0.1)
    assert crowd.driving(holder=(False, "ann")) == "ann"
    assert crowd.driving(holder=(False, "bob")) == "bob"
    assert crowd.driving() == "ann", "the first one heard"


def test_of_the_planners_the_one_that_asks_for_motion_drives():
    crowd = Crowd()
    crowd.heard("stays", Role.TRACKER, 0.0, inside=True)
    crowd.heard("goes", Role.TRACKER, 0.1, inside=True)
    assert crowd.driving(holder=(True, "stays")) == "goes"


def test_a_remote_tracker_that_moves_does_not_take_over_from_one_that_holds():
    crowd = Crowd(remote_trackers=("one", "two"))
    crowd.heard("one", Role.TRACKER, 0.0)
    crowd.heard("two", Role.TRACKER, 0.1)
    assert crowd.driving(holder=(False, "one")) == "one"


def test_why_somebody_does_not_drive():
    crowd = Crowd()
    ann, bob, low = crowd.heard("ann"), crowd.heard("bob"), crowd.heard("low", Role.STATION)
    holder = (False, "ann")
    assert crowd.priority(ann, NOW, holder) is Reason.OK
    assert crowd.priority(bob, NOW, holder) is Reason.BUSY
    assert crowd.priority(low, NOW, holder) is Reason.LOWER_PRIORITY
    crowd.hold(NOW)
    assert [crowd.priority(source, NOW, holder) for source in (ann, bob, low)] == [Reason.NOT_ARMED_SPEED] * 3


def test_one_that_waits_for_arming_has_the_lower_priority_though_nobody_drives():
    crowd = Crowd()
    crowd.claim(Role.GAMEPAD)
    low = crowd.heard("low", Role.STATION)
    assert crowd.driving() is None
    assert crowd.priority(low, NOW, None) is Reason.LOWER_PRIORITY


def test_the_highest_claim_counts_and_its_own_role_drives_on():
    crowd = Crowd()
    crowd.claim(Role.KEYBOARD)
    crowd.claim(Role.STATION)
    crowd.heard("s", Role.STATION)
    assert crowd.driving() is None
    crowd.heard("k", Role.KEYBOARD)
    assert crowd.driving() == "k"
    crowd.release(planners=True)
    assert crowd.driving() == "k"


@pytest.mark.parametrize("planners", [True, False])
def test_armed_on_hold_planners_wait_for_the_next_arming(planners):
    crowd = Crowd()
    crowd.claim(Role.GAMEPAD)
    crowd.release(planners=planners)
    crowd.heard("track", Role.TRACKER, inside=True)
    assert crowd.driving() == ("track" if planners else None)
    crowd.heard("s", Role.STATION)
    assert crowd.driving() == "s"


# After a stop


def test_after_a_stop_everybody_must_be_neutral_once():
    crowd = Crowd()
    crowd.heard("ann")
    crowd.hold(NOW)
    assert crowd.driving() is None
    assert crowd.heard("ann").held
    assert not crowd.heard("ann", speed=0.0).held
    assert not crowd.heard("ann").held


def test_silence_for_a_whole_lease_is_as_good_as_neutral():
    crowd = Crowd()
    crowd.heard("ann")
    crowd.hold(NOW)
    assert crowd.heard("ann", at=NOW + LEASE).held, "its lease ends with this instant"
    assert not crowd.heard("ann", at=NOW + 2 * LEASE + 1).held


def test_a_source_first_heard_after_the_stop_must_be_neutral_however_long_it_is_silent():
    crowd = Crowd()
    crowd.hold(NOW)
    assert crowd.heard("new").held
    assert crowd.heard("new", at=NOW + 10 * SECOND).held
    crowd.heard("new", speed=0.0, at=NOW + 10 * SECOND)
    assert not crowd.heard("new", at=NOW + 20 * SECOND).held


def test_a_source_whose_lease_had_lapsed_before_the_stop_is_a_new_one():
    crowd = Crowd()
    crowd.heard("ann")
    crowd.heard("bob", at=NOW + 2 * LEASE)
    crowd.hold(NOW + 2 * LEASE)
    assert crowd.heard("ann", at=NOW + 4 * LEASE).held


def test_so_is_one_that_was_the_last_to_be_heard():
    crowd = Crowd()
    crowd.heard("ann")
    crowd.hold(NOW + 2 * LEASE)
    assert crowd.heard("ann", at=NOW + 4 * LEASE).held


def test_arming_ends_what_a_stop_asks():
    crowd = Crowd()
    ann = crowd.heard("ann")
    crowd.hold(NOW)
    crowd.release(planners=True)
    assert not ann.held
    assert crowd.driving() == "ann"
    assert not crowd.heard("new").held


def test_without_a_stop_nobody_has_to_be_neutral():
    crowd = Crowd()
    assert not crowd.heard("ann").held
    crowd.heard("ann", speed=0.0)
    assert not crowd.heard("ann").held


def test_the_names_released_after_a_stop_are_bounded():
    crowd = Crowd()
    crowd.hold(NOW)
    for number in range(MAX_SOURCES + 1):
        crowd.heard(f"s{number}", speed=0.0)
    assert len(crowd._released) == MAX_SOURCES
    assert not crowd.heard(f"s{MAX_SOURCES - 1}").held
    assert crowd.heard("s-late").held


@pytest.mark.parametrize("name", ["invented{}", "mallory:{}"])
def test_names_invented_after_a_stop_keep_nobody_standing(name):
    crowd = Crowd()
    crowd.hold(NOW)
    for number in range(3 * MAX_SOURCES):
        crowd.heard(name.format(number), speed=0.0, at=NOW + number * LEASE * 2)
    late = NOW + 10 * MAX_SOURCES * LEASE
    crowd.heard("ann", speed=0.0, at=late)
    assert not crowd.heard("ann", at=late).held
    for number in range(3 * MAX_SOURCES):
        crowd.heard(name.format(f"more{number}"), speed=0.0, at=late)
    assert not crowd.heard("ann", at=late).held, "a source with a lease is not dropped"


# What is asked for


def test_motion_is_asked_for_by_operators():
    crowd = Crowd()
    assert crowd.requesting_motion(NOW) == ()
    crowd.heard("ann", speed=0.0)
    crowd.heard("track", Role.TRACKER, inside=True)
    assert crowd.requesting_motion(NOW) == ()
    crowd.heard("bob")
    assert crowd.requesting_motion(NOW) == ("bob",)


def test_planners_that_ask_for_motion_wait():
    crowd = Crowd()
    crowd.heard("ann")
    crowd.heard("stays", Role.TRACKER, 0.0, inside=True)
    crowd.heard("goes", Role.TRACKER, 0.1, inside=True)
    assert crowd.waiting(NOW) == ("goes",)
    assert crowd.waiting(NOW + LEASE + 1) == ()
