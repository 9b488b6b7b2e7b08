"""Thresholds with hysteresis and dwell time: a condition must last, and a level needs a margin to end."""

from dataclasses import dataclass

from monstertruck_runtime.clock import SECOND


class Dwell:
    """Becomes True once a condition has held for some seconds without interruption."""

    def __init__(self, seconds: float) -> None:
        self._needed = round(seconds * SECOND)
        self._since: int | None = None

    def update(self, time_ns: int, condition: bool) -> bool:
        """Process the condition at ``time_ns``; return whether it has held long enough."""
        if not condition:
            self._since = None
            return False
        if self._since is None:
            self._since = time_ns
        return time_ns - self._since >= self._needed


@dataclass(frozen=True, slots=True)
class Threshold:
    """Alarm limits; ``clear < set`` detects values that are too high, ``clear > set`` values that are too low."""

    set: float
    clear: float
    after: float = 0.0
    """Time beyond ``set`` before the alarm begins (s)."""


class ThresholdAlarm:
    """Switch with hysteresis and dwell.

    Args:
        threshold: limits and dwell times.
    """

    def __init__(self, threshold: Threshold) -> None:
        self._threshold = threshold
        self._dwell = Dwell(threshold.after)
        self.active = False

    def update(self, time_ns: int, value: float | None) -> bool:
        """Process the value at ``time_ns``; None leaves the alarm unchanged. Return whether the alarm changed."""
        if value is None:
            return False
        limits = self._threshold
        sign = 1.0 if limits.clear < limits.set else -1.0
        beyond = self._dwell.update(time_ns, sign * (value - limits.set) > 0)
        was = self.active
        self.active = sign * (value - limits.clear) > 0 if was else beyond
        return self.active != was
