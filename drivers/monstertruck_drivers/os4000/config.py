"""Configuration of the OS4000 compass."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.os4000.protocol import RATE_MAX, Fields
from monstertruck_schemas.base import FrameId, Positive, Schema

NEEDED = Fields.HEADING | Fields.PITCH | Fields.ROLL
"""Fields required for an attitude."""


class IronConfig(Schema):
    """Compensation of the truck's own magnetism in the measured field: ``soft (field - hard)``, in device axes.

    Calibrated on level ground: the vertical field is unchanged, and ``soft`` is scaled to determinant 1. With the
    default values the driver uses the unit's own heading; with other values it computes the heading.
    """

    hard_x: float = 0.0
    """Hard iron along x (microtesla), in the unit's own scale"""
    hard_y: float = 0.0
    """Hard iron along y (microtesla), in the unit's own scale"""
    soft_xx: Positive = 1.0
    """Element (x, x) of ``soft``"""
    soft_xy: float = 0.0
    """Elements (x, y) and (y, x) of ``soft``"""
    soft_yy: Positive = 1.0
    """Element (y, y) of ``soft``"""

    @model_validator(mode="after")
    def _keeps_directions_apart(self) -> Self:
        if not self.soft_xy * self.soft_xy < self.soft_xx * self.soft_yy:
            raise ValueError(f"soft_xy {self.soft_xy}: expected less than the root of soft_xx * soft_yy")
        return self


class Os4000Config(Schema):
    """OceanServer OS4000 compass.

    The driver writes rate, fields and format only if the unit's behaviour differs. Declination must be zero in the
    unit, so that its headings refer to magnetic north.
    """

    kind: Literal["os4000"] = "os4000"
    rate: Annotated[int, Field(ge=1, le=RATE_MAX)] = 20
    """Sentence rate (Hz); all fields at 19200 baud allow 24."""
    fields: Annotated[int, Field(ge=0, le=511)] = 335
    """Field mask; 335 = heading, pitch, roll, temperature, magnetic field, acceleration."""
    delay: Annotated[float, Field(ge=0, le=1)] = 0.04
    """Age of a measurement when its last byte arrives (s): 80 bytes at 19200 baud."""
    silence: Positive = 0.5
    """Timeout without a valid sentence (s), at least five periods; then the session ends."""
    field_strength: Positive | None = None
    """Magnitude of the magnetic field where the unit was calibrated (microtesla); None: not checked."""
    field_tolerance: Annotated[float, Field(gt=0, lt=1)] = 0.25
    """Tolerance of the field (fraction); beyond it, the heading is marked as disturbed."""
    iron: IronConfig = IronConfig()
    """Magnetic calibration of the unit on this truck"""
    gravity_tolerance: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """Tolerance of the acceleration (fraction of 1 g); beyond it, roll and pitch are not tilt."""
    frame: FrameId = "base"
    """Frame whose axes match the unit's mounting."""

    @model_validator(mode="after")
    def _fields_make_an_attitude(self) -> Self:
        if self.fields & NEEDED != NEEDED:
            raise ValueError(f"fields {self.fields} lacks heading (1), pitch (2) or roll (4)")
        if self.iron != IronConfig() and not self.fields & Fields.FIELD:
            raise ValueError(f"fields {self.fields} lacks the magnetic field (64), which iron needs")
        return self

    @property
    def timeout(self) -> float:
        """Time without a valid sentence after which the session ends (s)."""
        return max(self.silence, 5 / self.rate)
