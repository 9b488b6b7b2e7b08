"""Configuration of the link monitor."""

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Schema

Dbm = Annotated[float, Field(ge=-120, le=0)]


class LinkQualityConfig(Schema):
    """Monitored interface and its signal limits (rules of thumb)."""

    kind: Literal["link_quality"] = "link_quality"
    interface: Annotated[str, Field(pattern=r"^[^/\s]{1,15}$")] | None = None
    """Name of the interface; None selects the connected Wi-Fi interface, or else the connected wired one"""
    rate: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Checks per second"""
    smoothing: Annotated[float, Field(ge=0, le=60)] = 4.0
    """Time constant of the signal's mean (s)"""
    excellent: Dbm = -50.0
    """Minimum excellent signal (dBm)"""
    good: Dbm = -67.0
    """Minimum good signal (dBm)."""
    fair: Dbm = -75.0
    """Minimum fair signal (dBm)."""
    poor: Dbm = -85.0
    """Minimum poor signal (dBm); below it the link is unusable"""
    hysteresis: Annotated[float, Field(ge=0, le=20)] = 3.0
    """Margin above a better level's limit that the signal needs to reach that level again (dB)"""

    @model_validator(mode="after")
    def _limits_in_order(self) -> Self:
        for lower, upper in pairwise(("poor", "fair", "good", "excellent")):
            if not getattr(self, lower) < getattr(self, upper):
                raise ValueError(f"expected {lower} {getattr(self, lower)} < {upper} {getattr(self, upper)}")
        return self
