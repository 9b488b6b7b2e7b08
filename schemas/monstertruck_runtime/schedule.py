"""Periodic work without drift."""

from monstertruck_runtime.clock import SECOND, Clock


class Schedule:
    """Instants on one fixed grid. Those that were missed are skipped, not made up for.

    Args:
        clock: time; the grid begins at its present instant.
        rate: instants per second.
    """

    def __init__(self, clock: Clock, rate: float) -> None:
        self._clock = clock
        self._period = round(SECOND / rate)
        self._due = clock.now() - self._period

    async def next(self) -> int:
        """Wait for the next instant of the grid, at once the first time.

        Returns:
            When it was due, ns.
        """
        passed = self._clock.now() - self._due
        self._due += self._period * max(1, -(-passed // self._period))
        await self._clock.sleep_until(self._due)
        return self._due
