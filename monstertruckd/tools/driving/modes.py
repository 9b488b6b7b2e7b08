"""Choices of ``drive`` on the command line, light enough for ``--help``."""

from enum import StrEnum
from typing import Final

SPEEDS: Final = (0.05, 0.1, 0.15, 0.2, 0.3, 0.5)
"""Selectable speeds (m/s)."""


class SteeringMode(StrEnum):
    """Meaning of the driving keys: the angles of two axles, or the twist of the base."""

    FRONT = "front"
    REAR = "rear"
    COUNTER = "counter"
    CRAB = "crab"
    HYBRID = "hybrid"
    TWIST = "twist"
