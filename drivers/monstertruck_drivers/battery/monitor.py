"""Battery monitor: turns voltage samples into messages and events, for every driver that measures the battery."""

import math
import statistics
from collections import deque
from typing import Final, NamedTuple

import numpy as np

from monstertruck_drivers.battery.config import PackConfig
from monstertruck_drivers.thresholds import Dwell, Threshold, ThresholdAlarm
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import EventSink, Publisher, Subscription
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, BatteryLevel, DriveFeedback

MEDIAN_WINDOW: Final = 5
"""Window of the median filter (samples): rejects shorter spikes and connector bounces."""
GAP: Final = SECOND
"""Maximum time without a sample (ns); then all durations restart."""

CELL_VOLTS: Final = np.array((
    3.27, 3.61, 3.69, 3.71, 3.73, 3.75, 3.77, 3.79, 3.80, 3.82, 3.84,
    3.85, 3.87, 3.91, 3.95, 3.98, 4.02, 4.08, 4.11, 4.15, 4.20,
))  # fmt: skip
"""Resting voltage of a lithium-polymer cell at 0, 5 .. 100 % (widely used table of unknown origin)."""

_CHARGES: Final = np.linspace(0.0, 1.0, len(CELL_VOLTS))


def charge_of(cell_volts: float) -> float:
    """Remaining charge at a resting cell voltage, 0..1.

    Between 20 and 60 % a cell changes by 8 to 35 mV per 5 %, which is below the resolution of a 10-bit converter behind
    a six-cell divider. The result is no more accurate than +-0.1.
    """
    return float(np.interp(cell_volts, CELL_VOLTS, _CHARGES))


class BatteryVerdict(NamedTuple):
    """Battery state after a sample."""

    level: BatteryLevel
    voltage: float | None = None
    """Smoothed voltage (V); None while the sensor is faulty or too few samples exist."""
    rest_voltage: float | None = None
    """``voltage`` without the sag (V)."""


class BatteryJudge:
    """Turns voltage samples into smoothed voltages and a level."""

    def __init__(self, config: PackConfig) -> None:
        self._config = config
        self._level = BatteryLevel.UNKNOWN
        self._last: int | None = None
        self._reset()

    def _reset(self) -> None:
        config = self._config
        self._samples: deque[tuple[float, float]] = deque(maxlen=MEDIAN_WINDOW)
        self._smooth: tuple[float, float] | None = None
        self._low = Dwell(config.low_after)
        self._critical = Dwell(config.critical_after)
        self._collapsed = Dwell(config.collapsed_after)
        self._clear = Dwell(config.clear_after)
        self._over = ThresholdAlarm(Threshold(config.overcharged, config.overcharged_clear, config.overcharged_after))

    def update(self, time_ns: int, voltage: float, current: float | None = None) -> BatteryVerdict:
        """Take one sample.

        Args:
            time_ns: time of the sample; must not decrease.
            voltage: pack voltage (V); NaN if the converter read 0 or full scale.
            current: motor current (A), either sign; None if unknown: the sag is not compensated. The pack current is
                smaller at low motor speed, and includes the electronics: both effects are smaller than the table's
                error.
        """
        elapsed = 0 if self._last is None else time_ns - self._last
        if elapsed > GAP:
            self._reset()
        self._last = time_ns
        # An invalid sample is treated by the median as an implausible one.
        volts = -math.inf if math.isnan(voltage) else voltage
        sag = min(abs(current or 0.0) * self._config.resistance, self._config.max_compensation)
        self._samples.append((volts, volts + sag))
        if len(self._samples) < MEDIAN_WINDOW:
            return BatteryVerdict(self._level)
        loaded, rest = (statistics.median(column) for column in zip(*self._samples, strict=True))
        if not self._config.plausible_min <= loaded <= self._config.plausible_max:
            # Durations must not include the fault; the samples are kept, so that its end is noticed.
            samples = self._samples
            self._reset()
            self._samples = samples
            return BatteryVerdict(BatteryLevel.SENSOR_FAULT)
        self._smooth = self._smoothed((loaded, rest), elapsed / SECOND)
        self._level = self._judge(time_ns, loaded, rest)
        return BatteryVerdict(self._level, *self._smooth)

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
        # Judge the measured voltage: an estimated sag must not make a full pack look overcharged.
        self._over.update(time_ns, loaded)
        if critical or collapsed:
            return BatteryLevel.CRITICAL
        if self._level in (BatteryLevel.LOW, BatteryLevel.CRITICAL):
            return BatteryLevel.NORMAL if clear else self._level
        if self._over.active:
            return BatteryLevel.OVERCHARGED
        return BatteryLevel.LOW if low else BatteryLevel.NORMAL


