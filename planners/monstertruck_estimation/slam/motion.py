"""Motion of base between two scans: predicted from odometry, measured by matching; and the offset of their clocks."""

import math
from collections import deque
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.scan_matcher import LOW_OVERLAP, ScanMatch, deviations, difference
from monstertruck_estimation.slam.wheel_scale import WheelScale
from monstertruck_estimation.slam.worker_io import ScanIncrement
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Twist2, between, compose, rotation
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import OdometryUse

NOISE_MEMORY: Final = 40
"""Number of scans over which the noise of odometry, and of the motion predicted without it, is estimated."""


def velocity(delta: Array, dt: float) -> Twist2:
    """Return the velocity in base (vx, vy, wz; m/s, rad/s) of ``delta``, shape (3,), in ``dt`` s; 0 if ``dt`` is 0."""
    if dt <= 0:
        return 0.0, 0.0, 0.0
    vx, vy, wz = (delta / dt).tolist()
    return vx, vy, wz


FEWEST_SAMPLES: Final = 2
"""Minimum number of steps of a comparison."""
CONTRADICTIONS: Final = 2
"""Number of successive comparisons, by their last and by their first scans, that must contradict odometry to drop it.

One scan with a late stamp must not suffice.
"""


class OdometryCheck:
    """Compares distances and turns by odometry with those by the scans, which are independent of the wheels.

    The differences of their motions are summed over some seconds: a clock offset shifts both slightly but does not
    change the sums. A slow robot is compared over as much motion as a fast one: within seconds alone, its error would
    stay below the tolerance. A contradicted quantity, distances or turns, must agree step by step over 2 m or 2 rad
    before odometry is used again: a turn of the wrong sign agrees as long as the robot drives straight. If distances
    are contradicted, turns remain in use while they agree over the whole comparison, and vice versa.
    """

    def __init__(self) -> None:
        self._steps: deque[Array] = deque()
        """Seconds, motion by odometry and by scans, and whether the scans measured the distance; shape (8,)."""
        self._odom, self._scans, self._seconds = np.zeros(3), np.zeros(3), 0.0
        self._seen = True
        self._row = 0
        self._wrong = np.zeros(2, bool)
        self._kept = np.ones(2, bool)
        self._agreed = np.zeros((2, 2))
        self.since = 0.0
        """Start of the contradiction (s before the latest scan)."""

    @property
    def contradicted(self) -> bool:
        """Whether distances, or turns, by odometry are wrong."""
        return bool(self._wrong.any())

    @property
    def kept(self) -> tuple[bool, bool]:
        """Whether its distances, and its turns, are still used."""
        way, turn = self._kept.tolist()
        return way, turn

    def add(self, dt: float, odom: Array, moved: Array, *, seen: bool = True) -> None:
        """Add the motions in base over ``dt`` seconds, shape (3,), by odometry and by the scans.

        If the scans have not ``seen`` the distance (in a corridor), it is not compared.
        """
        self._seconds += dt
        self._odom, self._scans = compose(self._odom, odom), compose(self._scans, moved)
        self._seen &= seen
        step = np.array((self._seconds, *self._odom, *self._scans, self._seen))
        # Minimum length of a comparison step, in seconds and motion: otherwise the noise of single matches would add up
        # to a distance.
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
        """Skip ``dt`` seconds without a comparison; the next motion does not follow the last one."""
        self._odom, self._scans, self._seconds, self._seen = np.zeros(3), np.zeros(3), self._seconds + dt, True

    def _long_enough_without_oldest(self) -> bool:
        later = list(self._steps)[1:]
        compared = (5.0, 2.0)  # time (s) and motion (m or rad) over which odometry is compared with the scans
        return sum(float(step[0]) for step in later) > compared[0] and sum(map(_motion, later)) > compared[1]

    def _judge(self) -> None:
        """Compare over at least the last ``FEWEST_SAMPLES`` steps; drop odometry or readmit it."""
        rows = np.array(self._steps)[::-1]
        differences = np.cumsum(rows[:, 1:4] - rows[:, 4:7], axis=0)
        off = np.stack((np.hypot(differences[:, 0], differences[:, 1]), np.abs(differences[:, 2])), axis=1)
        lengths = np.stack((_lengths(rows[:, 1:4]), _lengths(rows[:, 4:7])))
        seen = np.stack((rows[:, 7], np.ones(len(rows))), axis=1)
        motion = np.cumsum(lengths, axis=1).max(axis=0)
        # Tolerated difference of the distance per radian (m), and of the turn per metre (rad): lever arms, unequal
        # wheels.
        crossed = 0.1
        # Tolerance for an offset of the clocks: 0.1, and at most 0.2 including crossed motion (m, rad).
        slack = np.minimum(0.1 + crossed * motion[:, ::-1], 0.2)
        tolerance = 0.3  # tolerated difference of odometry and scans as a share of the distance, or of the turn
        beyond = (off > tolerance * motion + slack)[FEWEST_SAMPLES - 1 :]
        wrong = sliding_window_view(beyond, CONTRADICTIONS, axis=0).all(axis=-1).any(axis=0)
        self._row = self._row + 1 if wrong.any() else 0
        if self._row >= CONTRADICTIONS:
            if not self.contradicted:
                self.since = float(rows[:, 0].sum())
                # Wheels without information agree with no scan.
                self._kept = off[-1] < tolerance * (lengths * seen).sum(axis=1).min(axis=0)
            self._wrong |= wrong
            self._kept &= ~wrong
            self._agreed[wrong] = 0.0
        if self.contradicted:
            by_odometry, by_scans = lengths[:, 0]
            error = abs(by_odometry[0] - by_scans[0]), abs(rows[0, 3] - rows[0, 6])
            self._agreed += np.stack((np.maximum(by_odometry, by_scans), error), axis=1) * seen[0][:, None]
            agreement = 0.4  # maximum mean error of a step, as a share of the motion, for readmitting odometry
            agreed = (2.0, 2.0)  # motion over which it must agree before it is readmitted, m and rad
            enough, good = self._agreed[:, 0] >= agreed, self._agreed[:, 1] <= agreement * self._agreed[:, 0]
            self._agreed[enough & ~good] = 0.0
            self._wrong &= ~(enough & good)
            if not self._wrong.any():
                self._steps.clear()
                self._row = 0


