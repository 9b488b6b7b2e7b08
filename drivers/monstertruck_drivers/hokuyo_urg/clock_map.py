"""Maps the sensor's 24-bit millisecond counter to the daemon's clock. Pure, no I/O.

A scan arrives later than its counter value was true by the time the revolution and the transfer take, plus
jitter that is never negative. So the least (arrival - sensor time) of late is the truth plus a constant
latency. That lower envelope follows drift: between two samples it may rise by the greatest drift a crystal
can have, and any lower sample pulls it down at once. The constant is found by comparing the envelope's first
seconds with a direct clock comparison (the sensor's time-adjust mode) made at start.
"""

from dataclasses import dataclass
from typing import Final

from monstertruck_drivers.hokuyo_urg.protocol import COUNTER_BITS, COUNTER_MASK

MILLISECOND: Final = 1_000_000
MAX_DRIFT_PPM: Final = 200
RESTART: Final = 1000 * MILLISECOND
"""Disagreement of both clocks over one scan that only a restarted counter can explain, ns."""
SETTLE: Final = 5000 * MILLISECOND
"""How long the start-up comparison is used while the latency is being found, ns (200 ppm = 1 ms)."""


@dataclass(frozen=True, slots=True)
class Anchor:
    """One comparison of both clocks."""

    counter: int
    """Sensor's milliseconds, 24 bits."""
    host: int
    """The daemon's time when the counter said so, ns."""
    round_trip: int = 0
    """How long the exchange took, ns; half of it bounds the error."""


class ClockMap:
    """Stamps of counter values, never going backwards.

    Args:
        nominal_latency: ns from a counter value to the arrival of its scan; used only where it cannot be measured
            (no ``anchor``, or the counter restarted before the first scan).
        anchor: comparison made at start.
    """

    def __init__(self, nominal_latency: int, anchor: Anchor | None = None) -> None:
        self.restarts = 0
        """How often the counter restarted."""
        self._latency: int = nominal_latency
        self._reference: int | None = None if anchor is None else anchor.host
        self._counter: int | None = None if anchor is None else anchor.counter
        self._host = 0 if anchor is None else anchor.host
        self._elapsed = 0  # sensor's ns since the first comparison
        self._envelope: int | None = None
        self._stamp: int | None = None

    def stamp(self, counter: int, arrival: int) -> int:
        """The daemon's time, ns, at which the sensor's counter said ``counter``.

        Args:
            counter: milliseconds, 24 bits, later than that of the previous call.
            arrival: when the last byte came, ns.
        """
        offset = self._follow(counter, arrival)
        stamp = self._elapsed + offset
        if self._stamp is not None:
            stamp = max(stamp, self._stamp + 1)
        self._stamp = stamp
        return stamp

    def _follow(self, counter: int, arrival: int) -> int:
        """Take one sample; returns (daemon's time - sensor's time) without latency."""
        waited = arrival - self._host
        previous, self._counter, self._host = self._counter, counter, arrival
        if previous is None:
            self._envelope = arrival
            return arrival - self._latency
        step = ((counter - previous) & COUNTER_MASK) * MILLISECOND
        if abs(_signed(step - waited)) > RESTART:
            self.restarts += 1
            self._reference = None
            self._elapsed += waited
            self._envelope = arrival - self._elapsed
            return self._envelope - self._latency
        self._elapsed += step
        sample = arrival - self._elapsed
        rise = step * MAX_DRIFT_PPM // 1_000_000
        self._envelope = sample if self._envelope is None else min(sample, self._envelope + rise)
        if self._reference is None:
            return self._envelope - self._latency
        reference = self._reference
        self._latency = self._envelope - reference
        if self._elapsed > SETTLE:
            self._reference = None
        return reference


def _signed(difference: int) -> int:
    """A difference of counters, ns, as the least one of all that a wrap makes equal."""
    turn = MILLISECOND << COUNTER_BITS
    return (difference + turn // 2) % turn - turn // 2
