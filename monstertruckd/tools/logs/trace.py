"""A signal of any length in bounded memory: minimum and maximum per interval of time."""

from dataclasses import dataclass
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from monstertruck_runtime.clock import SECOND

_SHORTEST_GAP = SECOND
"""Silences below this are never drawn as gaps, ns."""
_GAP_PERIODS = 5
"""Mean periods without a sample that count as a gap."""


@dataclass(slots=True)
class Bucket:
    """All samples of one interval."""

    first: int
    last: int
    low: float
    high: float
    newest: float

    def take(self, other: "Bucket") -> None:
        """Add the samples of a later bucket."""
        self.last = other.last
        self.low = min(self.low, other.low)
        self.high = max(self.high, other.high)
        self.newest = other.newest


class Trace:
    """Samples in the order of their times; at least ``limit / 2`` intervals once there are more samples than ``limit``.

    Extremes survive, so that a spike of one sample shows in an hour.

    Args:
        limit: greatest number of intervals kept.
    """

    def __init__(self, limit: int = 1000) -> None:
        self._limit = limit
        self._width = 0
        self.buckets: list[Bucket] = []
        self.count = 0

    def add(self, time: int, value: float) -> None:
        """Append a sample at ``time``, ns."""
        self.count += 1
        self._append(Bucket(time, time, value, value, value))
        if len(self.buckets) > self._limit:
            self._width = max(2 * self._width, 2 * (time - self.buckets[0].first) // self._limit)
            finer, self.buckets = self.buckets, []
            for bucket in finer:
                self._append(bucket)

    def _append(self, bucket: Bucket) -> None:
        if self.buckets and bucket.last - self.buckets[-1].first < self._width:
            self.buckets[-1].take(bucket)
        else:
            self.buckets.append(bucket)

    @property
    def low(self) -> float | None:
        """Least value; None without samples."""
        return min((bucket.low for bucket in self.buckets), default=None)

    @property
    def high(self) -> float | None:
        """Greatest value; None without samples."""
        return max((bucket.high for bucket in self.buckets), default=None)

    def pieces(self) -> list[list[Bucket]]:
        """The intervals, cut where samples are missing for longer than five mean periods and a second."""
        if not self.buckets:
            return []
        period = (self.buckets[-1].last - self.buckets[0].first) / max(self.count - 1, 1)
        gap = max(_SHORTEST_GAP, _GAP_PERIODS * period)
        pieces = [[self.buckets[0]]]
        for bucket in self.buckets[1:]:
            if bucket.first - pieces[-1][-1].last > gap:
                pieces.append([])
            pieces[-1].append(bucket)
        return pieces

    def middle(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Times, ns, and mid values of the intervals, both of shape (n,)."""
        times = np.array([(bucket.first + bucket.last) // 2 for bucket in self.buckets], np.int64)
        return times, np.array([fmean((bucket.low, bucket.high)) for bucket in self.buckets], np.float64)
