"""Ranges of several scans, arranged by beam."""

from collections.abc import Sequence

import numpy as np

from monstertruck_kinematics.beams import nearest_beams
from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan


def bearings_of(scan: LaserScan) -> Array:
    """Bearings of a scan's beams (rad), shape (n,)."""
    return scan.start_angle + scan.angle_increment * np.arange(len(scan.ranges), dtype=np.float64)


def stacked_ranges(scans: Sequence[LaserScan], missing: float) -> Array:
    """Ranges along the beams of the first scan (m).

    Args:
        scans: at least one scan; the number of beams may differ between scans.
        missing: value for a beam without a range.

    Returns:
        Shape (number of scans, number of beams in the first scan).
    """
    bearings = bearings_of(scans[0])
    return np.array([_along(bearings, scan, missing) for scan in scans])


def _along(bearings: Array, scan: LaserScan, missing: float) -> Array:
    """Ranges (m) of the beams closest to the given bearings, shape (n,)."""
    measured = np.where(scan.codes == VALID_BEAM, scan.ranges, missing)
    beams = nearest_beams(bearings, scan.start_angle, scan.angle_increment)
    return np.append(measured, missing)[np.minimum(beams, len(measured))]
