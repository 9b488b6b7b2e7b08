"""Judgement of the battery: median, smoothing, hysteresis and dwell; pure, fed with samples and their times."""

import math
import statistics
from collections import deque
from typing import Final

from monstertruck_drivers.maestro.config import BatteryConfig
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import BatteryLevel

WINDOW: Final = 5
"""Samples of the median: shorter spikes and connector bounces do not count."""
GAP: Final = SECOND
"""Nanoseconds without a sample after which nothing counts as continuous any more."""


class Dwell:
    """True once a condition has held without a break for some seconds."""

    def __init__(self, seconds: float) -> None:
        self._needed = round(seconds * SECOND)
        self._since: int | None = None

    def update(self, time_ns: int, condition: bool) -> bool:
        """Tell the condition at ``time_ns``."""
        if not condition:
            self._since = None
            return False
        if self._since is None:
            self._since = time_ns
        return time_ns - self._since >= self._needed


class BatteryJudge:
    """Turns voltage samples into a smoothed voltage and a level."""

    def __init__(self, config: BatteryConfig) -> None:
        self._config = config
        self._level = BatteryLevel.UNKNOWN
        self._last: int | None = None
        self._reset()

    def _reset(self) -> None:
        config = self._config
        self._samples: deque[float] = deque(maxlen=WINDOW)
        self._smooth: float | None = None
        self._low = Dwell(config.low_after)
        self._critical = Dwell(config.critical_after)
        self._collapsed = Dwell(config.collapsed_after)
        self._clear = Dwell(config.clear_after)

    def update(self, time_ns: int, voltage: float) -> tuple[float | None, BatteryLevel]:
        """Take one sample.

        Args:
            time_ns: when it was taken; must not go back.
            voltage: pack voltage, V.

        Returns:
            Smoothed voltage (None while the sensor is at fault or too few samples came) and level.
        """
        elapsed = 0 if self._last is None else time_ns - self._last
        if elapsed > GAP:
            self._reset()
        self._last = time_ns
        self._samples.append(voltage)
        if len(self._samples) < WINDOW:
            return None, self._level
        median = statistics.median(self._samples)
        if not self._config.plausible_min <= median <= self._config.plausible_max:
            # Nothing measured during the fault may count; the samples stay, so that its end is noticed.
            samples = self._samples
            self._reset()
            self._samples = samples
            return None, BatteryLevel.SENSOR_FAULT
        self._smooth = self._smoothed(median, elapsed / SECOND)
        self._level = self._judge(time_ns, median)
        return self._smooth, self._level

    def _smoothed(self, median: float, elapsed: float) -> float:
        if self._smooth is None or self._config.smoothing == 0:
            return median
        return median + (self._smooth - median) * math.exp(-elapsed / self._config.smoothing)

    def _judge(self, time_ns: int, volts: float) -> BatteryLevel:
        config = self._config
        low = self._low.update(time_ns, volts < config.low)
        critical = self._critical.update(time_ns, volts < config.critical)
        collapsed = self._collapsed.update(time_ns, volts < config.collapsed)
        clear = self._clear.update(time_ns, volts > config.clear)
        if critical or collapsed:
            return BatteryLevel.CRITICAL
        if self._level in (BatteryLevel.LOW, BatteryLevel.CRITICAL):
            return BatteryLevel.NORMAL if clear else self._level
        return BatteryLevel.LOW if low else BatteryLevel.NORMAL
