"""Settings of the RPLIDARs."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_drivers.rplidar.protocol import MODELS
from monstertruck_drivers.scanning.config import TurningHeadConfig


class RplidarConfig(TurningHeadConfig):
    """SLAMTEC RPLIDAR; the unit itself reports its model and scan modes."""

    kind: Literal["rplidar"] = "rplidar"
    model: Literal["a1", "a2", "a3", "c1", "s1", "s2"] = "a1"
    """Model expected: its baud rate and its emulator"""
    serial_number: str | None = None
    """Unit expected on this port (32 hexadecimal digits); null accepts any"""
    scan_mode: str = "typical"
    """Name of a mode that the unit lists (Standard, Express, Boost, Sensitivity, DenseBoost), or typical: the one that
    its maker recommends"""
    motor_pwm: Annotated[int, Field(ge=0, le=1023)] = 660
    """Duty cycle of the motor of an A2 or A3 on its adapter board, of 1023; 660 is the maker's default"""
    answer_timeout: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Seconds for an answer"""
    boot: Annotated[float, Field(gt=0, le=10)] = 2.0
    """Seconds a unit needs after a reset until it answers"""

    @property
    def own_baud(self) -> int:
        """Bits per second of the model's serial line."""
        return MODELS[self.model].baud

    @property
    def sheet(self) -> RangeSheet:
        """See ``scanning.config.sheet``."""
        return MODELS[self.model].ranges
