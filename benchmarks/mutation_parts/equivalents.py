"""Mutants that behave as the sound source does, so that no test can find them, each with its reason."""

from typing import Final

EQUIVALENTS: Final[dict[str, str]] = {}
"""By ``Mutant.key``."""
