"""A client that waits for what a robot says later: the robot may restart, or fall silent forever, meanwhile."""

import asyncio
from collections.abc import Awaitable
from typing import Any, Final, NoReturn, Protocol, TypeVar

from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import Delivery, Mailbox, latest
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateState
from monstertruck_schemas.topics import GATE

T = TypeVar("T")

LOST: Final = 60.0
"""Seconds without the state of the gate, which comes ten times a second, after which waiting ends: links that are lost
for shorter come back, and the robot drives on by itself meanwhile."""


class Subscriber(Protocol):
    """A client that subscribes to topics."""

    def subscribe(self, topic: Any, delivery: Delivery) -> Any:
        """A mailbox that is a context manager."""


async def while_it_runs(robot: Subscriber, work: Awaitable[T]) -> T:
    """The result of ``work``, which waits for what the robot's present run says.

    Raises:
        RequestRefusedError: the robot restarted: its new run knows nothing of it.
        NoAnswerError: it has been silent for ``LOST`` s.
        Exception: what ``work`` raised.
    """
    working = asyncio.ensure_future(work)
    with robot.subscribe(GATE, latest()) as gate:
        watching = asyncio.create_task(_until_gone(gate))
        try:
            await asyncio.wait((working, watching), return_when=asyncio.FIRST_COMPLETED)
            return working.result() if working.done() else watching.result()
        finally:
            working.cancel()
            watching.cancel()
            await asyncio.gather(working, watching, return_exceptions=True)


async def _until_gone(gate: Mailbox[GateState]) -> NoReturn:
    run: str | None = None
    while (state := await gate.next_within(LOST)) is not None:
        run = run or state.nonce
        if state.nonce != run:
            raise RequestRefusedError(Reason.SHUTDOWN, "the robot's daemon was restarted meanwhile")
    raise NoAnswerError(f"the robot has been silent for {LOST:g} s: it may be driving on")
