"""Scanner data sheets, used for replies to PP and by the emulators."""

from typing import Final, NamedTuple

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_drivers.hokuyo_urg.protocol import UNRETURNED


class ScannerModel(NamedTuple):
    """Data sheet of one scanner model."""

    product: str
    """``PROD`` of VV."""
    model: str
    """``MODL`` of PP."""
    protocol: str
    """``PROT`` of VV."""
    steps_per_turn: int
    first_step: int
    """First measuring step."""
    last_step: int
    """Last measuring step."""
    greatest_step: int
    """Maximum step of a request."""
    front_step: int
    least_mm: int
    greatest_mm: int
    rpm: int
    unreturned: int
    """Value of a beam without a return."""
    dazzled: int
    """Value of a beam with too strong a return."""
    failed: int
    """Value of a failed measurement."""
    ranges: RangeSheet
    """Range limits and errors."""

    @property
    def period(self) -> int:
        """Revolution period on the sensor's clock (ns)."""
        return 60_000_000_000 // self.rpm


URG_04LX: Final = ScannerModel(
    *("SOKUIKI Sensor URG-04LX", "URG-04LX(Hokuyo Automatic Co.,Ltd.)", "SCIP 2.0"),
    *(1024, 44, 725, 768, 384, 20, 5600, 600, 0, 18, 6),
    RangeSheet(0.02, 4.0, 0.01, 0.01),
)


def _lx(
    product: str, model: str, least_mm: int, greatest_mm: int, errors: tuple[int, int], sheet: RangeSheet
) -> ScannerModel:
    geometry = (1440, 0, 1080, 1080, 540)
    unreturned, failed = errors
    figures = (*geometry, least_mm, greatest_mm, 2400, unreturned, failed, failed)
    return ScannerModel(product, model, "SCIP 2.2", *figures, sheet)


LX: Final = {
    "ust_10lx": _lx(
        "UST-10LX", "UST-10LX", 20, 30000, (UNRETURNED, UNRETURNED), RangeSheet(0.06, 10.0, 0.04, 0.0, 4.0)
    ),
    "ust_20lx": _lx(
        "UST-20LX", "UST-20LX", 20, 60000, (UNRETURNED, UNRETURNED), RangeSheet(0.06, 20.0, 0.04, 0.0, 8.0)
    ),
    "utm_30lx": _lx(
        "SOKUIKI Sensor UTM-30LX-EW", "UTM-30LX-EW", 23, 60000, (1, 5), RangeSheet(0.1, 30.0, 0.03, 0.005 / 3)
    ),
}
"""Models of the series UST and UTM: 1081 steps over 270 degrees, 40 revolutions per second."""
