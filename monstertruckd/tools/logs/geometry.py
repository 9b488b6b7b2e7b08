"""Size of the robot whose log it is."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from monstertruck_runtime.errors import InputError
from monstertruckd.config.truck import Geometry


def recorded_geometry(log: Path, config: Mapping[str, Any]) -> Geometry:
    """Geometry by the configuration attached to a log; the default one where it says none.

    Args:
        log: named in complaints.
        config: plain values.

    Raises:
        InputError: this version does not take it.
    """
    try:
        return Geometry.model_validate(config.get("geometry", {}), strict=False)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        where = ".".join(("geometry", *map(str, detail["loc"])))
        text = detail["msg"].removeprefix("Value error, ")
        raise InputError(f"{log}: config.json: {where}: {text}") from error
