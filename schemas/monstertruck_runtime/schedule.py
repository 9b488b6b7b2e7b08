"""Periodic work without drift."""

from monstertruck_runtime.clock import MILLISECOND, SECOND, Clock


class Schedule:
    """Instants on one fixed grid. Those that were missed by a millisecond are skipped, not made up for.

    Args:
        clock: time; the grid begins at the millisecond of the first ``next``, for timers have no finer steps.
        rate: instants per second.
    """

    def __init__(self, clock: Clock, rate: float) -> None:
        self._clock = clock
        self._period = round(SECOND / rate)
        self._due: int | None = None

    async def next(self) -> int:
        """Wait for the next instant of the grid, at once the first time.

        Returns:
            When it was due, ns.
        """
        now = self._clock.now()
        if self._due is None:
            self._due = now - now % MILLISECOND
        else:
            passed = now - self._due - MILLISECOND
            self._due += self._period * max(1, -(-passed // self._period))
        await self._clock.sleep_until(self._due)
        return self._due
