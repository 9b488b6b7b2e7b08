"""Settings for pulse-controlled servos and speed controllers, whatever device sends the pulses."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.shafts import MotorLimits
from monstertruck_schemas.base import Schema

Microseconds = Annotated[float, Field(gt=0, le=4000)]


class ServoPulses(Schema):
    """One steering servo: ``pulse_us = centre_us + direction * scale_us_per_deg * servo angle in degrees``."""

    centre_us: Microseconds = 1439.2
    """Pulse that steers straight ahead."""
    scale_us_per_deg: Annotated[float, Field(gt=0)] = 10.48
    """Change of the pulse per degree of servo angle (us)."""
    direction: Literal[-1, 1] = -1
    """+1 if a longer pulse steers left, -1 if it steers right; depends on the servo's mounting."""
    min_us: Microseconds = 1088.0
    """Minimum commanded pulse (us)."""
    max_us: Microseconds = 1840.0
    """Maximum commanded pulse (us)."""
    max_angle_deg: Annotated[float, Field(gt=0, le=180)] = 45.0
    """Maximum commanded servo angle to either side (degrees)."""

    @model_validator(mode="after")
    def _centre_within_limits(self) -> Self:
        if not self.min_us < self.centre_us < self.max_us:
            raise ValueError(f"expected min_us {self.min_us} < centre_us {self.centre_us} < max_us {self.max_us}")
        return self

    def pulse_us(self, angle: float) -> float:
        """Pulse (us) for a servo angle (rad, left positive), clamped to every limit."""
        limit = self.max_angle_deg
        degrees = min(max(math.degrees(angle), -limit), limit)
        pulse = self.centre_us + self.direction * self.scale_us_per_deg * degrees
        return min(max(pulse, self.min_us), self.max_us)

    def angle_of(self, pulse_us: float) -> float:
        """Servo angle (rad, left positive) for a pulse (us)."""
        return math.radians((pulse_us - self.centre_us) * self.direction / self.scale_us_per_deg)

    @property
    def reach(self) -> tuple[float, float]:
        """Servo angles (rad) at the pulse limits: right (negative) and left."""
        ends = sorted(self.angle_of(pulse) for pulse in (self.min_us, self.max_us))
        limit = math.radians(self.max_angle_deg)
        return max(ends[0], -limit), min(ends[1], limit)


class EscPulses(Schema):
    """Speed controller without feedback: ``pulse_us = neutral_us + direction * reach_us * rate / max_rate``.

    It must reverse without braking first (crawler mode); the usual car mode treats the first reverse pulse as a brake.
    """

    neutral_us: Microseconds = 1500.0
    """Pulse at which the motor is at rest"""
    reach_us: Annotated[float, Field(gt=0, le=1000)] = 400.0
    """Change of the pulse that makes the motor turn at max_rate"""
    direction: Literal[-1, 1] = 1
    """+1 if a longer pulse drives forward"""
    max_rate: Annotated[float, Field(gt=0, le=10_000)] = 300.0
    """Measured rate at the maximum pulse (rad/s); it limits requests"""
    deceleration: Annotated[float, Field(gt=0)] = 400.0
    """Measured deceleration at a lower pulse (rad/s^2)"""
    quick_deceleration: Annotated[float, Field(gt=0)] = 500.0
    """Measured deceleration at the neutral pulse (rad/s^2)"""
    arming: Annotated[float, Field(ge=0, le=10)] = 2.0
    """Duration of neutral pulses that the controller requires before it moves (s)"""

    def pulse_us(self, rate: float) -> float:
        """Pulse (us) for a rate (rad/s), forward positive, clamped to the limits."""
        share = min(max(rate / self.max_rate, -1.0), 1.0)
        return self.neutral_us + self.direction * self.reach_us * share

    @property
    def motor_limits(self) -> MotorLimits:
        """Limits of the motor."""
        return MotorLimits(self.max_rate, self.deceleration, self.quick_deceleration)

    def rate(self, pulse_us: float) -> float:
        """Rate commanded by a pulse (rad/s), forward positive."""
        return (pulse_us - self.neutral_us) * self.direction / self.reach_us * self.max_rate
