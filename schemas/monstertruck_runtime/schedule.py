"""Periodic work without drift."""

from monstertruck_runtime.clock import MILLISECOND, SECOND, Clock


class Schedule:
    """Instants on one fixed grid. Those that were missed by a millisecond are skipped, not made up for.

    Args:
        clock: time; the grid begins at its present millisecond, for timers have no finer steps.
        rate: instants per second.
    """

    def __init__(self, clock: Clock, rate: float) -> None:
        self._clock = clock
        self._period = round(SECOND / rate)
        now = clock.now()
        self._due = now - now % MILLISECOND - self._period

    async def next(self) -> int:
        """Wait for the next instant of the grid, at once the first time.

        Returns:
            When it was due, ns.
        """
        passed = self._clock.now() - self._due - MILLISECOND
        self._due += self._period * max(1, -(-passed // self._period))
        await self._clock.sleep_until(self._due)
        return self._due
