"""Battery settings: the pack, its low, critical and overcharged limits, and the converter that measures it."""

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Schema

Volts = Annotated[float, Field(ge=0)]
Seconds = Annotated[float, Field(ge=0, le=60)]


class PackConfig(Schema):
    """Lithium-polymer pack and its limits; the default is 6S.

    The low, critical, clear and overcharged limits apply to the resting voltage (the measured voltage plus the sag
    caused by the motor current); the collapsed limit applies to the measured voltage. Calibrate the voltage scale: an
    error of 5 % makes a full pack look overcharged.
    """

    cells: Annotated[int, Field(ge=1, le=14)] = 6
    """Cells in series."""
    capacity_ah: Annotated[float, Field(gt=0, le=100)] = 5.0
    """Capacity of the pack in the truck (Ah): 3.7, 4.0 or 5.0"""
    resistance: Annotated[float, Field(ge=0, le=1)] = 0.06
    """Resistance of cells and wiring for the sag, ohm; 5 to 15 milliohm per cell are usual. Fit it to the voltage drop
    at a motor start: with half the true value the charge reads up to 0.2 too low at 100 W
    """
    max_compensation: Volts = 1.5
    """Maximum sag attributed to the motor's current, so that a wrong current cannot hide an empty pack"""
    smoothing: Seconds = 5.0
    """Time constant of the published voltages (s)."""
    low: Volts = 22.0
    """Voltage below which the pack is low."""
    low_after: Seconds = 10.0
    """Time below ``low`` before it is reported (s)."""
    clear: Volts = 22.4
    """Voltage above which low and critical end."""
    clear_after: Seconds = 30.0
    """Time above ``clear`` before low and critical end (s)."""
    critical: Volts = 21.0
    """Voltage below which the pack is critical."""
    critical_after: Seconds = 10.0
    """Time below ``critical`` before it is reported (s)."""
    collapsed: Volts = 19.8
    """Voltage that is critical after a shorter time."""
    collapsed_after: Seconds = 2.0
    """Time below ``collapsed`` before it is reported (s)."""
    overcharged: Volts = 25.3
    """Voltage above which the pack is overcharged."""
    overcharged_after: Seconds = 2.0
    """Time above ``overcharged`` before it is reported (s)."""
    overcharged_clear: Volts = 25.2
    """Voltage below which overcharged ends."""
    plausible_min: Volts = 15.0
    """Bounds of the plausible range, outside of which the sensor, not the battery, is considered faulty."""
    plausible_max: Volts = 26.0
    """Upper end of the plausible range."""

    @model_validator(mode="after")
    def _thresholds_in_order(self) -> Self:
        order = (
            "plausible_min",
            "collapsed",
            "critical",
            "low",
            "clear",
            "overcharged_clear",
            "overcharged",
            "plausible_max",
        )
        for lower, upper in pairwise(order):
            if not getattr(self, lower) < getattr(self, upper):
                raise ValueError(f"expected {lower} {getattr(self, lower)} < {upper} {getattr(self, upper)}")
        return self


class IioConfig(PackConfig):
    """Pack voltage measured through a divider on a channel of a Linux Industrial-IO converter."""

    kind: Literal["iio"] = "iio"
    device: str = ""
    """Name of the converter (contents of its file ``name``), such as ads1015; empty selects the only converter"""
    channel: Annotated[int, Field(ge=0, le=63)] = 0
    """Channel number N of in_voltageN_raw"""
    divider: Annotated[float, Field(gt=0)] = 10.0
    """Pack volts per volt at the pin; calibrate with a multimeter"""
    offset: float = 0.0
    """Offset added to the pack voltage (V)"""
    full_scale: Annotated[int, Field(gt=0)] | None = None
    """Maximum reading of the converter; None: from its scan element, or unknown"""
    rate: Annotated[float, Field(gt=0, le=50)] = 10.0
    """Readings per second"""
