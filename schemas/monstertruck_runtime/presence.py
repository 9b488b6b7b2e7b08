"""Waits for a later message of a robot that may restart or fall silent, or whose service may fail."""

import asyncio
from collections.abc import Awaitable
from typing import Any, Final, NoReturn, Protocol, TypeVar

from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import Delivery, Mailbox, latest
from monstertruck_schemas.health import HealthTable, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateState
from monstertruck_schemas.topics import GATE, HEALTH

T = TypeVar("T")

GONE: Final = 2.0
"""Maximum gap in the gate state, sent ten times a second, before a driving client gives up (s)."""


class Subscriber(Protocol):
    """A client that subscribes to topics."""

    def subscribe(self, topic: Any, delivery: Delivery) -> Any:
        """A mailbox that is a context manager."""


async def while_it_runs(robot: Subscriber, work: Awaitable[T], needs: ServiceName) -> T:
    """Return the result of ``work``, which waits for a message of the service ``needs`` of the robot's current run.

    Raises:
        RequestRefusedError: the service failed, or the robot restarted, so the new run does not know the request.
        NoAnswerError: the robot has been silent for 60 s.
        Exception: raised by ``work``.
    """
    working = asyncio.ensure_future(work)
    with robot.subscribe(GATE, latest()) as gate, robot.subscribe(HEALTH, latest()) as health:
        watching = asyncio.create_task(_until_gone(gate, health, needs))
        try:
            await asyncio.wait((working, watching), return_when=asyncio.FIRST_COMPLETED)
            return working.result() if working.done() else watching.result()
        finally:
            working.cancel()
            watching.cancel()
            await asyncio.gather(working, watching, return_exceptions=True)


async def _until_gone(gate: Mailbox[GateState], health: Mailbox[HealthTable], needs: ServiceName) -> NoReturn:
    run: str | None = None
    # Maximum gap before a waiting client gives up: shorter losses of the link recover, and the robot continues by
    # itself meanwhile.
    lost = 60.0
    while (state := await gate.next_within(lost)) is not None:
        run = run or state.nonce
        if state.nonce != run:
            raise RequestRefusedError(Reason.SHUTDOWN, "the robot's daemon was restarted meanwhile")
        for service in () if health.latest is None else health.latest.services:
            if service.name == needs and service.state is ServiceState.FAILED:
                raise RequestRefusedError(Reason.SERVICE_FAILED, f"{service.name}: {service.detail}")
    raise NoAnswerError(f"the robot has been silent for {lost:g} s: it may be driving on")