def _lengths(motions: Array) -> Array:
    """Return distances and turns (m, rad), shape (..., 2), of motions, shape (..., 3)."""
    return np.stack((np.hypot(motions[..., 0], motions[..., 1]), np.abs(motions[..., 2])), axis=-1)


def _motion(step: Array) -> float:
    """Return the largest distance or turn (m or rad) of a step by odometry or the scans."""
    return float(max(_lengths(step[1:4]).max(), _lengths(step[4:7]).max()))


class LastMotionPredictor:
    """Predict the motion between two scans from the last motions, without odometry.

    The prediction keeps either the velocity or the motion per scan. A busy host stamps evenly made scans in bursts
    (none for a second and then several at once) or in the wrong order; with such stamps, a robot in steady motion would
    seem to stop and leap. The motion per scan is used if its errors were clearly smaller.

    Args:
        config: initial noise.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._times: deque[float] = deque(maxlen=NOISE_MEMORY)
        steps = 3  # number of motions in the median motion per scan
        self._steps: deque[tuple[float, Array]] = deque(maxlen=steps)
        self._predictions = np.zeros((2, 3))
        """Predictions from the velocity and from the motion per scan."""
        self._errors = np.zeros(2)
        """Mean squares of their errors; one radian has the weight of one metre."""
        self._accepted = False

    def predict(self, dt: float) -> tuple[Array, Array]:
        """Return the motion in base over the next ``dt`` seconds, and its covariance (3, 3)."""
        self._times.append(dt)
        if self._steps:
            before, last = self._steps[-1]
            max_stretch = 3.0  # maximum factor by which a pause lengthens the last motion
            lasting = last * (min(dt / before, max_stretch) if before > 0 else 0.0)
            self._predictions = np.stack((lasting, np.median([step for _, step in self._steps], axis=0)))
        # Maximum share of the velocity's mean squared error for using the motion per scan: half the error.
        clearly = 0.25
        from_scan_to_scan = bool(self._errors[1] < clearly * self._errors[0])
        # If stamps do not measure the time, at least the usual time has passed.
        seconds = max(dt, sum(self._times) / len(self._times)) if from_scan_to_scan else dt
        place = self._config.odometry_floor[0] + self._config.blind_speed[0] * seconds
        turn = self._config.odometry_floor[1] + self._config.blind_speed[1] * seconds
        return self._predictions[int(from_scan_to_scan)], np.diag((place**2, place**2, turn**2))

    def learn(self, dt: float, moved: Array, match: ScanMatch) -> None:
        """Add the motion ``moved``, shape (3,), in ``dt`` seconds, as measured by the match."""
        before, self._accepted = self._accepted, match.accepted
        # The first motion after a misfit corrects the wrong prediction at the misfit.
        if not (before and match.accepted):
            return
        if self._steps and _is_clear(match):
            errors = np.square(between(self._predictions, moved)).sum(axis=1)
            self._errors += (errors - self._errors) / NOISE_MEMORY
        self._steps.append((dt, moved))


def _is_clear(match: ScanMatch) -> bool:
    """Whether a match measures the motion independently of the prediction."""
    clear_match = (0.15, 0.75)  # minimum degeneracy and overlap of a match for a comparison with odometry
    return match.degeneracy >= clear_match[0] and match.overlap >= clear_match[1]


class MotionPredictor:
    """Predict the motion between two scans, adapt the noise of odometry to the matches, and drop wrong odometry.

    Wheels slip, and many logs stamp odometry and scans with different clocks, so no constant noise fits all. The
    factors follow the root mean square of the innovations (adaptive Kalman filtering, Mehra 1972) of distances and
    turns.

    Args:
        config: initial noise.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._squares = np.ones(2)
        self._odom: Array | None = None
        self._by_odometry: tuple[Array, Array] | None = None
        """Motion by odometry with the wheels' scale, and its covariance."""
        self._raw = np.zeros(3)
        """The same motion unchanged by the scale."""
        self._scale = WheelScale(config.odometry_distance, config.odometry_floor[0])
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
        """Return the predictions that ``predict`` did not choose, and their covariances; none without odometry.

        The predictions always include the scans' own motion: wheels with only valid distances or only valid turns may
        still be wrong at one scan, and would then lose a robot that scans alone would not lose.
        """
        if self._by_odometry is None:
            return ()
        if not self.check.contradicted:
            return (self._by_motion,)
        return (self._by_motion, self._by_odometry) if any(self.check.kept) else (self._by_odometry,)

    def by_wheels(self, delta: Array) -> bool:
        """Whether ``delta``, shape (3,), is the motion by odometry, without contradiction."""
        return self.use is OdometryUse.USED and self._by_odometry is not None and delta is self._by_odometry[0]

    @property
    def odom(self) -> Array | None:
        """Latest pose of base in odom."""
        return self._odom

    @property
    def twist(self) -> Twist2:
        """Velocity of base between the last two scans (vx, vy, wz; m/s, rad/s)."""
        return velocity(self._delta, self._dt)

    def predict(self, dt: float, odom: Array | None) -> tuple[Array, Array]:
        """Return the motion in base over the last ``dt`` seconds, and its covariance (3, 3)."""
        config = self._config
        now = None if odom is None or not np.isfinite(odom).all() else np.array(odom, dtype=float)
        self._given |= odom is not None
        self._seen |= now is not None
        self._missing = self._missing + dt if now is None else 0.0
        delta = None if now is None or self._odom is None else between(self._odom, now)
        if delta is not None and math.hypot(delta[0], delta[1]) > config.fastest[0] * dt + config.fastest[1]:
            delta = None
        self._odom = now
        self._by_odometry = None
        if delta is not None:
            self._raw, delta = delta, delta * (self._scale.factor, self._scale.factor, 1.0)
            self._by_odometry = delta, self._noise(delta)
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
        """Return the covariance, shape (3, 3), of the motion ``delta`` by odometry."""
        config, (by_turn, by_way) = self._config, self._config.odometry_turn
        way, turned = math.hypot(delta[0], delta[1]), abs(float(delta[2]))
        floor = self._moving(delta) * np.array(config.odometry_floor)
        place = self.factors[0] * math.hypot(floor[0], config.odometry_distance * way)
        turn = self.factors[1] * math.hypot(floor[1], math.hypot(by_turn * turned, by_way * way))
        return np.diag((place**2, place**2, turn**2))

    def _moving(self, delta: Array) -> float:
        """Return the share of the minimum noise that is due to the motions by odometry and by the latest scan.

        Late stamps and slip cause errors only during motion: at standstill wheels are exact, and the scans show it.
        """
        still = 0.01  # share at standstill: the resolution of the encoders
        motion = (_lengths(np.stack((delta, self._delta))) / self._config.odometry_floor).max()
        return float(np.clip(motion, still, 1.0))

    def off(self, moved: Array) -> tuple[float, float] | None:
        """Return the difference of ``moved``, shape (3,), from odometry or from the last motion, whichever is nearer.

        Returns:
            Difference beyond two standard deviations of odometry (m, rad); None if odometry is not in use.
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
        # The first motion after a misfit corrects the wrong prediction at the misfit.
        if self._by_odometry is None or not (fitted and self._fitted):
            self.check.interrupt(dt)
            self._scale.interrupt()
            return
        by_odometry = self._by_odometry[0]
        # Along a corridor, the match takes the distance from the prediction and measures only the turn.
        compared = (*self._raw[:2], moved[2]) if match.degenerate else moved
        self.check.add(dt, self._raw, np.array(compared), seen=not match.degenerate)
        if self.check.contradicted:
            self._scale.reset()
        elif _is_clear(match):
            self._scale.add(self._raw, moved)
        else:
            self._scale.interrupt()
        if not _is_clear(match) or delta is not by_odometry:
            return
        off = between(delta, moved)
        fit_noise = (0.01, 0.005)  # standard deviation of a single match, m and rad
        place = (off[0] ** 2 + off[1] ** 2) / 2 / (noise[0, 0] + fit_noise[0] ** 2)
        turn = off[2] ** 2 / (noise[2, 2] + fit_noise[1] ** 2)
        max_innovation = 4.0  # limit of normalised innovations
        innovations = np.minimum((place, turn), max_innovation**2) * np.square(self.factors)
        self._squares += (innovations - self._squares) / NOISE_MEMORY


UNCONSTRAINED: Final = np.diag((1e-4, 1e-4, 1e-2))
"""Added to every information matrix: unconstrained directions get a standard deviation of 100 m or 10 rad."""


class UsualOverlap:
    """Running mean of the overlap of good matches."""

    def __init__(self) -> None:
        self._mean = 0.0

    @property
    def least(self) -> float:
        """Overlap below which a match overlaps clearly less than usual; negative before the first match."""
        return self._mean - 0.15

    def take(self, overlap: float) -> None:
        """Add the overlap of a good match."""
        self._mean += (overlap - self._mean) * (0.05 if self._mean else 1.0)


class ScanOdometry:
    """Scan odometry: motion between successive matches from the scans alone.

    With odometry, only matches with good overlap give a motion, and none across a rejected match: the robot may have
    been carried, and a partial fit at a wrong place must not be used before the overlap is back at its mean. Without
    odometry, rejected matches are skipped, and every accepted one is used.
    """

    def __init__(self) -> None:
        self._last: tuple[int, Array] | None = None
        self._usual = UsualOverlap()
        self._least = LOW_OVERLAP

    def take(
        self, stamp: int, match: ScanMatch, pose: Array, *, alone: bool, corrected: bool = False
    ) -> ScanIncrement | None:
        """Return the motion since the last used match; None if this one is not used.

        Args:
            stamp: stamp of the scan (ns).
            match: result of scan matching; its covariance includes the prediction, its information does not.
            pose: pose after the step, including a loop closure in it, shape (3,).
            alone: whether there is no odometry.
            corrected: whether a loop closure moved the map in this step; the next motion then starts at ``pose``.
        """
        if match.information is None or not (alone or match.overlap >= self._least):
            self._least = max(LOW_OVERLAP, self._usual.least)
            if corrected or not alone:
                self._last = None
            return None
        self._least = LOW_OVERLAP
        self._usual.take(match.overlap)
        last, self._last = self._last, (stamp, pose.copy() if corrected else match.pose)
        if last is None:
            return None
        since, origin = last
        turn = np.eye(3)
        turn[:2, :2] = rotation(-match.pose[2])
        covariance = turn @ np.linalg.inv(constrained(match, match.information) + UNCONSTRAINED) @ turn.T
        match_floor = (0.002, 0.001)  # minimum standard deviation of a match, m and rad
        covariance = (covariance + covariance.T) / 2 + np.diag(
            np.square((match_floor[0], match_floor[0], match_floor[1]))
        )
        x, y, yaw = between(origin, match.pose).tolist()
        return ScanIncrement(since, (x, y, yaw), tuple(covariance.ravel().tolist()))

    def forget(self) -> None:
        """Restart without a previous match."""
        self._last, self._least = None, LOW_OVERLAP


def constrained(match: ScanMatch, information: Array) -> Array:
    """Return the ``information``, shape (3, 3), of a match, without the weak direction's component if degenerate.

    That component comes from the ends of the visible walls, which move along with the robot.
    """
    if not match.degenerate:
        return information
    along = np.array((math.cos(match.direction), math.sin(match.direction), 0.0))
    weight = information @ along
    return information - np.outer(weight, weight) / max(float(along @ weight), 1e-9)


def without_weak_direction(match: ScanMatch, guess: Array, covariance: Array) -> ScanMatch:
    """Replace pose and covariance of a degenerate match along its weak direction by the values of ``guess``."""
    if match.information is None or not match.degenerate:
        return match
    information = constrained(match, match.information)
    posterior = np.linalg.inv(information + np.linalg.inv(covariance))
    pose = guess + posterior @ information @ difference(match.pose, guess)
    return replace(match, pose=pose, covariance=posterior)


OFFSET_LEAST_SCANS: Final = 120
"""Minimum number of scans."""


class ClockOffsetEstimator:
    """Estimate a constant offset between the clocks of odometry and scans, as in logs with badly stamped wheels.

    The matches' yaw rate is correlated with odometry's at shifted times; the lag with the best correlation is the
    offset. Only the yaw is used: both sources measure it best.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float, float]] = deque(maxlen=300)  # number of compared scans
        self._seen = 0
        self.offset: float | None = None
        """Lead of odometry over the scans (s); None if unknown or zero."""

    def add(self, stamp: int, matched: float, odom: float) -> None:
        """Add the yaw of an accepted match and of odometry (rad) at ``stamp`` (ns); both are ignored unless finite."""
        if not math.isfinite(odom):
            return
        self._samples.append((stamp, matched, odom))
        self._seen += 1
        offset_period = 40  # scans between two estimates
        if self._seen % offset_period == 0 and len(self._samples) >= OFFSET_LEAST_SCANS:
            self.offset = find_offset(*(np.array(column) for column in zip(*self._samples, strict=True)))


