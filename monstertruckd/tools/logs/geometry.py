"""Geometry of the robot that recorded a log."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import first_mistake
from monstertruckd.config.truck import Geometry


def recorded_geometry(log: Path, config: Mapping[str, Any]) -> Geometry:
    """Return the geometry from the configuration attached to a log, or the default if it has none.

    Args:
        log: path of the log, for error messages.
        config: attached configuration as plain values.

    Raises:
        InputError: the geometry is invalid in this version.
    """
    try:
        return Geometry.model_validate(config.get("geometry", {}), strict=False)
    except ValidationError as error:
        raise InputError(f"{log}: config.json: {first_mistake(error, 'geometry')}") from error
