"""What a configuration file may say about the stepper motors."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.shafts import MotorLimits
from monstertruck_drivers.steppers.protocol import MAX_RATE, MOTORS
from monstertruck_schemas.base import Schema

Seconds = Annotated[float, Field(gt=0)]


class StepperConfig(Schema):
    """Stepper motors on one microcontroller; the defaults are those of motors of 200 steps in half steps.

    Motor i turns the body's shaft i. Steppers have no encoder: positions are steps that were commanded, and a motor
    that loses steps, or is held, is not noticed.
    """

    kind: Literal["steppers"] = "steppers"
    motors: Annotated[int, Field(ge=1, le=MOTORS)] = MOTORS
    """Motors that turn shafts; the controller's others are not used"""
    steps_per_turn: Annotated[int, Field(ge=4, le=51_200)] = 400
    """Steps per motor turn, half or micro steps counted; must be what the controller says"""
    inverted: Annotated[tuple[bool, ...], Field(strict=False)] = (False,) * MOTORS
    """For each motor: driving forward takes negative rates"""
    max_rate: Annotated[float, Field(gt=0, le=MAX_RATE / 1000)] = 250.0
    """Steps per second: requests are limited to this; less than what makes a motor lose steps"""
    acceleration: Annotated[int, Field(gt=0, le=1_000_000)] = 4000
    """Acceleration of the controller's ramps, steps/s^2"""
    quick_deceleration: Annotated[int, Field(gt=0, le=1_000_000)] = 8000
    """Deceleration of its quick stop and of its watchdog, steps/s^2"""
    rate: Annotated[float, Field(ge=5, le=50)] = 20.0
    """Exchanges per second"""
    answer_timeout: Annotated[float, Field(gt=0, le=0.2)] = 0.05
    """Seconds in which an answer must come"""
    command_timeout: Seconds = 0.25
    """Age of the newest command at which the motors are brought to rest"""
    quick_stop_after: Seconds = 1.0
    """Age of the newest command at which they are stopped by quick stop"""
    watchdog: Annotated[float, Field(ge=0.05, le=2.0)] = 0.3
    """Seconds without a request to run after which the controller itself stops the motors"""

    @property
    def shafts(self) -> int:
        """How many driven shafts it serves."""
        return self.motors

    @property
    def turn(self) -> float:
        """Angle of a step, rad."""
        return 2.0 * math.pi / self.steps_per_turn

    @property
    def motor_limits(self) -> MotorLimits:
        """What a motor does."""
        return MotorLimits(
            self.max_rate * self.turn, self.acceleration * self.turn, self.quick_deceleration * self.turn
        )

    @property
    def stop_words(self) -> str:
        """Nothing: the stop script needs the port alone."""
        return ""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if len(self.inverted) < self.motors:
            raise ValueError(f"inverted has {len(self.inverted)} values: expected one for each of {self.motors} motors")
        if self.watchdog <= 2.0 / self.rate:
            raise ValueError(f"watchdog {self.watchdog:g} s: expected more than two exchanges, {2.0 / self.rate:g} s")
        if self.quick_deceleration < self.acceleration:
            raise ValueError(
                f"quick_deceleration {self.quick_deceleration}: expected at least acceleration, {self.acceleration}"
            )
        return self
