"""Time, injected everywhere: wall, virtual and replay clocks, and the event loops that carry them.

Every coroutine sleeps on its event loop as usual (``asyncio.sleep``, ``asyncio.timeout``); what differs is
the loop. ``VirtualLoop`` jumps to the next timer as soon as nothing is ready to run, so an hour of driving
takes as long as its computations, and two runs of one seed are identical. A replay clock is a virtual loop
that starts at the log's first stamp and can be held to a multiple of real time.

This is the only module that may import ``time``.
"""

import asyncio
import contextvars
import heapq
import selectors
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from typing import Any, Protocol, TypeVar, TypeVarTuple

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

SECOND = 1_000_000_000
"""Nanoseconds of a second."""


class Clock(Protocol):
    """What a service may know of time."""

    def now(self) -> int:
        """Nanoseconds of the daemon's monotonic time."""
        ...

    def real_offset(self) -> int:
        """Nanoseconds to add to ``now()`` for real (UNIX) time."""
        ...

    async def sleep(self, seconds: float) -> None:
        """Wait at least ``seconds``."""
        ...

    async def sleep_until(self, instant: int) -> None:
        """Wait until ``now() >= instant``; returns at once if that has passed."""
        ...

    def deadline(self, seconds: float) -> asyncio.Timeout:
        """Async context manager that raises ``TimeoutError`` inside after ``seconds``."""
        ...


class _LoopClock(ABC):
    """Shared part: sleeping rests on the running loop, whatever carries it."""

    @abstractmethod
    def now(self) -> int: ...

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def sleep_until(self, instant: int) -> None:
        while (left := instant - self.now()) > 0:
            await asyncio.sleep(left / SECOND)

    def deadline(self, seconds: float) -> asyncio.Timeout:
        return asyncio.timeout(seconds)


class WallClock(_LoopClock):
    """CLOCK_MONOTONIC and the ordinary event loop."""

    def now(self) -> int:
        """Nanoseconds of CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def real_offset(self) -> int:
        """Offset of CLOCK_REALTIME, read back to back with CLOCK_MONOTONIC."""
        before = time.monotonic_ns()
        real = time.time_ns()
        return real - (before + time.monotonic_ns()) // 2


class VirtualLoop(asyncio.SelectorEventLoop):
    """Event loop whose time jumps to the next timer when nothing is ready.

    Timers of one instant fire in the order in which they were set, so that nothing but the seed decides a run.

    Args:
        start: first instant, ns.
        rate: greatest speed relative to real time; ``None`` runs as fast as it can.
    """

    _scheduled: list[asyncio.TimerHandle]

    def __init__(self, start: int = 0, rate: float | None = None) -> None:
        self._now = start
        self._real_start = time.monotonic_ns()
        self._start = start
        self._rate = rate
        self._timers_set = 0
        self.woken = threading.Event()
        """Another thread has something for the loop."""
        super().__init__(_JumpingSelector(self))

    def time(self) -> float:
        """Virtual seconds."""
        return self._now / SECOND

    def now(self) -> int:
        """Virtual nanoseconds."""
        return self._now

    def call_at(
        self, when: float, callback: Callable[[*Ts], object], *args: *Ts, context: contextvars.Context | None = None
    ) -> asyncio.TimerHandle:
        """As in asyncio, but first set, first fired."""
        timer = _OrderedTimer(when, callback, args, self, context)
        timer.order = self._timers_set
        self._timers_set += 1
        heapq.heappush(self._scheduled, timer)
        timer._scheduled = True  # noqa: SLF001  # the loop's own mark
        return timer

    def call_soon_threadsafe(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: contextvars.Context | None = None
    ) -> asyncio.Handle:
        """As in asyncio; also tells the selector, which otherwise never asks the kernel."""
        handle = super().call_soon_threadsafe(callback, *args, context=context)
        self.woken.set()
        return handle

    def jump(self, seconds: float) -> None:
        """Advance by ``seconds``; called by the selector when nothing is ready.

        One nanosecond is added because the loop compares timers in float seconds.
        """
        self._now += round(seconds * SECOND) + 1
        if self._rate is not None:
            due = self._real_start + int((self._now - self._start) / self._rate)
            time.sleep(max(0, due - time.monotonic_ns()) / SECOND)


class _OrderedTimer(asyncio.TimerHandle):
    """Timer that yields to those of the same instant that were set before it."""

    __slots__ = ("order",)
    order: int
    _when: float
    _scheduled: bool

    def __lt__(self, other: "_OrderedTimer") -> bool:  # type: ignore[override]  # a heap of these alone; it is hot
        mine, theirs = self._when, other._when
        return mine < theirs or (mine == theirs and self.order < other.order)


class _JumpingSelector(selectors.DefaultSelector):
    """Never waits for a timer: if nothing came, the loop jumps.

    With nothing but the loop's own wake-up pipe registered, the kernel is asked only when a thread has woken the
    loop, or when there is no timer to jump to: asking at every turn would cost an eighth of a run.
    """

    def __init__(self, loop: VirtualLoop) -> None:
        super().__init__()
        self._loop = loop
        self._files = 0

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        key = super().register(fileobj, events, data)
        self._files += 1
        return key

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        key = super().unregister(fileobj)
        self._files -= 1
        return key

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        events: list[tuple[selectors.SelectorKey, int]] = []
        if timeout is None:
            self._loop.woken.clear()
            return super().select(None)
        if self._files > 1 or self._loop.woken.is_set():
            self._loop.woken.clear()
            events = super().select(0)
        if not events and timeout > 0:
            self._loop.jump(timeout)
        return events


class VirtualClock(_LoopClock):
    """Clock of a ``VirtualLoop``; its real time is fixed but for ``step_real``, so that runs are reproducible."""

    def __init__(self, loop: VirtualLoop, real_offset: int = 0) -> None:
        self._loop = loop
        self._real_offset = real_offset

    def now(self) -> int:
        """Virtual nanoseconds."""
        return self._loop.now()

    def real_offset(self) -> int:
        """The offset given at construction, and the steps since."""
        return self._real_offset

    def step_real(self, seconds: float) -> None:
        """Set the real time forwards or back, as an operator or a time server does."""
        self._real_offset += round(seconds * SECOND)


class ReplayClock(VirtualClock):
    """Clock of a recorded run: starts at the log's first stamp, with the log's own real-time offset."""


def run_virtual(
    main: Callable[[VirtualClock], Coroutine[Any, Any, T]], *, start: int = SECOND, rate: float | None = None
) -> T:
    """Run ``main(clock)`` to its end on a virtual loop of its own.

    Args:
        main: coroutine function that gets the clock.
        start: first instant, ns.
        rate: greatest speed relative to real time; ``None`` = unlimited.
    """
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(start, rate)) as runner:
        loop = runner.get_loop()
        assert isinstance(loop, VirtualLoop)
        return runner.run(main(VirtualClock(loop)))


def run_replay(
    main: Callable[[ReplayClock], Coroutine[Any, Any, T]], *, start: int, real_offset: int, rate: float | None
) -> T:
    """Run ``main(clock)`` on a loop that starts at ``start`` and is paced to ``rate`` times real time."""
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(start, rate)) as runner:
        loop = runner.get_loop()
        assert isinstance(loop, VirtualLoop)
        return runner.run(main(ReplayClock(loop, real_offset)))


def run_wall(main: Callable[[WallClock], Coroutine[Any, Any, T]]) -> T:
    """Run ``main(clock)`` on the ordinary event loop."""
    with asyncio.Runner() as runner:
        return runner.run(main(WallClock()))
