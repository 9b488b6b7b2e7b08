"""Scale of the wheels' distances from the scans: worn tyres, carpet and slip change it."""

import math

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import compose


class WheelScale:
    """Kalman filter of the scale, over stretches of the path measured by scans.

    Args:
        deviation: standard deviation of the scale before its measurement.
        noise: standard deviation of the position at either end of a stretch (m).
    """

    def __init__(self, deviation: float, noise: float) -> None:
        self._prior, self._noise = deviation**2, noise * math.sqrt(2.0)
        self._stretch = 3.0 * self._noise / deviation
        """Length of a stretch over which an error of ``deviation`` becomes significant (m)."""
        self.reset()

    def reset(self) -> None:
        """Forget all measurements."""
        self.value, self._variance, self._outlier = 1.0, self._prior, 0.0
        self.interrupt()

    @property
    def factor(self) -> float:
        """Factor on the wheels' distances; 1 while the initial deviation explains their error."""
        return self.value if (self.value - 1.0) ** 2 > self._prior else 1.0

    def interrupt(self) -> None:
        """Begin a new stretch after a motion that scans have not measured."""
        self._by_wheels, self._by_scans = np.zeros(3), np.zeros(3)

    def add(self, by_wheels: Array, by_scans: Array) -> None:
        """Add the motion between two scans by wheels and by scans, shape (3,) each; both use the turn by scans."""
        turned = np.array((*by_wheels[:2], by_scans[2]))
        self._by_wheels, self._by_scans = compose(self._by_wheels, turned), compose(self._by_scans, by_scans)
        driven, seen = self._by_wheels[:2], self._by_scans[:2]
        length = math.hypot(driven[0], driven[1])
        if length < self._stretch:
            return
        self.interrupt()
        innovation = math.hypot(seen[0], seen[1]) / length - self.value
        error = (self._noise / length) ** 2
        wear = 0.005  # standard deviation of the change of the scale per root metre
        self._variance += wear**2 * length
        before, self._outlier = self._outlier, 0.0
        if innovation**2 > 9.0 * (self._variance + error):  # three standard deviations
            self._outlier = innovation
            if before * innovation <= 0.0:
                return
            self._variance += innovation**2  # two stretches in a row: the ground has changed
        gain = self._variance / (self._variance + error)
        self.value += gain * innovation
        self._variance *= 1.0 - gain
