"""Motion of the base between two scans: predicted from odometry, measured by matching; the offset of their clocks."""

import math
from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.se2 import between, rotation
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.scan_matcher import LOW_OVERLAP, ScanMatch
from monstertruck_estimation.slam.worker_io import ScanIncrement
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND

TRUST_MEMORY: Final = 40
"""Scans over which the robust_weights in odometry is learned."""
MAX_INNOVATION: Final = 4.0
"""Normalised innovations count as this at most."""
TRUST_LIMITS: Final = (1.0, 3.0)
"""Limits of the factor on the standard deviation of the odometry."""
CLEAR_MATCH: Final = (0.15, 0.75)
"""Least degeneracy and overlap of a match that is compared with odometry."""
FIT_NOISE: Final = 0.01
"""Standard deviation of a match itself, m."""


def velocity(delta: Array, dt: float) -> tuple[float, float, float]:
    """Velocity in base (vx, vy, wz; m/s, rad/s) that makes the way ``delta``, shape (3,), in ``dt`` s; 0 if dt is."""
    if dt <= 0:
        return 0.0, 0.0, 0.0
    vx, vy, wz = (delta / dt).tolist()
    return vx, vy, wz


class MotionPredictor:
    """Predicts the motion between two scans, and adapts the noise of odometry to the matches.

    Wheels slip, and many logs stamp odometry and scans by different clocks; no constant fits all. The factor
    follows the root mean square of the innovations (adaptive Kalman filtering, Mehra 1972).

    Args:
        config: initial noise.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._square = 1.0
        self._odom: Array | None = None
        self._delta = np.zeros(3)
        self._dt = 0.0

    @property
    def factor(self) -> float:
        """Factor on the standard deviation of the way."""
        return min(max(math.sqrt(self._square), TRUST_LIMITS[0]), TRUST_LIMITS[1])

    @property
    def odom(self) -> Array | None:
        """Newest pose of base in odom."""
        return self._odom

    @property
    def twist(self) -> tuple[float, float, float]:
        """Velocity of base between the last two scans (vx, vy, wz; m/s, rad/s)."""
        return velocity(self._delta, self._dt)

    def predict(self, dt: float, odom: Array | None) -> tuple[Array, Array]:
        """Motion in base over the last ``dt`` seconds, and its covariance (3, 3)."""
        config = self._config
        known = odom is not None and bool(np.isfinite(odom).all())
        delta = None
        if known and self._odom is not None:
            delta = between(self._odom, np.asarray(odom, dtype=float))
            if math.hypot(delta[0], delta[1]) > config.fastest[0] * dt + config.fastest[1]:
                delta = None
        if delta is not None:
            way, turned = math.hypot(delta[0], delta[1]), abs(float(delta[2]))
            place = self.factor * math.hypot(config.odometry_floor[0], config.odometry_distance * way)
            by_turn, by_way = config.odometry_turn
            turn = math.hypot(config.odometry_floor[1], math.hypot(by_turn * turned, by_way * way))
        else:
            delta = self._delta * (min(dt / self._dt, 3.0) if self._dt > 0 else 0.0)
            place = config.odometry_floor[0] + config.blind_speed[0] * dt
            turn = config.odometry_floor[1] + config.blind_speed[1] * dt
        if known:
            self._odom = np.array(odom, dtype=float)
        return delta, np.diag((place**2, place**2, turn**2))

    def learn(self, dt: float, delta: Array, noise: Array, moved: Array, match: ScanMatch) -> None:
        """Compare the prediction ``delta`` (covariance ``noise``) with ``moved``, the motion by the match."""
        self._dt, self._delta = dt, moved
        if (
            self._odom is None
            or not match.accepted
            or match.degeneracy < CLEAR_MATCH[0]
            or match.overlap < CLEAR_MATCH[1]
        ):
            return
        off = between(delta, moved)
        place = (off[0] ** 2 + off[1] ** 2) / 2 / (noise[0, 0] + FIT_NOISE**2)
        innovation = min(place, MAX_INNOVATION**2) * self.factor**2
        self._square += (innovation - self._square) / TRUST_MEMORY


UNCONSTRAINED: Final = np.diag((1e-4, 1e-4, 1e-2))
"""Added to every information: an unconstrained direction has a standard deviation of 100 m, or of 10 rad."""
MATCH_FLOOR: Final = (0.002, 0.001)
"""Least standard deviation of a match, m and rad."""
OVERLAP_DROP: Final = 0.15
"""After a rejected match the overlap must return to the running mean less this."""
OVERLAP_GAIN: Final = 0.05
"""Weight of one match in the running mean of the overlap."""


class ScanOdometry:
    """Scan odometry: the motion between successive matches, by the scans alone.

    With odometry only matches of good overlap give a motion, and none is given across a rejected match: the robot may
    have been carried, and a half fit at a wrong place must not count before the overlap is back to its mean. Without
    odometry rejected matches are skipped, and every accepted one counts.
    """

    def __init__(self) -> None:
        self._last: tuple[int, Array] | None = None
        self._usual = 0.0
        """Running mean of the overlap of the matches used; 0 before the first."""
        self._least = LOW_OVERLAP

    def take(
        self, stamp: int, match: ScanMatch, pose: Array, *, alone: bool, corrected: bool = False
    ) -> ScanIncrement | None:
        """The motion since the last match that was used; None if this one is not.

        Args:
            stamp: of the scan, ns.
            match: result of scan matching; its covariance includes the prediction, its information does not.
            pose: shape (3,), pose after the step, in which a loop may have been closed.
            alone: there is no odometry.
            corrected: a loop closure moved the map at this step: the next motion begins at ``pose``.
        """
        if match.information is None or not (alone or match.overlap >= self._least):
            self._least = max(LOW_OVERLAP, self._usual - OVERLAP_DROP)
            if corrected or not alone:
                self._last = None
            return None
        self._least = LOW_OVERLAP
        self._usual += (match.overlap - self._usual) * (OVERLAP_GAIN if self._usual else 1.0)
        last, self._last = self._last, (stamp, pose.copy() if corrected else match.pose)
        if last is None:
            return None
        since, origin = last
        turn = np.eye(3)
        turn[:2, :2] = rotation(-match.pose[2])
        covariance = turn @ np.linalg.inv(_known(match, match.information) + UNCONSTRAINED) @ turn.T
        covariance = (covariance + covariance.T) / 2 + np.diag(
            np.square((MATCH_FLOOR[0], MATCH_FLOOR[0], MATCH_FLOOR[1]))
        )
        x, y, yaw = between(origin, match.pose).tolist()
        return ScanIncrement(since, (x, y, yaw), tuple(covariance.ravel().tolist()))

    def forget(self) -> None:
        """Start anew: the next match has no predecessor."""
        self._last, self._least = None, LOW_OVERLAP


def _known(match: ScanMatch, information: Array) -> Array:
    """Information without its component along the weak direction of a degenerate match.

    That component comes from the ends of the visible walls, which move along with the robot.
    """
    if not match.degenerate:
        return information
    along = np.array((math.cos(match.direction), math.sin(match.direction), 0.0))
    weight = information @ along
    return information - np.outer(weight, weight) / max(float(along @ weight), 1e-9)


OFFSET_SCANS: Final = 300
"""Scans compared."""
OFFSET_LEAST_SCANS: Final = 120
"""Fewest scans."""
OFFSET_PERIOD: Final = 40
"""Scans between two estimates."""
OFFSET_LAGS: Final = np.arange(-12, 13) * 0.05
"""Offsets tried, s."""
LEAST_OFFSET: Final = 0.09
"""Smaller offsets are within the noise, s."""
LEAST_EXCITATION: Final = 0.05
"""Least standard deviation of the yaw rate, rad/s."""
LEAST_CORRELATION: Final = 0.8
"""Least correlation at the offset."""
CORRELATION_GAIN: Final = 0.08
"""How much better it must be than at zero."""


class ClockOffsetEstimator:
    """Estimates a constant offset between the clocks of odometry and scans, as logs with badly stamped wheels have it.

    The yaw rate by the matches is correlated with that of odometry at shifted times; the lag of the best correlation is
    the offset. Only the yaw takes part: both measure it best.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float, float]] = deque(maxlen=OFFSET_SCANS)
        self._seen = 0
        self.offset: float | None = None
        """Seconds by which odometry runs ahead of the scans; None = not known, or none."""

    def add(self, stamp: int, matched: float, odom: float) -> None:
        """Take the yaw of an accepted match and that of odometry, both rad at ``stamp``, ns."""
        self._samples.append((stamp, matched, odom))
        self._seen += 1
        if self._seen % OFFSET_PERIOD == 0 and len(self._samples) >= OFFSET_LEAST_SCANS:
            self.offset = find_offset(*(np.array(column) for column in zip(*self._samples, strict=True)))


