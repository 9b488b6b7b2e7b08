"""Intake of requests: checked in Zenoh's thread, then passed to the event loop one at a time.

Even in another thread, a decoder holds the interpreter while it runs, so the size, the rate and the first look of the
input are checked before decoding. Every topic has its own queue, and every owner its own rate, so a flood from one does
not delay the others. Stop orders are never refused; if they repeat faster than the truck could react, they are merged.
"""

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.threads import ThreadHop
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import UNCONDITIONAL, ControlRequest, Order, Request
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.sensor import StandPose
from monstertruck_schemas.topics import (
    ESTOP_WAY,
    REQ_CONTROL,
    REQ_DRIVE,
    REQ_LOCALISATION,
    REQ_MAP,
    REQ_PATH,
    STAND_POSE,
    Topic,
    owner_of,
)
from monstertruckd.bus.access import Sender, role_needed
from monstertruckd.bus.local import Bus

REQUEST_QUEUE: Final = 64
"""Requests of one topic that may wait for the loop."""


TOGETHER: Final = 5.0
"""Ratio of the rate of all owners together to the rate of one owner: without certificates names can be invented."""


@dataclass(frozen=True, slots=True)
class Limit:
    """Limits on one topic."""

    size: int = 2048
    """Bytes of one request."""
    rate: float | None = 5.0
    """Requests a second of one owner, in bursts of as many; None: any number."""


LIMITS: Final = {
    REQ_DRIVE.name: Limit(rate=200.0),
    REQ_CONTROL.name: Limit(rate=None),
    REQ_PATH.name: Limit(size=131_072),
    REQ_LOCALISATION.name: Limit(rate=20.0),
    REQ_MAP.name: Limit(size=524_288, rate=1.0),
}
"""All others: ``Limit()``. The kind of an order is known once it is decoded: see ``ORDER_RATE``. A path of 2000 poses
fits, and the map of a building: at the edges of its rooms a cell takes about one bit."""

ORDER_RATE: Final = 5.0
"""Maximum number of orders per second and owner, without those that stop."""


@dataclass(slots=True)
class _Budget:
    """Number of requests that may be accepted now; at most the number allowed per second."""

    left: float
    at: int
    """When it was true (ns)."""

    def spend(self, now: int, rate: float) -> bool:
        """Use one request from the budget; return False if none is left."""
        self.left = min(self.left + (now - self.at) / SECOND * rate, rate)
        self.at = now
        if self.left < 1.0:
            return False
        self.left -= 1.0
        return True


class OwnerRates:
    """Limits the request rate of each owner's programs, and of all owners together; may be called from any thread.

    Args:
        rate: requests per second for one owner; also the maximum burst.
        clock: time source.
    """

    def __init__(self, rate: float, clock: Clock) -> None:
        self._rate = rate
        self._clock = clock
        self._lock = threading.Lock()
        self._budgets: dict[str, _Budget] = {}
        self._together = _Budget(rate * TOGETHER, clock.now())

    def spend(self, source: str) -> bool:
        """Count one request from ``source``; return False if its owner has sent too many."""
        owner = owner_of(source)
        with self._lock:
            now = self._clock.now()
            budget = self._budgets.pop(owner, None) or _Budget(self._rate, now)
            # The least recent owner gives way to a new one.
            if len(self._budgets) >= 64:
                del self._budgets[next(iter(self._budgets))]
            self._budgets[owner] = budget
            return budget.spend(now, self._rate) and self._together.spend(now, self._rate * TOGETHER)


class Refusals:
    """Reports refused requests as events, at most once per second, so that garbage cannot cause a flood of events.

    Must be constructed on the event loop.

    Args:
        bus: bus that carries the events.
        clock: time source.
        reporter: name of the reporting service.
    """

    def __init__(self, bus: Bus, clock: Clock, reporter: str) -> None:
        self._clock = clock
        self._reporter = reporter
        self._event = bus.event_sink()
        self._lock = threading.Lock()
        self._reported = -SECOND
        self._count = 0
        self._reports: ThreadHop[tuple[Reason, str, str, int]] = ThreadHop(self._report, 1, lambda _: None)

    def add(self, reason: Reason, source: str, text: str) -> None:
        """Record that a request from ``source`` was refused; may be called from any thread."""
        with self._lock:
            now = self._clock.now()
            self._count += 1
            if now - self._reported < SECOND:
                return
            self._reported, count, self._count = now, self._count, 0
        self._reports.put((reason, source, text, count))

    def close(self) -> None:
        """Stop reporting."""
        self._reports.close()

    def _report(self, refusal: tuple[Reason, str, str, int]) -> None:
        reason, source, text, count = refusal
        self._event(reason, Severity.WARNING, self._reporter, text, by=source, count=count)


