"""Nested scopes: services start outside-in and stop inside-out.

``asyncio.TaskGroup`` cancels its members at once and in arbitrary order, so the recorder could end before the
last neutral command was written. Here a failing service only interrupts the owner of the scopes; then every scope
ends its services, the newest first and each completely, before the scope around it ends any.
"""

import asyncio
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager
from typing import Any


class Scope:
    """Services that live and end together; made by ``scope``."""

    def __init__(self, name: str) -> None:
        owner = asyncio.current_task()
        assert owner is not None
        self.name = name
        self.failures: list[BaseException] = []
        self._owner = owner
        self._tasks: list[asyncio.Task[None]] = []
        self.interrupted = False
        self._ending = False

    def start(self, name: str, service: Coroutine[Any, Any, None]) -> None:
        """Run ``service`` until the scope ends; its exception ends this scope and all scopes inside."""
        task = asyncio.create_task(service, name=f"{self.name}/{name}")
        task.add_done_callback(self._done)
        self._tasks.append(task)

    async def end(self) -> bool:
        """End all services, newest first and each completely, whatever cancels the owner meanwhile.

        Returns:
            True if the owner was cancelled meanwhile by somebody else, who must still hear of it.
        """
        self._ending = True
        disturbed = False
        for task in reversed(self._tasks):
            task.cancel()
            while not task.done():
                try:
                    await asyncio.wait([task])
                except asyncio.CancelledError:
                    disturbed = True
        if self.interrupted:
            self._owner.uncancel()
        return disturbed

    def _done(self, task: asyncio.Task[None]) -> None:
        if task.cancelled() or (error := task.exception()) is None:
            return
        self.failures.append(error)
        if not self.interrupted and not self._ending:
            self.interrupted = True
            self._owner.cancel()


@asynccontextmanager
async def scope(name: str) -> AsyncIterator[Scope]:
    """Open a scope; on exit its services are cancelled one by one, newest first, each awaited.

    Raises:
        BaseExceptionGroup: what its services raised, with the body's own exception if it had one.
    """
    opened = Scope(name)
    raised: list[BaseException] = []
    try:
        yield opened
    except BaseException as error:
        disturbed = await opened.end()
        own = opened.interrupted and isinstance(error, asyncio.CancelledError)
        if not own:
            raised.append(error)
        if not opened.failures:
            raise
    else:
        disturbed = await opened.end()
    if opened.failures:
        raise BaseExceptionGroup(f"scope {name}", [*raised, *opened.failures])
    if disturbed:
        raise asyncio.CancelledError
