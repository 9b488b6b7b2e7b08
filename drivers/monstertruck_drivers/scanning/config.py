"""Settings that all scanners with a turning head share."""

from typing import Annotated, Any, Literal

from pydantic import Field

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_schemas.base import FrameId, Schema


def sheet(settings: Any) -> RangeSheet:
    """Return a scanner's ranges by its data sheet: the attribute ``sheet`` of its settings."""
    # Ranges of a scanner whose settings state none, as for a URG-04LX.
    stated: RangeSheet = getattr(settings, "sheet", RangeSheet(0.02, 4.0, 0.01, 0.01))
    return stated


class ReturnsConfig(Schema):
    """Settings of a scanner that cannot tell a covered window from open ground."""

    no_return: Literal["unknown", "free"] = "unknown"
    """Meaning of a beam without a return: unknown, or free up to the scanner's range. The scanner cannot tell a
    covered window from open ground"""


class TurningHeadConfig(ReturnsConfig):
    """Settings of a scanner that streams its beams while its head turns."""

    frame: FrameId = "lidar"
    """Frame of the published scans."""
    silence: Annotated[float, Field(gt=0, le=10)] = 0.5
    """Maximum time without a byte before the session ends (s)"""
    first_scan: Annotated[float, Field(gt=0, le=60)] = 6.0
    """Maximum time for the first revolution, including the motor's start (s)"""
    stale: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Maximum time without a complete later revolution before the session ends (s)"""
