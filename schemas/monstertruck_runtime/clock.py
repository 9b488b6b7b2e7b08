"""Injected time: wall, virtual and replay clocks, and their event loops.

Every coroutine sleeps on its event loop as usual (``asyncio.sleep``, ``asyncio.timeout``); only the loop differs.
``VirtualLoop`` jumps to the next timer as soon as no task is ready, so an hour of driving takes only its computing
time, and two runs with one seed are identical. A replay clock is a virtual loop that starts at the log's first stamp
and can be limited to a multiple of real time. ``Schedule`` runs periodic work without drift on any loop.

This is the only module that may import ``time``.
"""

import asyncio
import contextvars
import heapq
import itertools
import selectors
import signal
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from enum import IntEnum
from types import FrameType
from typing import Any, Final, NamedTuple, TypeVar, TypeVarTuple

import uvloop

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

SECOND = 1_000_000_000
"""Nanoseconds per second."""

MILLISECOND: Final = SECOND // 1000


MANY_TIMERS: Final = 100
"""Minimum number of timers before cancelled ones are removed."""

GUARD: Final = 300.0
"""Maximum processor time, or wait for another thread, per virtual second (s): compiling kernels takes a minute or
two.
"""
ENDING: Final = 600.0
"""Virtual seconds within which all tasks must end after a run."""


def is_date(real: int) -> bool:
    """Whether a real time (ns) is a plausible date of a run."""
    # 946_684_800 * SECOND: 2000-01-01: earlier dates come from a virtual clock, or a computer whose clock was never set
    return real >= 946_684_800 * SECOND


