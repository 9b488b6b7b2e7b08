"""From voltage samples to messages and events, for every driver that measures the battery."""

from typing import Final

from monstertruck_drivers.battery.config import PackConfig
from monstertruck_drivers.battery.judge import BatteryJudge, charge_of
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import EventSink, Publisher, Subscription
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, BatteryLevel, DriveFeedback

CURRENT_VALID: Final = SECOND // 2
"""Nanoseconds for which a motor current explains the sag."""

LEVEL_EVENTS: Final = {
    BatteryLevel.NORMAL: (Reason.OK, Severity.INFO),
    BatteryLevel.LOW: (Reason.BATTERY_LOW, Severity.WARNING),
    BatteryLevel.CRITICAL: (Reason.BATTERY_CRITICAL, Severity.ERROR),
    BatteryLevel.OVERCHARGED: (Reason.BATTERY_OVERCHARGED, Severity.WARNING),
    BatteryLevel.SENSOR_FAULT: (Reason.DEVICE_FAULT, Severity.ERROR),
}


class BatteryMonitor:
    """Judges and publishes samples; outlives the sessions of the driver that takes them.

    Args:
        config: the pack.
        out: where messages go.
        events: told when the level changes.
        source: name in events.
        drive: motor feedback for the sag; None = the voltage is judged as measured.
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

    def take(self, stamp: int, received: int, volts: float, *, at_limit: bool = False) -> None:
        """Take one sample, V; ``at_limit`` = the converter reads 0 or full scale: a wire of the divider is off."""
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
            )
        )

    def _motor_current(self, stamp: int) -> float | None:
        """Newest current; not every feedback carries one."""
        feedback = self._drive.latest if self._drive is not None else None
        if feedback is not None and feedback.current is not None:
            self._current, self._current_at = feedback.current, feedback.stamp
        return self._current if stamp - self._current_at <= CURRENT_VALID else None
