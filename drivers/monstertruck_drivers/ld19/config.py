"""Settings for the LD19 and related models."""

from typing import Literal

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_drivers.ld19.protocol import MODELS
from monstertruck_drivers.scanning.config import TurningHeadConfig


class Ld19Config(TurningHeadConfig):
    """LDROBOT LD06, LD19 or STL-19P: the unit streams from power-up and accepts no settings over its cable."""

    kind: Literal["ld19"] = "ld19"
    model: Literal["ld06", "ld19", "stl19p"] = "ld19"
    """Model: all send the same packets, but differ in range and accuracy"""

    @property
    def sheet(self) -> RangeSheet:
        """See ``scanning.config.sheet``."""
        return MODELS[self.model].ranges