def find_offset(stamps: Array, matched: Array, odom: Array) -> float | None:
    """Return the lead of ``odom`` over ``matched`` (s); None without a clear offset.

    Args:
        stamps: rising stamps, shape (n,) (ns).
        matched: yaw by the scans, shape (n,) (rad).
        odom: yaw by the wheels, shape (n,) (rad).
    """
    times = (stamps - stamps[0]) / SECOND
    wheel, scan = np.unwrap(odom), np.unwrap(matched)
    offset_lags = np.arange(-12, 13) * 0.05  # tried offsets, s
    margin = float(offset_lags[-1])
    inside = (times[:-1] >= margin) & (times[1:] <= times[-1] - margin)
    steps = np.diff(times)[inside]
    turning = np.diff(scan)[inside] / steps if len(steps) else np.zeros(0)
    if len(turning) < OFFSET_LEAST_SCANS // 2 or _is_steady(turning):
        return None
    likeness = np.array([_correlation(turning, times, wheel, lag, inside) for lag in offset_lags])
    best = int(np.argmax(likeness))
    if not 0 < best < len(offset_lags) - 1 or likeness[best] < 0.8:  # minimum correlation at the offset
        return None
    before, peak, after = likeness[best - 1 : best + 2].tolist()
    step = float(offset_lags[1] - offset_lags[0])
    lag = float(offset_lags[best]) + step * (before - after) / (2.0 * (before - 2.0 * peak + after))
    at, sooner, later = (_turning(times, wheel, shifted, inside) for shifted in (lag, lag - step, lag + step))
    gain = float((turning - turning.mean()) @ (at - at.mean())) / max(float(at.var()) * len(at), 1e-9)
    residuals = turning - turning.mean() - gain * (at - at.mean())
    slopes = gain * (later - sooner) / (2.0 * step)
    # Neighbouring scans have correlated errors, blocks of them do not.
    blocks = np.add.reduceat(residuals * slopes, np.arange(0, len(slopes), 20))
    deviation = float(np.linalg.norm(blocks)) / max(float(slopes @ slopes), 1e-9)
    # Interpolation between scans smooths odometry, which favours shifts by half of their period.
    smoothing = float(np.median(np.diff(times))) / 2.0
    return -lag if abs(lag) > max(smoothing, 3.0 * deviation) else None


def _turning(times: Array, wheel: Array, lag: float, inside: NDArray[np.bool_]) -> Array:
    """Return wheel yaw rates between consecutive ``times`` shifted by ``lag`` (s), where ``inside``."""
    return np.asarray((np.diff(np.interp(times + lag, times, wheel)) / np.diff(times))[inside])


def _correlation(turning: Array, times: Array, wheel: Array, lag: float, inside: NDArray[np.bool_]) -> float:
    turned = _turning(times, wheel, lag, inside)
    if _is_steady(turned):
        return 0.0
    return float(np.mean((turning - turning.mean()) * (turned - turned.mean())) / (turning.std() * turned.std()))


def _is_steady(rates: Array) -> bool:
    """Whether yaw rates (rad/s) vary too little to show a shift in time."""
    return bool(rates.std() < 0.05)
