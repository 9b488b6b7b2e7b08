"""Settings for boards that run ROSArduinoBridge."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.arduino_bridge.protocol import AUTO_STOP, PID_RATE
from monstertruck_drivers.shafts import MotorLimits
from monstertruck_schemas.base import Schema

Seconds = Annotated[float, Field(gt=0)]


class ArduinoBridgeConfig(Schema):
    """Two motors with encoders on a microcontroller; the left one drives the body's first shaft."""

    kind: Literal["arduino_bridge"] = "arduino_bridge"
    counts_per_turn: Annotated[int, Field(ge=4, le=1_000_000)] = 1440
    """Encoder counts per turn of the shaft (of the wheel if `geometry.drive_ratio` is 1)"""
    pid_rate: Annotated[float, Field(gt=0, le=1000)] = PID_RATE
    """Rate of the board's speed controller (Hz, `PID_RATE` of the firmware)"""
    inverted: Annotated[tuple[bool, bool], Field(strict=False)] = (False, False)
    """Whether driving forward needs negative counts (left, right)"""
    max_rate: Annotated[float, Field(gt=0, le=1000)] = 10.0
    """Maximum motor rate (rad/s)"""
    deceleration: Annotated[float, Field(gt=0)] = 20.0
    """Measured deceleration to a lower set-point (rad/s^2)"""
    quick_deceleration: Annotated[float, Field(gt=0)] = 30.0
    """Measured deceleration after `m 0 0`, which removes the motors' voltage at once (rad/s^2)"""
    auto_stop: Annotated[float, Field(ge=0.05, le=10)] = AUTO_STOP
    """Time without a set-point after which the board stops the motors (s, `AUTO_STOP_INTERVAL`). It is compiled into
    the firmware and cannot be read: compile it with 250 ms and enter the value here
    """
    rate: Annotated[float, Field(ge=5, le=50)] = 20.0
    """Exchanges per second"""
    answer_timeout: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """Timeout of an answer (s)"""
    command_timeout: Seconds = 0.25
    """Age of the latest command at which the motors stop (s)"""
    boot: Annotated[float, Field(ge=0, le=10)] = 3.0
    """Maximum time from opening the port to the board's first answer (s); most boards restart when the port opens"""

    @property
    def shafts(self) -> int:
        """Number of driven shafts."""
        return len(self.inverted)

    @property
    def turn(self) -> float:
        """Angle per encoder count (rad)."""
        return math.tau / self.counts_per_turn

    @property
    def motor_limits(self) -> MotorLimits:
        """Motor limits."""
        return MotorLimits(self.max_rate, self.deceleration, self.quick_deceleration)

    @property
    def stop_words(self) -> str:
        """Arguments of the stop script: none, because it needs only the port."""
        return ""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.auto_stop <= 2.0 / self.rate:
            raise ValueError(f"auto_stop {self.auto_stop:g} s: expected more than two exchanges, {2.0 / self.rate:g} s")
        return self
