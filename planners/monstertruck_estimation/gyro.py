"""Yaw rate of an inertial measurement unit: without its bias, and judged against the wheels before it is believed."""

import math
from collections import deque
from typing import Annotated, Final

from pydantic import Field

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Schema

Positive = Annotated[float, Field(gt=0)]

STILL: Final = 1e-4
"""Way of the fastest shaft between two readings, m, up to which the robot stands."""
KEPT: Final = 100
"""Rates that are kept."""
LATE: Final = SECOND // 10
"""A rate this much older than the wheels' reading still stands for it, ns."""


class GyroConfig(Schema):
    """What the yaw rate of an IMU is worth."""

    rest: Positive = 0.5
    """Seconds at rest after which the bias is known"""
    max_bias: Positive = 0.1
    """A mean rate at rest above this is no bias, rad/s: the robot is turned by hand"""
    window: Positive = 1.5
    """Seconds over which turns by the gyroscope and by the wheels are compared"""
    tolerance: Positive = 0.12
    """Tolerated difference, rad,"""
    share: Annotated[float, Field(ge=0, lt=1)] = 0.35
    """and as a share of the greater turn: wheels slip"""
    proof: Positive = 0.3
    """Turn of the wheels in the window with which an IMU that was left out has to agree to count again, rad"""


class Gyro:
    """Yaw rates of the IMU, in base.

    Args:
        config: limits.
    """

    def __init__(self, config: GyroConfig) -> None:
        self._config = config
        self._rates: deque[tuple[int, float]] = deque(maxlen=KEPT)
        self._rest: list[float] = []
        self._rested = 0.0
        self._turns: deque[tuple[int, float, float]] = deque()
        """(ns, turn by the wheels, turn by the gyroscope), rad."""
        self.bias: float | None = None
        """rad/s; None = the robot has not stood long enough."""
        self.trusted = True
        """It agrees with the wheels."""
        self.difference = 0.0
        """Turn by the gyroscope less turn by the wheels in the window, rad."""
        self._left_out: int | None = None
        """Since when it is not trusted, ns."""

    def observe(self, stamp: int, rate: float) -> None:
        """Take a yaw rate, rad/s, at ``stamp``, ns."""
        self._rates.append((stamp, rate))

    def turned(self, since: int, stamp: int, wheels: float | None, way: float) -> float | None:
        """Mean yaw rate between two readings of the wheels, rad/s; None = leave it to the wheels.

        Args:
            since: ns.
            stamp: ns.
            wheels: mean yaw rate by the wheels, rad/s; None = they slip, and judge nobody.
            way: of the fastest shaft, m.
        """
        found = [rate for at, rate in self._rates if since < at <= stamp]
        if not found and self._rates and stamp - self._rates[-1][0] <= LATE:
            found = [self._rates[-1][1]]
        if not found:
            self._turns.clear()
            return None
        mean, dt = math.fsum(found) / len(found), (stamp - since) / SECOND
        if way <= STILL:
            self._stand(mean, dt)
            return 0.0 if self.trusted else None
        self._rest, self._rested = [], 0.0
        if self.bias is None:
            return None
        rate = mean - self.bias
        if wheels is None:
            self._turns.clear()
        else:
            self._judge(stamp, wheels * dt, rate * dt)
        return rate if self.trusted else None

    def wheels_slipped(self, since: int) -> None:
        """Something else has shown that the wheels slip since then, ns: a disagreement with them was their fault."""
        self._turns.clear()
        if self._left_out is not None and self._left_out >= since:
            self.trusted, self._left_out = True, None

    def _stand(self, mean: float, dt: float) -> None:
        self._rest.append(mean)
        self._rested += dt
        if self._rested >= self._config.rest:
            bias = math.fsum(self._rest) / len(self._rest)
            if abs(bias) <= self._config.max_bias:
                self.bias = bias
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
