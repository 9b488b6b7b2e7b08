"""Receiver settings: the meaning of each channel."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.receiver.protocol import RADIO_CHANNELS
from monstertruck_schemas.base import Schema

Channel = Annotated[int, Field(ge=1, le=RADIO_CHANNELS)]


class ReceiverConfig(Schema):
    """Radio-control channels, numbered as on the transmitter."""

    speed: Channel = 2
    """Speed stick"""
    steer: Channel = 1
    """Steering stick"""
    arm: Channel = 5
    """Arming switch; the robot moves only while it is on"""
    drive: Channel | None = None
    """Switch for manual driving; off: planners may drive, the operator only supervises; null: always manual"""
    estop: Channel | None = None
    """Emergency stop switch; null: none"""
    unseen: Channel | None = None
    """Switch that permits driving into unseen ground; null: none"""
    inverted: Annotated[tuple[Channel, ...], Field(strict=False)] = (1,)
    """Channels with reversed sign; otherwise up is ahead and left is on. Transmitters send higher values for right"""
    dead_band: Annotated[float, Field(ge=0, le=0.3)] = 0.05
    """Dead band around a stick's centre, as a fraction of its travel"""
    settle: Annotated[int, Field(ge=1, le=20)] = 3
    """Consecutive frames with a switch on before it takes effect; off takes effect immediately"""
    silence: Annotated[float, Field(gt=0, le=2)] = 0.2
    """Timeout without channels (s); then the transmitter counts as lost"""

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        used = [self.speed, self.steer, self.arm, *(c for c in (self.drive, self.estop, self.unseen) if c is not None)]
        if len(set(used)) < len(used):
            raise ValueError(f"every channel may have only one use, got {used}")
        return self


class CrsfConfig(ReceiverConfig):
    """CRSF receiver: ExpressLRS or TBS Crossfire."""

    kind: Literal["crsf"] = "crsf"


class SbusConfig(ReceiverConfig):
    """SBUS receiver behind an adapter that inverts the line."""

    kind: Literal["sbus"] = "sbus"
