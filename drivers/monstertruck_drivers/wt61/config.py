"""Settings for the WT61."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_drivers.inertial import ImuCorrection
from monstertruck_schemas.base import Schema


class Wt61Config(Schema):
    """WitMotion WT61: three gyroscopes and three accelerometers."""

    kind: Literal["wt61"] = "wt61"
    average: Annotated[int, Field(ge=1, le=20)] = 2
    """Number of measurements averaged in one message; the unit measures at 100 Hz"""
    delay: Annotated[float, Field(ge=0, le=0.5)] = 0.008
    """Age of a measurement when its last byte arrives (s): 33 bytes and the unit's filter"""
    silence: Annotated[float, Field(gt=0, le=10)] = 0.3
    """Timeout without a measurement (s); then the session ends"""
    stuck_after: Annotated[int, Field(ge=2, le=10_000)] = 50
    """Number of consecutive identical measurements after which the session ends: real sensors have noise"""
    correction: ImuCorrection = ImuCorrection()
    """Biases and scale of this unit"""
