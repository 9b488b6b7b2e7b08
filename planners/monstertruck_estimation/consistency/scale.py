"""Change of a lidar's scale from one revolution to another: all ranges become longer or shorter by one factor.

A motion of the robot changes every range by another factor. That one factor changes hundreds of them alike is no
chance, however large it is: what decides is which points one of both explanations fits alone, see ``ScanVerdict``.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from monstertruck_estimation.consistency.exchange import REFUTING, ScanVerdict
from monstertruck_estimation.slam.registration import Cloud, fitting, register
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array

LEAST_PAIRS: Final = 30
"""Beams with a range in both revolutions whose factor is looked at."""


class Revolution(NamedTuple):
    """A scan with its ranges."""

    ranges: Array
    """Shape (n,), m; not finite where there is none."""
    scan: Scan
    """In base."""
    origin: tuple[float, float]
    """Place of the sensor in base, m."""


def scale_change(newest: Revolution, earlier: Revolution, motions: list[Array]) -> float | None:
    """Return the factor by which the newest ranges are longer than the earlier ones, where no motion explains them.

    Args:
        newest: revolution.
        earlier: one that is not old.
        motions: that the robot may have made meanwhile, at least one, each of shape (3,): where registrations begin.
    """
    cloud = Cloud.of(earlier.scan)
    moved = max((_fits(newest.scan, cloud, motion) for motion in motions), key=np.count_nonzero)
    if np.count_nonzero(~moved) < REFUTING or len(newest.ranges) != len(earlier.ranges):
        return None
    factor = _factor(newest.ranges, earlier.ranges)
    if factor is None:
        return None
    rescaled = _rescaled(newest.scan, newest.origin, 1.0 / factor)
    scaled = max((_fits(rescaled, cloud, motion) for motion in motions), key=np.count_nonzero)
    alone, scaled_alone, misfits = map(np.count_nonzero, (moved & ~scaled, scaled & ~moved, ~scaled))
    return factor if ScanVerdict(claimed=int(alone), own=int(scaled_alone), misfits=int(misfits)).refuted else None


def _fits(scan: Scan, cloud: Cloud, motion: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return fitting(scan, cloud, register(scan, cloud, motion).pose)


def _factor(newest: Array, earlier: Array) -> float | None:
    both = np.isfinite(newest) & np.isfinite(earlier) & (newest > 0.0) & (earlier > 0.0)
    if np.count_nonzero(both) < LEAST_PAIRS:
        return None
    return math.exp(float(np.median(np.log(newest[both] / earlier[both]))))


def _rescaled(scan: Scan, origin: tuple[float, float], factor: float) -> Scan:
    points = np.asarray(origin) + factor * (scan.points - np.asarray(origin))
    return Scan(points, scan.normals, scan.variances * factor**2, scan.extents * factor)
