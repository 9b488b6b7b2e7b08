"""Settings of the LD19 and its relatives."""

from typing import Literal

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_drivers.ld19.protocol import MODELS
from monstertruck_drivers.scanning.config import TurningHeadConfig


class Ld19Config(TurningHeadConfig):
    """LDROBOT LD06, LD19 or STL-19P: streams from power-up on; nothing can be set over its cable."""

    kind: Literal["ld19"] = "ld19"
    model: Literal["ld06", "ld19", "stl19p"] = "ld19"
    """Which one it is: they send the same, but reach and measure differently"""

    @property
    def sheet(self) -> RangeSheet:
        """See ``scanning.config.sheet``."""
        return MODELS[self.model].ranges
