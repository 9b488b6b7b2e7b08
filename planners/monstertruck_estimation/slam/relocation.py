"""Relocalisation: detects that scans no longer fit the map, and finds the place of the new submap in that map.

A robot that was carried fits nowhere near its predicted pose. Its scans start a separate submap, which odometry does
not join to the map. The surroundings of the latest keyframe are searched for in every other submap, the map first
(branch and bound, one slice of yaws per scan, so that no scan waits for the whole search). A place found is verified
like every loop closure, and joins both submaps only with the support of matches from other places. A submap whose place
was not found at first is found when the robot returns to it, from the map or from a later submap.

A join may still be wrong, because a similar-looking room fits equally well. A join therefore stays unconfirmed while
the robot continues, and is undone if later observations of both sides contradict it, or if the robot is lost again.
"""

import math
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.budget import Pieces, PiecewiseSearch, ScanBudget, Work, finished
from monstertruck_estimation.slam.closure import CONTRADICTION, VIEW, LoopCloser, contradiction, opposed, surroundings
from monstertruck_estimation.slam.correlation import PIECE, Peak, Submap, correlate, look_ups
from monstertruck_estimation.slam.keyframes import Join, KeyframeMap
from monstertruck_estimation.slam.motion import UsualOverlap
from monstertruck_estimation.slam.scan_matcher import LIKELY, LOW_OVERLAP, ScanMatch, deviations, off_guess
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND

PERIOD_GAIN: Final = 0.1
"""Weight of one period in the usual period."""


class LossDetector:
    """Detect that scans no longer fit the map.

    After a misfit or a gap the overlap must return to nearly its mean, and after a gap the match must constrain all
    directions: a partial fit, or one wall, occurs in many places. The mapper decides whether the match looks through
    walls of the map and whether it agrees with the motion: rooms of one shape overlap everywhere.
    """

    def __init__(self) -> None:
        self._stamp: int | None = None
        self.fitted = 0
        """Stamp of the last scan that fitted (ns)."""
        self._period = 0.0
        self._usual = UsualOverlap()
        self._misfits = 0
        self._spacing, self._path = 0.0, 0.0
        self.after_gap = False
        """Whether no scan has fitted since a gap."""

    @property
    def fits(self) -> bool:
        """Whether the latest scan fits."""
        return not self._misfits and not self.after_gap

    def doubts(self, match: ScanMatch) -> bool:
        """Whether a match follows a misfit, or overlaps clearly less than usual."""
        return not self.fits or match.overlap < self._usual.least

    def suspects(self, match: ScanMatch, guess: Array, covariance: Array) -> bool:
        """Whether an accepted ``match`` overlaps clearly less than usual, and is far from the predicted pose.

        Such a match is at a place that only looks similar. ``guess``, shape (3,), has ``covariance``, shape (3, 3).
        """
        if not match.accepted or match.overlap >= self._usual.least:
            return False
        return off_guess(match.pose, guess, covariance) > LIKELY

    @property
    def sparse(self) -> bool:
        """Whether scans are a keyframe's distance apart by wheels that agree with them."""
        return self._spacing >= 1.0

    @property
    def lost(self) -> bool:
        """Whether scans have not fitted for 1.5 s."""
        since = (self._stamp or 0) - self.fitted
        # Distance travelled until the robot is lost, by wheels that agree with sparse scans, as a multiple of the
        # distance between keyframes. Three scans so far apart, or a turn among people, may show the same crowd. By
        # default it is 2.1 m, less than ``VIEW``: a submap that begins there still shares surroundings with the last
        # keyframe.
        lost_path = 7.0
        far = not self.sparse or self.after_gap or self._path >= lost_path
        lost_after = 1.5  # maximum duration of misfits (s); then the robot is lost
        lost_scans = 3  # maximum number of misfits; then the robot is lost
        return self._misfits >= lost_scans and since >= lost_after * SECOND and far

    def arrive(self, stamp: int) -> None:
        """Register the arrival of a scan with ``stamp`` (ns) that will be matched."""
        if self._stamp is not None:
            dt = (stamp - self._stamp) / SECOND
            # A gap is a pause longer than this (s) and than this multiple of the usual one: the robot may then be
            # elsewhere.
            gap = (5.0, 3.0)
            self.after_gap |= dt > max(gap[0], gap[1] * self._period)
            self._period += (dt - self._period) * (PERIOD_GAIN if self._period else 1.0)
        self._stamp = stamp

    def take(self, match: ScanMatch, moved: tuple[float, float] = (0.0, 0.0), *, led: bool = False) -> None:
        """Add the match of the scan that arrived.

        Args:
            match: match of the scan.
            moved: distance, and motion, since the previous scan by wheels that agree with the scans, as multiples of
                the distance and motion between keyframes; 0 without such wheels.
            led: whether the match agrees with the motion (by wheels over a gap or between sparse scans), or the rest of
                its view is new: it then fits, however little of its view is known.
        """
        self._path += moved[0]
        self._spacing += (moved[1] - self._spacing) * PERIOD_GAIN
        if led:
            self.restart()
            return
        if self.misfits(match):
            self._misfits += 1
            return
        self._usual.take(match.overlap)
        self.restart()

    def misfits(self, match: ScanMatch) -> bool:
        """Whether ``match`` overlaps too little; after a misfit or a gap, clearly less than usual."""
        doubt = self._misfits or self.after_gap
        least = max(LOW_OVERLAP, self._usual.least) if doubt else LOW_OVERLAP
        return not match.accepted or match.overlap < least or (self.after_gap and match.degenerate)

    def restart(self) -> None:
        """Treat the latest scan as fitting, because it has become part of the map."""
        self._misfits, self.after_gap, self.fitted, self._path = 0, False, self._stamp or 0, 0.0


