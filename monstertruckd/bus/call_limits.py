"""Limits on remote calls, checked in the receiving thread so that a flood does not reach the event loop.

An emergency stop is refused only if too many stops from the same owner, or from all owners together, are already in
progress.
"""

import threading
from collections import Counter
from typing import Final, NamedTuple

from monstertruck_runtime.clock import Clock
from monstertruck_schemas.req import Order
from monstertruck_schemas.topics import owner_of
from monstertruckd.bus.access import ANONYMOUS
from monstertruckd.bus.intake import ORDER_RATE, OwnerRates

ESTOP: Final = Order.ESTOP.value
ORDERS: Final = frozenset(order.value for order in Order)
"""Calls that must get through when others fill the places."""


class Allowance(NamedTuple):
    """Limits on calls of one kind."""

    rate: float
    """Maximum calls per second of one owner."""
    served: int
    """Maximum number of calls being served, excluding emergency stops."""
    waiting: int
    """Maximum number of waiting calls."""


CALLS: Final = Allowance(100.0, 16, 64)
ORDER_CALLS: Final = Allowance(ORDER_RATE, 2 * CALLS.served, 2 * CALLS.waiting)


class EstopLimit(NamedTuple):
    """Limits on emergency stops that are waiting or being carried out."""

    owner: int
    together: int
    """Limit of all owners: without certificates names can be invented."""


ESTOPS: Final = EstopLimit(8, 64)
TOO_MANY: Final = "too many calls at once"


class CallLimits:
    """Counts calls; may be called from any thread.

    Args:
        clock: time source.
    """

    def __init__(self, clock: Clock) -> None:
        self._calls = OwnerRates(CALLS.rate, clock)
        self._orders = OwnerRates(ORDER_CALLS.rate, clock)
        self._lock = threading.Lock()
        self._estops: Counter[str] = Counter()

    def refusal(self, name: str, source: str | None, waiting: int) -> str:
        """Return the reason for refusing a call; empty to accept it. Call ``ended`` for each accepted emergency stop.

        Args:
            name: name of the call.
            source: caller; None if the key names no source.
            waiting: number of calls waiting to be served.
        """
        source = source or ANONYMOUS
        if name == ESTOP:
            with self._lock:
                owner = owner_of(source)
                if self._estops[owner] >= ESTOPS.owner:
                    return f"{ESTOPS.owner} emergency stops of {owner} are still in progress"
                if self._estops.total() >= ESTOPS.together:
                    return f"{ESTOPS.together} emergency stops are still in progress"
                self._estops[owner] += 1
            return ""
        rates, what = (self._orders, "orders") if name in ORDERS else (self._calls, "calls")
        allowance = _allowance(name)
        if not rates.spend(source):
            return f"more than {allowance.rate:g} {what} a second"
        return TOO_MANY if waiting >= allowance.waiting else ""

    def ended(self, name: str, source: str | None) -> None:
        """Record that an accepted call was carried out or discarded."""
        if name == ESTOP:
            with self._lock:
                owner = owner_of(source or ANONYMOUS)
                self._estops[owner] -= 1
                if not self._estops[owner]:
                    del self._estops[owner]


def may_be_served(name: str, under_way: int) -> bool:
    """Return whether a call may be served while ``under_way`` others, except emergency stops, are served."""
    return name == ESTOP or under_way < _allowance(name).served


def _allowance(name: str) -> Allowance:
    return ORDER_CALLS if name in ORDERS else CALLS
