"""Zones of the map: keepout zones and speed zones."""

from enum import StrEnum
from itertools import pairwise
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Message, Name, Nanoseconds, Positive, Schema
from monstertruck_schemas.req import Request

Coordinate = Annotated[float, Field(ge=-10_000, le=10_000)]
Corner = Annotated[tuple[Coordinate, ...], Field(strict=False, min_length=2, max_length=2)]
"""x and y (m). Of any length to the type checker, because log viewers read no JSON schema of a pair."""
Corners = Annotated[tuple[Corner, ...], Field(strict=False, max_length=200)]
Whole = Annotated[int, Field(ge=0, lt=2**31)]

LONGEST_OFF: Final = 86_400.0
"""Maximum off time of a zone (s)."""
OFF_FOR: Final = 600.0
"""Default off time of a zone (s)."""


class ZoneArea(Schema):
    """A polygon in map with its rule; points are inside by the even-odd rule."""

    kind: Literal["keepout", "speed"]
    """Rule: no entry, or a speed limit."""
    corners: Annotated[Corners, Field(min_length=3)]
    """Corners of the polygon (m)."""
    limit: Positive | None = None
    """Maximum speed on a speed zone (m/s)."""
    inside: Literal["stop", "leave"] = "stop"
    """Reaction of a robot inside a keepout zone: stand and report, or leave slowly by the shortest way.
    A stop is right if the zone stands for stairs that no sensor sees."""

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if (self.kind == "speed") is not (self.limit is not None):
            raise ValueError("limit: expected for a speed zone (m/s), and for no other kind")
        if self.kind == "speed" and self.inside != "stop":
            raise ValueError("inside: expected for keepout zones only")
        closed = (*self.corners, self.corners[0])
        twice = sum(a[0] * b[1] - b[0] * a[1] for a, b in pairwise(closed))
        if abs(twice) < 2e-4:
            raise ValueError("corners: expected a polygon of at least 1 cm^2")
        return self


class ZoneMask(Schema):
    """A grid of speed limits, aligned with map; row 0 is the lowest y."""

    resolution: Positive
    """Side of a cell (m)."""
    width: Annotated[int, Field(gt=0, lt=2**31)]
    """Number of columns."""
    height: Annotated[int, Field(gt=0, lt=2**31)]
    """Number of rows."""
    x: float
    """Outer corner of cell (0, 0) (m)."""
    y: float
    """Outer corner of cell (0, 0) (m)."""
    limits: Annotated[tuple[float, ...], Field(strict=False)]
    """Maximum speed by level - 1 (m/s); 0 = keepout. Cells of level 0 have no limit."""
    runs: Annotated[tuple[Whole, ...], Field(strict=False)]
    """Level and number of the cells of each run, row by row."""


class Zone(Schema):
    """An active zone: a polygon or a mask."""

    name: Name
    """Name of the zone."""
    kind: Literal["keepout", "speed"]
    """Rule: no entry, or a speed limit."""
    corners: Corners = ()
    """Corners of the polygon (m); empty for a mask."""
    mask: ZoneMask | None = None
    limit: float | None = None
    """Maximum speed on a speed zone (m/s); None for keepout zones and masks."""
    inside: Literal["stop", "leave"] = "stop"
    """See ``ZoneArea.inside``."""
    saved: bool = False
    """Whether an operator made it, and may remove it; otherwise the configuration has it."""
    off_until: Nanoseconds | None = None
    """End of the time that an operator turned it off for; None while it is in force."""


class Zones(Message):
    """All zones, and those that contain the robot."""

    zones: tuple[Zone, ...] = ()
    inside: tuple[str, ...] = ()
    """Names of the zones that the footprint reaches into, those that are off included; in the order of ``zones``."""


class ZoneOrder(StrEnum):
    """Operator's orders for zones."""

    ADD = "add"
    """Add a polygon, or replace one that an operator made."""
    REMOVE = "remove"
    OFF = "off"
    ON = "on"


class ZoneRequest(Request):
    """Add or remove a zone, or turn one off for a while."""

    order: ZoneOrder
    name: Name
    area: ZoneArea | None = None
    """Polygon of a new zone."""
    seconds: Annotated[float, Field(gt=0, le=LONGEST_OFF)] = OFF_FOR
    """How long a zone is off (s)."""
