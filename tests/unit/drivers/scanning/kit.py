"""A square room around a scanner that turns in its middle, and where the beams of its scans end."""

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan

Array = NDArray[np.float64]


class Room:
    """``BeamSource``: walls at ``half`` m on all four sides; the scanner turns at ``rate`` rad/s, left positive."""

    def __init__(self, half: float = 3.0, rate: float = 0.0) -> None:
        self.half, self.rate = half, rate

    def yaw(self, times_ns: Array) -> Array:
        return np.asarray(self.rate * times_ns / SECOND)

    def beams(self, bearings: Array, times_ns: NDArray[np.int64], sheet: RangeSheet) -> Array:
        ways = bearings + self.yaw(times_ns)
        ranges = self.half / np.maximum(np.abs(np.cos(ways)), np.abs(np.sin(ways)))
        return np.where(ranges <= sheet.greatest, ranges, np.inf)

    def off(self, scan: LaserScan) -> Array:
        """Distances of the ends of its beams from the walls, m, each beam placed by its own instant."""
        beams = np.flatnonzero(scan.codes == VALID_BEAM)
        times = scan.stamp + beams * scan.time_increment * SECOND
        ways = scan.start_angle + scan.angle_increment * beams + self.yaw(times)
        points = scan.ranges[beams] * np.stack((np.cos(ways), np.sin(ways)))
        return np.asarray(np.abs(np.abs(points).max(axis=0) - self.half))


def ahead(scan: LaserScan, degrees: float = 10.0) -> NDArray[np.bool_]:
    """Which of its valid beams look straight ahead, give or take so many degrees."""
    bearings = scan.start_angle + scan.angle_increment * np.flatnonzero(scan.codes == VALID_BEAM)
    return np.asarray(np.abs(np.remainder(bearings + np.pi, 2 * np.pi) - np.pi) < np.radians(degrees))
