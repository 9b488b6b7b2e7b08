"""Files that are installed with the modules: configurations, and what the service needs."""

from pathlib import Path
from typing import Final

_PACKAGE: Final = Path(__file__).resolve().parents[1]
PLACES: Final = (_PACKAGE, _PACKAGE.parent)
"""Folders of an installed wheel, and of a checkout."""


def shipped(name: str) -> Path:
    """Where a file is, e.g. ``configs/demo.yaml``; below the last place if it is in none."""
    return next((place / name for place in PLACES if (place / name).is_file()), PLACES[-1] / name)
