"""Motion of the base between two scans: predicted from odometry, measured by matching; the offset of their clocks."""

import math
from collections import deque
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.scan_matcher import LOW_OVERLAP, ScanMatch, deviations
from monstertruck_estimation.slam.worker_io import ScanIncrement
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Twist2, between, compose, rotation
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import OdometryUse

NOISE_MEMORY: Final = 40
"""Scans over which the noise of odometry, and of the motion predicted without it, is estimated."""


def velocity(delta: Array, dt: float) -> Twist2:
    """Velocity in base (vx, vy, wz; m/s, rad/s) of the motion ``delta``, shape (3,), in ``dt`` s; 0 if dt is."""
    if dt <= 0:
        return 0.0, 0.0, 0.0
    vx, vy, wz = (delta / dt).tolist()
    return vx, vy, wz


FEWEST_SAMPLES: Final = 2
"""Fewest steps of a comparison."""
SLACK: Final = (0.1, 0.2)
"""Tolerated difference for an offset of the clocks, and its largest value with that of crossed motion, m and rad."""
CONTRADICTIONS: Final = 2
"""Comparisons in a row that contradict odometry before it is dropped, by their last scans and by their first ones: one
scan with a late stamp contradicts nothing, wherever it lies."""


class OdometryCheck:
    """Compares distances and turns by odometry with those by the scans, which are independent of the wheels.

    The differences of their motions are summed over some seconds: clocks that disagree shift both a little and change
    no sum. A slow robot's are compared over as much motion as a fast one's: within seconds alone its error would not
    exceed ``SLACK``. What was contradicted, ways or turns, must agree step by step over 2 m or 2 rad before odometry
    counts again: a turn of the wrong sign agrees as long as the robot drives straight. Where ways are contradicted,
    turns count on if they agree over all that was compared, and the reverse.
    """

    def __init__(self) -> None:
        self._steps: deque[Array] = deque()
        """Seconds, motion by odometry and by the scans, whether these measured the way; shape (8,)."""
        self._odom, self._scans, self._seconds = np.zeros(3), np.zeros(3), 0.0
        self._seen = True
        self._row = 0
        self._wrong = np.zeros(2, bool)
        self._kept = np.ones(2, bool)
        self._agreed = np.zeros((2, 2))
        self.since = 0.0
        """Seconds before the newest scan from which on odometry is contradicted."""

    @property
    def contradicted(self) -> bool:
        """Whether ways or turns by odometry are wrong."""
        return bool(self._wrong.any())

    @property
    def kept(self) -> tuple[bool, bool]:
        """Whether its ways, and its turns, are used even so."""
        way, turn = self._kept.tolist()
        return way, turn

    def add(self, dt: float, odom: Array, moved: Array, *, seen: bool = True) -> None:
        """Take the motions in base over ``dt`` seconds, shape (3,), by odometry and by the scans.

        Where the scans have not ``seen`` the way (a corridor), it contradicts nothing, and agrees with nothing.
        """
        self._seconds += dt
        self._odom, self._scans = compose(self._odom, odom), compose(self._scans, moved)
        self._seen &= seen
        step = np.array((self._seconds, *self._odom, *self._scans, self._seen))
        # Least length of a step of the comparison, s and motion: the noise of single matches would add up to a
        # distance.
        sample = (0.25, 0.1)
        if self._seconds < sample[0] or _motion(step) < sample[1]:
            return
        self._steps.append(step)
        while len(self._steps) >= FEWEST_SAMPLES + CONTRADICTIONS and self._long_enough_without_oldest():
            self._steps.popleft()
        self._odom, self._scans, self._seconds, self._seen = np.zeros(3), np.zeros(3), 0.0, True
        if len(self._steps) >= FEWEST_SAMPLES + CONTRADICTIONS - 1:
            self._judge()

    def interrupt(self, dt: float) -> None:
        """Over ``dt`` seconds there is nothing to compare, and the next motion does not follow the last one."""
        self._odom, self._scans, self._seconds, self._seen = np.zeros(3), np.zeros(3), self._seconds + dt, True

    def _long_enough_without_oldest(self) -> bool:
        later = list(self._steps)[1:]
        compared = (5.0, 2.0)  # time (s) and motion (m or rad) over which odometry is compared with the scans
        return sum(float(step[0]) for step in later) > compared[0] and sum(map(_motion, later)) > compared[1]

    def _judge(self) -> None:
        """Compare over the last ``FEWEST_SAMPLES`` and more steps; drop odometry, or take it back."""
        rows = np.array(self._steps)[::-1]
        differences = np.cumsum(rows[:, 1:4] - rows[:, 4:7], axis=0)
        off = np.stack((np.hypot(differences[:, 0], differences[:, 1]), np.abs(differences[:, 2])), axis=1)
        lengths = np.stack((_lengths(rows[:, 1:4]), _lengths(rows[:, 4:7])))
        seen = np.stack((rows[:, 7], np.ones(len(rows))), axis=1)
        motion = np.cumsum(lengths, axis=1).max(axis=0)
        # Tolerated difference of the distance per radian, m, and of the turn per metre, rad: levers, unequal wheels.
        crossed = 0.1
        slack = np.minimum(SLACK[0] + crossed * motion[:, ::-1], SLACK[1])
        tolerance = 0.3  # tolerated difference of odometry and scans as a share of the distance, or of the turn
        beyond = (off > tolerance * motion + slack)[FEWEST_SAMPLES - 1 :]
        wrong = sliding_window_view(beyond, CONTRADICTIONS, axis=0).all(axis=-1).any(axis=0)
        self._row = self._row + 1 if wrong.any() else 0
        if self._row >= CONTRADICTIONS:
            if not self.contradicted:
                self.since = float(rows[:, 0].sum())
                # Wheels that say nothing agree with nothing.
                self._kept = off[-1] < tolerance * (lengths * seen).sum(axis=1).min(axis=0)
            self._wrong |= wrong
            self._kept &= ~wrong
            self._agreed[wrong] = 0.0
        if self.contradicted:
            by_odometry, by_scans = lengths[:, 0]
            error = abs(by_odometry[0] - by_scans[0]), abs(rows[0, 3] - rows[0, 6])
            self._agreed += np.stack((np.maximum(by_odometry, by_scans), error), axis=1) * seen[0][:, None]
            agreement = 0.4  # mean error of a step, as a share of the motion, below which odometry is used again
            agreed = (2.0, 2.0)  # motion with that agreement after which odometry is used again, m and rad
            enough, good = self._agreed[:, 0] >= agreed, self._agreed[:, 1] <= agreement * self._agreed[:, 0]
            self._agreed[enough & ~good] = 0.0
            self._wrong &= ~(enough & good)
            if not self._wrong.any():
                self._steps.clear()
                self._row = 0


