"""What a calibration leaves behind: values with their uncertainty, and the file that keeps them."""

from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Schema

CONFIDENCE: Final = 0.95
"""Of every interval: of a hundred trucks measured like this, so many have their true value inside."""

Value = bool | int | float
WizardName = Literal["battery", "compass", "drive", "steering"]

STEERING: Final = "devices.steering.driver"
COMPASS: Final = "devices.compass.driver.iron"

KEYS: Final[dict[WizardName, tuple[str, ...]]] = {
    "battery": (
        f"{STEERING}.battery.gain",
        f"{STEERING}.battery.offset",
        "monitors.battery.divider",
        "monitors.battery.offset",
    ),
    "compass": tuple(f"{COMPASS}.{name}" for name in ("hard_x", "hard_y", "soft_xx", "soft_xy", "soft_yy")),
    "drive": ("geometry.drive_ratio", "devices.drive.driver.inverted"),
    "steering": tuple(
        f"{STEERING}.{axle}.{name}"
        for axle in ("front", "rear")
        for name in ("centre_us", "scale_us_per_deg", "direction", "min_us", "max_us")
    ),
}
"""Values of the configuration that each wizard may set; a calibration never touches any other."""


class Estimate(Schema):
    """One measured value."""

    name: str
    value: Value
    unit: str = ""
    low: float | None = None
    """Lower end of the interval; None: the value is a choice (a sign), not a number"""
    high: float | None = None
    samples: Annotated[int, Field(ge=1)]
    """Measurements it rests on"""
    meaning: str
    """What the value is, and what its interval covers"""
    key: str | None = None
    """Place in the configuration that it sets; None: for information only"""
    date: str = ""
    """When it was measured, UTC by the robot's clock; set when it is saved"""


class Result(Schema):
    """What one run of a wizard measured."""

    wizard: WizardName
    date: str = ""
    """Of the newest estimate; set when it is saved"""
    measured: str
    """What was done, in a sentence"""
    confidence: float = CONFIDENCE
    """Of the intervals"""
    estimates: Annotated[tuple[Estimate, ...], Field(min_length=1)]
    unobserved: tuple[str, ...] = ()
    """What this measurement cannot tell"""
    readings: tuple[tuple[float, ...], ...] = ()
    """Raw readings that a later run may use again; their meaning is the wizard's"""
    partial: bool = False
    """Only these were measured: what the run before found beside them stays"""
    again: str | None = None
    """What has to be done before the calibration is complete"""

    def over(self, before: "Result | None", date: str) -> "Result":
        """This result as it is saved on ``date``, with what it keeps of the one ``before``."""
        fresh = tuple(e if e.date else e.model_copy(update={"date": date}) for e in self.estimates)
        names = {estimate.name for estimate in fresh}
        old = before.estimates if self.partial and before is not None else ()
        kept = tuple(estimate for estimate in old if estimate.name not in names)
        return self.model_copy(update={"date": date, "estimates": fresh + kept})

    def estimate(self, name: str) -> Estimate | None:
        """The estimate of that name."""
        return next((estimate for estimate in self.estimates if estimate.name == name), None)


class CalibrationFile(Schema):
    """Everything known of one truck; replaced as a whole, never changed."""

    version: Literal[1] = 1
    number: Annotated[int, Field(ge=1)]
    """Counts the files of this truck"""
    robot: str
    written: str
    """UTC, by the robot's clock"""
    change: str
    """What it differs in from the one before"""
    results: dict[WizardName, Result]


def utc(real_ns: int) -> str:
    """A real (UNIX) time, ns, as ``YYYY-MM-DDThh:mm:ssZ``."""
    return f"{np.datetime64(real_ns // SECOND, 's')}Z"
