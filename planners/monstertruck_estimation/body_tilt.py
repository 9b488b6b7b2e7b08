"""The body's tilt by its compass, corrected for the body's acceleration.

A compass finds the vertical by an accelerometer, which feels the reaction to gravity and to the body's acceleration:
0.9 m/s^2 look like 5 degrees, and a truck that slows down on seeing a slope would see one because it slows down. The
odometry's acceleration, by its speed and its speed times its yaw rate, is taken out of each reading.
"""

import math
from collections import deque
from typing import Final, NamedTuple

from monstertruck_kinematics.description import GRAVITY
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import Attitude
from monstertruck_schemas.state import Odometry

KEPT_ODOMETRY: Final = 64
"""Readings of the odometry."""


class Tilt(NamedTuple):
    """Roll and pitch of the body, rad, REP 103."""

    roll: float
    pitch: float


class BodyAcceleration:
    """The body's acceleration by its odometry, and its tilt without it.

    Args:
        felt: seconds over which it is averaged.
    """

    # 0.06: seconds over which the odometry's acceleration is averaged, as the compass's accelerometer feels it
    def __init__(self, felt: float = 0.06) -> None:
        self._felt = round(felt * SECOND)
        self._speeds: deque[tuple[int, float, float]] = deque(maxlen=KEPT_ODOMETRY)

    def observe(self, odometry: Odometry) -> None:
        """Take a reading; readings older than the latest are ignored."""
        if not self._speeds or odometry.stamp > self._speeds[-1][0]:
            self._speeds.append((odometry.stamp, odometry.twist.vx, odometry.twist.wz))

    def at(self, stamp: int) -> tuple[float, float]:
        """Forward and left, m/s^2, over the time before ``stamp``, ns; 0 where the odometry does not give it."""
        spell = [speed for speed in self._speeds if stamp - 2 * self._felt <= speed[0] <= stamp]
        old = next((speed for speed in reversed(spell) if speed[0] <= stamp - self._felt), None)
        if old is None or old is spell[-1]:
            return 0.0, 0.0
        new = spell[-1]
        forward = (new[1] - old[1]) * SECOND / (new[0] - old[0])
        left = (new[1] * new[2] + old[1] * old[2]) / 2
        return _believed(forward), _believed(left)

    def tilt(self, attitude: Attitude) -> Tilt:
        """Tilt of the body by a valid reading of its compass."""
        return without(self.at(attitude.stamp), Tilt(attitude.roll, attitude.pitch))


def without(acceleration: tuple[float, float], tilt: Tilt) -> Tilt:
    """Tilt of a body whose accelerometer took the reaction to gravity and to its acceleration for the vertical.

    Args:
        acceleration: forward and left, m/s^2.
        tilt: measured.
    """
    forward, left = acceleration
    return Tilt(tilt.roll - math.atan2(left, GRAVITY), tilt.pitch + math.atan2(forward, GRAVITY))


def _believed(acceleration: float) -> float:
    # 2.0: acceleration of the body that is trusted at most, m/s^2: beyond it the wheels spin, and nothing is taken out
    return acceleration if abs(acceleration) <= 2.0 else 0.0
