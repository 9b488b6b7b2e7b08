"""Settings of mapping and localisation; light, for the daemon's start."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, create_model

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_schemas.base import Schema

Positive = Annotated[float, Field(gt=0)]
Probability = Annotated[float, Field(gt=0, lt=1)]


def _settings_of(model: type[Any]) -> type[Schema]:
    """A configuration section with the fields of a dataclass; every number in it is positive."""
    kinds = {float: Positive, int: Annotated[int, Field(gt=0)], tuple[float, float]: tuple[Positive, Positive]}
    fields: dict[str, Any] = {field.name: (kinds[field.type], field.default) for field in dataclasses.fields(model)}  # type: ignore[index]
    return create_model(
        "MapperSettings", __base__=Schema, __doc__="Noise models and limits; see MapperConfig.", **fields
    )


if TYPE_CHECKING:

    class MapperSettings(Schema):
        """The fields of ``MapperConfig``."""

else:
    MapperSettings = _settings_of(MapperConfig)


class GridConfig(Schema):
    """Occupancy grid: cells and sensor model."""

    resolution: Annotated[float, Field(ge=0.01, le=1)] = 0.05
    """Edge of a cell, m."""
    hit: Annotated[float, Field(gt=0.5, lt=1)] = 0.7
    """Probability that a cell in which a beam ends is occupied."""
    miss: Annotated[float, Field(gt=0, lt=0.5)] = 0.4
    """Probability that a cell a beam has passed is occupied."""
    limit: Annotated[float, Field(gt=0.5, lt=1)] = 0.98
    """No cell becomes surer than this, so that what moves away is forgotten."""
    spacing: Positive = 0.1
    """Scans join the grid after so much way, m,"""
    turn: Positive = 0.1
    """or turn, rad,"""
    pause: Positive = 1.0
    """or seconds."""
    remembered: Annotated[int, Field(ge=16)] = 6000
    """Scans kept to draw the grid anew after a loop closure; of more, every other old one is forgotten."""


class SlamConfig(Schema):
    """Simultaneous localisation and mapping, or localisation in a saved map."""

    mode: Literal["mapping", "localisation"] = "mapping"
    map: Path | None = None
    """Folder of the saved map; needed for localisation"""
    save: Path | None = None
    """Folder the map is saved to at the end and every ``save_period`` seconds; null = nowhere"""
    save_period: Positive = 60.0
    front: Literal["planar", "kiss"] = "planar"
    """Scan front end"""
    mapper: MapperSettings = MapperSettings()
    grid: GridConfig = GridConfig()
    max_tilt: Annotated[float, Field(gt=0, le=1.5)] = 0.1
    """Scans whose plane was tilted more than this are left out, rad"""
    ceiling: Positive | None = None
    """Height of the ceiling over the base, m, where there is one"""
    tiles_period: Positive = 1.0
    """Seconds between two messages of changed tiles"""
    map_period: Positive = 10.0
    """Seconds after which a changed map is published whole, at the latest"""
    slew: tuple[Positive, Positive] = (0.3, 0.5)
    """The pose in map follows corrections no faster than this, m/s and rad/s, so that trackers see no jump,"""
    jump: Positive = 1.0
    """unless they are greater than this, m: then at once"""
    latency: Annotated[float, Field(gt=0, le=1)] = 0.03
    """Seconds after which a step of the worker counts on the virtual clock"""
    deadline: Annotated[float, Field(gt=0, le=60)] = 20.0
    """Seconds after which a silent worker is killed"""
