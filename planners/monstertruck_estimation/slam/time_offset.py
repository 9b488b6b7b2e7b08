"""Finds a constant offset between the clocks of odometry and scans, as logs with badly stamped wheels have it.

The turning that the matches saw is correlated with the turning of odometry at other times; the lag at which they agree
best is the offset. Only the yaw takes part: it is what both measure best.
"""

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_runtime.clock import SECOND

Array = NDArray[np.float64]

KEPT: Final = 300
"""Scans looked at."""
LEAST: Final = 120
"""Scans needed."""
EVERY: Final = 40
"""Scans between two looks."""
LAGS: Final = np.arange(-12, 13) * 0.05
"""Offsets tried, s."""
TELLING: Final = 0.09
"""Smaller offsets are within the noise, s."""
EXCITED: Final = 0.05
"""Standard deviation of the turning without which nothing can be told, rad/s."""
ALIKE: Final = 0.8
"""Least correlation at the offset."""
CLEARLY: Final = 0.08
"""How much better it must be than at zero."""


class OffsetWatch:
    """Collects matched and wheel headings of one run."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float, float]] = deque(maxlen=KEPT)
        self._seen = 0
        self.offset: float | None = None
        """Seconds by which odometry runs ahead of the scans; None = not known, or none."""

    def add(self, stamp: int, matched: float, odom: float) -> None:
        """Take the yaw of an accepted match and that of odometry, both rad at ``stamp``, ns."""
        self._samples.append((stamp, matched, odom))
        self._seen += 1
        if self._seen % EVERY == 0 and len(self._samples) >= LEAST:
            self.offset = find_offset(*(np.array(column) for column in zip(*self._samples, strict=True)))


def find_offset(stamps: Array, matched: Array, odom: Array) -> float | None:
    """Seconds by which ``odom`` runs ahead of ``matched``; None if there is no clear offset.

    Args:
        stamps: shape (n,), ns, rising.
        matched: shape (n,), yaw by the scans, rad.
        odom: shape (n,), yaw by the wheels, rad.
    """
    times = (stamps - stamps[0]) / SECOND
    wheel, scan = np.unwrap(odom), np.unwrap(matched)
    margin = float(LAGS[-1])
    inside = (times[:-1] >= margin) & (times[1:] <= times[-1] - margin)
    steps = np.diff(times)[inside]
    turning = np.diff(scan)[inside] / steps if len(steps) else np.zeros(0)
    if len(turning) < LEAST // 2 or turning.std() < EXCITED:
        return None
    likeness = np.array([_likeness(turning, times, wheel, lag, inside) for lag in LAGS])
    best, still = int(np.argmax(likeness)), likeness[np.argmin(np.abs(LAGS))]
    if abs(LAGS[best]) < TELLING or likeness[best] < ALIKE or likeness[best] - still < CLEARLY:
        return None
    return -float(LAGS[best])


def _likeness(turning: Array, times: Array, wheel: Array, lag: float, inside: NDArray[np.bool_]) -> float:
    shifted = np.interp(times + lag, times, wheel)
    turned = np.diff(shifted)[inside] / np.diff(times)[inside]
    spread = turned.std()
    if spread < EXCITED:
        return 0.0
    return float(np.mean((turning - turning.mean()) * (turned - turned.mean())) / (turning.std() * spread))
