"""Settings of the WT61."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import Schema


class ImuCorrection(Schema):
    """What is taken out of the measurements, as calibrated; the unit's own axes."""

    rate_x: float = 0.0
    """Bias of the angular velocity, rad/s"""
    rate_y: float = 0.0
    rate_z: float = 0.0
    rate_scale: Annotated[float, Field(ge=0.5, le=2)] = 1.0
    """Factor on the angular velocity about z, its bias taken out"""
    force_x: float = 0.0
    """Bias of the specific force, m/s^2"""
    force_y: float = 0.0


class Wt61Config(Schema):
    """WitMotion WT61: three gyroscopes, three accelerometers."""

    kind: Literal["wt61"] = "wt61"
    average: Annotated[int, Field(ge=1, le=20)] = 2
    """Measurements of which one message is the mean; the unit takes 100 a second"""
    delay: Annotated[float, Field(ge=0, le=0.5)] = 0.008
    """Age of a measurement when its last byte arrives, s: 33 bytes and the unit's filter"""
    silence: Annotated[float, Field(gt=0, le=10)] = 0.3
    """Seconds without a measurement that end the session"""
    stuck_after: Annotated[int, Field(ge=2, le=10_000)] = 50
    """Measurements that are equal to the last bit, in a row, that end the session: sensors are never so quiet"""
    correction: ImuCorrection = ImuCorrection()
    """Biases and scale of this unit"""
