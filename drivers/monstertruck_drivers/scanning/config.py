"""Settings that all scanners with a turning head share."""

from typing import Annotated, Any, Final, Literal

from pydantic import Field

from monstertruck_schemas.base import FrameId, Schema

UNSTATED: Final = 4.0
"""Sight of a scanner whose settings do not state one, m: that of a URG-04LX."""


def sight(settings: Any) -> float:
    """Return the distance at which a scanner is sure to see any obstacle, m, by the data sheet of its model."""
    stated: float = getattr(settings, "sight", UNSTATED)
    return stated


class ReturnsConfig(Schema):
    """A scanner that reports a covered window and open ground alike."""

    no_return: Literal["unknown", "free"] = "unknown"
    """What a beam without a return says: nothing, or that the way is free as far as the scanner reaches. The scanner
    reports a covered window and open ground alike"""


class TurningHeadConfig(ReturnsConfig):
    """A scanner that streams its beams while its head turns."""

    frame: FrameId = "lidar"
    """Frame of the published scans."""
    silence: Annotated[float, Field(gt=0, le=10)] = 0.5
    """Seconds without a byte that end the session"""
    first_scan: Annotated[float, Field(gt=0, le=60)] = 6.0
    """Seconds allowed for the first revolution; the motor may have to start"""
    stale: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Seconds without a whole revolution, later on, that end the session"""