def prediction_is_certain(covariance: Array) -> bool:
    """Whether the ``covariance``, (3, 3), of a predicted pose is small enough to rule out any other place.

    A match in a wider window is one of possibly several fitting places.
    """
    return all(_certain(covariance))


def _certain(covariance: Array) -> tuple[bool, bool]:
    """Whether position and yaw of a predicted pose are certain enough for a match near it after a gap."""
    place, turn = deviations(covariance)
    return place <= 0.5, turn <= 0.5  # m, rad


def led_there(match: ScanMatch, guess: Array, covariance: Array) -> bool:
    """Whether ``match`` agrees with wheels over a gap: with ``guess``, shape (3,), and ``covariance``, shape (3, 3).

    The wheels must know the position; the scan may correct a yaw that a turn over the gap has made uncertain.
    """
    # Maximum Mahalanobis distance from the predicted pose of a match that agrees with the wheels. Half of the correct
    # matches are that near (chi-square of three degrees of freedom: 48 %), and one in fifteen of the wrong ones, which
    # are spread over the matcher's window of three standard deviations on each axis (a ball in a cube).
    led = 1.5
    return off_guess(match.pose, guess, covariance) <= led and _certain(covariance)[0]


def exceeds(off: tuple[float, float], limits: tuple[float, float]) -> bool:
    """Whether a difference exceeds ``limits`` (m, rad)."""
    return off[0] > limits[0] or off[1] > limits[1]


def contradicts(keyframes: KeyframeMap, scan: Scan, pose: Array, most: float = CONTRADICTION) -> bool:
    """Whether ``scan`` at ``pose``, shape (3,), and the keyframes around it contradict each other.

    They do if more than a share ``most`` of the beams of either pass through walls of the other. Areas not seen by any
    keyframe contradict nothing: the robot may have crossed them by odometry alone.
    """
    own = np.flatnonzero(keyframes.part == keyframes.part[-1])
    off = keyframes.poses[own, :2] - pose[:2]
    far = np.hypot(off[:, 0], off[:, 1])
    order = np.argsort(far, kind="stable")[:6]  # maximum number of keyframes for comparison with a scan
    near = own[order[far[order] <= keyframes.config.local_reach]]
    if not len(near):
        return False
    scans = [keyframes.frames[k].scan for k in near]
    return contradiction([scan], pose[None], scans, keyframes.poses[near]) > most


MAX_RIVAL: Final = 0.9
"""A place is ambiguous if a second one scores more than this share of its score."""
APART: Final = (1.0, 0.5)
"""Minimum difference of two distinct places (m, rad)."""


class JoinChange(StrEnum):
    """Change made by a search."""

    JOINED = "joined"
    PARTED = "parted"


