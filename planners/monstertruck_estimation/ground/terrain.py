"""Tilt under the robot and its recent variation."""

import math


class TerrainEstimator:
    """Track the tilt and its standard deviation over the last seconds (both axes, exponentially weighted).

    Args:
        window: time constant of the standard deviation (s).
    """

    def __init__(self, window: float) -> None:
        self._window = window
        self.tilt = 0.0
        """Angle between the robot's z axis and the vertical (rad)."""
        self._mean = (0.0, 0.0)
        self._variance = 0.0
        self._t: float | None = None

    @property
    def roughness(self) -> float:
        """Standard deviation (rad)."""
        return math.sqrt(self._variance)

    def add(self, t: float, roll: float, pitch: float) -> None:
        """Add a sample at time ``t`` (s); samples not later than the last are ignored."""
        self.tilt = math.acos(min(math.cos(roll) * math.cos(pitch), 1.0))
        if self._t is None:
            self._mean = (roll, pitch)
        elif t > self._t:
            share = 1.0 - math.exp((self._t - t) / self._window)
            off = (roll - self._mean[0], pitch - self._mean[1])
            self._variance = (1.0 - share) * (self._variance + share * (off[0] ** 2 + off[1] ** 2))
            self._mean = (self._mean[0] + share * off[0], self._mean[1] + share * off[1])
        else:
            return
        self._t = t
