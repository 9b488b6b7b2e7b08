"""Detection of a change of the lidar's scale between two revolutions: one factor on all ranges.

Motion of the robot changes every range by a different factor. The points that fit only one of the two explanations
decide between motion and scale, see ``ScanVerdict``.
"""

import math
from typing import NamedTuple

import numpy as np

from monstertruck_estimation.consistency.exchange import REFUTING, ScanVerdict
from monstertruck_estimation.slam.registration import Cloud, fitting, register
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import compose, inverse, transform

Marks = np.ndarray[tuple[int], np.dtype[np.bool_]]


class Revolution(NamedTuple):
    """A scan and the sensor's position."""

    scan: Scan
    """Scan in base."""
    origin: tuple[float, float]
    """Position of the sensor in base (m)."""


class ScaleWatch:
    """Compare each revolution with the previous one.

    If the scale changes within a revolution, neither a motion nor a factor explains it; the next revolution is then
    compared with the one before the change. The last revolution before a change is kept: a change back may take longer
    or happen while the lidar is covered. The ranges have changed back once they fit that revolution, and fit it worse
    when divided by the factor: the points of a single wall fit at any scale.
    """

    def __init__(self) -> None:
        self._sound: tuple[Revolution, Array] | None = None
        """Last revolution before the scale changed, and the wheels' motion since; None while it is unchanged."""
        self._scale = 1.0
        """Factor from that revolution's ranges to the current ones."""
        self._reference: Revolution | None = None
        self._over: list[Array] = []
        """Motions from the reference to an unexplained revolution; empty without one."""

    def restart(self, latest: Revolution | None) -> None:
        """Restart with a lidar that was restarted, whose scale is new."""
        self._sound = None
        self.begin(latest)

    def begin(self, latest: Revolution | None) -> None:
        """Start comparing at a revolution, or at the next one."""
        self._reference, self._over = latest, []

    def change(self, latest: Revolution, motions: list[Array]) -> float | None:
        """Return the common scale factor of all ranges, or None.

        Args:
            latest: the revolution to judge.
            motions: since the previous revolution, see ``scale_change``; always as many, the wheels' motion last.
        """
        earlier = self._reference
        factor = self._changed(latest, motions)
        if self._sound is None and (factor is None or earlier is None):
            return None
        if self._sound is None:
            assert earlier is not None
            self._sound, self._scale = (earlier, np.zeros(3)), 1.0
        sound, moved = self._sound
        moved = compose(moved, motions[-1])
        # 0.5: maximum distance over which it sees the same surroundings, m
        self._sound = None if math.hypot(moved[0], moved[1]) > 0.5 else (sound, moved)
        if _changed_back(latest, sound, moved, self._scale):
            self._sound = None
            return 1.0 / self._scale
        self._scale *= 1.0 if factor is None else factor
        return factor

    def _changed(self, latest: Revolution, motions: list[Array]) -> float | None:
        factor, skipped = None, bool(self._over)
        over = [compose(*pair) for pair in zip(self._over, motions, strict=True)] if skipped else motions
        if self._reference is not None:
            factor = scale_change(latest, self._reference, over)
        if factor is None and self._reference is not None and not skipped:
            self._over = motions
        else:
            self.begin(latest)
        return None if factor == 1.0 else factor


def scale_change(latest: Revolution, earlier: Revolution, motions: list[Array]) -> float | None:
    """Return the factor from earlier to latest ranges: 1 if a motion explains them, None if no factor does.

    Args:
        latest: the revolution to judge.
        earlier: reference revolution.
        motions: initial guesses of the registration, at least one, the most likely one first, each of shape (3,) (m,
            rad).
    """
    cloud = Cloud.of(earlier.scan)
    fits = []
    for motion in motions:
        fits.append(_fits(latest.scan, cloud, motion))
        if np.count_nonzero(~fits[-1]) < REFUTING:
            return 1.0
    moved = max(fits, key=np.count_nonzero)
    factor = _factor(latest, earlier, motions)
    if factor is None:
        return None
    rescaled = _rescaled(latest.scan, latest.origin, 1.0 / factor)
    scaled = max((_fits(rescaled, cloud, motion) for motion in motions), key=np.count_nonzero)
    return factor if _refuted(moved, scaled, latest._replace(scan=rescaled), earlier) else None


