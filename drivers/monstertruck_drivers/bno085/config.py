"""Settings for the BNO085."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_drivers.inertial import ImuCorrection
from monstertruck_schemas.base import FrameId, Schema


class Bno085Config(Schema):
    """CEVA BNO085 in UART-RVC mode (PS0 high, PS1 low): tilt, specific force, and a turn rate derived from its heading.

    Its heading is relative to power-up and drifts by half a degree a minute, so it does not replace a compass.
    """

    kind: Literal["bno085"] = "bno085"
    average: Annotated[int, Field(ge=1, le=20)] = 2
    """Frames averaged in one message; the unit sends 100 frames a second"""
    delay: Annotated[float, Field(ge=0, le=0.5)] = 0.006
    """Delay from the measurement to the last byte of its frame (s): 19 bytes and the unit's filter"""
    silence: Annotated[float, Field(gt=0, le=10)] = 0.3
    """Timeout without a frame (s); then the session ends"""
    stuck_after: Annotated[int, Field(ge=2, le=10_000)] = 100
    """Number of consecutive frames with an identical acceleration after which the session ends: real sensors have
    noise
    """
    gravity_tolerance: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """Tolerance of the acceleration (fraction of 1 g); beyond it, roll and pitch are not tilt"""
    correction: ImuCorrection = ImuCorrection()
    """Biases and scale of this unit"""
    frame: FrameId = "base"
    """Frame whose axes match the unit's mounting, for its tilt"""
