"""The way in for requests: judged in the sender's thread, then one at a time onto the loop.

Even in another thread a decoder holds the interpreter while it runs, so what may be decoded is bounded by size, by rate
and by a look at the bytes. Every topic waits in a queue of its own: a flood of one delays no other.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.threads import ThreadHop
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, Order
from monstertruck_schemas.topics import REQ_CONTROL, REQ_DRIVE, REQ_PATH, Topic
from monstertruckd.bus.local import Bus

DEPTH: Final = 64
"""Requests of one topic that may wait for the loop."""

MAX_VALUES: Final = 16_384
MAX_MARKS: Final = 512
"""Commas, and brackets, braces and quotes, of one request: many small objects would take tens of milliseconds."""

_RANKS: Final = {Order.ESTOP: 2, Order.STOP: 1}
"""Where orders have to be dropped, these are the last to go."""


@dataclass(frozen=True, slots=True)
class Limit:
    """What one topic may bring."""

    size: int = 2048
    """Bytes of one request."""
    rate: float | None = 5.0
    """Requests a second, in bursts of as many; None = any number."""


LIMITS: Final = {
    REQ_DRIVE.name: Limit(rate=200.0),
    REQ_CONTROL.name: Limit(rate=None),
    REQ_PATH.name: Limit(size=131_072),
}
"""All others: ``Limit()``. No order is turned away for its rate, for it may be an emergency stop; a path of 2000 poses
fits."""


class Intake:
    """Takes in the requests of one topic; to be made on the loop.

    Args:
        topic: one that outsiders write.
        bus: where the requests go.
        clock: time.
        guard: runs what happens on the loop, so that a bug does not vanish there.
        source: who reports refusals.
    """

    def __init__(
        self, topic: Topic[Any], bus: Bus, clock: Clock, guard: Callable[[Callable[[], object]], None], source: str
    ) -> None:
        self.topic = topic
        self._limit = LIMITS.get(topic.name, Limit())
        self._clock = clock
        self._source = source
        self._event = bus.event_sink()
        self._lock = threading.Lock()
        self._budget = self._limit.rate or 0.0
        self._spent_at = clock.now()
        self._reported = -SECOND
        self._refused = 0
        self._requests: ThreadHop[Message] = ThreadHop(
            lambda request: guard(lambda: bus.inject(topic, request)), DEPTH, bus.add_drops, _rank
        )
        self._refusals: ThreadHop[tuple[Reason, str, int]] = ThreadHop(self._report, 1, lambda _: None)

    def take(self, size: int, read: Callable[[], bytes]) -> None:
        """Judge, decode and queue one request; callable from any thread.

        Args:
            size: bytes it has.
            read: gets them.
        """
        name, limit = self.topic.name, self._limit
        if size > limit.size:
            self._refuse(Reason.BAD_INPUT, f"{name}: request of {size} bytes, at most {limit.size} are taken")
            return
        if limit.rate is not None and not self._within(limit.rate):
            self._refuse(Reason.MESSAGES_DROPPED, f"{name}: more than {limit.rate:g} requests a second")
            return
        data = read()
        if data.count(b",") > MAX_VALUES or sum(map(data.count, (b"[", b"{", b'"'))) > MAX_MARKS:
            self._refuse(Reason.BAD_INPUT, f"{name}: request of too many parts")
            return
        try:
            request = wire.decode(self.topic, data)
        except InputError as error:
            self._refuse(Reason.BAD_INPUT, str(error))
        else:
            self._requests.put(request)

    def close(self) -> None:
        """Discard what waits and everything to come."""
        self._requests.close()
        self._refusals.close()

    def _within(self, rate: float) -> bool:
        with self._lock:
            now = self._clock.now()
            self._budget = min(self._budget + (now - self._spent_at) / SECOND * rate, rate)
            self._spent_at = now
            if self._budget < 1.0:
                return False
            self._budget -= 1.0
            return True

    def _refuse(self, reason: Reason, text: str) -> None:
        """Report at most once a second: a flood of garbage must not become one of events."""
        with self._lock:
            now = self._clock.now()
            self._refused += 1
            if now - self._reported < SECOND:
                return
            self._reported, count, self._refused = now, self._refused, 0
        self._refusals.put((reason, text, count))

    def _report(self, refusal: tuple[Reason, str, int]) -> None:
        reason, text, count = refusal
        self._event(reason, Severity.WARNING, self._source, text, count=count)


def _rank(request: Message) -> int:
    return _RANKS.get(request.order, 0) if isinstance(request, ControlRequest) else 0
