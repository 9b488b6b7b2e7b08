"""Punctuality of the control tick."""

from dataclasses import dataclass
from typing import Final

import numpy as np

KEPT: Final = 1 << 12
"""Ticks remembered: 82 s at 50 Hz."""


@dataclass(frozen=True, slots=True)
class Lateness:
    """Seconds late against the schedule."""

    ticks: int
    p50: float
    p99: float
    max: float


class TickMeter:
    """Ring of the newest latenesses; counts and keeps the maximum for ever."""

    def __init__(self, kept: int = KEPT) -> None:
        self._ring = np.zeros(kept)
        self.ticks = 0
        self._max = 0.0

    def record(self, lateness: float) -> None:
        """Add one tick, seconds late."""
        self._ring[self.ticks % len(self._ring)] = lateness
        self.ticks += 1
        self._max = max(self._max, lateness)

    def lateness(self) -> Lateness:
        """Percentiles over the ticks remembered, each one of them; maximum over all."""
        if self.ticks == 0:
            return Lateness(0, 0.0, 0.0, 0.0)
        known = self._ring[: self.ticks]
        middle, high = ((len(known) * percent + 99) // 100 - 1 for percent in (50, 99))
        ordered = np.partition(known, (middle, high))
        return Lateness(self.ticks, float(ordered[middle]), float(ordered[high]), self._max)
