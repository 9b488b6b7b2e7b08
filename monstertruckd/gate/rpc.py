"""Orders by remote call: answered with the gate's state once carried out, or refused with the reason.

A called order takes the same way as one on ``req/control``: it is recorded there and passes the same checks.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.ports import RpcRegistry
from monstertruck_runtime.requests import parse_request
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, Order
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.state import GateMode
from monstertruck_schemas.topics import GATE, REQ_CONTROL
from monstertruckd.bus.local import Bus
from monstertruckd.gate.core import Decision

CARRIED_OUT: Final[Mapping[Order, Callable[[GateMode], bool]]] = {
    Order.ARM: lambda mode: mode.active,
    Order.DISARM: lambda mode: not mode.active,
    Order.ESTOP: lambda mode: mode is GateMode.ESTOPPED,
    Order.RESET: lambda mode: mode is not GateMode.ESTOPPED,
    Order.STOP: lambda mode: not mode.moving,
    Order.ASK: lambda _: True,
    Order.HAND_OVER: lambda _: True,
}
"""Modes that show an order as carried out."""

STANDSTILL: Final = 4.0
"""Seconds for the truck to come to rest."""

GRADUAL: Final = frozenset({Order.DISARM, Order.STOP})
"""Orders that end with the truck at rest; the others take effect at once."""


def register(rpc: RpcRegistry, bus: Bus, clock: Clock) -> None:
    """Serve every ``Order`` under its name; the payload is a ``ControlRequest``, the answer a ``GateState``.

    Args:
        rpc: where.
        bus: carries the orders to the gate.
        clock: time.
    """
    for order in Order:
        role = AccessRole.OBSERVER if order is Order.ESTOP else AccessRole.PILOT
        rpc.register(order.value, partial(_carry_out, bus, clock, order), role)


async def _carry_out(bus: Bus, clock: Clock, order: Order, payload: dict[str, Any]) -> dict[str, Any]:
    request = parse_request(ControlRequest, {**payload, "order": order.value})
    with bus.subscribe(GATE, fifo(64)) as states:
        states.drain()
        (decision,) = bus.inject(REQ_CONTROL, request)
        assert isinstance(decision, Decision)
        if decision.reason is not Reason.OK:
            raise RequestRefusedError(decision.reason, decision.text)
        try:
            async with clock.deadline(STANDSTILL):
                while True:
                    state = await states.next()
                    if CARRIED_OUT[order](state.mode):
                        return state.model_dump(mode="json")
                    if order not in GRADUAL:
                        raise RequestRefusedError(state.worst)
        except TimeoutError:
            msg = f"{order.value} accepted, but standstill is not confirmed after {STANDSTILL:g} s"
            raise NoAnswerError(msg) from None
