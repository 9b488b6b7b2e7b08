"""Detects a change of the lidar's scale between two revolutions: one factor on all ranges.

Motion of the robot changes every range by a different factor. The points that fit only one of the two explanations
decide between motion and scale, see ``ScanVerdict``.
"""

import math
from typing import NamedTuple

import numpy as np

from monstertruck_estimation.consistency.exchange import REFUTING, ScanVerdict
from monstertruck_estimation.slam.registration import Cloud, fitting, register
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.beams import nearest_beams
from monstertruck_kinematics.elementary import Array


class Revolution(NamedTuple):
    """A scan with its ranges."""

    ranges: Array
    """Ranges, shape (n,) (m); not finite for beams without a range."""
    start_angle: float
    """Angle of the first beam (rad)."""
    angle_increment: float
    """Angle between neighbouring beams (rad)."""
    scan: Scan
    """Scan in base."""
    origin: tuple[float, float]
    """Position of the sensor in base (m)."""


def scale_change(newest: Revolution, earlier: Revolution, motions: list[Array]) -> float | None:
    """Return the factor from the earlier ranges to the latest ones, or None if motion explains the latest scan.

    Args:
        newest: latest revolution.
        earlier: reference revolution.
        motions: initial guesses of the registration, at least one, the most likely one first, each of shape (3,) (m,
            rad).
    """
    cloud = Cloud.of(earlier.scan)
    fits = []
    for motion in motions:
        fits.append(_fits(newest.scan, cloud, motion))
        if np.count_nonzero(~fits[-1]) < REFUTING:
            return None
    moved = max(fits, key=np.count_nonzero)
    factor = _factor(newest, earlier)
    if factor is None:
        return None
    rescaled = _rescaled(newest.scan, newest.origin, 1.0 / factor)
    scaled = max((_fits(rescaled, cloud, motion) for motion in motions), key=np.count_nonzero)
    # Nothing else changes with the scale: every point that does not fit the rescaled revolution is evidence of motion.
    alone, misfits = int(np.count_nonzero(scaled & ~moved)), int(np.count_nonzero(~scaled))
    return factor if ScanVerdict(claimed=misfits, own=alone, misfits=misfits).refuted else None


def _fits(scan: Scan, cloud: Cloud, motion: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return fitting(scan, cloud, register(scan, cloud, motion).pose)


def _factor(newest: Revolution, earlier: Revolution) -> float | None:
    """Compare beams of the same bearing: their number and the first one's bearing may differ between revolutions."""
    bearings = newest.start_angle + newest.angle_increment * np.arange(len(newest.ranges))
    beams = nearest_beams(bearings, earlier.start_angle, earlier.angle_increment)
    met = beams < len(earlier.ranges)
    new, old = newest.ranges[met], earlier.ranges[beams[met]]
    both = np.isfinite(new) & np.isfinite(old) & (new > 0.0) & (old > 0.0)
    if np.count_nonzero(both) < 30:  # minimum number of beams with a range in both revolutions
        return None
    return math.exp(float(np.median(np.log(new[both] / old[both]))))


def _rescaled(scan: Scan, origin: tuple[float, float], factor: float) -> Scan:
    points = np.asarray(origin) + factor * (scan.points - np.asarray(origin))
    return Scan(points, scan.normals, scan.variances * factor**2, scan.extents * factor)
