"""JSON-compatible values."""

import math
from collections.abc import Mapping
from enum import Enum
from pathlib import PurePath
from typing import Any

from pydantic import BaseModel


def plain(value: Any) -> Any:
    """Return a JSON-compatible copy: models and enums become plain, non-finite numbers become None.

    Args:
        value: value of mappings, sequences, models and scalars.
    """
    match value:
        case BaseModel():
            return plain(value.model_dump(mode="json"))
        case Enum():
            return value.value
        case PurePath():
            return str(value)
        case float():
            return value if math.isfinite(value) else None
        case Mapping():
            return {str(key): plain(inner) for key, inner in value.items()}
        case list() | tuple() | set() | frozenset():
            return [plain(inner) for inner in value]
        case _:
            return value