def _changed_back(latest: Revolution, sound: Revolution, motion: Array, scale: float) -> bool:
    """Whether the latest ranges have the scale of the sound revolution, rather than still ``scale`` times that."""
    cloud = Cloud.of(sound.scan)
    rescaled = _rescaled(latest.scan, latest.origin, 1.0 / scale)
    still, back = (_fits(scan, cloud, motion) for scan in (rescaled, latest.scan))
    return _refuted(still, back, latest, sound)


def _refuted(others: Marks, fits: Marks, latest: Revolution, earlier: Revolution) -> bool:
    """Whether the points that fit at the scale of ``latest`` refute the other scale, at which ``others`` fit.

    Nothing else changes with the scale: every point that does not fit is evidence against it, unless the earlier
    revolution did not reach so far.
    """
    reach = _polar(earlier.scan.points, earlier.origin)[1].max()
    judged = _polar(latest.scan.points, latest.origin)[1] <= reach
    alone, misfits = (int(np.count_nonzero(points & judged)) for points in (fits & ~others, ~fits))
    return ScanVerdict(claimed=misfits, own=alone, misfits=misfits).refuted


def _fits(scan: Scan, cloud: Cloud, motion: Array) -> Marks:
    return fitting(scan, cloud, register(scan, cloud, motion).pose)


def _factor(latest: Revolution, earlier: Revolution, motions: list[Array]) -> float | None:
    """Compare points of equal bearing, under the motion that gives the best agreement on one factor.

    Return None for too few compared points, or if the factor is within their scatter: the lidar then sees another
    place.
    """
    bearings, distances = _polar(latest.scan.points, latest.origin)
    seen = [_polar(transform(inverse(motion), earlier.scan.points), latest.origin) for motion in motions]
    found = [_ratios(bearings, distances, *earlier_ones) for earlier_ones in seen]
    if min(map(len, found)) < 30:  # minimum number of points with a partner of equal bearing
        return None
    medians = [float(np.median(ratios)) for ratios in found]
    spreads = [float(np.median(np.abs(ratios - middle))) for ratios, middle in zip(found, medians, strict=True)]
    best = int(np.argmin(spreads))
    sigmas, normal = 3.0, 1.4826  # significance; standard deviations per median deviation of normal values
    return math.exp(medians[best]) if abs(medians[best]) > sigmas * normal * spreads[best] else None


def _polar(points: Array, origin: tuple[float, float]) -> tuple[Array, Array]:
    x, y = points[:, 0] - origin[0], points[:, 1] - origin[1]
    return np.arctan2(y, x), np.hypot(x, y)


def _ratios(bearings: Array, distances: Array, others: Array, reach: Array) -> Array:
    """Return the log ratios of the points' distances to the distances of their neighbours by bearing."""
    order = np.argsort(others)
    there = np.searchsorted(others[order], bearings)
    sides = [order[(there + side) % len(order)] for side in (-1, 0)]
    apart = [np.abs(np.remainder(others[side] - bearings + math.pi, math.tau) - math.pi) for side in sides]
    nearest = np.where(apart[0] < apart[1], *sides)
    close = np.minimum(*apart) < math.radians(1)  # of beams with equal bearing
    result: Array = np.log(distances[close] / reach[nearest[close]])
    return result


def _rescaled(scan: Scan, origin: tuple[float, float], factor: float) -> Scan:
    points = np.asarray(origin) + factor * (scan.points - np.asarray(origin))
    return Scan(points, scan.normals, scan.variances * factor**2, scan.extents * factor)
