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
        np.percentile(self._ring, 50)  # its first call loads modules for milliseconds: not within a control tick

    def record(self, lateness: float) -> None:
        """Add one tick, seconds late."""
        self._ring[self.ticks % len(self._ring)] = lateness
        self.ticks += 1
        self._max = max(self._max, lateness)

    def lateness(self) -> Lateness:
        """Percentiles over the ticks remembered, maximum over all."""
        if self.ticks == 0:
            return Lateness(0, 0.0, 0.0, 0.0)
        p50, p99 = np.percentile(self._ring[: self.ticks], (50, 99))
        return Lateness(self.ticks, float(p50), float(p99), self._max)
