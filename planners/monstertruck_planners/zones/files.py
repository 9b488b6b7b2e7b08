"""Zone files: polygons, mask images, and zones made by operators."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from pydantic import Field, field_validator

from monstertruck_planners.zones.config import (
    KEEPOUT_MASK,
    SPEED_MASK,
    SpeedMaskConfig,
    ZonesConfig,
    require_free_names,
)
from monstertruck_planners.zones.shapes import mask_of
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import contents_if_present, reading
from monstertruck_runtime.small_files import replace_file
from monstertruck_runtime.yaml_files import read_yaml
from monstertruck_schemas.base import Name, Schema
from monstertruck_schemas.zones import Zone, ZoneArea

if TYPE_CHECKING:
    from monstertruck_runtime.map_files import WorldMap

_EXPECTED: Final = "zones"
LARGEST_ZONE_FILE: Final = 2_000_000
"""Maximum size of the file of the operators' zones (bytes)."""


class ZoneFile(Schema):
    """Content of a polygon file."""

    zones: dict[Name, ZoneArea] = Field(default_factory=dict)
    """Polygons by name."""

    @field_validator("zones")
    @classmethod
    def _named(cls, areas: dict[str, ZoneArea]) -> dict[str, ZoneArea]:
        return require_free_names(areas)


def zone_of(name: str, area: ZoneArea, *, saved: bool) -> Zone:
    """Return the zone of a polygon; ``saved`` marks a zone made by an operator."""
    return Zone(name=name, kind=area.kind, corners=area.corners, limit=area.limit, inside=area.inside, saved=saved)


def configured(config: ZonesConfig, max_speed: float) -> tuple[list[Zone], list[str]]:
    """Return the zones of a configuration, and remarks on its mask images.

    Args:
        config: configuration of the zones.
        max_speed: reference of the percentages in a speed mask (m/s).

    Raises:
        InputError: a file is invalid; the error names file, key and expected value.
    """
    zones = [zone_of(name, area, saved=False) for name, area in config.areas.items()]
    if config.file is not None:
        with reading(config.file, _EXPECTED):
            more = ZoneFile.model_validate_json(json.dumps(read_yaml(config.file)))
        if twice := more.zones.keys() & config.areas.keys():
            raise InputError(f"{config.file}: zones.{min(twice)}: the configuration has a zone of this name")
        zones += [zone_of(name, area, saved=False) for name, area in more.zones.items()]
    masks, remarks = _masks(config, max_speed)
    return zones + masks, remarks


def _masks(config: ZonesConfig, max_speed: float) -> tuple[list[Zone], list[str]]:
    """Return the zones of the mask images, and remarks on them; arguments as for ``configured``."""
    zones: list[Zone] = []
    remarks: list[str] = []
    if config.keepout_mask is None and config.speed_mask is None:
        return zones, remarks
    from monstertruck_runtime.map_files import OCCUPIED, load_map  # noqa: PLC0415  # loads the library of pictures

    if (keepout := config.keepout_mask) is not None:
        world = load_map(keepout.map)
        partly = np.count_nonzero((world.cells > 0) & (world.cells < OCCUPIED))
        if partly:
            remarks.append(
                f"{keepout.map}: {partly} cells of values 1 to 99, which Nav2 treats as costs: they are free here"
            )
        limits = np.where(world.cells == OCCUPIED, 0.0, np.inf)
        zones += _masked(KEEPOUT_MASK, limits, world, keepout.inside, keepout.map)
    if (speed := config.speed_mask) is not None:
        world = load_map(speed.map)
        zones += _masked(SPEED_MASK, speed_limits(world, speed, max_speed), world, "stop", speed.map)
    return zones, remarks


def speed_limits(world: "WorldMap", config: SpeedMaskConfig, max_speed: float) -> np.ndarray:
    """Return the speed limit of each cell of a mask, as Nav2's speed filter reads it (m/s); +inf without a limit.

    Args:
        world: mask.
        config: conversion of values to limits.
        max_speed: speed at 100 percent (m/s).
    """
    limits = config.base + config.multiplier * world.cells.astype(np.float64)
    none = (world.cells <= 0) | (limits <= 0.0)
    if config.type == "percent":
        none |= limits > 100.0
        limits = limits / 100.0 * max_speed
    return np.where(none, np.inf, limits)


def _masked(name: str, limits: np.ndarray, world: "WorldMap", inside: str, file: Path) -> list[Zone]:
    mask = mask_of(limits, world.resolution, world.origin)
    if mask is None:
        raise InputError(f"{file}: contains no zone cells: check image, mode and thresholds")
    kind = "keepout" if name == KEEPOUT_MASK else "speed"
    return [Zone.model_validate({"name": name, "kind": kind, "mask": mask, "inside": inside})]


def load_saved(file: Path) -> dict[str, ZoneArea]:
    """Load the zones made by operators, by name; empty without a file.

    Raises:
        InputError: the file is damaged.
    """
    data = contents_if_present(file, _EXPECTED, LARGEST_ZONE_FILE)
    if data is None:
        return {}
    with reading(file, _EXPECTED):
        return ZoneFile.model_validate_json(data).zones


def save(file: Path, areas: dict[str, ZoneArea]) -> None:
    """Save the zones made by operators.

    Raises:
        OSError: the file could not be written and is unchanged.
    """
    replace_file(file, ZoneFile(zones=areas).model_dump_json(indent=1, exclude_none=True))
