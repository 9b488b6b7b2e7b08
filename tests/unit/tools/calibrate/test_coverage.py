"""True values of hidden trucks lie inside the stated intervals as often as these say, and the intervals are narrow."""

import pytest

from tests.calibration_light import LIGHT, coverage

HALF_WIDTHS = {
    "odometry.way": 0.01,
    "odometry.wheelbase": 0.01,
    "odometry.offset": 0.0087,
    "lidar.x": 0.010,
    "lidar.y": 0.010,
    "lidar.yaw": 0.0087,
    "imu.rate_scale": 0.01,
    "slip.icr_left": 0.002,
    "slip.gain_left": 0.01,
}
"""Median half-widths at most: 1 %, 0.5 degrees, 10 mm."""
FITS = {"odometry": 16}


@pytest.mark.parametrize("wizard", LIGHT)
def test_intervals_hold_and_are_narrow(wizard: str):
    fits = FITS.get(wizard, 60)
    found = coverage(wizard, fits)
    inside = sum(share for share, _ in found.values()) / len(found)
    assert 0.88 <= inside <= 1.0
    for name, (share, half) in found.items():
        assert share >= 0.8, name
        assert half <= HALF_WIDTHS.get(name, 1.0), name
