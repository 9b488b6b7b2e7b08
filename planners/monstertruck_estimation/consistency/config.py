"""Settings of the consistency check; light, for the daemon's start."""

from typing import Annotated, Final, Literal

from pydantic import Field

from monstertruck_schemas.base import Positive, Schema

Share = Annotated[float, Field(ge=0, lt=1)]
SCAN_LIBRARIES: Final = ("numba", "scipy")
"""Packages without which the motion by scans is not measured."""
MAX_SPEED: Final = 5.0
"""A drive position that would need more than this, m/s, is a new origin, not a motion."""


class ConsistencyConfig(Schema):
    """Comparison of the robot's independent measures of motion."""

    scans: Literal["kiss", "own"] | None = "kiss"
    """Scan odometry: kiss-icp (`own` where it is not installed), or this repository's own, with three quarters of its
    processor time; null = the motion by scans is not measured"""
    slip: Share = 0.3
    """Tolerated slip: share of the wheels' distance or turn by which the robot moves less"""
    slide: Share = 0.2
    """Tolerated share of the robot's distance by which the wheels show less: they slide, or are greater than
    configured"""
    delay: Positive = 0.2
    """Tolerated delay of one sensor's content against another's, s"""
    window: Annotated[float, Field(ge=1, le=8)] = 5.0
    """Longest time over which motions are compared, s"""
    latency: Annotated[float, Field(gt=0, le=1)] = 0.02
    """Seconds after which a step of the worker counts on the virtual clock"""
    deadline: Annotated[float, Field(gt=0, le=60)] = 5.0
    """Seconds after which a silent worker is killed"""
