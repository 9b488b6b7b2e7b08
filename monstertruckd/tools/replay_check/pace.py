"""A clock for services to tick as they did in a recorded run, not by their schedules.

A tick on the wall clock comes some time after it is due; whether a reading in between was taken follows from the log.
Messages are logged in the order of their publication, and a service that reads its inputs and publishes without an
await in between has read exactly those before its output. So its tick waits until the replay reaches that output, and
has that output's stamp as its time.
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
        """The running task ticks by this; tasks that it starts do not."""
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
        """For the running task it is ``instant``, ns, while the context lasts."""
        self.instant = instant
        self.adopt()
        yield
        task = asyncio.current_task()
        assert task is not None
        del _PACES[task]

    async def hold(self) -> None:
        """Called by the service's clock: wait for the next tick."""
        self._held = asyncio.get_running_loop().create_future()
        try:
            await self._held
        finally:
            self._held = None

    async def release(self, instant: int) -> None:
        """Let the service have its turn at ``instant``, ns, when the loop comes to it; once for each instant."""
        if instant == self.instant:
            return
        while self._held is None or self._held.done():
            await asyncio.sleep(0)
        self.instant = instant
        self._held.set_result(None)


class RecordedTurns:
    """Results of the worker count when the log shows them, however long the worker takes now."""

    def __init__(self) -> None:
        self._waiting: deque[asyncio.Future[None]] = deque()
        self._open = False

    async def wait(self, _: VirtualClock, due: int) -> None:
        """Wait for ``next``; when the worker was thought to be done, ``due``, does not matter."""
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
        """Nothing waits any longer: the log is at its end."""
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
        """Wait until ``instant`` to the nanosecond: a jump of the loop ends one beyond its timer."""
        await super().sleep_until(instant - 1)
