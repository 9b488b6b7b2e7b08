"""Settings of the zones; light, for the daemon's start."""

from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field, field_validator

from monstertruck_schemas.base import Name, NotNegative, Schema
from monstertruck_schemas.zones import ZoneArea

KEEPOUT_MASK: Final = "keepout_mask"
SPEED_MASK: Final = "speed_mask"
"""Zone names of the two masks."""


class KeepoutMaskConfig(Schema):
    """Keepout zones as a mask image."""

    map: Path
    """map_server YAML file; cells of value 100 are keepout"""
    inside: Literal["stop", "leave"] = "stop"
    """Reaction of a robot inside a zone: stop and report, or leave slowly"""


class SpeedMaskConfig(Schema):
    """Speed zones as a mask image, with the parameters of Nav2's CostmapFilterInfo.

    The limit of a cell is ``base + multiplier * value``. Cells of value 0, unknown cells and limits of 0 or less impose
    no limit.
    """

    map: Path
    """map_server YAML file"""
    type: Literal["percent", "absolute"] = "percent"
    """Unit of the limit: percent of `gate.speed` (type 1 of Nav2; none above 100), or m/s (type 2)"""
    base: float = 0.0
    """Constant term of the limit."""
    multiplier: float = 1.0
    """Factor on the value of a cell."""


class ZonesConfig(Schema):
    """Keepout and speed zones of the map; operators add more by command and on the page."""

    areas: dict[Name, ZoneArea] = Field(default_factory=dict)
    """Polygons by name"""
    file: Path | None = None
    """YAML file with more polygons under the key `zones`, in the format of `areas`"""
    keepout_mask: KeepoutMaskConfig | None = None
    """Mask image of keepout zones, e.g. one made for Nav2"""
    speed_mask: SpeedMaskConfig | None = None
    """Mask image of speed zones"""
    margin: NotNegative = 0.05
    """Clearance from zones for pose errors (m)"""
    leave_speed: Annotated[float, Field(ge=0.02, le=1)] = 0.1
    """Maximum speed of a robot that leaves a keepout zone (m/s)"""

    @field_validator("areas")
    @classmethod
    def _named(cls, areas: dict[str, ZoneArea]) -> dict[str, ZoneArea]:
        return require_free_names(areas)


def require_free_names(areas: dict[str, ZoneArea]) -> dict[str, ZoneArea]:
    """Return the areas.

    Raises:
        ValueError: an area has the name of a mask.
    """
    if taken := areas.keys() & {KEEPOUT_MASK, SPEED_MASK}:
        raise ValueError(f"{min(taken)}: expected another name, because a mask has this one")
    return areas
