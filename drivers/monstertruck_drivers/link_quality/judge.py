"""From samples to a level: smoothing and hysteresis; pure."""

import math

from monstertruck_drivers.link_quality.config import LinkQualityConfig
from monstertruck_drivers.link_quality.interfaces import Sample
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import LinkLevel, LinkMedium


class LinkJudge:
    """Judges one interface after the other."""

    def __init__(self, config: LinkQualityConfig) -> None:
        self._smoothing = config.smoothing
        self._hysteresis = config.hysteresis
        self._bounds = (
            (LinkLevel.EXCELLENT, config.excellent),
            (LinkLevel.GOOD, config.good),
            (LinkLevel.FAIR, config.fair),
            (LinkLevel.POOR, config.poor),
            (LinkLevel.UNUSABLE, -math.inf),
        )
        self._forget()

    def _forget(self) -> None:
        self._name: str | None = None
        self._last = 0
        self._rank: int | None = None
        self.signal: float | None = None
        """Smoothed, dBm; None while nothing is known of it."""

    def update(self, time_ns: int, sample: Sample | None) -> LinkLevel:
        """Take one sample; None = there is no interface."""
        if sample is None or not sample.connected:
            self._forget()
            return LinkLevel.DOWN
        if sample.medium is LinkMedium.ETHERNET:
            self._forget()
            return LinkLevel.EXCELLENT
        level = sample.signal.level if sample.signal is not None else None
        if level is None:
            self._forget()
            return LinkLevel.UNKNOWN
        if sample.name != self._name:
            self._forget()
        self._name = sample.name
        self.signal = self._smoothed(level, (time_ns - self._last) / SECOND)
        self._last = time_ns
        self._rank = self._ranked(self.signal)
        return self._bounds[self._rank][0]

    def _smoothed(self, level: float, elapsed: float) -> float:
        if self.signal is None or self._smoothing == 0:
            return level
        return level + (self.signal - level) * math.exp(-elapsed / self._smoothing)

    def _ranked(self, signal: float) -> int:
        """Best level whose limit is reached; those better than the present one ask for more."""
        for rank, (_, bound) in enumerate(self._bounds):
            climbing = self._rank is not None and rank < self._rank
            if signal >= bound + (self._hysteresis if climbing else 0.0):
                return rank
        raise AssertionError("the last limit is always reached")
