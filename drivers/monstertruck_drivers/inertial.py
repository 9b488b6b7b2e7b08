"""Correction shared by the IMU drivers: removes biases and scale errors."""

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Schema
from monstertruck_schemas.sensor import Vector3

Xyz = tuple[float, float, float]


class ImuCorrection(Schema):
    """Calibrated correction of the measurements, in the unit's axes."""

    rate_x: float = 0.0
    """Bias of the angular velocity (rad/s)"""
    rate_y: float = 0.0
    """Bias about y (rad/s)"""
    rate_z: float = 0.0
    """Bias about z (rad/s)"""
    rate_scale: Annotated[float, Field(ge=0.5, le=2)] = 1.0
    """Factor on the angular velocity about z, after its bias is subtracted"""
    force_x: float = 0.0
    """Bias of the specific force (m/s^2)"""
    force_y: float = 0.0
    """Bias along y (m/s^2)"""


def mean(vectors: Sequence[Xyz]) -> Xyz:
    """Return the component-wise mean of vectors."""
    x, y, z = (sum(axis) / len(vectors) for axis in zip(*vectors, strict=True))
    return x, y, z


def corrected_rate(rate: Xyz, by: ImuCorrection) -> Vector3:
    """Angular velocity corrected for bias (rad/s)."""
    x, y, z = rate
    return Vector3(x=x - by.rate_x, y=y - by.rate_y, z=(z - by.rate_z) * by.rate_scale)


def corrected_force(force: Xyz, by: ImuCorrection) -> Vector3:
    """Specific force corrected for bias (m/s^2)."""
    x, y, z = force
    return Vector3(x=x - by.force_x, y=y - by.force_y, z=z)
