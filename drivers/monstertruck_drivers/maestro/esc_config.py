"""Settings for a radio-control speed controller (ESC) on a channel of a Maestro that also steers."""

from typing import Literal, Self

from pydantic import model_validator

from monstertruck_drivers.maestro.config import BatteryInputConfig, Channel, MaestroConfig
from monstertruck_drivers.servos import EscPulses
from monstertruck_drivers.shafts import MotorLimits, SteeringOutputs
from monstertruck_schemas.base import Schema


class EscConfig(EscPulses):
    """Speed controller on a channel."""

    channel: Channel = 2
    """Channel of the servo controller."""

    def quarters(self, rate: float) -> int:
        """Target (quarter microseconds) for a rate (rad/s), forward positive, clamped to the limits."""
        return round(4 * self.pulse_us(rate))


class MaestroEscConfig(Schema):
    """Maestro with the speed controller of the only driven shaft on one channel and the steering servos on others."""

    kind: Literal["maestro_esc"] = "maestro_esc"
    esc: EscConfig = EscConfig()
    unit: MaestroConfig = MaestroConfig()
    """The Maestro itself: servos, battery input, rates"""

    @property
    def motor_limits(self) -> MotorLimits:
        """Motor limits."""
        return self.esc.motor_limits

    @property
    def steering_outputs(self) -> SteeringOutputs:
        """Steering outputs driven by the servos."""
        return self.unit.steering_outputs

    @property
    def battery(self) -> BatteryInputConfig | None:
        """The unit's battery input."""
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
            raise ValueError(f"esc.channel {self.esc.channel}: another function of the unit uses this channel")
        if unit.device_number is not None or unit.use_crc:
            raise ValueError("unit: expected the compact protocol without CRC, which the stop script uses")
        return self