def _lengths(motions: Array) -> Array:
    """Ways and turns, m and rad, shape (..., 2), of motions, shape (..., 3)."""
    return np.stack((np.hypot(motions[..., 0], motions[..., 1]), np.abs(motions[..., 2])), axis=-1)


def _motion(step: Array) -> float:
    """Distance or turn, m or rad, of a step by odometry or the scans: what is most."""
    return float(max(_lengths(step[1:4]).max(), _lengths(step[4:7]).max()))


class LastMotionPredictor:
    """Predicts the motion between two scans from the last ones, without odometry.

    Either the velocity lasts, or the motion from scan to scan: a busy host stamps scans that were made evenly in
    bursts, none for a second and then some at once, or in the wrong order; over the times between such stamps a steady
    robot would stand and leap. The motion from scan to scan is used where its errors were clearly smaller.

    Args:
        config: initial noise.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._times: deque[float] = deque(maxlen=NOISE_MEMORY)
        steps = 3  # motions of which the median is the one that lasts from scan to scan
        self._steps: deque[tuple[float, Array]] = deque(maxlen=steps)
        self._predictions = np.zeros((2, 3))
        """By the velocity, and from scan to scan."""
        self._errors = np.zeros(2)
        """Their mean squares; a radian counts as a metre."""
        self._accepted = False

    def predict(self, dt: float) -> tuple[Array, Array]:
        """Motion in base over the next ``dt`` seconds, and its covariance (3, 3)."""
        self._times.append(dt)
        if self._steps:
            before, last = self._steps[-1]
            max_stretch = 3.0  # greatest factor by which a pause makes a motion longer than the last one
            lasting = last * (min(dt / before, max_stretch) if before > 0 else 0.0)
            self._predictions = np.stack((lasting, np.median([step for _, step in self._steps], axis=0)))
        # Share of the mean squared error of the prediction by velocity below which that from scan to scan is used: half
        # as far off.
        clearly = 0.25
        from_scan_to_scan = bool(self._errors[1] < clearly * self._errors[0])
        # Where stamps are no measure of the time, the usual time has passed at least.
        seconds = max(dt, sum(self._times) / len(self._times)) if from_scan_to_scan else dt
        place = self._config.odometry_floor[0] + self._config.blind_speed[0] * seconds
        turn = self._config.odometry_floor[1] + self._config.blind_speed[1] * seconds
        return self._predictions[int(from_scan_to_scan)], np.diag((place**2, place**2, turn**2))

    def learn(self, dt: float, moved: Array, match: ScanMatch) -> None:
        """Take the motion ``moved``, shape (3,), in ``dt`` seconds by the match."""
        before, self._accepted = self._accepted, match.accepted
        # The first motion after a misfit makes up for what was predicted wrongly at it.
        if not (before and match.accepted):
            return
        if self._steps and _is_clear(match):
            errors = np.square(between(self._predictions, moved)).sum(axis=1)
            self._errors += (errors - self._errors) / NOISE_MEMORY
        self._steps.append((dt, moved))


def _is_clear(match: ScanMatch) -> bool:
    """Whether a match says what the motion was, without the prediction's help."""
    clear_match = (0.15, 0.75)  # least degeneracy and overlap of a match that is compared with odometry
    return match.degeneracy >= clear_match[0] and match.overlap >= clear_match[1]


