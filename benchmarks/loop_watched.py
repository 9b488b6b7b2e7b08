"""The processes that ``loop.py`` measures, with a look inside.

    python loop_watched.py daemon CONFIG REPORT     the daemon, until SIGTERM
    python loop_watched.py empty REPORT SECONDS     an event loop with nothing but a tick of the gate's rate

The report is JSON. ``ticks``: every tick's instant, ns, and its lateness, ms. ``callbacks``: those of at least
``NOTABLE`` ms of processor time, as instant, ms, and what it was. ``collections``: of garbage, as instant, ms,
generation. Callbacks are looked at from SIGUSR1 on: that costs the daemon half a percent of a core or more.
"""

import asyncio
import gc
import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import uvloop

from monstertruck_runtime.clock import Schedule, WallClock, run_wall
from monstertruckd.gate.service import TickMeter

NOTABLE = 0.5
RATE = 50.0
MEASURED = {"add_reader": 1, "call_soon": 0, "call_soon_threadsafe": 0, "call_later": 1, "call_at": 1}
"""The loop's ways to take a callback, with the number of arguments before it."""


class WatchedLoop(uvloop.Loop):
    """Event loop that measures its callbacks once ``watch`` is called, without cost before."""

    def __init__(self) -> None:
        super().__init__()
        self._readers: dict[int, tuple[Callable[..., Any], tuple[Any, ...]]] = {}

    def add_reader(self, fd: Any, callback: Callable[..., Any], *args: Any) -> None:
        """Add a reader as usual, wrapped so that it can be measured later."""
        self._readers[fd] = (callback, args)
        super().add_reader(fd, callback, *args)

    def remove_reader(self, fd: Any) -> Any:
        """Remove a reader as usual."""
        self._readers.pop(fd, None)
        return super().remove_reader(fd)

    def watch(self, report: dict[str, Any]) -> None:
        """Measure every callback from now on."""
        found: list[tuple[int, float, str]] = report["callbacks"]
        clock = time.thread_time

        def measured(callback: Callable[..., Any], *args: Any) -> None:
            begin = clock()
            callback(*args)
            used = 1e3 * (clock() - begin)
            if used >= NOTABLE:
                found.append((time.monotonic_ns(), used, _name(callback)))

        def through(method: Callable[..., Any], before: int) -> Callable[..., Any]:
            """Return ``method`` with its callback, after ``before`` other arguments, measured once."""

            def call(*args: Any, **options: Any) -> Any:
                if args[before] is measured:
                    return method(*args, **options)
                return method(*args[:before], measured, *args[before:], **options)

            return call

        for fd, (callback, args) in self._readers.items():
            super().add_reader(fd, measured, callback, *args)
        for name, before in MEASURED.items():
            setattr(self, name, through(getattr(self, name), before))


def _name(callback: Any) -> str:
    """Return the task's name and coroutine, or the function."""
    task = getattr(callback, "__self__", None)
    if isinstance(task, asyncio.Task):
        return f"{task.get_name()}: {task.get_coro().__qualname__}"  # type: ignore[union-attr]
    return getattr(callback, "__qualname__", repr(callback))


def watch_collector(report: dict[str, Any]) -> None:
    """Measure every garbage collection: generation and ms of processor time."""
    found: list[tuple[int, float, int]] = report.setdefault("collections", [])
    begin = 0.0

    def measure(phase: str, info: dict[str, int]) -> None:
        nonlocal begin
        if phase == "start":
            begin = time.thread_time()
        else:
            found.append((time.monotonic_ns(), 1e3 * (time.thread_time() - begin), info["generation"]))

    gc.callbacks.append(measure)


def watch_ticks(report: dict[str, Any]) -> None:
    """Record the gate's reports to its meter."""
    ticks: list[tuple[int, float]] = report.setdefault("ticks", [])
    record = TickMeter.record

    def noted(meter: TickMeter, lateness: float) -> None:
        ticks.append((time.monotonic_ns(), 1e3 * lateness))
        record(meter, lateness)

    TickMeter.record = noted  # type: ignore[method-assign]


async def empty(clock: WallClock, report: dict[str, Any], seconds: float) -> None:
    """Measure the floor: ticks awaited like the gate's, without work."""
    schedule = Schedule(clock, RATE)
    ticks = report.setdefault("ticks", [])
    for _ in range(round(seconds * RATE)):
        due = await schedule.next()
        now = clock.now()
        ticks.append((now, (now - due) / 1e6))


def main() -> None:
    """Run the given process, then write the report."""
    report: dict[str, Any] = {"callbacks": []}
    if sys.argv[1] == "empty":
        target = Path(sys.argv[2])
        run_wall(lambda clock: empty(clock, report, float(sys.argv[3])))
    else:
        from monstertruckd.run import run_daemon  # noqa: PLC0415  # the empty loop's process stays empty

        target = Path(sys.argv[3])
        watch_ticks(report)
        watch_collector(report)
        loop = WatchedLoop()
        uvloop.new_event_loop = lambda: loop
        signal.signal(signal.SIGUSR1, lambda *_: loop.watch(report))
        run_daemon(Path(sys.argv[2]), verbose=False)
    target.write_text(json.dumps(report))


if __name__ == "__main__":
    main()
