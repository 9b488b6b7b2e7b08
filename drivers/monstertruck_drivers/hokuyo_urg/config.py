"""Settings for Hokuyo scanners."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_drivers.hokuyo_urg.models import LX, URG_04LX
from monstertruck_drivers.scanning.config import ReturnsConfig, ScannerConfig


class ScipConfig(ScannerConfig):
    """Settings for a SCIP scanner; the driver always reads the scan geometry from the sensor."""

    SERIES: ClassVar[tuple[str, ...]]
    """Supported series: the product or model name must contain one of these names."""

    serial_number: str | None = None
    """Serial number expected on this port (``SERI`` of VV); None: any."""
    scan_format: Literal["MD", "MS"] = "MD"
    """MD: three characters per range; MS: two, at most 4095 mm, two thirds of the bytes."""
    cluster: Annotated[int, Field(ge=1, le=99)] = 1
    """Number of neighbouring steps merged into one range; over RS232 use 2 or more, because a full scan does not fit in
    100 ms.
    """
    skip: Annotated[int, Field(ge=0, le=9)] = 0
    """Number of revolutions skipped between two scans."""
    max_bad_scans: Annotated[int, Field(ge=0)] = 5
    """Maximum number of consecutive damaged scans before the session restarts."""
    stale_periods: Annotated[float, Field(gt=1)] = 5.0
    """Number of scan intervals without a valid scan before the session restarts."""
    first_scan_periods: Annotated[float, Field(gt=1)] = 16.0
    """Number of scan intervals allowed for the first scan after starting."""
    line_timeout: Annotated[float, Field(gt=0)] = 0.14
    """Maximum silence within the answer to a command (s)."""
    verify_timeout: Annotated[float, Field(gt=0)] = 10.0
    """Time limit for the sensor to verify a suspected internal fault (s, statuses 21-49)."""
    clock_samples: Annotated[int, Field(ge=1, le=100)] = 12
    """Number of exchanges of the start-up clock comparison; the fastest one is used."""

    @property
    def sheet(self) -> RangeSheet:
        """See ``scanning.config.sheet``."""
        return URG_04LX.ranges


class HokuyoConfig(ScipConfig):
    """URG-04LX."""

    SERIES = ("URG",)

    kind: Literal["hokuyo_urg"] = "hokuyo_urg"


class HokuyoLxConfig(ScipConfig, ReturnsConfig):
    """UST-10LX, UST-20LX or UTM-30LX."""

    SERIES = ("UST", "UTM")

    kind: Literal["hokuyo_lx"] = "hokuyo_lx"
    model: Literal["ust_10lx", "ust_20lx", "utm_30lx"] = "ust_10lx"
    """Emulated model, and the range on which the gate relies; the driver reads the geometry from the sensor"""
    stale_periods: Annotated[float, Field(gt=1)] = 20.0
    """Number of scan intervals (25 ms) without a valid scan before the session restarts."""
    first_scan_periods: Annotated[float, Field(gt=1)] = 60.0
    """Number of scan intervals allowed for the first scan after starting."""

    @property
    def sheet(self) -> RangeSheet:
        """See ``scanning.config.sheet``."""
        return LX[self.model].ranges
