"""Detection of values that repeat exactly for longer than their noise allows.

A sensor whose noise has a standard deviation of at least 0.6 digits gives its most frequent value with a
probability of at most 0.6 (normal distribution): 40 equal values in a row happen once in 10^9. The detector learns a
value's noise while the robot stands. A value without noise may stay the same for hours; the detector never reports it.
"""

import math
from collections import deque
from typing import Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan

NOISE_READINGS: Final = 20
"""Number of values over which the noise is measured."""


class RepeatDetector:
    """Repeat detector for one value of a sensor."""

    def __init__(self) -> None:
        self._last: float | None = None
        self._row = 0
        self._longest = 0
        self._digit = math.inf
        self._still: deque[float] = deque(maxlen=NOISE_READINGS)
        self._noise = math.inf
        """Standard deviation of the quietest window."""
        self._windows = 0

    @property
    def frozen(self) -> bool:
        """Whether the value has repeated for longer than its noise allows."""
        enough = 0.6  # minimum standard deviation of the noise, in digits, for a value to be judged
        known = self._windows >= 2 and self._noise >= enough * self._digit  # the noise is known after two windows
        longer = 8  # factor on the longest earlier row: quantisation and filters also produce rows
        # Minimum number of equal values in a row that such noise does not produce.
        return known and self._row >= max(40, longer * self._longest)

    @property
    def row(self) -> int:
        """Current number of equal values in a row."""
        return self._row

    def observe(self, value: float, *, still: bool) -> None:
        """Take a value, and whether the robot stands."""
        if value == self._last:
            self._row += 1
        else:
            if self._last is not None:
                self._digit = min(self._digit, abs(value - self._last))
                if not self.frozen:
                    self._longest = max(self._longest, self._row)
            self._last, self._row = value, 1
        if not still or self._row > 10:  # a longer row may come from a frozen value and does not show the noise
            self._still.clear()
            return
        self._still.append(value)
        if len(self._still) == NOISE_READINGS:
            mean = math.fsum(self._still) / NOISE_READINGS
            spread = math.sqrt(math.fsum((one - mean) ** 2 for one in self._still) / NOISE_READINGS)
            self._noise, self._windows = min(self._noise, spread), self._windows + 1
            self._still.clear()


class WholeRepeats:
    """Repeat detector for a scan or an image: hundreds of values.

    Two of them are never identical, except in a simulation without motion and noise.
    """

    def __init__(self) -> None:
        self._last: bytes | None = None
        self._row = 1
        self._different = 0
        self._noisy = False
        self._moved = 0.0
        self.frozen = False

    @property
    def row(self) -> int:
        """Current number of equal scans or images in a row."""
        return self._row

    def observe(self, whole: bytes, *, moved: float) -> None:
        """Take a scan or image, and the robot's motion since the previous one by another measure (m or rad)."""
        before, self._last = self._last, whole
        if whole != before:
            self._row, self._moved, self.frozen = 1, 0.0, False
            self._different = self._different + 1 if moved == 0.0 and before is not None else 0
            proof = 10  # number of different ones in a row at standstill that proves noise in each
            self._noisy |= self._different >= proof
            return
        self._row += 1
        self._different = 0
        self._moved += moved
        equal = 3  # number of equal ones in a row that rules out chance
        # Minimum motion (m or rad) that rules out repeats by chance, even without noise.
        self.frozen |= self._row >= equal and (self._noisy or self._moved >= 0.15)

    def pause(self) -> None:
        """Start a new row: the next one does not follow the last, or has too little content to be compared."""
        self._last, self._row, self._moved, self.frozen = None, 1, 0.0, False


def scan_content(scan: LaserScan) -> bytes | None:
    """Return what a scan repeats if its lidar does, for ``WholeRepeats``; None if it has too few ranges.

    The content of a scan that repeats a packet of 2 to 19 beams (LD19: 12) is the set of its ranges, as revolutions cut
    such packets differently. The content of any other scan is its ranges in order.
    """
    valid, fewest = scan.codes == VALID_BEAM, 20
    if np.count_nonzero(valid) < fewest:
        return None
    different = np.unique(scan.ranges[valid])
    packet = len(different) < fewest and _repeats_packet(np.where(valid, scan.ranges, math.nan), fewest)
    return (different if packet else scan.ranges).tobytes()


def _repeats_packet(ranges: Array, longest: int) -> bool:
    """Return whether most ranges recur after some number of beams, beyond chance.

    Ranges in coarse digits, and those of a wall, recur as often after one beam as after more.

    Args:
        ranges: ranges (m), NaN without a return, shape (n,); at least ``longest`` of them are returns.
        longest: a repeated packet has fewer beams than this.
    """
    pairs = [(ranges[:-beams], ranges[beams:]) for beams in range(1, longest)]
    counts = np.array([np.count_nonzero(np.isfinite(before) | np.isfinite(after)) for before, after in pairs])
    shares = np.array([np.count_nonzero(before == after) for before, after in pairs]) / counts
    chance = np.maximum.accumulate(shares)[:-1]
    # Chance exceeds six standard deviations once in 10^9 (normal distribution).
    highest = chance + 6.0 * np.sqrt(chance * (1.0 - chance) / counts[1:])
    return bool((shares[1:] > np.maximum(highest, 0.5)).any())