CURRENT_VALID: Final = SECOND // 2
"""Maximum age of a motor current that explains the sag (ns)."""

LEVEL_EVENTS: Final = {
    BatteryLevel.NORMAL: (Reason.OK, Severity.INFO),
    BatteryLevel.LOW: (Reason.BATTERY_LOW, Severity.WARNING),
    BatteryLevel.CRITICAL: (Reason.BATTERY_CRITICAL, Severity.ERROR),
    BatteryLevel.OVERCHARGED: (Reason.BATTERY_OVERCHARGED, Severity.WARNING),
    BatteryLevel.SENSOR_FAULT: (Reason.DEVICE_FAULT, Severity.ERROR),
}


class BatteryMonitor:
    """Judges and publishes samples; it outlives the sessions of the driver that provides the samples.

    Args:
        config: the pack.
        out: sink of battery messages.
        events: sink of events, one for every change of the level.
        source: source name in the events.
        drive: motor feedback used to compensate for sag; None: the measured voltage is used uncompensated.
    """

    def __init__(
        self,
        config: PackConfig,
        out: Publisher[Battery],
        events: EventSink,
        source: str,
        drive: Subscription[DriveFeedback] | None = None,
    ) -> None:
        self._config = config
        self._out = out
        self._events = events
        self._source = source
        self._drive = drive
        self._judge = BatteryJudge(config)
        self._level = BatteryLevel.NORMAL
        self._current = 0.0
        self._current_at = -CURRENT_VALID

    def take(
        self, stamp: int, received: int, volts: float, *, at_limit: bool = False, current: float | None = None
    ) -> None:
        """Process one voltage sample.

        Args:
            stamp: time of the sample (ns).
            received: arrival time of the sample (ns).
            volts: pack voltage (V).
            at_limit: whether the converter reads 0 or full scale, because a wire of the divider is disconnected.
            current: current into the pack (A); None if not measured.
        """
        verdict = self._judge.update(stamp, float("nan") if at_limit else volts, self._motor_current(stamp))
        level, rest = verdict.level, verdict.rest_voltage
        if level is not self._level and level in LEVEL_EVENTS:
            reason, severity = LEVEL_EVENTS[level]
            self._events(reason, severity, self._source, f"battery {level.value} at {volts:.1f} V", raw_voltage=volts)
            self._level = level
        self._out.put(
            Battery(
                stamp=stamp,
                received=received,
                seq=self._out.next_seq(),
                voltage=verdict.voltage,
                raw_voltage=volts,
                cells=self._config.cells,
                level=level,
                rest_voltage=rest,
                cell_voltage=None if rest is None else rest / self._config.cells,
                charge=None if rest is None else charge_of(rest / self._config.cells),
                capacity_ah=self._config.capacity_ah,
                current=current,
            )
        )

    def _motor_current(self, stamp: int) -> float | None:
        """Return the latest motor current (A); None if the feedback carries none."""
        feedback = self._drive.latest if self._drive is not None else None
        if feedback is not None and feedback.current is not None:
            self._current, self._current_at = feedback.current, feedback.stamp
        return self._current if stamp - self._current_at <= CURRENT_VALID else None
