"""Turns on a virtual clock, taken strictly in the order (due, sequence)."""

import asyncio
import heapq
import itertools
import weakref
from typing import Protocol

from monstertruck_runtime.clock import SECOND, VirtualClock


class Turns(Protocol):
    """Says when a worker's result counts."""

    async def wait(self, clock: VirtualClock, due: int) -> None:
        """Wait for the turn of a result that is due at ``due``, ns."""
        ...


class Agenda:
    """Wakes waiting coroutines at their instants; those due together in the order in which they began to wait."""

    def __init__(self) -> None:
        self._sequence = itertools.count()
        self._turns: list[tuple[int, int, asyncio.Future[None]]] = []

    async def wait(self, clock: VirtualClock, due: int) -> None:
        """Wait for the turn at ``due``, ns."""
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._turns, (due, next(self._sequence), turn))
        self._arm(clock, due)
        await turn

    def _arm(self, clock: VirtualClock, due: int) -> None:
        left = max(0, due - clock.now()) / SECOND
        asyncio.get_running_loop().call_later(left, self._ring, clock, due)

    def _ring(self, clock: VirtualClock, due: int) -> None:
        now = clock.now()
        if now < due:  # timers count in float seconds
            self._arm(clock, due)
            return
        while self._turns and self._turns[0][0] <= now:
            turn = heapq.heappop(self._turns)[2]
            if not turn.done():
                turn.set_result(None)


_agendas: "weakref.WeakKeyDictionary[VirtualClock, Turns]" = weakref.WeakKeyDictionary()


def agenda_of(clock: VirtualClock) -> Turns:
    """The one agenda all workers of a clock share."""
    return _agendas.setdefault(clock, Agenda())


def use_agenda(clock: VirtualClock, agenda: Turns) -> None:
    """Let ``agenda`` say when the results of all workers of ``clock`` count."""
    _agendas[clock] = agenda