class Relocation:
    """Join submaps: the latest keyframe's to the map, and other open ones to the robot's current submap.

    A join is checked at every keyframe until it is confirmed.
    """

    def __init__(self) -> None:
        self._submaps: dict[int, tuple[int, Array, Submap]] = {}
        """Per part: its keyframes, the pose of the first one, and their surfaces, all at the time of the merge."""
        self._progress: PiecewiseSearch[Join | JoinChange | None] | None = None
        self._last = -1

    @property
    def busy(self) -> bool:
        """Whether a search is running."""
        return self._progress is not None

    def step(self, keyframes: KeyframeMap, closer: LoopCloser, budget: ScanBudget) -> JoinChange | None:
        """Continue the search, or the check of a join; return whether submaps were joined or parted.

        Both move poses; a place found moves a submap.
        """
        newest = len(keyframes) - 1
        if self._progress is None:
            if newest == self._last or not (keyframes.doubtful or _others(keyframes, newest)):
                return None
            self._last = newest
            self._progress = PiecewiseSearch(self._examined(keyframes, closer, newest))
        if not self._progress.run(budget):
            return None
        found, self._progress = self._progress.result, None
        return self._part(keyframes, closer, found) if isinstance(found, Join) else found

    def part(self, keyframes: KeyframeMap, closer: LoopCloser) -> JoinChange | None:
        """Undo all joins in doubt."""
        return self._part(keyframes, closer, keyframes.doubtful[0]) if keyframes.doubtful else None

    def _part(self, keyframes: KeyframeMap, closer: LoopCloser, join: Join) -> JoinChange:
        keyframes.separate(join)
        closer.forget(np.ones(len(keyframes), bool))
        self.forget()
        return JoinChange.PARTED

    def _examined(self, keyframes: KeyframeMap, closer: LoopCloser, at: int) -> Pieces[Join | JoinChange | None]:
        """Check the joins in doubt, then search for keyframe ``at``; return a wrong join, or the change made."""
        for join in tuple(keyframes.doubtful):
            own, others = keyframes.sides(join)
            if (yield from opposed(keyframes, own, others)):
                return join
            # Distance near keyframes of the other side (m) after which a join without contradiction is confirmed.
            confirming = 10.0
            if _way_along(keyframes, own[own >= join.since], others) >= confirming:
                keyframes.doubtful.remove(join)
        return (yield from self._joined(keyframes, closer, at))

    def finish(self, keyframes: KeyframeMap, closer: LoopCloser) -> bool:
        """Search for every open submap in all others, without a budget; return whether submaps were joined."""
        self.forget()
        joined = False
        while any(finished(self._joined(keyframes, closer, at)) for at in _samples(keyframes)):
            joined = True
        keyframes.doubtful.clear()
        return joined

    def forget(self) -> None:
        """Forget the search, because the keyframes were renumbered."""
        self._submaps, self._progress, self._last = {}, None, -1

    def _joined(self, keyframes: KeyframeMap, closer: LoopCloser, at: int) -> Pieces[JoinChange | None]:
        """Place the surroundings of keyframe ``at`` in the other submaps, and verify them there.

        A place is rejected when most of the verified keyframes do not fit.
        """
        for part in _others(keyframes, at):
            pose = yield from self._place(keyframes, at, part)
            if pose is None:
                continue
            keyframes.place(at, pose, part)
            failed, (keys, other) = 0, _checks(keyframes, at, part)
            for key in keys:
                found = yield from closer.join(keyframes, key, other)
                if found:
                    return JoinChange.JOINED
                failed += found is None
                if failed > 3:  # maximum number of failed verifications; then the place is rejected
                    break
        return None

    def _place(self, keyframes: KeyframeMap, at: int, part: int) -> Pieces[Array | None]:
        """Return the place of keyframe ``at``'s surroundings in submap ``part``; None if there is none or several."""
        origin, submap = yield from self._submap(keyframes, part)
        levels = 7  # levels of the pyramid of the whole map
        yield submap.grid_cost(levels)
        grid, cloud = submap.grid(levels), submap.cloud
        low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
        middle, half = (low + high) / 2, float((high - low).max() / 2) + 1.0
        _, query = surroundings(keyframes, at)
        points = query.points[np.linspace(0, len(query) - 1, min(len(query), 160)).astype(np.intp)]
        fewest_slices = 4  # minimum number of slices of a search
        slices = max(math.ceil(look_ups(points, (half, math.pi), levels) / PIECE), fewest_slices)
        peaks: list[Peak] = []
        work = 15_000  # maximum number of blocks evaluated below the first level in one slice
        anywhere = (1e6, 1e6)  # standard deviation of the unknown pose, m and rad
        min_score = 0.5  # minimum mean likelihood of a place found
        for k in range(slices):
            yield PIECE + work * len(points)
            guess = np.array((*middle, (k + 0.5) * math.tau / slices))
            least = max(min_score, MAX_RIVAL * max((peak.score for peak in peaks), default=0.0))
            peak = correlate(grid, points, guess, (half, math.pi / slices), anywhere, least, work=work)
            peaks += [] if peak is None else [peak]
        best = _unique(peaks)
        if best is None:
            return None
        # Search again around the best place for a similar one in the same direction.
        window = half, 0.1  # half width of the search for a rival of similar direction, rad
        yield look_ups(points, window, levels)
        peak = correlate(grid, points, best, window, anywhere, min_score, APART[0], work)
        if peak is None or peak.rival > MAX_RIVAL * peak.score:
            return None
        return compose(keyframes.poses[part], between(origin, peak.pose))

    def _submap(self, keyframes: KeyframeMap, part: int) -> Pieces[tuple[Array, Submap]]:
        """Return the keyframes of ``part``, merged again after growth, and the pose of its first one at that time."""
        numbers = np.flatnonzero(keyframes.part == part)
        known = self._submaps.get(part)
        if known is None or known[0] != len(numbers):
            part_keys = 300  # maximum number of keyframes of the map, or of a submap, in a search
            kept = numbers[np.linspace(0, len(numbers) - 1, min(len(numbers), part_keys)).astype(np.intp)]
            yield Work.ELEMENT * sum(len(keyframes.frames[k].scan) for k in kept)
            known = self._submaps[part] = len(numbers), keyframes.poses[part], keyframes.submap(kept)
        return known[1:]


