"""Settings for a PCA9685 with steering servos, with or without a speed controller."""

from functools import cached_property
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.pca9685.protocol import ADDRESS, ADDRESSES, CHANNELS, COUNTS, OSCILLATOR, count_us, prescale
from monstertruck_drivers.servos import EscPulses, ServoPulses
from monstertruck_drivers.shafts import MotorLimits, SteeringOutputs
from monstertruck_schemas.base import Schema

Channel = Annotated[int, Field(ge=0, lt=CHANNELS)]


class Pca9685Servo(ServoPulses):
    """Steering servo on a channel."""

    channel: Channel = 0
    """Channel of the board."""


class Pca9685Esc(EscPulses):
    """Speed controller on a channel."""

    channel: Channel = 1
    """Channel of the board."""


class Pca9685Config(Schema):
    """NXP PCA9685 with the steering servos."""

    kind: Literal["pca9685"] = "pca9685"
    address: Annotated[int, Field(ge=ADDRESSES[0], le=ADDRESSES[-1])] = ADDRESS
    """7-bit address, set by the solder bridges of the board"""
    front: Pca9685Servo = Pca9685Servo()
    rear: Pca9685Servo | None = None
    """Servo of the rear axle; null: it does not steer"""
    frequency: Annotated[float, Field(ge=40, le=330)] = 50.0
    """Pulse rate (Hz); analog servos and most speed controllers expect 50. The resolution of a pulse is 1/4096 of the
    cycle"""
    oscillator: Annotated[float, Field(ge=23e6, le=27e6)] = OSCILLATOR
    """This chip's oscillator frequency (Hz): measure the frequency of a pulse and set oscillator = 4096 times that
    times (prescaler + 1), which ``probe`` prints. An error of 4 % moves a neutral pulse by 60 us"""
    dead_time: Annotated[float, Field(ge=0, le=1)] | None = None
    """Dead time from a steering command to the first movement of the wheels (s); null if it was not measured"""
    lag: Annotated[float, Field(ge=0, le=1)] | None = None
    """Time constant of the wheels' movement after the dead time (s); null if it was not measured"""
    poll_rate: Annotated[float, Field(gt=0, le=50)] = 20.0
    """Rate at which the registers are read back (Hz)"""
    answer_timeout: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Timeout of one transfer on the bus (s)"""
    command_timeout: Annotated[float, Field(gt=0, le=2)] = 0.25
    """Maximum age of a command (s); after that, the servos hold and the motor receives its neutral pulse"""

    @cached_property
    def prescale(self) -> int:
        """Prescaler value."""
        return prescale(self.frequency, self.oscillator)

    def counts(self, pulse_us: float) -> int:
        """Convert a pulse length (us) to counts."""
        return round(pulse_us / count_us(self.prescale, self.oscillator))

    def pulse_us(self, counts: int) -> float:
        """Convert counts to a pulse length (us)."""
        return counts * count_us(self.prescale, self.oscillator)

    @property
    def servos(self) -> tuple[Pca9685Servo, ...]:
        """Configured servos."""
        return (self.front,) if self.rear is None else (self.front, self.rear)

    @property
    def steering_outputs(self) -> SteeringOutputs:
        """Steering outputs driven by the servos."""
        rear = (0.0, 0.0) if self.rear is None else self.rear.reach
        return SteeringOutputs((self.front.reach, rear), self.dead_time, self.lag)

    @property
    def battery(self) -> None:
        """None, because the chip measures nothing."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.rear is not None and self.rear.channel == self.front.channel:
            raise ValueError(f"front and rear share channel {self.front.channel}; expected one each")
        longest = max(servo.max_us for servo in self.servos)
        if self.counts(longest) >= COUNTS:
            raise ValueError(f"frequency {self.frequency:g}: a pulse of {longest:g} us is longer than a cycle")
        return self


class Pca9685EscConfig(Schema):
    """PCA9685 with the speed controller of the only driven shaft on one channel and the steering servos on others."""

    kind: Literal["pca9685_esc"] = "pca9685_esc"
    esc: Pca9685Esc = Pca9685Esc()
    unit: Pca9685Config = Pca9685Config()
    """The chip itself: servos, frequency, rates"""

    @property
    def motor_limits(self) -> MotorLimits:
        """Motor limits."""
        return self.esc.motor_limits

    @property
    def steering_outputs(self) -> SteeringOutputs:
        """Steering outputs driven by the servos."""
        return self.unit.steering_outputs

    @property
    def battery(self) -> None:
        """None, because the chip measures nothing."""

    @property
    def command_timeout(self) -> float:
        """Age of the latest command at which the pulse becomes neutral (s)."""
        return self.unit.command_timeout

    @property
    def stop_words(self) -> str:
        """Address, channel and neutral pulse in counts, for the stop script."""
        return f"{self.unit.address}:{self.esc.channel}:{self.unit.counts(self.esc.neutral_us)}"

    @model_validator(mode="after")
    def _channels_differ(self) -> Self:
        if self.esc.channel in (servo.channel for servo in self.unit.servos):
            raise ValueError(f"esc.channel {self.esc.channel}: a servo uses this channel")
        if self.unit.counts(self.esc.neutral_us + self.esc.reach_us) >= COUNTS:
            raise ValueError(f"unit.frequency {self.unit.frequency:g}: the longest pulse of esc is longer than a cycle")
        return self