def minute_of_day(real: int) -> int | None:
    """Return the local time of day (minutes since midnight) at a real time (ns).

    None if the time is not a valid date.
    """
    if not is_date(real):
        return None
    local = time.localtime(real // SECOND)
    return 60 * local.tm_hour + local.tm_min


def processor_time() -> float:
    """Processor time of the calling thread (s), independent of the load of the computer."""
    return time.thread_time()


class Clock(ABC):
    """Clock passed to services; sleeping uses the timers of the running loop."""

    @abstractmethod
    def now(self) -> int:
        """Daemon time (monotonic), ns."""

    @abstractmethod
    def real_offset(self) -> int:
        """Offset from ``now()`` to real (UNIX) time, ns."""

    async def sleep(self, seconds: float) -> None:
        """Wait at least ``seconds``."""
        await asyncio.sleep(seconds)

    async def sleep_until(self, instant: int) -> None:
        """Wait until ``now() >= instant``; returns at once if that has passed."""
        while (left := instant - self.now()) > 0:
            await asyncio.sleep(left / SECOND)

    def deadline(self, seconds: float) -> asyncio.Timeout:
        """Async context manager that raises ``TimeoutError`` inside after ``seconds``.

        On the wall clock it may trigger 1.5 ms early.
        """
        return asyncio.timeout(seconds)


class WallClock(Clock):
    """CLOCK_MONOTONIC with uvloop, whose timers have millisecond resolution."""

    async def sleep(self, seconds: float) -> None:
        """Wait at least ``seconds``, and one iteration of the event loop."""
        await self.sleep_until(self.now() + round(seconds * SECOND))

    async def sleep_until(self, instant: int) -> None:
        """Wait for the full millisecond at or after ``instant``; the kernel may add almost a millisecond.

        If it has passed, wait one iteration of the event loop, so that a late task does not starve the others.
        """
        while True:
            await asyncio.sleep(max(-(-instant // MILLISECOND) - self.now() // MILLISECOND, 0) / 1000)
            if self.now() >= instant:
                return

    def now(self) -> int:
        """Nanoseconds of CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def real_offset(self) -> int:
        """Offset of CLOCK_REALTIME, read immediately after CLOCK_MONOTONIC."""
        before = time.monotonic_ns()
        real = time.time_ns()
        return real - (before + time.monotonic_ns()) // 2


class HungError(RuntimeError):
    """Virtual time does not advance, or tasks do not end; their stacks were written to standard error."""


ON_COMPUTER: Final[contextvars.ContextVar[bool]] = contextvars.ContextVar("on_computer", default=False)
"""True for tasks on the robot's computer, whose loop can stall while world and devices continue: see
``VirtualLoop.stall``.
"""


def on_computer() -> contextvars.Context:
    """Return a context for tasks and callbacks of the robot's computer; tasks that they start inherit it."""
    context = contextvars.copy_context()
    context.run(ON_COMPUTER.set, True)
    return context


class VirtualLoop(asyncio.SelectorEventLoop):
    """Event loop whose time jumps to the next timer when no task is ready.

    Timers of the same instant fire in the order of their creation, so only the seed determines a run. An exception
    outside ``Exception`` in a callback, such as a test's timeout, ends the run.

    Args:
        start: initial time, ns.
        rate: maximum speed relative to real time; None: unlimited.
        guard: see ``GUARD``.
    """

    def __init__(self, start: int = 0, rate: float | None = None, guard: float = GUARD) -> None:
        self.instant = start
        """Virtual nanoseconds."""
        self.woken = False
        """Set when another thread has added a callback."""
        self._real_start = time.monotonic_ns()
        self._start = start
        self._rate = rate
        self._timers: list[_Timer] = []
        """Heap of timers."""
        self._timers_set = 0
        self._most_timers = MANY_TIMERS
        self._held: list[asyncio.Handle] | None = None
        """Callbacks waiting for the end of a stall; None without a stall."""
        self._guard = guard
        self._turns = 0
        self._guarded_second = -1
        self._used = 0.0
        """Processor time at the start of the current virtual second (s)."""
        self._end_by: int | None = None
        super().__init__(_VirtualSelector(self))

    def time(self) -> float:
        """Virtual seconds."""
        return self.instant / SECOND

    def call_at(
        self, when: float, callback: Callable[[*Ts], object], *args: *Ts, context: contextvars.Context | None = None
    ) -> asyncio.TimerHandle:
        """Schedule as asyncio does; timers of the same instant fire in the order of creation."""
        if len(self._timers) > self._most_timers:
            self._timers = [timer for timer in self._timers if not timer.handle.cancelled()]
            heapq.heapify(self._timers)
            self._most_timers = 2 * len(self._timers) + MANY_TIMERS
        context = contextvars.copy_context() if context is None else context
        handle = asyncio.TimerHandle(when, callback, args, self, context)
        heapq.heappush(self._timers, _Timer(when, self._timers_set, handle, callback, args, context))
        self._timers_set += 1
        return handle

    def call_soon_threadsafe(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: contextvars.Context | None = None
    ) -> asyncio.Handle:
        """Schedule as asyncio does; also note that the kernel must be polled."""
        handle = super().call_soon_threadsafe(callback, *args, context=context)
        self.woken = True
        return handle

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        """Handle as asyncio does, but raise an exception outside ``Exception`` from the running loop."""
        error = context.get("exception")
        if error is not None and not isinstance(error, Exception | asyncio.CancelledError):
            raise error
        super().call_exception_handler(context)

    def end_soon(self) -> None:
        """Announce the end of the run: its tasks have ``ENDING`` to end."""
        self._end_by = self.instant + round(ENDING * SECOND)

    def watch(self) -> None:
        """Check that virtual time advances; called in every iteration.

        Raises:
            HungError: it does not advance.
        """
        self._turns += 1
        if self._turns % 1024:  # number of loop iterations between two checks of the processor time
            return
        second, used = self.instant // SECOND, time.process_time()
        if second != self._guarded_second:
            self._guarded_second, self._used = second, used
        elif used - self._used > self._guard:
            raise self._hung(f"virtual second {second} has taken {used - self._used:.0f} s of processor time")

    def wait(self, select: Callable[[float], T]) -> T:
        """Wait for another thread or a file: no task is ready and no timer is set.

        Raises:
            HungError: the wait timed out.
        """
        for _ in range(max(1, round(self._guard))):
            if events := select(min(1.0, self._guard)):
                return events
        raise self._hung(f"all tasks have waited for {self._guard:.0f} s without a timer")

    def _hung(self, what: str) -> HungError:
        """Write the stacks of all tasks to standard error."""
        tasks = sorted(asyncio.all_tasks(self), key=lambda task: task.get_name())
        for task in tasks:
            task.print_stack(file=sys.stderr)
        return HungError(f"{what}; {len(tasks)} tasks, see their stacks")

    def stall(self, seconds: float) -> None:
        """Suspend the robot's computer for some time, as during a computation; everything else continues.

        Callbacks that become due meanwhile run afterwards, in order. A second stall during a stall has no effect.

        Args:
            seconds: duration from now.
        """
        if self._held is not None:
            return
        self._held, skipped = [], asyncio.Handle(lambda: None, (), self, contextvars.Context())
        skipped.cancel()
        ready: Any = self._ready  # type: ignore[attr-defined]
        for i, handle in enumerate(ready):
            if handle._context.get(ON_COMPUTER, False):  # noqa: SLF001 - as BaseEventLoop does
                self._held.append(handle)
                ready[i] = skipped
        self.call_soon = self._call_soon_stalled  # type: ignore[method-assign]
        self.call_at(self.time() + seconds, self._go_on, context=contextvars.Context())

    def _call_soon_stalled(
        self, callback: Callable[[*Ts], object], *args: *Ts, context: contextvars.Context | None = None
    ) -> asyncio.Handle:
        """Schedule as asyncio does, but hold back callbacks of the robot's computer during a stall."""
        context = contextvars.copy_context() if context is None else context
        if self._held is None or not context.get(ON_COMPUTER, False):
            return super().call_soon(callback, *args, context=context)
        handle = asyncio.Handle(callback, args, self, context)
        self._held.append(handle)
        return handle

    def _go_on(self) -> None:
        """End a stall."""
        held, self._held = self._held or [], None
        del self.call_soon
        self._ready.extend(held)  # type: ignore[attr-defined]

    def next_timer(self) -> float | None:
        """Seconds until the next timer that is not cancelled; None without one."""
        while self._timers and self._timers[0].handle.cancelled():
            heapq.heappop(self._timers)
        return self._timers[0].when - self.instant / SECOND if self._timers else None

    def jump(self, seconds: float) -> None:
        """Advance by ``seconds``.

        One nanosecond is added because the loop compares timers in float seconds.
        """
        self.instant += round(seconds * SECOND) + 1
        if self._end_by is not None and self.instant > self._end_by:
            self._end_by = None
            raise self._hung(f"tasks have not ended within {ENDING:.0f} virtual seconds")
        if self._rate is not None:
            due = self._real_start + int((self.instant - self._start) / self._rate)
            time.sleep(max(0, due - time.monotonic_ns()) / SECOND)

    def fire(self) -> None:
        """Pass the due timers to this iteration of the event loop."""
        end = self.time() + 1 / SECOND
        while self._timers and self._timers[0].when < end:
            timer = heapq.heappop(self._timers)
            self.call_soon(timer.run, context=timer.context)


class _Timer(NamedTuple):
    """Heap entry of a timer, ordered by time and then by number of creation."""

    when: float
    """Time, s."""
    number: int
    handle: asyncio.TimerHandle
    callback: Callable[..., object]
    args: tuple[Any, ...]
    context: contextvars.Context

    def run(self) -> None:
        if not self.handle.cancelled():
            self.callback(*self.args)


class _VirtualSelector(selectors.DefaultSelector):
    """Poll the kernel, once per loop iteration; without limit if no task is ready and no timer is set.

    The kernel is polled only when another thread has woken the loop, when files other than the wake-up pipe are
    watched, or without a timer to jump to.
    """

    def __init__(self, loop: VirtualLoop) -> None:
        super().__init__()
        self._loop = loop
        self._files = 0

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        """Watch a file, and count it."""
        key = super().register(fileobj, events, data)
        self._files += 1
        return key

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        """Stop watching a file."""
        key = super().unregister(fileobj)
        self._files -= 1
        return key

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return events of files; without watched files, the time of an idle loop jumps."""
        loop = self._loop
        loop.watch()
        idle, wait = timeout is None, loop.next_timer()
        events: list[tuple[selectors.SelectorKey, int]] = []
        if idle and wait is None:
            loop.woken = False
            events = loop.wait(super().select)
        elif loop.woken or self._files > 1:
            loop.woken = False
            events = super().select(timeout if wait is None else 0)
        if wait is None:
            return events
        if idle and not events and wait > 0:
            loop.jump(wait)
            wait = 0.0
        if wait < 1 / SECOND:
            loop.fire()
        return events


class VirtualClock(Clock):
    """Clock of a ``VirtualLoop``; its real time is fixed except for ``step_real``, so that runs are reproducible."""

    def __init__(self, loop: VirtualLoop, real_offset: int = 0) -> None:
        self._loop = loop
        self._real_offset = real_offset

    def now(self) -> int:
        """Virtual nanoseconds."""
        return self._loop.instant

    def real_offset(self) -> int:
        """Offset given at construction, plus later steps."""
        return self._real_offset

    def spend(self, seconds: float) -> None:
        """Advance time at once: timers due meanwhile fire late, as after a computation."""
        self._loop.instant += round(seconds * SECOND)

    def stall(self, seconds: float) -> None:
        """Stall the robot's computer, see ``VirtualLoop.stall``."""
        self._loop.stall(seconds)

    def step_real(self, seconds: float) -> None:
        """Step the real time forwards or back, as an operator or a time server does."""
        self._real_offset += round(seconds * SECOND)


class ReplayClock(VirtualClock):
    """Clock of a recorded run: starts at the log's first stamp, with the log's own real-time offset."""


def run_virtual(
    main: Callable[[VirtualClock], Coroutine[Any, Any, T]],
    *,
    start: int = SECOND,
    rate: float | None = None,
    guard: float = GUARD,
) -> T:
    """Run ``main(clock)`` to its end on a new virtual loop.

    Args:
        main: coroutine function that receives the clock.
        start: initial time, ns.
        rate: maximum speed relative to real time; None: unlimited.
        guard: see ``GUARD``.

    Raises:
        HungError: virtual time does not advance, or tasks do not end.
    """
    return _run(VirtualLoop(start, rate, guard), lambda loop: main(VirtualClock(loop)))


def run_replay(
    main: Callable[[ReplayClock], Coroutine[Any, Any, T]], *, start: int, real_offset: int, rate: float | None
) -> T:
    """Run ``main(clock)`` on a loop that starts at ``start`` and is paced to ``rate`` times real time."""
    return _run(VirtualLoop(start, rate), lambda loop: main(ReplayClock(loop, real_offset)))


def _run(loop: VirtualLoop, main: Callable[[VirtualLoop], Coroutine[Any, Any, T]]) -> T:
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        try:
            return runner.run(main(loop))
        finally:
            loop.end_soon()


def run_wall(main: Callable[[WallClock], Coroutine[Any, Any, T]]) -> T:
    """Run ``main(clock)`` on uvloop.

    Ctrl-C cancels it, a second one is ignored during its shutdown, a third one interrupts.

    A second Ctrl-C, or timeout(1), which signals a program and its group, must not interrupt the shutdown of ``main``,
    which stops the robot.
    """

    async def work() -> T:
        if before is signal.default_int_handler and here:
            _ignore_second_interrupt()
        return await main(WallClock())

    before, here = signal.getsignal(signal.SIGINT), threading.current_thread() is threading.main_thread()
    try:
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            return runner.run(work())
    finally:
        if here and signal.getsignal(signal.SIGINT) is not before:
            signal.signal(signal.SIGINT, before)


def _ignore_second_interrupt() -> None:
    """Ignore the second interrupt within ``asyncio.Runner``, whose handler would abort; the first one cancels."""
    handler, come = signal.getsignal(signal.SIGINT), itertools.count(1)

    def interrupt(number: int, frame: FrameType | None) -> None:
        if next(come) != 2 and callable(handler):
            handler(number, frame)

    signal.signal(signal.SIGINT, interrupt)


class Lead(IntEnum):
    """Time by which schedules precede the gate's ticks (ns); negative: follow them."""

    BEFORE_GATE = 4 * MILLISECOND
    """For most schedules: the gate's inputs are fresh at its tick, and the loop is free."""
    ESTIMATES = 5 * MILLISECOND
    """For services whose estimates others use."""
    POLLING = 8 * MILLISECOND
    """For services that query a device: unless its line is slow, the answer arrives before the estimates are made."""
    IN_THREADS = -2 * MILLISECOND
    """For services that work in threads: after the tick, which a thread holding the interpreter lock would delay."""


class Schedule:
    """Instants on a fixed grid. Instants missed by a millisecond or more are skipped.

    Schedules of one rate have the same instants, so that services wake together: a loop that sleeps in between runs
    with cold caches, and the first service to run warms them for the others.

    Args:
        clock: source of time.
        rate: instants per second.
        ahead: lead over the multiples of the period, ns; negative: lag.
    """

    def __init__(self, clock: Clock, rate: float, ahead: int = Lead.BEFORE_GATE) -> None:
        self._clock = clock
        self._period = round(SECOND / rate)
        self._ahead = ahead
        self._behind: int | None = None
        """The next instant is the first one of the grid after this time."""

    async def next(self) -> int:
        """Wait for the next instant; return its time, ns."""
        due = self._step(self._clock.now() - MILLISECOND)
        await self._clock.sleep_until(due)
        return due

    def step(self) -> int:
        """Next instant (ns), for callers that wait themselves; now if it was missed."""
        due = self._step(0)
        if (newest := self._clock.now() - MILLISECOND) > due:
            self._behind = due = newest
        return due

    def _step(self, earliest: int) -> int:
        """Next instant after ``earliest``: the first one immediately, the second at least half a period later."""
        if self._behind is None:
            now = self._clock.now()
            due = now - now % MILLISECOND
            self._behind = due + self._period // 2
        else:
            behind = max(self._behind, earliest)
            self._behind = due = behind + self._period - (behind + self._ahead) % self._period
        return due
