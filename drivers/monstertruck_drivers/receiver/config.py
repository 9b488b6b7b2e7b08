"""Settings of receivers: what the channels mean."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.receiver.protocol import CHANNELS
from monstertruck_schemas.base import Schema

Channel = Annotated[int, Field(ge=1, le=CHANNELS)]


class ReceiverConfig(Schema):
    """Channels of the radio control, as the transmitter numbers them."""

    speed: Channel = 2
    """Stick of the speed"""
    steer: Channel = 1
    """Stick of the steering"""
    arm: Channel = 5
    """Switch without which the robot does not move"""
    drive: Channel | None = None
    """Switch by which the hand drives; off, planners may drive and the hand only supervises; null = it always drives"""
    estop: Channel | None = None
    """Switch of the emergency stop; null = none"""
    unseen: Channel | None = None
    """Switch to drive into unseen ground; null = none"""
    inverted: Annotated[tuple[Channel, ...], Field(strict=False)] = (1,)
    """Channels that count the other way; without this, up is ahead and left is on. Transmitters send more for right"""
    dead_band: Annotated[float, Field(ge=0, le=0.3)] = 0.05
    """Share of a stick's way around its middle that counts as the middle"""
    settle: Annotated[int, Field(ge=1, le=20)] = 3
    """Frames in a row in which a switch must be on before it counts as on; off counts at once"""
    silence: Annotated[float, Field(gt=0, le=2)] = 0.2
    """Seconds without channels after which the transmitter counts as lost"""

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        used = [self.speed, self.steer, self.arm, *(c for c in (self.drive, self.estop, self.unseen) if c is not None)]
        if len(set(used)) < len(used):
            raise ValueError(f"every channel may have one use only, got {used}")
        return self


class CrsfConfig(ReceiverConfig):
    """Receiver that speaks CRSF: ExpressLRS or TBS Crossfire."""

    kind: Literal["crsf"] = "crsf"


class SbusConfig(ReceiverConfig):
    """Receiver that speaks SBUS, behind an adapter that inverts the line."""

    kind: Literal["sbus"] = "sbus"
