"""Detection of a body that stands while its wheels roll: likelihood ratio of standing and rolling, scan by scan.

The distance by the scans is modelled as a function of the distance by the wheels, a broken line. Before the break both
hypotheses have the same slope, fitted to the places; after the break the body stands (slope 0) or rolls with the
maximum tolerated slip. The difference of the two sums of squared residuals, in variances of a place, is twice the
logarithm of the likelihood ratio. Every place since the wheels' velocity became steady may be the break.

The errors of places are assumed independent. Scans may drift as well: if the wheels are so slow that slip and drift
together could explain a standing body, the test gives no evidence.
"""

import math
from collections import deque

import numpy as np

from monstertruck_estimation.slam.registration import CORRELATION, Cloud, Fit
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.state import StandingBody


class StandingWatch:
    """Watches the motion from scan to scan for a body that stands.

    Args:
        slip: tolerated slip, as a fraction of the wheels' motion.
        delay: tolerated delay of the scans, s.
        drift: tolerated lasting error of the speed by scans, m/s.
    """

    def __init__(self, slip: float, delay: float, drift: float) -> None:
        self._slip, self._drift = slip, drift
        self._delay = round(delay * SECOND)
        self._velocity: Array | None = None
        self._steady_since = 0
        compared = 20  # number of the latest places that are compared
        self._places: deque[tuple[int, float, float, float]] = deque(maxlen=compared)
        """Stamp, distance by the wheels and by the scans, variance of the latter."""

    def observe(self, since: int, stamp: int, rolled: Array, moved: Array, covariance: Array) -> StandingBody | None:
        """Take the motion between two scans; return the evidence of a standing body.

        Args:
            since: stamp of the earlier scan, ns.
            stamp: stamp of the later scan, ns.
            rolled: motion by the wheels, shape (3,), m, m, rad.
            moved: motion by the scans, shape (3,), m, m, rad.
            covariance: covariance of the pose at the later scan, shape (3, 3).
        """
        velocity, before = rolled / (stamp - since) * SECOND, self._velocity
        self._velocity, speed = velocity, float(np.linalg.norm(velocity))
        if before is None or not np.linalg.norm(velocity - before) < self._slip * speed:
            self._places.clear()
            self._steady_since = stamp
            return None
        if since - self._steady_since < self._delay:
            return None  # scans delayed by that much still show the earlier velocity
        equal = (1.0 + self._slip) / 2  # share of the wheels' motion missing where both hypotheses are equally likely
        if math.hypot(self._slip * speed, self._drift) > equal * speed:
            self._places.clear()
            return None
        direction = velocity / speed
        _, way, shown, _ = self._places[-1] if self._places else (since, 0.0, 0.0, 0.0)
        variance = float(direction @ covariance @ direction)
        self._places.append((stamp, way + float(rolled @ direction), shown + float(moved @ direction), variance))
        return self._judged()

    def _judged(self) -> StandingBody | None:
        _, rolled, shown, variances = np.array(self._places).T
        least = 3  # number of places beyond the coefficients; the stated variance has the weight of as many places
        apart = rolled - rolled[:-2, None]  # at least two places after the break; row: break, column: place
        sloped = np.arange(len(apart)) >= 3  # places that determine the slope before the break; with fewer it is 1
        free = len(rolled) - np.where(sloped, 3, 2)
        if not (free >= least).any():
            return None
        before, after = np.minimum(apart, 0.0), np.maximum(apart, 0.0)
        stood = np.where(sloped[:, None], shown, shown - before)
        slopes = np.where(sloped[:, None], before, 0.0)
        stands = _residuals(slopes, stood)
        rolls = _residuals(slopes, stood - (1.0 - self._slip) * after)
        likelier = (rolls - stands) * (least + free) / (least * variances.mean() + stands)
        start = int(np.where(free >= least, likelier, -np.inf).argmax())
        # Twice the logarithm of the likelihood ratio of a finding: 4 standard deviations. A false finding moves the
        # robot 3 cm back while an operator watches it.
        if likelier[start] <= 4.0**2:
            return None
        way, seen = float(rolled[-1] - rolled[start]), float(shown[-1] - shown[start])
        return StandingBody(since=self._places[start][0], stamp=self._places[-1][0], rolled=way, shown=seen)


def _residuals(along: Array, values: Array) -> Array:
    """Return the sum of squared residuals of the line fitted to each row of ``values`` over the row of ``along``."""
    x, y = along - along.mean(axis=1, keepdims=True), values - values.mean(axis=1, keepdims=True)
    square = (x * x).sum(axis=1)
    slope = np.divide((x * y).sum(axis=1), square, out=np.zeros(len(x)), where=square > 0.0)
    residuals: Array = ((y - slope[:, None] * x) ** 2).sum(axis=1)
    return residuals


def spread(fit: Fit, scan: Scan, cloud: Cloud) -> float:
    """Return the variance of the pairs' distances, as a fraction of the stated one."""
    stated = float(scan.variances[:, 0].mean() + cloud.variances[:, 0].mean())
    return fit.residual**2 / stated


def place_covariance(fit: Fit, spread: float) -> Array:
    """Return the covariance of a registered pose in base, shape (3, 3), for the measured ``spread`` of the pairs.

    Errors that neighbouring beams share are left out: they are the same in all scans from nearly one place.
    """
    c, s = math.cos(fit.pose[2]), math.sin(fit.pose[2])
    turned = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    return np.asarray(spread * CORRELATION * np.linalg.inv(turned.T @ fit.information @ turned + np.eye(3)))
