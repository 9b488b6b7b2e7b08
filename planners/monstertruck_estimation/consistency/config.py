"""Settings of the consistency check; light, for the daemon's start."""

from typing import Annotated, Final, Literal

from pydantic import Field

from monstertruck_schemas.base import Positive, Schema

Share = Annotated[float, Field(ge=0, lt=1)]
SCAN_LIBRARIES: Final = ("numba", "scipy")
"""Packages that scan odometry requires."""
MAX_SPEED: Final = 5.0
"""A drive position that would need a higher speed (m/s) is a new origin, not a motion."""


class ConsistencyConfig(Schema):
    """Comparison of the robot's independent measures of motion."""

    scans: Literal["kiss", "own"] | None = "kiss"
    """Scan odometry: kiss-icp (`own` if it is not installed), or this repository's own, with three quarters of its
    processor time; null to measure no motion by scans"""
    slip: Share = 0.3
    """Tolerated slip: missing motion of the robot, as a share of the wheels' distance or turn"""
    slide: Share = 0.2
    """Tolerated shortfall of the wheels, as a share of the robot's distance: they slide, or are larger than
    configured"""
    delay: Positive = 0.2
    """Tolerated delay of one sensor's content against the others (s)"""
    drift: Annotated[float, Field(ge=0, le=0.1)] = 0.012
    """Tolerated lasting error of the speed by scans (m/s, rad/s) where they show that a body stands: the lowest speed
    of a docking"""
    window: Annotated[float, Field(ge=1, le=8)] = 5.0
    """Maximum time window for comparing motions (s)"""
    latency: Annotated[float, Field(gt=0, le=1)] = 0.02
    """Latency of a worker step on the virtual clock (s)"""
    deadline: Annotated[float, Field(gt=0, le=60)] = 5.0
    """Maximum silence of the worker before it is killed (s)"""
