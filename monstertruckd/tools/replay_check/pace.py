"""A clock that lets services tick as in a recorded run, instead of by their schedules.

A tick on the wall clock is executed some time after it is due; whether a reading in between was used follows from the
log. Messages are logged in the order of their publication, and a service that reads its inputs and publishes without an
await in between has read exactly those before its output. Its tick therefore waits until the replay reaches that
output, and has that output's stamp as its time.
"""

import asyncio
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final
from weakref import WeakKeyDictionary

from monstertruck_runtime.clock import ReplayClock, VirtualClock

_PACES: Final[WeakKeyDictionary[asyncio.Task[Any], "Pace"]] = WeakKeyDictionary()


class Pace:
    """The ticks of one service."""

    def __init__(self) -> None:
        self.instant: int | None = None
        """Time of the latest tick (ns); None before the first."""
        self._held: asyncio.Future[None] | None = None

    def adopt(self) -> None:
        """Use this pace for the running task; not for tasks that it starts."""
        task = asyncio.current_task()
        assert task is not None
        _PACES[task] = self

    @staticmethod
    def current() -> "Pace | None":
        """Pace of the running task."""
        task = asyncio.current_task()
        return None if task is None else _PACES.get(task)

    @contextmanager
    def borrowed(self, instant: int) -> Iterator[None]:
        """Set the running task's time to ``instant``, ns, while the context is open."""
        self.instant = instant
        self.adopt()
        yield
        task = asyncio.current_task()
        assert task is not None
        del _PACES[task]

    async def hold(self) -> None:
        """Wait for the next tick; called by the service's clock."""
        self._held = asyncio.get_running_loop().create_future()
        try:
            await self._held
        finally:
            self._held = None

    async def release(self, instant: int) -> None:
        """Execute the service's tick at ``instant``, ns, in a later loop iteration; once for each instant."""
        if instant == self.instant:
            return
        while self._held is None or self._held.done():
            await asyncio.sleep(0)
        self.instant = instant
        self._held.set_result(None)


class RecordedTurns:
    """Delivers results of the worker when the log shows them, however long the worker takes now."""

    def __init__(self) -> None:
        self._waiting: deque[asyncio.Future[None]] = deque()
        self._open = False

    async def wait(self, _: VirtualClock, due: int) -> None:
        """Wait for ``next``; the time when the worker's result was due is ignored."""
        del due
        if self._open:
            return
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append(turn)
        await turn

    def next(self) -> None:
        """Deliver the oldest waiting result now; if none waits, the recorded one came from inputs outside the log."""
        while self._waiting:
            turn = self._waiting.popleft()
            if not turn.done():
                turn.set_result(None)
                return

    def open(self) -> None:
        """Stop waiting: the log has ended."""
        self._open = True
        while self._waiting:
            self.next()


class PacedClock(ReplayClock):
    """A replay clock; tasks that adopted a ``Pace`` see the time of their ticks."""

    def now(self) -> int:
        """Nanoseconds of the log's daemon time."""
        pace = Pace.current()
        return super().now() if pace is None or pace.instant is None else pace.instant

    async def sleep_until(self, instant: int) -> None:
        """Wait until ``instant``, or for the next tick."""
        pace = Pace.current()
        if pace is None:
            await super().sleep_until(instant)
        else:
            await pace.hold()

    async def reach(self, instant: int) -> None:
        """Wait until ``instant`` to the nanosecond: a jump of the loop ends one nanosecond after its timer."""
        await super().sleep_until(instant - 1)