class Repeats:
    """Holds the latest order from each owner briefly, to limit the number of orders passed to the event loop.

    Must be constructed on the event loop.

    Args:
        deliver: called on the loop with each order.
    """

    def __init__(self, deliver: Callable[[Message], None]) -> None:
        self._deliver = deliver
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._newest: dict[str, Callable[[], Message]] = {}

    def put(self, source: str, order: Callable[[], Message]) -> None:
        """Deliver an order after ``REPEAT`` seconds unless its owner gives a newer one; may be called from any thread.

        Args:
            source: source of the order.
            order: creates the order, on the loop.
        """
        owner = owner_of(source)
        with self._lock:
            first = not self._newest
            self._newest.pop(owner, None)
            # The owner heard least recently gives way: others are stopping the truck then.
            if len(self._newest) >= 8:
                del self._newest[next(iter(self._newest))]
            self._newest[owner] = order
        if first:
            with suppress(RuntimeError):  # the loop was closed meanwhile
                # s; of further orders only the latest follows.
                self._loop.call_soon_threadsafe(self._loop.call_later, 0.02, self._deliver_all)

    def _deliver_all(self) -> None:
        with self._lock:
            newest, self._newest = self._newest, {}
        for order in newest.values():
            self._deliver(order())


class Intake:
    """Accepts the requests of one topic; must be constructed on the loop.

    Args:
        topic: topic that clients outside the daemon may write.
        bus: bus that carries the requests.
        clock: time source.
        guard: runs callbacks on the event loop, so that their errors are reported.
        reporter: name of the service that reports refusals.
        only: the only order accepted, on a separate path; None for all orders.
    """

    def __init__(
        self,
        topic: Topic[Any],
        bus: Bus,
        clock: Clock,
        guard: Callable[[Callable[[], object]], None],
        reporter: str,
        only: Order | None = None,
    ) -> None:
        self.topic = topic
        self._name = topic.name if only is None else ESTOP_WAY
        self._only = only
        self._limit = LIMITS.get(topic.name, Limit())
        self._rates = None if self._limit.rate is None else OwnerRates(self._limit.rate, clock)
        self._order_rates = OwnerRates(ORDER_RATE, clock)
        # Orders a second of one owner that stop and are taken at once; of further ones only the latest follows.
        self._stop_rates = {order: OwnerRates(50.0, clock) for order in UNCONDITIONAL}
        self._refusals = Refusals(bus, clock, reporter)

        def deliver(request: Message) -> None:
            guard(lambda: bus.inject(topic, request))

        self._requests: ThreadHop[Message] = ThreadHop(
            deliver, REQUEST_QUEUE, bus.add_drops, lambda request: _order(request) in UNCONDITIONAL
        )
        self._estops: ThreadHop[Message] = ThreadHop(deliver, REQUEST_QUEUE, bus.add_drops)
        """Emergency stops wait for no other order."""
        self._repeats = {Order.ESTOP: Repeats(self._estops.put), Order.STOP: Repeats(self._requests.put)}

    def take(self, sender: Sender, size: int, read: Callable[[], bytes]) -> None:
        """Check, decode and queue one request; may be called from any thread.

        Args:
            sender: owner according to the key, whatever the request claims.
            size: size of the request (bytes).
            read: returns the bytes of the request.
        """
        name, limit, source = self._name, self._limit, sender.source
        if size > limit.size:
            text = f"{name}: request of {size} bytes, at most {limit.size} are accepted"
            self._refusals.add(Reason.BAD_INPUT, source, text)
            return
        if not self.charge(source):
            self._refusals.add(Reason.MESSAGES_DROPPED, source, f"{name}: more than {limit.rate:g} requests a second")
            return
        data = read()
        ordinary = self.topic is REQ_CONTROL and not _may_stop(data)
        if ordinary and not self._may_order(sender):
            return
        # 512: commas, and brackets, braces and quotes, of one request: many small objects would take tens of
        # milliseconds
        if data.count(b",") > 16_384 or sum(map(data.count, (b"[", b"{", b'"'))) > 512:  # commas of a request at most
            self._refusals.add(Reason.BAD_INPUT, source, f"{name}: request in too many parts")
            return
        try:
            request = wire.decode(self.topic, data)
        except InputError as error:
            self._refusals.add(Reason.BAD_INPUT, source, str(error))
            return
        assert isinstance(request, Request)
        order = _order(request)
        if self._only is not None and order is not self._only:
            self._refusals.add(Reason.BAD_INPUT, source, f"{name}: expected the order {self._only}, found {order}")
            return
        if not sender.may(needed := role_needed(request)):
            self._refusals.add(Reason.NOT_PERMITTED, source, f"{name}: {sender.refusal(needed)}")
            return
        stops = order in UNCONDITIONAL
        if order is not None and not stops and not ordinary and not self._may_order(sender):
            return
        said = {"source": source, "role": sender.grant.capped(request.role)}
        if order is not None and stops and not self._stop_rates[order].spend(source):
            self._repeats[order].put(source, partial(request.model_copy, update=said))
        else:
            (self._estops if order is Order.ESTOP else self._requests).put(request.model_copy(update=said))

    def _may_order(self, sender: Sender) -> bool:
        """Return whether an order that does not stop the truck is accepted; count it, and report a refusal."""
        name, needed = self._name, AccessRole.PILOT
        if not sender.may(needed):
            self._refusals.add(Reason.NOT_PERMITTED, sender.source, f"{name}: {sender.refusal(needed)}")
        elif not self._order_rates.spend(sender.source):
            text = f"{name}: more than {ORDER_RATE:g} orders a second"
            self._refusals.add(Reason.MESSAGES_DROPPED, sender.source, text)
        else:
            return True
        return False

    def charge(self, source: str) -> bool:
        """Count one request from ``source``; False if its owner has sent too many. May be called from any thread."""
        return self._rates is None or self._rates.spend(source)

    def close(self) -> None:
        """Discard waiting messages and all later ones."""
        self._requests.close()
        self._estops.close()
        self._refusals.close()


