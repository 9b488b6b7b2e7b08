"""Judgement of the battery: median, sag, smoothing, hysteresis and dwell; pure, fed with samples and their times."""

import math
import statistics
from collections import deque
from typing import Final, NamedTuple

import numpy as np

from monstertruck_drivers.battery.config import PackConfig
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.thresholds import Alarm, Dwell, Threshold
from monstertruck_schemas.sensor import BatteryLevel

WINDOW: Final = 5
"""Samples of the median: shorter spikes and connector bounces do not count."""
GAP: Final = SECOND
"""Nanoseconds without a sample after which nothing counts as continuous any more."""

CELL_VOLTS: Final = (
    3.27, 3.61, 3.69, 3.71, 3.73, 3.75, 3.77, 3.79, 3.80, 3.82, 3.84,
    3.85, 3.87, 3.91, 3.95, 3.98, 4.02, 4.08, 4.11, 4.15, 4.20,
)  # fmt: skip
"""Resting voltage of a lithium-polymer cell at 0, 5 .. 100 % (table in common circulation, of no one maker)."""

_CELL_VOLTS: Final = np.array(CELL_VOLTS)
_CHARGES: Final = np.linspace(0.0, 1.0, len(CELL_VOLTS))


def charge_of(cell_volts: float) -> float:
    """Share of the capacity left at a resting cell voltage, 0..1.

    Between 20 and 60 % a cell changes by 8 to 35 mV per 5 %, less than a 10-bit converter resolves behind a
    divider for six cells: no better than 0.1 either way.
    """
    return float(np.interp(cell_volts, _CELL_VOLTS, _CHARGES))


class Verdict(NamedTuple):
    """What is known of the battery after a sample."""

    level: BatteryLevel
    voltage: float | None = None
    """Smoothed, V; None while the sensor is at fault or too few samples came."""
    rest_voltage: float | None = None
    """As ``voltage``, without the sag."""


class BatteryJudge:
    """Turns voltage samples into smoothed voltages and a level."""

    def __init__(self, config: PackConfig) -> None:
        self._config = config
        self._level = BatteryLevel.UNKNOWN
        self._last: int | None = None
        self._reset()

    def _reset(self) -> None:
        config = self._config
        self._samples: deque[tuple[float, float]] = deque(maxlen=WINDOW)
        self._smooth: tuple[float, float] | None = None
        self._low = Dwell(config.low_after)
        self._critical = Dwell(config.critical_after)
        self._collapsed = Dwell(config.collapsed_after)
        self._clear = Dwell(config.clear_after)
        self._over = Alarm(Threshold(config.overcharged, config.overcharged_clear, config.overcharged_after))

    def update(self, time_ns: int, voltage: float, current: float | None = None) -> Verdict:
        """Take one sample.

        Args:
            time_ns: when it was taken; must not go back.
            voltage: pack voltage, V; NaN = the converter was at an end of its scale.
            current: the motor's, A, either sign; None = unknown, no sag is taken out. The pack's own current is
                smaller while the motor is slow, and has the electronics' added: both are within the table's error.
        """
        elapsed = 0 if self._last is None else time_ns - self._last
        if elapsed > GAP:
            self._reset()
        self._last = time_ns
        # An invalid sample takes part in the median as an implausible one.
        volts = -math.inf if math.isnan(voltage) else voltage
        sag = min(abs(current or 0.0) * self._config.resistance, self._config.max_compensation)
        self._samples.append((volts, volts + sag))
        if len(self._samples) < WINDOW:
            return Verdict(self._level)
        loaded, rest = (statistics.median(column) for column in zip(*self._samples, strict=True))
        if not self._config.plausible_min <= loaded <= self._config.plausible_max:
            # Nothing measured during the fault may count; the samples stay, so that its end is noticed.
            samples = self._samples
            self._reset()
            self._samples = samples
            return Verdict(BatteryLevel.SENSOR_FAULT)
        self._smooth = self._smoothed((loaded, rest), elapsed / SECOND)
        self._level = self._judge(time_ns, loaded, rest)
        return Verdict(self._level, *self._smooth)

    def _smoothed(self, new: tuple[float, float], elapsed: float) -> tuple[float, float]:
        if self._smooth is None or self._config.smoothing == 0:
            return new
        kept = math.exp(-elapsed / self._config.smoothing)
        return new[0] + (self._smooth[0] - new[0]) * kept, new[1] + (self._smooth[1] - new[1]) * kept

    def _judge(self, time_ns: int, loaded: float, rest: float) -> BatteryLevel:
        config = self._config
        low = self._low.update(time_ns, rest < config.low)
        critical = self._critical.update(time_ns, rest < config.critical)
        collapsed = self._collapsed.update(time_ns, loaded < config.collapsed)
        clear = self._clear.update(time_ns, rest > config.clear)
        # Judged by what was measured: a guess of the sag must not make a full pack overcharged.
        self._over.update(time_ns, loaded)
        if critical or collapsed:
            return BatteryLevel.CRITICAL
        if self._level in (BatteryLevel.LOW, BatteryLevel.CRITICAL):
            return BatteryLevel.NORMAL if clear else self._level
        if self._over.active:
            return BatteryLevel.OVERCHARGED
        return BatteryLevel.LOW if low else BatteryLevel.NORMAL
