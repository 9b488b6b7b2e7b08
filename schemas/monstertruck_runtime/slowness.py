"""Slow computers on the virtual clock: a run takes as much time as on a slower computer.

The processor time of every turn of a service's tasks is measured, and virtual time advances by this time multiplied by
a factor: timers due meanwhile fire late, as on that computer. A worker's result is delivered after its declared latency
or its measured processor time, whichever is longer, multiplied by the factor; each worker has its own processor. Such
runs depend on the speed of this computer and are not reproducible. Without a factor no time is measured, and runs are
reproducible.

Callbacks outside of service tasks (bytes of the links, the world) take no time.
"""

import asyncio
from collections.abc import Callable, Coroutine, Generator
from contextvars import ContextVar
from typing import Any, Final, Literal, TypeVar
from weakref import WeakKeyDictionary

from monstertruck_runtime.clock import Clock, VirtualClock, processor_time

T = TypeVar("T")

Board = Literal["xu4", "pi2"]

BOARDS: Final[dict[Board, float]] = {"xu4": 5.0, "pi2": 20.0}
"""Estimates, measured on no board: Dhrystone figures of one core (Cortex-A15 3.5 DMIPS/MHz at 2.0 GHz, Cortex-A7 1.9 at
0.9 GHz) against some 35 000 DMIPS of the reference computer's core."""

_module: ContextVar[str | None] = ContextVar("module", default=None)
"""Service of the current task; tasks inherit it from their creators."""


def factor_of(slowness: float | Board) -> float:
    """Return the factor, given as a number or by the name of a board."""
    return slowness if isinstance(slowness, float) else BOARDS[slowness]


class SlowComputer:
    """A computer with cores ``factor`` times slower than this one.

    Args:
        clock: clock whose time advances; at most one slow computer per clock.
        factor: ratio of the computing times.
    """

    def __init__(self, clock: VirtualClock, factor: float) -> None:
        self.factor = factor
        self.turns: dict[str, list[float]] = {}
        """Processor time on this computer (s) of every turn of every service, and of every step of every worker."""
        self._clock = clock
        _computers[clock] = self
        asyncio.get_running_loop().set_task_factory(self._task)

    def service(self, name: str, work: Coroutine[Any, Any, T]) -> Coroutine[Any, Any, T]:
        """Wrap ``work`` as the service ``name``, to be run by a task; tasks that it creates belong to the service."""
        return _Measured(work, name, self)

    def note(self, name: str, used: float) -> None:
        """Record processor time (s) that delays no other task."""
        self.turns.setdefault(name, []).append(used)

    def charge(self, name: str, used: float) -> None:
        """Record processor time (s) of the loop, and advance the virtual time by its duration on the slow computer."""
        self.note(name, used)
        self._clock.spend(used * self.factor)

    def _task(self, loop: asyncio.AbstractEventLoop, work: Any, **options: Any) -> asyncio.Task[Any]:
        name = _module.get()
        return asyncio.Task(work if name is None else _Measured(work, name, self), loop=loop, **options)


_computers: WeakKeyDictionary[Clock, SlowComputer] = WeakKeyDictionary()


def slow_computer(clock: Clock) -> SlowComputer | None:
    """Computer simulated by a clock; None: this one, at full speed."""
    return _computers.get(clock)


class _Measured(Coroutine[Any, Any, T]):
    """Coroutine whose turns are measured."""

    def __init__(self, work: Coroutine[Any, Any, T], name: str, computer: SlowComputer) -> None:
        self._work = work
        self._name = name
        self._computer = computer

    def send(self, value: Any) -> Any:
        """Run the coroutine up to its next await."""
        _module.set(self._name)
        return self._turn(self._work.send, value)

    def throw(self, *error: Any) -> Any:
        """Raise an exception in the coroutine and run it up to its next await."""
        _module.set(self._name)
        return self._turn(self._work.throw, *error)

    def close(self) -> None:
        """End the coroutine at its current await."""
        self._work.close()

    def __await__(self) -> Generator[Any, Any, T]:
        """Raise: only tasks run this coroutine, by ``send`` and ``throw``."""
        raise NotImplementedError

    def _turn(self, go_on: Callable[..., Any], *arguments: Any) -> Any:
        begin = processor_time()
        try:
            return go_on(*arguments)
        finally:
            self._computer.charge(self._name, processor_time() - begin)
