"""Configuration of the Maestro: servo calibration, battery scale and thresholds, deadman."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.battery.config import PackConfig
from monstertruck_drivers.maestro.protocol import ADC_MAX, CHANNELS
from monstertruck_drivers.servos import ServoPulses
from monstertruck_drivers.shafts import SteeringOutputs
from monstertruck_schemas.base import Schema

Channel = Annotated[int, Field(ge=0, lt=CHANNELS)]


class ServoConfig(ServoPulses):
    """Steering servo on a channel."""

    channel: Channel
    """Channel of the servo controller."""
    speed: Annotated[int, Field(ge=0, le=0x3FFF)] = 100
    """Speed limit of the pulse (0.25 us per 10 ms); 0 = unlimited."""
    acceleration: Annotated[int, Field(ge=0, le=255)] = 0
    """Acceleration limit of the pulse (0.25 us per 10 ms per 80 ms); 0 = unlimited."""

    def quarters(self, angle: float) -> int:
        """Target (quarter microseconds) for a servo angle (rad, left positive), clamped to every limit."""
        return round(4 * self.pulse_us(angle))

    def within_limits(self, quarters: int) -> bool:
        """Whether a pulse (quarter microseconds) can be a target of this driver."""
        rounding = 2  # tolerance of a pulse around its target (quarter microseconds)
        return 4 * self.min_us - rounding <= quarters <= 4 * self.max_us + rounding

    def angle(self, quarters: int) -> float:
        """Servo angle (rad, left positive) for a pulse in quarter microseconds."""
        return self.angle_of(quarters / 4)


class CurrentInputConfig(Schema):
    """Pack current sensor: a Hall sensor on an analog input; the default is a 20 A ACS712."""

    channel: Channel = 4
    """Analog input of the servo controller."""
    zero: float = 2.5
    """Voltage at no current (V)"""
    volts_per_amp: Annotated[float, Field(gt=0)] = 0.1
    """Sensitivity (V/A)"""
    reverse: bool = False
    """Whether the voltage falls while the pack is charged"""

    def amps(self, raw: int) -> float:
        """Current into the pack (A) for a 10-bit reading relative to the 5 V rail."""
        amps = (raw * 5.0 / ADC_MAX - self.zero) / self.volts_per_amp
        return -amps if self.reverse else amps


class BatteryInputConfig(PackConfig):
    """Pack voltage measured through a divider on an analog input."""

    channel: Channel = 5
    """Analog input of the servo controller."""
    volts_per_count: Annotated[float, Field(gt=0)] = 5.0 * 10 / ADC_MAX
    """Scale (V per count). The reference is the USB 5 V rail (5 % tolerance) behind a 1:10 divider: calibrate with a
    multimeter.
    """
    gain: Annotated[float, Field(gt=0)] = 1.0
    """Calibration factor for the voltage."""
    offset: float = 0.0
    """Offset added after the gain (V)."""
    current: CurrentInputConfig | None = None
    """Sensor of the current into the pack, which shows charging; null: none"""

    @model_validator(mode="after")
    def _ends_of_scale_are_faults(self) -> Self:
        # A broken divider reads 0 or full scale.
        for raw in (0, ADC_MAX):
            if self.plausible_min <= self.volts(raw) <= self.plausible_max:
                raise ValueError(f"reading {raw} means {self.volts(raw):.1f} V, which is not plausible")
        return self

    def volts(self, raw: int) -> float:
        """Pack voltage (V) for a 10-bit reading."""
        return raw * self.volts_per_count * self.gain + self.offset


class MaestroConfig(Schema):
    """Pololu Micro Maestro 6."""

    kind: Literal["maestro"] = "maestro"
    front: ServoConfig = ServoConfig(channel=1)
    rear: ServoConfig = ServoConfig(channel=0)
    front_right: ServoConfig | None = None
    """Servo of the front right wheel, where every wheel has a servo; ``front`` is then the front left wheel"""
    rear_right: ServoConfig | None = None
    """Servo of the rear right wheel; ``rear`` is then the rear left wheel"""
    dead_time: Annotated[float, Field(ge=0, le=1)] | None = None
    """Dead time from a steering command to the first movement of the wheels (s); null if it was not measured"""
    lag: Annotated[float, Field(ge=0, le=1)] | None = None
    """Time constant of the wheels' movement after the dead time (s); null if it was not measured"""
    battery: BatteryInputConfig | None = BatteryInputConfig()
    poll_rate: Annotated[float, Field(gt=0, le=50)] = 20.0
    """Rate at which both pulses and the error word are read (Hz)."""
    battery_rate: Annotated[float, Field(gt=0, le=50)] = 10.0
    """Rate at which the battery is read (Hz); never more often than ``poll_rate``."""
    answer_timeout: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Timeout of all answers to one poll (s)."""
    command_timeout: Annotated[float, Field(gt=0, le=2)] = 0.25
    """Maximum age of a steering command (s); the servos then hold their position and the deadman line is released."""
    deadman_channel: Channel | None = None
    """Digital output held high while commands are fresh; wire it to the motor controller's quick-stop input."""
    deadman_feed: Literal["fresh", "always"] = "fresh"
    """When the driver feeds the Maestro's serial timeout: see ``MaestroDriver``."""
    device_number: Annotated[int, Field(ge=0, le=127)] | None = None
    """Device number of the Pololu protocol; null selects the compact protocol."""
    use_crc: bool = False
    """Whether commands carry a CRC; must match the unit's own setting."""

    @property
    def servos(self) -> tuple[ServoConfig, ...]:
        """Front and rear servo, or front left, front right, rear left and rear right."""
        if self.front_right is None or self.rear_right is None:
            return self.front, self.rear
        return self.front, self.front_right, self.rear, self.rear_right

    @property
    def steering_outputs(self) -> SteeringOutputs:
        """Steering outputs driven by the servos."""
        return SteeringOutputs(tuple(servo.reach for servo in self.servos), self.dead_time, self.lag)

    @model_validator(mode="after")
    def _channels_differ(self) -> Self:
        used = {"front": self.front.channel, "rear": self.rear.channel}
        if (self.front_right is None) != (self.rear_right is None):
            raise ValueError("front_right and rear_right: expected both or neither")
        if self.front_right is not None and self.rear_right is not None:
            used |= {"front_right": self.front_right.channel, "rear_right": self.rear_right.channel}
        if self.battery is not None:
            used["battery"] = self.battery.channel
            if self.battery.current is not None:
                used["current"] = self.battery.current.channel
        if self.deadman_channel is not None:
            used["deadman_channel"] = self.deadman_channel
        if len(set(used.values())) < len(used):
            raise ValueError(f"every channel may have only one use, got {used}")
        return self
