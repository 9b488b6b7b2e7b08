"""Stepper motor settings in the configuration file."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.shafts import MotorLimits
from monstertruck_drivers.steppers.protocol import MAX_RATE, MOTORS
from monstertruck_schemas.base import Schema

Seconds = Annotated[float, Field(gt=0)]


class StepperConfig(Schema):
    """Stepper motors on one microcontroller; the defaults suit 200-step motors in half steps.

    Motor i turns the body's shaft i. Steppers have no encoder: positions are commanded steps, and lost steps or a
    blocked motor go undetected.
    """

    kind: Literal["steppers"] = "steppers"
    motors: Annotated[int, Field(ge=1, le=MOTORS)] = MOTORS
    """Motors that turn shafts; the controller's other motors are unused"""
    steps_per_turn: Annotated[int, Field(ge=4, le=51_200)] = 400
    """Steps per motor turn, including half or micro steps; must equal the controller's value"""
    inverted: Annotated[tuple[bool, ...], Field(strict=False)] = (False,) * MOTORS
    """For each motor: whether driving forward needs negative rates"""
    max_rate: Annotated[float, Field(gt=0, le=MAX_RATE / 1000)] = 250.0
    """Limit of requested rates (steps/s); choose it below the rate at which a motor loses steps"""
    acceleration: Annotated[int, Field(gt=0, le=1_000_000)] = 4000
    """Acceleration of the controller's ramps (steps/s^2)"""
    quick_deceleration: Annotated[int, Field(gt=0, le=1_000_000)] = 8000
    """Deceleration of the controller's quick stop and watchdog (steps/s^2)"""
    rate: Annotated[float, Field(ge=5, le=50)] = 20.0
    """Exchanges per second"""
    answer_timeout: Annotated[float, Field(gt=0, le=0.2)] = 0.05
    """Timeout of an answer (s)"""
    command_timeout: Seconds = 0.25
    """Maximum age of the latest command (s), after which the motors ramp down to rest"""
    quick_stop_after: Seconds = 1.0
    """Maximum age of the latest command (s), after which the motors quick-stop"""
    watchdog: Annotated[float, Field(ge=0.05, le=2.0)] = 0.3
    """Time without a run request after which the controller itself stops the motors (s)"""

    @property
    def shafts(self) -> int:
        """Number of driven shafts."""
        return self.motors

    @property
    def turn(self) -> float:
        """Angle per step (rad)."""
        return 2.0 * math.pi / self.steps_per_turn

    @property
    def motor_limits(self) -> MotorLimits:
        """Motor limits."""
        return MotorLimits(
            self.max_rate * self.turn, self.acceleration * self.turn, self.quick_deceleration * self.turn
        )

    @property
    def stop_words(self) -> str:
        """Arguments of the stop script: none, because it needs only the port."""
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
