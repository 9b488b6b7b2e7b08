"""True values of hidden trucks lie inside the stated intervals as often as these say, and the intervals are narrow."""

import math

import pytest

from tests.calibration_light import HALF_WIDTHS, LIGHT, coverage
from tests.long_kit import mostly_long

FITS = {"odometry": 12, "steering": 10, "lidar": 40, "sonar": 4, "camera": 4}


@pytest.mark.parametrize("wizard", mostly_long(LIGHT, LIGHT.keys() - {"camera", "odometry", "sonar"}))
def test_intervals_hold_and_are_narrow(wizard: str):
    fits = FITS.get(wizard, 60)
    found = coverage(wizard, fits)
    inside = sum(share for share, _ in found.values()) / len(found)
    assert 0.88 <= inside <= 1.0
    for name, (share, half) in found.items():
        assert share >= 0.8 or fits < 10, name
        assert half <= HALF_WIDTHS.get(name, math.inf), name