class MotionPredictor:
    """Predicts the motion between two scans, adapts the noise of odometry to the matches, and drops wrong odometry.

    Wheels slip, and many logs stamp odometry and scans by different clocks; no constant fits all. The factors
    follow the root mean square of the innovations (adaptive Kalman filtering, Mehra 1972), of ways and of turns.

    Args:
        config: initial noise.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._squares = np.ones(2)
        self._odom: Array | None = None
        self._by_odometry: tuple[Array, Array] | None = None
        self._alone = LastMotionPredictor(config)
        self._by_motion = np.zeros(3), np.zeros((3, 3))
        self._delta = np.zeros(3)
        self._dt = 0.0
        self._given, self._seen = False, False
        self._fitted = False
        self._missing = 0.0
        self.check = OdometryCheck()

    @property
    def factors(self) -> tuple[float, float]:
        """Factors on the standard deviations of distance and turn."""
        noise_limits = (1.0, 3.0)  # limits of the factors on the standard deviations of odometry
        place, turn = np.clip(np.sqrt(self._squares), *noise_limits).tolist()
        return place, turn

    @property
    def use(self) -> OdometryUse:
        """Whether odometry predicts the motion."""
        if not self._given:
            return OdometryUse.NONE
        if not self._seen or self._missing >= 1.0:  # seconds without finite odometry after which it is missing
            return OdometryUse.MISSING
        return OdometryUse.CONTRADICTED if self.check.contradicted else OdometryUse.USED

    @property
    def others(self) -> tuple[tuple[Array, Array], ...]:
        """The predictions that ``predict`` did not choose, and their covariances; none without odometry.

        That by the scans' own motion is always among all of them: wheels of which only ways or turns count may still
        be wrong at one scan, and would then lose a robot that scans alone do not lose.
        """
        if self._by_odometry is None:
            return ()
        if not self.check.contradicted:
            return (self._by_motion,)
        return (self._by_motion, self._by_odometry) if any(self.check.kept) else (self._by_odometry,)

    def by_wheels(self, delta: Array) -> bool:
        """Whether the motion ``delta``, shape (3,), is that by odometry, and nothing contradicts it."""
        return self.use is OdometryUse.USED and self._by_odometry is not None and delta is self._by_odometry[0]

    @property
    def odom(self) -> Array | None:
        """Newest pose of base in odom."""
        return self._odom

    @property
    def twist(self) -> Twist2:
        """Velocity of base between the last two scans (vx, vy, wz; m/s, rad/s)."""
        return velocity(self._delta, self._dt)

    def predict(self, dt: float, odom: Array | None) -> tuple[Array, Array]:
        """Motion in base over the last ``dt`` seconds, and its covariance (3, 3)."""
        config = self._config
        now = None if odom is None or not np.isfinite(odom).all() else np.array(odom, dtype=float)
        self._given |= odom is not None
        self._seen |= now is not None
        self._missing = self._missing + dt if now is None else 0.0
        delta = None if now is None or self._odom is None else between(self._odom, now)
        if delta is not None and math.hypot(delta[0], delta[1]) > config.fastest[0] * dt + config.fastest[1]:
            delta = None
        self._odom = now
        self._by_odometry = None if delta is None else (delta, self._noise(delta))
        self._by_motion = self._alone.predict(dt)
        if self._by_odometry is None:
            return self._by_motion
        if not self.check.contradicted:
            return self._by_odometry
        way, turned = self.check.kept
        kept = np.array((way, way, turned))
        motion, noise = self._by_motion
        return np.where(kept, self._by_odometry[0], motion), np.where(kept, self._by_odometry[1], noise)

    def _noise(self, delta: Array) -> Array:
        """Covariance, shape (3, 3), of the motion ``delta`` by odometry."""
        config, (by_turn, by_way) = self._config, self._config.odometry_turn
        way, turned = math.hypot(delta[0], delta[1]), abs(float(delta[2]))
        place = self.factors[0] * math.hypot(config.odometry_floor[0], config.odometry_distance * way)
        turn = self.factors[1] * math.hypot(config.odometry_floor[1], math.hypot(by_turn * turned, by_way * way))
        return np.diag((place**2, place**2, turn**2))

    def off(self, moved: Array) -> tuple[float, float] | None:
        """How far ``moved``, shape (3,), is from the motion by odometry, or as the last one, whichever is nearer.

        Returns:
            m and rad beyond two standard deviations of odometry; None where it is not in use.
        """
        if self.use is not OdometryUse.USED or self._by_odometry is None:
            return None
        offs = (between(delta, moved) for delta in (self._by_motion[0], self._by_odometry[0]))
        x, y, turn = min(offs, key=lambda off: math.hypot(*off)).tolist()
        noise = deviations(self._by_odometry[1])
        off_noise = 2.0  # standard deviations of odometry that explain a difference from it
        return max(math.hypot(x, y) - off_noise * noise[0], 0.0), max(abs(turn) - off_noise * noise[1], 0.0)

    def learn(self, dt: float, delta: Array, noise: Array, moved: Array, match: ScanMatch) -> None:
        """Compare the prediction ``delta`` (covariance ``noise``) with ``moved``, the motion by the match."""
        self._dt, self._delta = dt, moved
        self._alone.learn(dt, moved, match)
        fitted, self._fitted = self._fitted, match.accepted and match.overlap >= LOW_OVERLAP
        # The first motion after a misfit makes up for what was predicted wrongly at it.
        if self._by_odometry is None or not (fitted and self._fitted):
            self.check.interrupt(dt)
            return
        by_odometry = self._by_odometry[0]
        # Along a corridor the match takes the distance from the prediction; only its turn is measured.
        compared = (*by_odometry[:2], moved[2]) if match.degenerate else moved
        self.check.add(dt, by_odometry, np.array(compared), seen=not match.degenerate)
        if not _is_clear(match) or delta is not by_odometry:
            return
        off = between(delta, moved)
        fit_noise = (0.01, 0.005)  # standard deviation of a match itself, m and rad
        place = (off[0] ** 2 + off[1] ** 2) / 2 / (noise[0, 0] + fit_noise[0] ** 2)
        turn = off[2] ** 2 / (noise[2, 2] + fit_noise[1] ** 2)
        max_innovation = 4.0  # limit to which normalised innovations are clamped
        innovations = np.minimum((place, turn), max_innovation**2) * np.square(self.factors)
        self._squares += (innovations - self._squares) / NOISE_MEMORY


UNCONSTRAINED: Final = np.diag((1e-4, 1e-4, 1e-2))
"""Added to every information: an unconstrained direction has a standard deviation of 100 m, or of 10 rad."""
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
        covariance = turn @ np.linalg.inv(constrained(match, match.information) + UNCONSTRAINED) @ turn.T
        match_floor = (0.002, 0.001)  # least standard deviation of a match, m and rad
        covariance = (covariance + covariance.T) / 2 + np.diag(
            np.square((match_floor[0], match_floor[0], match_floor[1]))
        )
        x, y, yaw = between(origin, match.pose).tolist()
        return ScanIncrement(since, (x, y, yaw), tuple(covariance.ravel().tolist()))

    def forget(self) -> None:
        """Start again: the next match has no predecessor."""
        self._last, self._least = None, LOW_OVERLAP


def constrained(match: ScanMatch, information: Array) -> Array:
    """``information`` of a match, shape (3, 3), without its component along the weak direction if it is degenerate.

    That component comes from the ends of the visible walls, which move along with the robot.
    """
    if not match.degenerate:
        return information
    along = np.array((math.cos(match.direction), math.sin(match.direction), 0.0))
    weight = information @ along
    return information - np.outer(weight, weight) / max(float(along @ weight), 1e-9)


OFFSET_LEAST_SCANS: Final = 120
"""Fewest scans."""
LEAST_EXCITATION: Final = 0.05
"""Least standard deviation of the yaw rate, rad/s."""


class ClockOffsetEstimator:
    """Estimates a constant offset between the clocks of odometry and scans, as logs with badly stamped wheels have it.

    The yaw rate by the matches is correlated with that of odometry at shifted times; the lag of the best correlation is
    the offset. Only the yaw takes part: both measure it best.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float, float]] = deque(maxlen=300)  # scans compared
        self._seen = 0
        self.offset: float | None = None
        """Seconds by which odometry runs ahead of the scans; None = not known, or none."""

    def add(self, stamp: int, matched: float, odom: float) -> None:
        """Take the yaw of an accepted match and that of odometry, both rad at ``stamp``, ns; not finite: ignored."""
        if not math.isfinite(odom):
            return
        self._samples.append((stamp, matched, odom))
        self._seen += 1
        offset_period = 40  # scans between two estimates
        if self._seen % offset_period == 0 and len(self._samples) >= OFFSET_LEAST_SCANS:
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
    offset_lags = np.arange(-12, 13) * 0.05  # offsets tried, s
    margin = float(offset_lags[-1])
    inside = (times[:-1] >= margin) & (times[1:] <= times[-1] - margin)
    steps = np.diff(times)[inside]
    turning = np.diff(scan)[inside] / steps if len(steps) else np.zeros(0)
    if len(turning) < OFFSET_LEAST_SCANS // 2 or turning.std() < LEAST_EXCITATION:
        return None
    likeness = np.array([_correlation(turning, times, wheel, lag, inside) for lag in offset_lags])
    best, still = int(np.argmax(likeness)), likeness[np.argmin(np.abs(offset_lags))]
    if (
        abs(offset_lags[best]) < 0.09  # smaller offsets are within the noise, s
        or likeness[best] < 0.8  # least correlation at the offset
        or likeness[best] - still < 0.08  # how much better it must be than at zero
    ):
        return None
    return -float(offset_lags[best])


def _correlation(turning: Array, times: Array, wheel: Array, lag: float, inside: NDArray[np.bool_]) -> float:
    shifted = np.interp(times + lag, times, wheel)
    turned = np.diff(shifted)[inside] / np.diff(times)[inside]
    spread = turned.std()
    if spread < LEAST_EXCITATION:
        return 0.0
    return float(np.mean((turning - turning.mean()) * (turned - turned.mean())) / (turning.std() * spread))
