"""Yaw rate of an inertial measurement unit: corrected for its bias and checked against the wheels."""

import math
from collections import deque
from typing import Annotated, Final

from pydantic import Field

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Positive, Schema

RESTING_DISTANCE: Final = 1e-4
"""Maximum distance of the fastest shaft between two readings at standstill (m)."""


class GyroConfig(Schema):
    """Trust in the IMU's yaw rate."""

    rest: Positive = 0.5
    """Minimum time at rest to measure the bias (s)"""
    max_bias: Positive = 0.1
    """Maximum bias (rad/s): a higher mean rate means that the robot is turned by hand"""
    window: Positive = 1.5
    """Window over which the turns by gyroscope and wheels are compared (s)"""
    tolerance: Positive = 0.12
    """Tolerated difference of the turns (rad)"""
    share: Annotated[float, Field(ge=0, lt=1)] = 0.35
    """Tolerated difference as a share of the greater turn, because wheels slip"""
    proof: Positive = 0.3
    """Minimum turn of the wheels in the window for readmitting a rejected IMU that agrees (rad)"""
    drift: Annotated[float, Field(ge=0)] = 5e-5
    """Maximum drift of the bias after a rest (rad/s^2), as the device warms up by two degrees a minute"""


class Gyro:
    """Corrects the yaw rates of the IMU in base and compares them with the wheels.

    Args:
        config: limits.
    """

    def __init__(self, config: GyroConfig) -> None:
        self._config = config
        self._rates: deque[tuple[int, float]] = deque(maxlen=100)  # maximum number of stored rates
        self._rest: list[float] = []
        self._rested = 0.0
        self._turns: deque[tuple[int, float, float]] = deque()
        """Stamp (ns), turn by the wheels and turn by the gyroscope (rad)."""
        self._long: deque[tuple[int, float, float, float]] = deque()
        """Stamp (ns), turn by the wheels, turn by the gyroscope and tolerated difference (rad)."""
        self._sums = (0.0, 0.0)
        """Sums over ``_long``: difference of the turns, and tolerated difference (rad)."""
        self._known = 0
        """Time of the last bias measurement (ns)."""
        self.bias: float | None = None
        """rad/s; None: the robot has not stood long enough."""
        self.trusted = True
        """Whether the IMU agrees with the wheels."""
        self.difference = 0.0
        """Turn by the gyroscope minus turn by the wheels in the window (rad)."""
        self._left_out: int | None = None
        """Start of the distrust (ns)."""

    def observe(self, stamp: int, rate: float) -> None:
        """Add a yaw rate (rad/s) at ``stamp`` (ns)."""
        self._rates.append((stamp, rate))

    def turned(self, since: int, stamp: int, wheels: float | None, distance: float) -> float | None:
        """Return the mean yaw rate between two readings of the wheels (rad/s); None to use the wheels' own.

        Args:
            since: stamp of the earlier reading (ns).
            stamp: stamp of the later reading (ns).
            wheels: mean yaw rate by the wheels (rad/s); None while they slip, which skips the comparison.
            distance: distance of the fastest shaft, m.
        """
        found = [rate for at, rate in self._rates if since < at <= stamp]
        # SECOND // 10: maximum age of a rate relative to the wheels' reading, ns
        if not found and self._rates and stamp - self._rates[-1][0] <= SECOND // 10:
            found = [self._rates[-1][1]]
        if not found:
            self._forget()
            return None
        mean, dt = math.fsum(found) / len(found), (stamp - since) / SECOND
        if distance <= RESTING_DISTANCE:
            self._stand(mean, dt, stamp)
            return 0.0 if self.trusted else None
        self._rest, self._rested = [], 0.0
        if self.bias is None:
            return None
        rate = mean - self.bias
        if wheels is None:
            self._forget()
        else:
            self._judge(stamp, wheels * dt, rate * dt)
            self._judge_long(stamp, wheels * dt, rate * dt, distance)
        return rate if self.trusted else None

    def variance(self, stamp: int, dt: float, distance: float) -> float:
        """Return the growth of the turn's variance in ``dt`` seconds (rad^2): the bias has drifted since the last rest.

        A bias that drifts at a rate d for a time T turns the heading by d T^2 / 2.
        """
        if distance <= RESTING_DISTANCE or self.bias is None:
            return 0.0
        rested = (stamp - self._known) / SECOND
        return self._config.drift**2 * rested**3 * dt

    def _forget(self) -> None:
        """Start the comparison again."""
        self._turns.clear()
        self._long.clear()
        self._sums = (0.0, 0.0)

    def wheels_slipped(self, since: int) -> None:
        """Discard the disagreement since ``since`` (ns): another sensor has shown that the wheels slipped."""
        self._forget()
        if self._left_out is not None and self._left_out >= since:
            self.trusted, self._left_out = True, None

    def _stand(self, mean: float, dt: float, stamp: int) -> None:
        self._forget()
        self._rest.append(mean)
        self._rested += dt
        if self._rested >= self._config.rest:
            bias = math.fsum(self._rest) / len(self._rest)
            if abs(bias) <= self._config.max_bias:
                self.bias, self._known = bias, stamp
            self._rest, self._rested = [], 0.0

    def _judge(self, stamp: int, wheels: float, gyro: float) -> None:
        config, turns = self._config, self._turns
        turns.append((stamp, wheels, gyro))
        while stamp - turns[0][0] > config.window * SECOND:
            turns.popleft()
        by_wheels, by_gyro = math.fsum(turn[1] for turn in turns), math.fsum(turn[2] for turn in turns)
        self.difference = by_gyro - by_wheels
        agrees = abs(self.difference) <= config.tolerance + config.share * max(abs(by_wheels), abs(by_gyro))
        if self.trusted and not agrees:
            self._left_out = stamp
        if self.trusted or abs(by_wheels) >= config.proof:
            self.trusted = agrees

    def _judge_long(self, stamp: int, wheels: float, gyro: float, distance: float) -> None:
        """Drop a bias that has crept away too slowly for the short window, until the robot rests."""
        config, rows = self._config, self._long
        if not self.trusted:
            rows.clear()
            self._sums = (0.0, 0.0)
            return
        # 0.05: maximum constant curvature error of the wheels, rad/m
        rows.append((stamp, wheels, gyro, config.share * abs(wheels) + 0.05 * distance))
        off, allowed = self._sums[0] + gyro - wheels, self._sums[1] + rows[-1][3]
        long = 20 * SECOND  # second, longer comparison window, ns: it reveals a drifting bias
        while stamp - rows[0][0] > long:
            _, by_wheels, by_gyro, may = rows.popleft()
            off, allowed = off - (by_gyro - by_wheels), allowed - may
        self._sums = (off, allowed)
        if stamp - rows[0][0] > long // 4 and abs(off) > config.tolerance + allowed:
            self.difference, self.trusted, self._left_out, self.bias = off, False, stamp, None
            self._forget()
