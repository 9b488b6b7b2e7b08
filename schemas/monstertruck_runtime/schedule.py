"""Periodic work without drift."""

from typing import Final

from monstertruck_runtime.clock import MILLISECOND, SECOND, Clock

AHEAD: Final = 4 * MILLISECOND
"""So long before the gate's ticks the instants of the others lie: its newest input is fresh then, and the loop free."""

ESTIMATES: Final = AHEAD + MILLISECOND
"""The same of those whose estimates the others use."""

QUESTIONS: Final = ESTIMATES + 3 * MILLISECOND
"""The same of those who ask a device: unless its line is slow, the answer is there when the estimates are made."""

IN_THREADS: Final = -2 * MILLISECOND
"""The same of those that work in threads: behind the tick, which a thread that holds the interpreter would delay."""


class Schedule:
    """Instants on one fixed grid. Of those that were missed by a millisecond none is made up for.

    Schedules of one rate have the same instants, so that services wake together: a loop that sleeps in between runs
    code from cold caches, and what comes first pays for what follows.

    Args:
        clock: time.
        rate: instants per second.
        ahead: of the multiples of the period, ns; negative: behind them.
    """

    def __init__(self, clock: Clock, rate: float, ahead: int = AHEAD) -> None:
        self._clock = clock
        self._period = round(SECOND / rate)
        self._ahead = ahead
        self._behind: int | None = None
        """The next instant is the grid's first one behind this."""

    async def next(self) -> int:
        """Wait for the next instant; returns when it was due, ns."""
        due = self._step(self._clock.now() - MILLISECOND)
        await self._clock.sleep_until(due)
        return due

    def step(self) -> int:
        """The next instant, ns, for those who wait by themselves; if it was missed, now: slow work goes on at once."""
        due = self._step(0)
        if (newest := self._clock.now() - MILLISECOND) > due:
            self._behind = due = newest
        return due

    def _step(self, earliest: int) -> int:
        """The next instant behind ``earliest``: at once the first time; the second is half a period off at least."""
        if self._behind is None:
            now = self._clock.now()
            due = now - now % MILLISECOND
            self._behind = due + self._period // 2
        else:
            behind = max(self._behind, earliest)
            self._behind = due = behind + self._period - (behind + self._ahead) % self._period
        return due
