"""Settings for RPLIDARs."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_drivers.rplidar.protocol import MODELS
from monstertruck_drivers.scanning.config import TurningHeadConfig


class RplidarConfig(TurningHeadConfig):
    """SLAMTEC RPLIDAR; the unit itself reports its model and scan modes."""

    kind: Literal["rplidar"] = "rplidar"
    model: Literal["a1", "a2", "a3", "c1", "s1", "s2"] = "a1"
    """Expected model; determines the baud rate and the emulator"""
    serial_number: str | None = None
    """Serial number expected on this port (32 hexadecimal digits); null accepts any"""
    scan_mode: str = "typical"
    """Name of a scan mode of the unit (Standard, Express, Boost, Sensitivity, DenseBoost), or typical: the mode that
    the unit recommends
    """
    motor_pwm: Annotated[int, Field(ge=0, le=1023)] = 660
    """Motor duty cycle of an A2 or A3 on its adapter board (of 1023); 660 is the manufacturer's default"""
    answer_timeout: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Timeout of an answer (s)"""
    boot: Annotated[float, Field(gt=0, le=10)] = 2.0
    """Maximum time from a reset to the first answer (s)"""

    @property
    def own_baud(self) -> int:
        """Baud rate of the model's serial line (bit/s)."""
        return MODELS[self.model].baud

    @property
    def sheet(self) -> RangeSheet:
        """See ``scanning.config.sheet``."""
        return MODELS[self.model].ranges
