"""Settings shared by scanners."""

from typing import Annotated, Any, Literal

from pydantic import Field

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_schemas.base import FrameId, Schema
from monstertruck_schemas.body import HalfTurn


def sheet(settings: Any) -> RangeSheet:
    """Return a scanner's range limits: the attribute ``sheet`` of its settings."""
    # Default for scanners whose settings have none: the URG-04LX.
    stated: RangeSheet = getattr(settings, "sheet", RangeSheet(0.02, 4.0, 0.01, 0.01))
    return stated


class ScannerConfig(Schema):
    """Settings shared by all scanners."""

    frame: FrameId | None = None
    """Frame of the published scans; null: the name of the role"""
    hidden: Annotated[tuple[tuple[HalfTurn, HalfTurn], ...], Field(strict=False)] = ()
    """Sectors hidden by parts of the robot, such as a mast: first and last bearing counter-clockwise in the published
    scans (rad); they are outside the field of view"""


class ReturnsConfig(ScannerConfig):
    """Settings for a scanner that cannot tell a covered window from open ground."""

    no_return: Literal["unknown", "free"] = "unknown"
    """Meaning of a beam without a return: unknown, or free up to the scanner's maximum range. The scanner cannot tell a
    covered window from open ground"""


class TurningHeadConfig(ReturnsConfig):
    """Settings for a scanner that streams its beams while its head turns."""

    silence: Annotated[float, Field(gt=0, le=10)] = 0.5
    """Maximum time without a byte before the session ends (s)"""
    first_scan: Annotated[float, Field(gt=0, le=60)] = 6.0
    """Maximum time for the first revolution, including the motor's start (s)"""
    stale: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Maximum time without a complete later revolution before the session ends (s)"""
