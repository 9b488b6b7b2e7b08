"""Settings for a laser scanner described by its data sheet."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_drivers.scanning.config import ReturnsConfig
from monstertruck_drivers.sheet_lidar.protocol import MOST_BEAMS
from monstertruck_schemas.base import Positive


class SheetLidarConfig(ReturnsConfig):
    """Laser scanner of any manufacturer, described by its data sheet, for simulation before its driver exists.

    On a robot, it is any device that sends the frames of ``sheet_lidar/protocol.py``, such as a microcontroller.
    """

    kind: Literal["sheet_lidar"] = "sheet_lidar"
    beams: Annotated[int, Field(ge=8, le=MOST_BEAMS)] = 450
    """Beams per scan"""
    field_of_view: Annotated[float, Field(gt=0, le=math.tau)] = math.tau
    """Angle that a scan covers, centred straight ahead (rad)"""
    direction: Literal["clockwise", "counter_clockwise"] = "clockwise"
    """Turning direction seen from above"""
    rate: Annotated[float, Field(ge=2, le=100)] = 10.0
    """Scans per second"""
    range_min: Annotated[float, Field(ge=0, lt=60)] = 0.05
    """Minimum range (m)"""
    range_max: Annotated[float, Field(gt=0, le=60)] = 12.0
    """Maximum range to a white surface (m)"""
    range_dark: Positive | None = None
    """Maximum range to a surface of 10 % reflectivity (m); null if the data sheet has none"""
    error: Annotated[float, Field(ge=0, lt=1)] = 0.03
    """Error bound of a range (m)"""
    relative_error: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Error bound as a fraction of the range; the larger bound applies"""
    first_scan: Annotated[float, Field(gt=0, le=60)] = 6.0
    """Maximum time for the first scan, including the motor's start (s)"""
    stale: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Maximum time without a later scan before the session ends (s)"""

    @property
    def increment(self) -> float:
        """Angle between beams (rad), counter-clockwise positive; a full turn ends one step before its start."""
        steps = self.beams if self.field_of_view == math.tau else self.beams - 1
        return (-1.0 if self.direction == "clockwise" else 1.0) * self.field_of_view / steps

    @property
    def start_angle(self) -> float:
        """Direction of the first beam (rad)."""
        return math.copysign(self.field_of_view / 2, -self.increment)

    @property
    def time_increment(self) -> float:
        """Time between beams (s)."""
        return abs(self.increment) / math.tau / self.rate

    @property
    def sheet(self) -> RangeSheet:
        """Range limits and errors."""
        return RangeSheet(self.range_min, self.range_max, self.error, self.relative_error, self.range_dark)

    @model_validator(mode="after")
    def _ranges_in_order(self) -> Self:
        if not self.range_min < (self.range_dark or self.range_max) <= self.range_max:
            raise ValueError(
                f"range_min {self.range_min:g} m, range_dark {self.range_dark} m, range_max "
                f"{self.range_max:g} m: expected increasing values"
            )
        return self
