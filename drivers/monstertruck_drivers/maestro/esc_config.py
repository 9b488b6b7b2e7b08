"""Settings of a radio-control speed controller (ESC) on a channel of a Maestro, which steers as well."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.maestro.config import BatteryInputConfig, Channel, MaestroConfig, Microseconds
from monstertruck_drivers.shafts import MotorLimits, SteeringOutputs
from monstertruck_schemas.base import Schema


class EscConfig(Schema):
    """Speed controller without feedback: ``pulse_us = neutral_us + direction * reach_us * rate / max_rate``.

    It must reverse without braking first (crawler mode); a car's usual mode takes the first reverse pulse for a brake.
    """

    channel: Channel = 2
    neutral_us: Microseconds = 1500.0
    """Pulse at which the motor stands still"""
    reach_us: Annotated[float, Field(gt=0, le=1000)] = 400.0
    """Change of the pulse that makes the motor turn at max_rate"""
    direction: Literal[-1, 1] = 1
    """+1 where a longer pulse drives forward"""
    max_rate: Annotated[float, Field(gt=0, le=10_000)] = 300.0
    """Rate at the end of the pulses, as measured, rad/s; requests are limited to this"""
    deceleration: Annotated[float, Field(gt=0)] = 400.0
    """Deceleration by a lower pulse, as measured, rad/s^2"""
    quick_deceleration: Annotated[float, Field(gt=0)] = 500.0
    """Deceleration at the neutral pulse, as measured, rad/s^2"""
    arming: Annotated[float, Field(ge=0, le=10)] = 2.0
    """Seconds of neutral pulses that it wants before it moves"""

    def quarters(self, rate: float) -> int:
        """Target in quarter microseconds for a rate, rad/s, forward positive, held within the limits."""
        share = min(max(rate / self.max_rate, -1.0), 1.0)
        return round(4 * (self.neutral_us + self.direction * self.reach_us * share))

    def rate(self, pulse_us: float) -> float:
        """Rate that a pulse asks for, rad/s, forward positive."""
        return (pulse_us - self.neutral_us) * self.direction / self.reach_us * self.max_rate


class MaestroEscConfig(Schema):
    """Maestro with the speed controller of the only driven shaft on one channel and the steering servos on others."""

    kind: Literal["maestro_esc"] = "maestro_esc"
    esc: EscConfig = EscConfig()
    unit: MaestroConfig = MaestroConfig()
    """The Maestro itself: servos, battery input, rates"""

    @property
    def motor_limits(self) -> MotorLimits:
        """Limits of the motor."""
        return MotorLimits(self.esc.max_rate, self.esc.deceleration, self.esc.quick_deceleration)

    @property
    def steering_outputs(self) -> SteeringOutputs:
        """Steering outputs of the servos."""
        return self.unit.steering_outputs

    @property
    def battery(self) -> BatteryInputConfig | None:
        """Its battery input."""
        return self.unit.battery

    @property
    def command_timeout(self) -> float:
        """Age of the latest command at which the pulse becomes neutral (s)."""
        return self.unit.command_timeout

    @property
    def stop_words(self) -> str:
        """Channel and neutral pulse in quarter microseconds, for the stop script."""
        return f"{self.esc.channel}:{self.esc.quarters(0.0)}"

    @model_validator(mode="after")
    def _channels_differ(self) -> Self:
        unit = self.unit
        used = {servo.channel for servo in unit.servos} | {unit.deadman_channel}
        used |= {None if unit.battery is None else unit.battery.channel}
        if self.esc.channel in used:
            raise ValueError(f"esc.channel {self.esc.channel}: the unit uses it for something else")
        if unit.device_number is not None or unit.use_crc:
            raise ValueError("unit: expected the compact protocol without CRC, which the stop script speaks")
        return self
