"""What the wheels say about the way between two scans, and how far that is to be trusted."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.frontend import Match
from monstertruck_estimation.slam.se2 import between

Array = NDArray[np.float64]

MEMORY: Final = 40
"""Scans over which the trust in odometry is learned."""
OUTLIER: Final = 4.0
"""Normalised innovations count as this at most."""
LIMITS: Final = (1.0, 3.0)
"""Factor on the standard deviation of the way, at least and at most."""
CLEAR: Final = (0.15, 0.75)
"""Degeneracy and overlap from which a match can tell the odometry's error."""
FIT_NOISE: Final = 0.01
"""Standard deviation of a match itself, m."""


def velocity(delta: Array, dt: float) -> tuple[float, float, float]:
    """Velocity in base (vx, vy, wz; m/s, rad/s) that makes the way ``delta``, shape (3,), in ``dt`` s; 0 if dt is."""
    if dt <= 0:
        return 0.0, 0.0, 0.0
    vx, vy, wz = (delta / dt).tolist()
    return vx, vy, wz


class MotionModel:
    """Predicts the motion between two scans, and learns from the matches how good odometry is.

    Wheels slip, and many logs stamp odometry and scans by clocks that disagree; no constant covers both a good and a
    bad one. The factor follows the root mean square of the innovations (adaptive Kalman filtering, Mehra 1972).

    Args:
        config: noise before anything is learned.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._square = 1.0
        self._odom: Array | None = None
        self._delta = np.zeros(3)
        self._dt = 0.0

    @property
    def factor(self) -> float:
        """Factor on the standard deviation of the way."""
        return min(max(math.sqrt(self._square), LIMITS[0]), LIMITS[1])

    @property
    def odom(self) -> Array | None:
        """Newest pose of base in odom."""
        return self._odom

    @property
    def twist(self) -> tuple[float, float, float]:
        """Velocity of base between the last two scans (vx, vy, wz; m/s, rad/s)."""
        return velocity(self._delta, self._dt)

    def predict(self, dt: float, odom: Array | None) -> tuple[Array, Array]:
        """Motion in base over the last ``dt`` seconds, and its covariance (3, 3)."""
        config = self._config
        known = odom is not None and bool(np.isfinite(odom).all())
        delta = None
        if known and self._odom is not None:
            delta = between(self._odom, np.asarray(odom, dtype=float))
            if math.hypot(delta[0], delta[1]) > config.fastest[0] * dt + config.fastest[1]:
                delta = None
        if delta is not None:
            way, turned = math.hypot(delta[0], delta[1]), abs(float(delta[2]))
            place = self.factor * math.hypot(config.odometry_floor[0], config.odometry_distance * way)
            by_turn, by_way = config.odometry_turn
            turn = math.hypot(config.odometry_floor[1], math.hypot(by_turn * turned, by_way * way))
        else:
            delta = self._delta * (min(dt / self._dt, 3.0) if self._dt > 0 else 0.0)
            place = config.odometry_floor[0] + config.blind_speed[0] * dt
            turn = config.odometry_floor[1] + config.blind_speed[1] * dt
        if known:
            self._odom = np.array(odom, dtype=float)
        return delta, np.diag((place**2, place**2, turn**2))

    def learn(self, dt: float, delta: Array, noise: Array, moved: Array, match: Match) -> None:
        """Take what a match made of the prediction ``delta`` (covariance ``noise``): the base moved by ``moved``."""
        self._dt, self._delta = dt, moved
        if self._odom is None or not match.accepted or match.degeneracy < CLEAR[0] or match.overlap < CLEAR[1]:
            return
        off = between(delta, moved)
        place = (off[0] ** 2 + off[1] ** 2) / 2 / (noise[0, 0] + FIT_NOISE**2)
        innovation = min(place, OUTLIER**2) * self.factor**2
        self._square += (innovation - self._square) / MEMORY
