"""Configuration of the host monitor."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Schema

Celsius = Annotated[float, Field(ge=-40, le=150)]
Share = Annotated[float, Field(ge=0, le=1)]
Seconds = Annotated[float, Field(ge=0, le=3600)]
Bytes = Annotated[int, Field(ge=0)]


class HostHealthConfig(Schema):
    """Limits of the computer's load and resources; each ``..._clear`` value ends the shortage."""

    kind: Literal["host_health"] = "host_health"
    rate: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Checks per second"""
    after: Seconds = 3.0
    """Time beyond a limit before it is reported (s)"""
    hot: Celsius = 80.0
    """Temperature limit of the hottest thermal zone (degrees Celsius)"""
    hot_clear: Celsius = 75.0
    """Temperature below which the overheating ends (degrees Celsius)."""
    busy: Share = 0.95
    """Limit of the busy fraction of all cores"""
    busy_clear: Share = 0.85
    """Busy fraction below which the overload ends."""
    busy_after: Seconds = 10.0
    """Time above ``busy`` before it is reported (s): planning may use the whole processor for a while"""
    slow: Share = 0.8
    """Limit for the allowed clock, as a fraction of the maximum clock; lower it where a cap is intended"""
    memory: Share = 0.1
    """Minimum available fraction of the memory"""
    memory_clear: Share = 0.15
    """Available fraction above which the shortage of memory ends."""
    disk: Bytes = 1_000_000_000
    """Minimum free space of the file system that holds ``disk_path`` (bytes)"""
    disk_clear: Bytes = 1_500_000_000
    """Free space above which the shortage of disk space ends (bytes)."""
    disk_path: Path = Path("runs")
    """Log folder; it need not exist yet"""

    @model_validator(mode="after")
    def _clear_of_the_limits(self) -> Self:
        pairs = (("hot_clear", "hot"), ("busy_clear", "busy"), ("memory", "memory_clear"), ("disk", "disk_clear"))
        for lower, upper in pairs:
            if not getattr(self, lower) < getattr(self, upper):
                raise ValueError(f"expected {lower} {getattr(self, lower)} < {upper} {getattr(self, upper)}")
        return self
