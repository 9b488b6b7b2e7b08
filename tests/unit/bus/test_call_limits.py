"""Which calls are taken, and which are refused where they arrive."""

import pytest

from monstertruck_runtime.clock import SECOND, WallClock
from monstertruckd.bus.call_limits import (
    CALLS,
    ESTOPS,
    ORDER_RATE,
    CallLimits,
    may_be_served,
)
from monstertruckd.gate.service import STANDSTILL


class FixedClock(WallClock):
    stamp = SECOND

    def now(self) -> int:
        return self.stamp


@pytest.fixture
def limits() -> CallLimits:
    return CallLimits(FixedClock())


def taken(limits: CallLimits, name: str, source: str | None, count: int) -> int:
    return [limits.refusal(name, source, 0) for _ in range(count)].count("")


@pytest.mark.parametrize(("name", "rate"), [("topics", CALLS.rate), ("disarm", ORDER_RATE), ("stop", ORDER_RATE)])
def test_each_owner_has_a_rate_and_orders_have_their_own(limits: CallLimits, name: str, rate: float):
    assert taken(limits, name, "eve", round(3 * rate)) == rate
    assert f"more than {rate:g}" in limits.refusal(name, "eve", 0)
    for other in ("topics", "arm"):
        assert limits.refusal(other, "ann", 0) == ""
    assert taken(limits, "estop", "eve", 1) == 1


@pytest.mark.parametrize(("name", "rate"), [("topics", CALLS.rate), ("disarm", ORDER_RATE)])
def test_programs_of_one_owner_share_its_rate(limits: CallLimits, name: str, rate: float):
    texts = [limits.refusal(name, f"eve:{number}", 0) for number in range(round(10 * rate))]
    assert texts.count("") == rate
    assert limits.refusal(name, "ann", 0) == ""


def test_orders_of_one_owner_never_fill_all_places():
    assert 2 * CALLS.served > ORDER_RATE * (1 + STANDSTILL)


@pytest.mark.parametrize("source", ["eve", None])
def test_an_emergency_stop_is_refused_only_while_many_of_its_owner_are_carried_out(
    limits: CallLimits, source: str | None
):
    assert taken(limits, "estop", source, 3 * ESTOPS.owner) == ESTOPS.owner
    assert "are still in progress" in limits.refusal("estop", source, 0)
    assert limits.refusal("estop", "ann", 10 * CALLS.waiting) == ""
    limits.ended("estop", source)
    limits.ended("disarm", source)
    assert taken(limits, "estop", source, 3) == 1


def test_programs_of_one_owner_share_what_it_may_stop(limits: CallLimits):
    assert [limits.refusal("estop", f"eve:{number}", 0) for number in range(3 * ESTOPS.owner)].count("") == ESTOPS.owner


def test_emergency_stops_under_invented_names_are_bounded_together(limits: CallLimits):
    names = [f"eve{number}" for number in range(3 * ESTOPS.together)]
    assert [limits.refusal("estop", name, 0) for name in names].count("") == ESTOPS.together
    assert f"{ESTOPS.together} emergency stops are still in progress" in limits.refusal("estop", "ann", 0)
    limits.ended("estop", names[0])
    assert limits.refusal("estop", "ann", 0) == ""


def test_orders_wait_and_are_served_where_others_are_refused_and_emergency_stops_always(limits: CallLimits):
    for waiting, expected in ((CALLS.waiting - 1, "dte"), (CALLS.waiting, "de"), (2 * CALLS.waiting, "e")):
        names = {"d": "disarm", "t": "topics", "e": "estop"}
        assert [key for key, name in names.items() if not limits.refusal(name, "ann", waiting)] == list(expected)
    for under_way, expected in ((CALLS.served - 1, "dte"), (CALLS.served, "de"), (2 * CALLS.served, "e")):
        assert [key for key, name in names.items() if may_be_served(name, under_way)] == list(expected)