def find_offset(stamps: Array, matched: Array, odom: Array) -> float | None:
    """Seconds by which ``odom`` runs ahead of ``matched``; None if there is no clear offset.

    Args:
        stamps: shape (n,), ns, rising.
        matched: shape (n,), yaw by the scans, rad.
        odom: shape (n,), yaw by the wheels, rad.
    """
    times = (stamps - stamps[0]) / SECOND
    wheel, scan = np.unwrap(odom), np.unwrap(matched)
    margin = float(OFFSET_LAGS[-1])
    inside = (times[:-1] >= margin) & (times[1:] <= times[-1] - margin)
    steps = np.diff(times)[inside]
    turning = np.diff(scan)[inside] / steps if len(steps) else np.zeros(0)
    if len(turning) < OFFSET_LEAST_SCANS // 2 or turning.std() < LEAST_EXCITATION:
        return None
    likeness = np.array([_correlation(turning, times, wheel, lag, inside) for lag in OFFSET_LAGS])
    best, still = int(np.argmax(likeness)), likeness[np.argmin(np.abs(OFFSET_LAGS))]
    if (
        abs(OFFSET_LAGS[best]) < LEAST_OFFSET
        or likeness[best] < LEAST_CORRELATION
        or likeness[best] - still < CORRELATION_GAIN
    ):
        return None
    return -float(OFFSET_LAGS[best])


def _correlation(turning: Array, times: Array, wheel: Array, lag: float, inside: NDArray[np.bool_]) -> float:
    shifted = np.interp(times + lag, times, wheel)
    turned = np.diff(shifted)[inside] / np.diff(times)[inside]
    spread = turned.std()
    if spread < LEAST_EXCITATION:
        return 0.0
    return float(np.mean((turning - turning.mean()) * (turned - turned.mean())) / (turning.std() * spread))
