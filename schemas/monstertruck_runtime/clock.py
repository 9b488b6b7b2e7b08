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
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, Final, Protocol, TypeVar, TypeVarTuple

import uvloop

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

SECOND = 1_000_000_000
"""Nanoseconds of a second."""

MILLISECOND: Final = SECOND // 1000

MANY_TIMERS: Final = 100
"""From so many on, cancelled timers are cleared away."""

LONGEST_JUMP: Final = 86_400.0
"""Seconds that a virtual loop waits at a time, as asyncio's own."""


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
        """Async context manager that raises ``TimeoutError`` inside after ``seconds``.

        On the wall clock it may be 1.5 ms early.
        """
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
    """CLOCK_MONOTONIC and uvloop, whose timers count its whole milliseconds."""

    async def sleep(self, seconds: float) -> None:
        """Wait at least ``seconds``, and one turn of the loop."""
        until = self.now() + round(seconds * SECOND)
        if until <= self.now():
            await asyncio.sleep(0)
        await self.sleep_until(until)

    async def sleep_until(self, instant: int) -> None:
        """Wait for the whole millisecond at or after ``instant``; the kernel may take most of another one."""
        while (now := self.now()) < instant:
            await asyncio.sleep((-(-instant // MILLISECOND) - now // MILLISECOND) / 1000)

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

    Timers of one instant fire in the order in which they were set, so that nothing but the seed decides a run. The
    kernel is asked only when another thread has woken the loop, when files beside its own wake-up pipe are watched, or
    when there is no timer to jump to.

    Args:
        start: first instant, ns.
        rate: greatest speed relative to real time; ``None`` runs as fast as it can.
    """

    _ready: deque[asyncio.Handle]
    _stopping: bool
    _clock_resolution: float
    _timer_cancelled_count: int

    def __init__(self, start: int = 0, rate: float | None = None) -> None:
        self.instant = start
        """Virtual nanoseconds."""
        self._real_start = time.monotonic_ns()
        self._start = start
        self._rate = rate
        self._timers: list[tuple[float, int, asyncio.TimerHandle]] = []
        """Heap of (when in s, number in the order of setting, handle)."""
        self._timers_set = 0
        self._woken = False
        """Another thread has something for the loop."""
        self._watcher = _CountingSelector()
        super().__init__(self._watcher)

    def time(self) -> float:
        """Virtual seconds."""
        return self.instant / SECOND

    def call_at(
        self, when: float, callback: Callable[[*Ts], object], *args: *Ts, context: contextvars.Context | None = None
    ) -> asyncio.TimerHandle:
        """As in asyncio, but first set, first fired."""
        timer = asyncio.TimerHandle(when, callback, args, self, context)
        heapq.heappush(self._timers, (when, self._timers_set, timer))
        self._timers_set += 1
        timer._scheduled = True  # type: ignore[attr-defined]  # noqa: SLF001  # the loop's own mark: it counts those cancelled
        return timer

    def call_soon_threadsafe(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: contextvars.Context | None = None
    ) -> asyncio.Handle:
        """As in asyncio; also notes that the kernel has to be asked."""
        handle = super().call_soon_threadsafe(callback, *args, context=context)
        self._woken = True
        return handle

    def _run_once(self) -> None:
        """One turn, in asyncio's order: events, timers, then all that is ready now."""
        timers, ready = self._timers, self._ready
        self._drop_cancelled()
        idle = not ready and not self._stopping
        events: list[tuple[selectors.SelectorKey, int]] = []
        if self._woken or self._watcher.count > 1 or (idle and not timers):
            self._woken = False
            events = self._watcher.select(None if idle and not timers else 0)
            self._process_events(events)  # type: ignore[attr-defined]
        if idle and timers and not events and (wait := timers[0][0] - self.time()) > 0:
            self.jump(min(wait, LONGEST_JUMP))
        end = self.instant / SECOND + self._clock_resolution
        while timers and timers[0][0] < end:
            timer = heapq.heappop(timers)[2]
            timer._scheduled = False  # type: ignore[attr-defined]  # noqa: SLF001
            ready.append(timer)
        for _ in range(len(ready)):
            handle = ready.popleft()
            if not handle._cancelled:  # noqa: SLF001
                handle._run()  # noqa: SLF001

    def _drop_cancelled(self) -> None:
        """Forget cancelled timers that are next, or all once they are the majority of many."""
        timers = self._timers
        if len(timers) > MANY_TIMERS and self._timer_cancelled_count > len(timers) / 2:
            timers[:] = [entry for entry in timers if not entry[2].cancelled()]
            heapq.heapify(timers)
            self._timer_cancelled_count = 0
        while timers and timers[0][2]._cancelled:  # noqa: SLF001
            heapq.heappop(timers)
            self._timer_cancelled_count -= 1

    def jump(self, seconds: float) -> None:
        """Advance by ``seconds``.

        One nanosecond is added because the loop compares timers in float seconds.
        """
        self.instant += round(seconds * SECOND) + 1
        if self._rate is not None:
            due = self._real_start + int((self.instant - self._start) / self._rate)
            time.sleep(max(0, due - time.monotonic_ns()) / SECOND)


class _CountingSelector(selectors.DefaultSelector):
    """Knows how many files are watched."""

    count = 0

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        key = super().register(fileobj, events, data)
        self.count += 1
        return key

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        key = super().unregister(fileobj)
        self.count -= 1
        return key


class VirtualClock(_LoopClock):
    """Clock of a ``VirtualLoop``; its real time is fixed but for ``step_real``, so that runs are reproducible."""

    def __init__(self, loop: VirtualLoop, real_offset: int = 0) -> None:
        self._loop = loop
        self._real_offset = real_offset

    def now(self) -> int:
        """Virtual nanoseconds."""
        return self._loop.instant

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
    """Run ``main(clock)`` on uvloop."""
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(main(WallClock()))
