"""Thresholds with hysteresis and dwell: conditions that must hold for a time, levels that are left only by a margin."""

from dataclasses import dataclass

from monstertruck_runtime.clock import SECOND


class Dwell:
    """True once a condition has held without a break for some seconds."""

    def __init__(self, seconds: float) -> None:
        self._needed = round(seconds * SECOND)
        self._since: int | None = None

    def update(self, time_ns: int, condition: bool) -> bool:
        """Take the condition at ``time_ns``; whether it has held long enough."""
        if not condition:
            self._since = None
            return False
        if self._since is None:
            self._since = time_ns
        return time_ns - self._since >= self._needed


@dataclass(frozen=True, slots=True)
class Threshold:
    """Limits that set and clear an alarm; ``clear < set`` watches for too much, ``clear > set`` for too little."""

    set: float
    clear: float
    after: float = 0.0
    """Seconds beyond ``set`` before it begins."""


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
        """Take the value at ``time_ns``; without a value nothing changes. Returns whether the alarm changed."""
        if value is None:
            return False
        limits = self._threshold
        sign = 1.0 if limits.clear < limits.set else -1.0
        beyond = self._dwell.update(time_ns, sign * (value - limits.set) > 0)
        was = self.active
        self.active = sign * (value - limits.clear) > 0 if was else beyond
        return self.active != was
