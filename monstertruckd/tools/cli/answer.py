"""An order to the gate, and what became of it."""

from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeVar

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import NoAnswerError
from monstertruck_runtime.mailbox import Delivery, Mailbox, fifo
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Event
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import EVENT, GATE, Topic

M = TypeVar("M", bound=Message)

FULFILLED: Final = {
    Order.ARM: frozenset(mode for mode in GateMode if mode.active),
    Order.DISARM: frozenset(mode for mode in GateMode if not mode.active),
    Order.ESTOP: frozenset({GateMode.ESTOPPED}),
    Order.RESET: frozenset(GateMode) - {GateMode.ESTOPPED},
}
"""States that show an order as carried out."""

PATIENCE: Final = 5.0
"""Seconds to wait for such a state: a truck that drives is stopped before it is disarmed."""

SETTLED: Final = 2
"""States published after the robot had the order, by which a refusal would have come."""


class Operator(Protocol):
    """What is needed of a ``TruckClient``."""

    source: str

    def subscribe(self, topic: Topic[M], delivery: Delivery) -> Mailbox[M]:
        """Follow a topic."""
        ...

    async def get_retained(self, topic: Topic[M]) -> M | None:
        """Newest message of a retained topic."""
        ...

    async def order(self, order: Order, lease: float = 1.0) -> None:
        """Send an order."""
        ...


@dataclass(frozen=True, slots=True)
class Answer:
    """What became of an order."""

    order: Order
    reason: Reason
    """OK, or why the gate refused."""
    text: str
    """The same in words."""
    state: GateState
    """The gate's newest state."""

    def as_json(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {
            "order": self.order,
            "accepted": self.reason is Reason.OK,
            "reason": self.reason,
            "text": self.text,
            "mode": self.state.mode,
            "holder": self.state.holder,
            "limited_by": self.state.reasons,
        }


async def give(operator: Operator, clock: Clock, order: Order, patience: float = PATIENCE) -> Answer:
    """Give an order and wait until the gate refuses it or its state shows it carried out.

    The gate tells refusals as events and acknowledges by its state; nothing is told of an order that changes nothing,
    so states published after the robot certainly had the order decide then.

    Args:
        operator: who gives it.
        clock: time.
        order: which one.
        patience: seconds to wait.

    Raises:
        NoAnswerError: neither came in time.
        NotFoundError: the robot is not there.
    """
    with operator.subscribe(EVENT, fifo(256)) as events, operator.subscribe(GATE, fifo(256)) as states:
        try:
            async with clock.deadline(patience):
                before = await states.next()
                await operator.order(order)
                quick = before.mode not in FULFILLED[order]
                left = 0
                if not quick:
                    await operator.get_retained(GATE)
                    left = SETTLED
                while True:
                    state = await states.next()
                    if (refusal := _refusal(events, operator.source, order)) is not None:
                        return Answer(order, refusal.reason, refusal.text or refusal.reason.text, state)
                    left -= 1
                    if state.mode in FULFILLED[order] and left <= 0:
                        return Answer(order, Reason.OK, Reason.OK.text, state)
        except TimeoutError:
            raise NoAnswerError(f"{order.value}: the gate did not answer within {patience:g} s") from None


def _refusal(events: Mailbox[Event], source: str, order: Order) -> Event | None:
    for event in events.drain():
        if event.values.get("by") == source and event.values.get("request") == order.value:
            return event
    return None
