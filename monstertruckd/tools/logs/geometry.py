"""Size of the robot whose log it is."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import first_mistake
from monstertruckd.config.truck import Geometry


def recorded_geometry(log: Path, config: Mapping[str, Any]) -> Geometry:
    """Geometry by the configuration attached to a log; the default where it is missing there.

    Args:
        log: named in complaints.
        config: plain values.

    Raises:
        InputError: this version does not take it.
    """
    try:
        return Geometry.model_validate(config.get("geometry", {}), strict=False)
    except ValidationError as error:
        raise InputError(f"{log}: config.json: {first_mistake(error, 'geometry')}") from error
