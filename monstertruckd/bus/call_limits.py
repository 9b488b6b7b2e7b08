"""Limits of remote calls, checked in the receiving thread, so that a flood does not reach the event loop.

An emergency stop is refused only where as many of the same owner, or of all together, are being carried out.
"""

import threading
from collections import Counter
from typing import Final

from monstertruck_runtime.clock import Clock
from monstertruck_schemas.req import Order
from monstertruck_schemas.topics import owner_of
from monstertruckd.bus.access import ANONYMOUS
from monstertruckd.bus.intake import ORDER_RATE, OwnerRates

ESTOP: Final = Order.ESTOP.value
ORDERS: Final = frozenset(order.value for order in Order)
"""Calls that must get through when others fill the places."""

MAX_CALLS: Final = 16
"""Calls served at once; twice as many with orders, emergency stops not counted."""
MAX_WAITING: Final = 64
"""Calls that wait to be served; twice as many with orders."""
ROOM: Final = 4 * MAX_WAITING
"""Calls that wait with emergency stops."""
MAX_ESTOPS: Final = 8
"""Emergency stops of one owner that wait or are carried out."""
ALL_ESTOPS: Final = 64
"""Limit of all owners together: without certificates names can be invented."""
CALL_RATE: Final = 100.0
"""Calls a second of one owner that are not orders."""
TOO_MANY: Final = "too many calls at once"


class CallLimits:
    """Counts calls; callable from any thread.

    Args:
        clock: time.
    """

    def __init__(self, clock: Clock) -> None:
        self._calls = OwnerRates(CALL_RATE, clock)
        self._orders = OwnerRates(ORDER_RATE, clock)
        self._lock = threading.Lock()
        self._estops: Counter[str] = Counter()

    def refusal(self, name: str, source: str | None, waiting: int) -> str:
        """Why a call is not taken; empty if it is. Each emergency stop that is taken has to be ``ended``.

        Args:
            name: of the call.
            source: caller; None if the key names no source.
            waiting: calls that wait to be served.
        """
        source = source or ANONYMOUS
        if name == ESTOP:
            with self._lock:
                owner = owner_of(source)
                if self._estops[owner] >= MAX_ESTOPS:
                    return f"{MAX_ESTOPS} emergency stops of {owner} are being carried out"
                if self._estops.total() >= ALL_ESTOPS:
                    return f"{ALL_ESTOPS} emergency stops are being carried out"
                self._estops[owner] += 1
            return ""
        order = name in ORDERS
        rates, rate, what = (self._orders, ORDER_RATE, "orders") if order else (self._calls, CALL_RATE, "calls")
        if not rates.spend(source):
            return f"more than {rate:g} {what} a second"
        return TOO_MANY if waiting >= (2 * MAX_WAITING if order else MAX_WAITING) else ""

    def ended(self, name: str, source: str | None) -> None:
        """A call that was taken has been carried out, or is discarded."""
        if name == ESTOP:
            with self._lock:
                owner = owner_of(source or ANONYMOUS)
                self._estops[owner] -= 1
                if not self._estops[owner]:
                    del self._estops[owner]


def may_be_served(name: str, under_way: int) -> bool:
    """Whether a call has a place while ``under_way`` others, emergency stops not counted, are served."""
    return name == ESTOP or under_way < (2 * MAX_CALLS if name in ORDERS else MAX_CALLS)