class StandIntake:
    """Receives a test stand's observations of the robot for the recorder; must be constructed on the loop.

    Args:
        bus: bus whose taps get the observations.
        clock: time source.
        guard: see ``Intake``.
        refusals: reports refused messages.
    """

    SIZE: Final = 1024
    """Maximum size of one pose (bytes)."""
    RATE: Final = 120.0
    """Maximum number of poses per second."""

    def __init__(
        self, bus: Bus, clock: Clock, guard: Callable[[Callable[[], object]], None], refusals: Refusals
    ) -> None:
        self._refusals = refusals
        self._rates = OwnerRates(self.RATE, clock)
        self._poses: ThreadHop[StandPose] = ThreadHop(
            lambda pose: guard(lambda: bus.put_stand(STAND_POSE, pose)), REQUEST_QUEUE, bus.add_drops
        )

    def take(self, size: int, read: Callable[[], bytes]) -> None:
        """Check, decode and queue one pose; may be called from any thread. For the arguments see ``Intake.take``."""
        name = STAND_POSE.name
        if size > self.SIZE:
            self._refusals.add(Reason.BAD_INPUT, name, f"{name}: {size} bytes, at most {self.SIZE} are accepted")
        elif not self._rates.spend(name):
            self._refusals.add(Reason.MESSAGES_DROPPED, name, f"{name}: more than {self.RATE:g} poses a second")
        else:
            try:
                self._poses.put(wire.decode(STAND_POSE, read()))
            except InputError as error:
                self._refusals.add(Reason.BAD_INPUT, name, str(error))

    def close(self) -> None:
        """Discard waiting messages and all later ones."""
        self._poses.close()


def _may_stop(data: bytes) -> bool:
    """Return whether an order may be a stop order, without the cost of decoding it.

    Escaped letters are covered because they start with a backslash.
    """
    return b"stop" in data or b"\\" in data


def _order(request: Message) -> Order | None:
    return request.order if isinstance(request, ControlRequest) else None