def _way_along(keyframes: KeyframeMap, own: NDArray[np.intp], others: NDArray[np.intp]) -> float:
    """Return the distance (m) along those of ``own`` that are near ``others``."""
    off = keyframes.poses[own, None, :2] - keyframes.poses[others, :2]
    met = own[np.hypot(off[..., 0], off[..., 1]).min(axis=1, initial=math.inf) < VIEW]
    return float(np.hypot(*np.diff(keyframes.poses[met, :2], axis=0).T).sum())


def _others(keyframes: KeyframeMap, at: int) -> list[int]:
    """Return the submaps that keyframe ``at``'s submap may be joined to, the map first, then the latest."""
    parts, counts = np.unique(keyframes.part, return_counts=True)
    fewest_keys = 2  # minimum number of keyframes of a submap in a search
    if counts[parts == keyframes.part[at]] < fewest_keys:
        return []
    others = parts[(parts != keyframes.part[at]) & (counts >= fewest_keys)]
    return sorted(others.tolist(), key=lambda part: -part if part else -math.inf)


def _samples(keyframes: KeyframeMap) -> list[int]:
    """Return keyframes of every open submap, evenly chosen."""
    parts = [np.flatnonzero(keyframes.part == part) for part in np.unique(keyframes.part[~keyframes.joined()])]
    last_keys = 12  # maximum number of keyframes per open submap searched for at the end of a run
    chosen = [own[np.linspace(0, len(own) - 1, min(len(own), last_keys)).astype(np.intp)] for own in parts]
    return [int(k) for own in chosen for k in own]


def _checks(keyframes: KeyframeMap, at: int, part: int) -> tuple[list[int], int]:
    """Return the keyframes to verify after submap ``part`` was aligned with keyframe ``at``'s, and the other submap.

    They come from the smaller submap, whose views the greater one should share: first those at the place of ``at``, and
    only those near keyframes of the other submap.
    """
    submaps = [np.flatnonzero(keyframes.part == one) for one in (keyframes.part[at], part)]
    few, many = sorted(submaps, key=len)
    off = keyframes.poses[few, None, :2] - keyframes.poses[many, :2]
    near = few[np.hypot(off[..., 0], off[..., 1]).min(axis=1) < VIEW]
    there = keyframes.poses[few, :2] - keyframes.poses[at, :2]
    middle = few[np.argmin(np.hypot(there[:, 0], there[:, 1]))]
    checks = 10  # maximum number of keyframes verified at a place found
    check_spacing = 2  # step between these keyframes
    near = near[np.abs(near - middle) <= checks * check_spacing]
    near = near[np.argsort(np.abs(near - middle), kind="stable")][: checks * check_spacing : check_spacing]
    return near.tolist(), int(keyframes.part[many[0]])


def _unique(peaks: list[Peak]) -> Array | None:
    """Return the best pose if no other place scores nearly as well."""
    if not peaks:
        return None
    best = max(peaks, key=lambda peak: peak.score)
    for peak in peaks:
        off = between(best.pose, peak.pose)
        elsewhere = math.hypot(off[0], off[1]) > APART[0] or abs(off[2]) > APART[1]
        if elsewhere and peak.score > MAX_RIVAL * best.score:
            return None
    return best.pose
