"""Body tilt from the compass, corrected for the body's acceleration.

A compass finds the vertical with an accelerometer, which measures the reaction to gravity and to the body's
acceleration. 0.9 m/s^2 look like a tilt of 5 degrees: a truck that brakes for a slope would then see a slope because it
brakes. The acceleration that the odometry measures (the change of its speed, and its speed times its yaw rate) is
therefore subtracted from each reading.
"""

import math
from collections import deque
from typing import Final, NamedTuple

from monstertruck_kinematics.description import GRAVITY
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import Attitude
from monstertruck_schemas.state import Odometry

KEPT_ODOMETRY: Final = 64
"""Odometry readings."""


class Tilt(NamedTuple):
    """Roll and pitch of the body (rad, REP 103)."""

    roll: float
    pitch: float


class BodyAcceleration:
    """Estimate the body's acceleration from odometry and remove it from the measured tilt.

    Args:
        felt: averaging time of the acceleration (s).
    """

    # 0.06: averaging time of the odometry's acceleration, s; the compass's accelerometer averages over as long
    def __init__(self, felt: float = 0.06) -> None:
        self._felt = round(felt * SECOND)
        self._speeds: deque[tuple[int, float, float]] = deque(maxlen=KEPT_ODOMETRY)

    def observe(self, odometry: Odometry) -> None:
        """Add a reading; readings older than the latest are ignored."""
        if not self._speeds or odometry.stamp > self._speeds[-1][0]:
            self._speeds.append((odometry.stamp, odometry.twist.vx, odometry.twist.wz))

    def at(self, stamp: int) -> tuple[float, float]:
        """Return the mean acceleration forward and left (m/s^2) before ``stamp`` (ns); 0 where odometry is missing."""
        spell = [speed for speed in self._speeds if stamp - 2 * self._felt <= speed[0] <= stamp]
        old = next((speed for speed in reversed(spell) if speed[0] <= stamp - self._felt), None)
        if old is None or old is spell[-1]:
            return 0.0, 0.0
        new = spell[-1]
        forward = (new[1] - old[1]) * SECOND / (new[0] - old[0])
        left = (new[1] * new[2] + old[1] * old[2]) / 2
        return _believed(forward), _believed(left)

    def tilt(self, attitude: Attitude) -> Tilt:
        """Return the body's tilt from a valid compass reading."""
        return without(self.at(attitude.stamp), Tilt(attitude.roll, attitude.pitch))


def without(acceleration: tuple[float, float], tilt: Tilt) -> Tilt:
    """Return the true tilt of an accelerating body from the tilt that its accelerometer measured.

    Args:
        acceleration: forward and left (m/s^2).
        tilt: measured tilt (rad).
    """
    forward, left = acceleration
    return Tilt(tilt.roll - math.atan2(left, GRAVITY), tilt.pitch + math.atan2(forward, GRAVITY))


def _believed(acceleration: float) -> float:
    # 2.0: maximum plausible acceleration of the body, m/s^2; above it the wheels spin, and no correction is applied
    return acceleration if abs(acceleration) <= 2.0 else 0.0
