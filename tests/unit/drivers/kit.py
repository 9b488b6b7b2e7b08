"""What a service publishes, reports and hears, for tests without a bus."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any, Generic, TypeVar

from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason

M = TypeVar("M", bound=Message)


class Kept(Generic[M]):
    """Publisher that keeps everything."""

    def __init__(self) -> None:
        self.kept: list[M] = []
        self._more = asyncio.Event()

    @property
    def last(self) -> M:
        return self.kept[-1]

    def next_seq(self) -> int:
        return len(self.kept)

    def put(self, message: M) -> None:
        self.kept.append(message)
        self._more.set()

    async def count(self, more: int) -> None:
        """Wait for so many messages from now on."""
        wanted = len(self.kept) + more
        async with asyncio.timeout(30):
            while len(self.kept) < wanted:
                self._more.clear()
                await self._more.wait()


class Latest(Generic[M]):
    """Subscription of which only ``latest`` is used."""

    def __init__(self) -> None:
        self.latest: M | None = None
        self.drops = 0

    async def next(self) -> M:
        raise NotImplementedError


class Events:
    def __init__(self) -> None:
        self.kept: list[tuple[Reason, Severity, str, dict[str, Any]]] = []

    def __call__(self, reason: Reason, severity: Severity, source: str, text: str = "", **values: Any) -> None:
        self.kept.append((reason, severity, text, values))

    def reasons(self) -> list[Reason]:
        return [reason for reason, *_ in self.kept]


@contextlib.asynccontextmanager
async def background(coroutine: Any) -> AsyncIterator[asyncio.Task[Any]]:
    """Runs beside the test; a failure is raised at the end."""
    task = asyncio.create_task(coroutine)
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
