"""Localisation in a saved map: tracking by scan matching; the whole map is searched for a robot of unknown place.

What the search finds is compared with the whole map again over the next metres, and every match with the saved grid:
a match that fits walls, but whose beams cross others, is none. Beams that end where the map knows nothing are not
matched: at the edge of the map they count neither for a pose nor against it.
"""

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.correlation import Submap, merged
from monstertruck_estimation.slam.global_search import GlobalLocaliser
from monstertruck_estimation.slam.map_evidence import EvidenceGrid
from monstertruck_estimation.slam.mapping import LOST_AFTER, estimate, fits, status_of
from monstertruck_estimation.slam.motion import ClockOffsetEstimator, MotionPredictor, ScanOdometry, constrained
from monstertruck_estimation.slam.registration import Cloud
from monstertruck_estimation.slam.scan_matcher import (
    MatchStatus,
    PlanarMatcher,
    ScanMatch,
    deviations,
    rejected,
)
from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.storage import SavedGraph, SavedMap, surface_elements
from monstertruck_estimation.slam.worker_io import GridPatch, ScanInput, SlamEstimate
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2, between, compose, compose_jacobians, inverse
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.health import LocalisationStatus, OdometryUse

FOUND_COVARIANCE: Final = np.diag(np.square((0.05, 0.05, 0.02)))
"""Covariance of a pose found by global localisation, m^2 and rad^2."""
MATCH_COVARIANCE: Final = np.diag(np.square((0.02, 0.02, 0.01)))
"""Covariance of a match itself, m^2 and rad^2."""
MAX_CONTRADICTION: Final = 0.3
"""Greatest share of beams that contradict the saved grid of a match that counts: people and new furniture do, too."""

Predicted = tuple[Array, Array, Array]
"""Pose by the predicted motion, shape (3,), and covariances, (3, 3): of the window of its match, and as published."""


def submap_of(saved: SavedMap) -> Submap:
    """All surfaces of a saved map.

    Raises:
        InputError: it has none.
    """
    if saved.graph is not None and saved.graph.scans:
        return Submap(Cloud.of(merged(saved.graph.scans, saved.graph.poses)))
    surfaces = surface_elements(saved.grid)
    if not len(surfaces):
        raise InputError("the map has no occupied cells next to free ones: nothing to localise in")
    return Submap(Cloud.of(surfaces))


class LocalisationEstimator:
    """An ``Estimator`` in a saved map.

    Args:
        saved: the map.
        config: noise models.
        start: base in map, if known approximately; None = anywhere.
    """

    def __init__(self, saved: SavedMap, config: MapperConfig, start: Pose2 | None = None) -> None:
        self._saved = saved
        self._config = config
        self._submap = submap_of(saved)
        self._front = PlanarMatcher()
        self._motion = MotionPredictor(config)
        self._evidence = EvidenceGrid(saved.grid)
        self._global = self._search_anew() if start is None else None
        self._tracking = start is not None
        """Whether the place is known; with a search under way it is being checked."""
        self._checked = 0.0
        """Distance since the place was found, m."""
        self._pose = np.array(start or (0.0, 0.0, 0.0))
        self._covariance = np.diag((0.2**2, 0.2**2, 0.1**2))
        """Of the pose as the matches have it: of the window of the next one."""
        self._published_covariance = self._covariance
        """That of the predicted motion where matches do not count, and along the weak direction of degenerate ones."""
        self._stamp: int | None = None
        self._misfits = 0
        """Matches in a row that do not count."""
        self._blind = False
        """Whether the last match left a direction open."""
        self._published = False
        self._offset = ClockOffsetEstimator()
        self._scan_odometry = ScanOdometry()
        self.counts = {"scans": 0, "keys": 0, "closures": 0, "rejected": 0, "searches": int(start is None)}

    @property
    def twist(self) -> Twist2:
        """See ``Estimator``."""
        return self._motion.twist

    @property
    def odometry(self) -> OdometryUse:
        """See ``Estimator``."""
        return self._motion.use

    def step(self, scan: Scan, inputs: ScanInput) -> SlamEstimate | None:
        """See ``Estimator``."""
        stamp = inputs.stamp
        if self._stamp is not None and stamp <= self._stamp:
            return None
        odom = None if inputs.odom is None else np.array(inputs.odom)
        dt = 0.0 if self._stamp is None else (stamp - self._stamp) / SECOND
        delta, noise = self._motion.predict(dt, odom)
        guess = compose(self._pose, delta)
        by_pose, by_delta = compose_jacobians(self._pose, delta)
        moved_by = by_delta @ noise @ by_delta.T
        covariance = by_pose @ self._covariance @ by_pose.T + moved_by
        published = by_pose @ self._published_covariance @ by_pose.T + moved_by
        self._stamp = stamp
        self.counts["scans"] += 1
        events: tuple[str, ...] = ()
        mount = inputs.mount
        found = None if self._global is None else self._global.step(scan, stamp, odom, mount)
        if not self._tracking:
            match, status = self._unknown(guess, covariance)
            if found is not None:
                match, status = self._found(scan, found, mount)
                published = FOUND_COVARIANCE
                events = ("found",)
                self._scan_odometry.forget()
        else:
            match, status = self._track(scan, delta, (guess, covariance, published), mount)
            # By scans alone the first match behind a corridor makes up for an error there: that is no velocity.
            blind, self._blind = self._blind, match.degenerate
            if not blind or match.degenerate or self.odometry is OdometryUse.USED:
                self._motion.learn(dt, delta, noise, between(self._pose, match.pose), match)
            events = () if match.accepted else ("rejected",)
            if self._global is not None and self._refuted(match.pose, found, delta):
                match, status = self._unknown(guess, covariance)
                events = ("refuted",)
        alone = odom is None or self.odometry is not OdometryUse.USED
        moved = self._scan_odometry.take(stamp, match, match.pose, alone=alone)
        self._pose, self._covariance = match.pose, match.covariance
        if match.information is not None and not self._misfits:
            published = np.linalg.inv(constrained(match, match.information) + np.linalg.inv(published))
        self._published_covariance = published
        if inputs.odom is not None and match.accepted:
            self._offset.add(stamp, float(match.pose[2]), inputs.odom[2])
        odom_now = self._motion.odom
        correction = None if odom is None or odom_now is None else compose(self._pose, inverse(odom_now))
        placed = (self._pose, published, correction)
        return estimate(stamp, placed, match, status, events, self._offset.offset, moved, self.odometry)

    def changes(self) -> tuple[list[GridPatch], bool]:
        """See ``Estimator``: a saved map never changes, but is published once."""
        published, self._published = self._published, True
        return [], not published

    def patch(self) -> GridPatch:
        """See ``Estimator``."""
        return patch_of(self._saved)

    def graph(self) -> SavedGraph | None:
        """See ``Estimator``."""
        return self._saved.graph

    def trajectory(self) -> None:
        """See ``Estimator``: the poses were estimated one by one."""

    def on_map(self) -> None:
        """See ``Estimator``."""

    def poses_at(self, _stamps: NDArray[np.int64]) -> None:
        """See ``Estimator``."""

    def finish(self) -> bool:
        """See ``Estimator``: there is nothing to optimise."""
        return False

    def _track(
        self, scan: Scan, delta: Array, predicted: Predicted, mount: Pose2
    ) -> tuple[ScanMatch, LocalisationStatus]:
        guess, covariance, _ = predicted
        alone = self.odometry is not OdometryUse.USED
        matched = self._matched_alone if alone else self._matched
        match, good = matched(scan, delta, predicted, mount)
        if not good:
            # The predicted motion may be wrong: by a late odometry, or by stamps that are not those of the scans.
            before = compose(guess, inverse(delta)), *predicted[1:]
            still, good = matched(scan, np.zeros(3), before, mount)
            # Half a fit near the prediction says more than scans alone do, but less than wheels.
            if good or (alone and _strayed(match, guess) and not _strayed(still, before[0])):
                match, guess = still, before[0]
        if match.accepted and not good and (not alone or _strayed(match, guess)):
            match = rejected(guess, covariance, MatchStatus.FAR)
        place, turn = deviations(match.covariance)
        # New obstacles lower the overlap; only a pose of large covariance is searched for.
        self._misfits = 0 if good else self._misfits + 1
        self.counts["rejected"] += not match.accepted
        # Standard deviation from which the robot is searched for on the whole map, m and rad.
        lost_deviation = (1.0, 0.5)
        if self._misfits >= 3 * LOST_AFTER or place > lost_deviation[0] or turn > lost_deviation[1]:
            self._global, self._tracking = self._search_anew(), False
            self.counts["searches"] += 1
            return match, LocalisationStatus.SEARCHING
        lost = self._misfits >= LOST_AFTER and not match.accepted
        return match, LocalisationStatus.LOST if lost else status_of(match, LocalisationStatus.LOCALISED)

    def _matched_alone(self, scan: Scan, delta: Array, predicted: Predicted, mount: Pose2) -> tuple[ScanMatch, bool]:
        """Match all beams, for the motion is known too badly to say which end on mapped ground."""
        match = self._front.match(scan, delta, *predicted[:2], self._submap)
        contradiction = self._evidence.judge(match.pose, scan.points, np.array(mount[:2])).contradiction
        if not (fits(match) and contradiction <= MAX_CONTRADICTION):
            return match, False
        return _without_weak_direction(match, predicted[0], predicted[2]), True

    def _matched(self, scan: Scan, delta: Array, predicted: Predicted, mount: Pose2) -> tuple[ScanMatch, bool]:
        """Match the beams that end on mapped ground; whether the match counts."""
        guess, covariance, published = predicted
        sensor = np.array(mount[:2])
        mapped = self._evidence.judged(guess, scan.points, sensor)
        share = float(mapped.mean()) if len(mapped) else 0.0
        if share < 0.65:  # least share of a scan's beams that end on mapped ground
            return rejected(guess, covariance, MatchStatus.EMPTY), False
        whole = share >= 0.95  # share of beams on mapped ground from which on all beams are matched
        seen = scan if whole else scan.chosen(mapped)
        match = self._front.match(seen, delta, guess, covariance, self._submap)
        contradiction = self._evidence.judge(match.pose, seen.points, sensor).contradiction
        # Least overlap of the beams on mapped ground where others do not end there, and of a match far from the motion.
        partial_overlap = 0.8
        # Greatest share of these beams that contradict the saved grid: few walls fit in many places.
        partial_contradiction = 0.15
        clear = match.overlap >= partial_overlap and contradiction <= partial_contradiction
        if _far(match.pose, guess, published):
            good = clear and whole and not match.degenerate
        else:
            good = contradiction <= MAX_CONTRADICTION and (clear or whole)
        if not (good and fits(match)):
            return match, False
        return _without_weak_direction(match, guess, published), True

    def _search_anew(self) -> GlobalLocaliser:
        return GlobalLocaliser(self._submap, self._evidence, self._config)

    def _unknown(self, guess: Array, covariance: Array) -> tuple[ScanMatch, LocalisationStatus]:
        outside = self._global is not None and self._global.outside
        status = LocalisationStatus.OUTSIDE if outside else LocalisationStatus.SEARCHING
        return rejected(guess, covariance, MatchStatus.EMPTY), status

    def _found(self, scan: Scan, pose: Array, mount: Pose2) -> tuple[ScanMatch, LocalisationStatus]:
        """Track from ``pose``; the search goes on, as a check."""
        self._tracking, self._checked, self._misfits = True, 0.0, 0
        return self._track(scan, np.zeros(3), (pose, FOUND_COVARIANCE, FOUND_COVARIANCE), mount)

    def _refuted(self, pose: Array, found: Array | None, delta: Array) -> bool:
        """Whether the check says that the robot is not at ``pose``; it ends when it has confirmed the place."""
        assert self._global is not None
        self._checked += math.hypot(delta[0], delta[1])
        if (found is None or not _apart(pose, found)) and not self._global.outside:
            # Distance after which the search that confirms a place found ends, and after which it ends without having
            # done so, m.
            checked_way = (3.0, 9.0)
            if self._checked >= checked_way[0 if found is not None else 1]:
                self._global = None
            return False
        self._global, self._tracking = self._search_anew(), False
        self.counts["searches"] += 1
        return True


def _without_weak_direction(match: ScanMatch, guess: Array, covariance: Array) -> ScanMatch:
    """A degenerate match has its pose along the weak direction from ``guess``, whose ``covariance`` is that there."""
    if match.information is None or not match.degenerate:
        return match
    information = constrained(match, match.information)
    gain = np.linalg.solve(information + np.linalg.inv(covariance), information)
    return replace(match, pose=guess + gain @ _difference(match.pose, guess))


def _far(pose: Array, guess: Array, covariance: Array) -> bool:
    """Whether ``pose`` is further from ``guess``, of ``covariance``, than its motion and a match can be."""
    off = _difference(pose, guess)
    distance = math.sqrt(float(off @ np.linalg.solve(covariance + MATCH_COVARIANCE, off)))
    far = 3.0  # standard deviations of the predicted pose from which a match is far from the motion
    return distance > far or _apart(pose, guess)


def _difference(pose: Array, other: Array) -> Array:
    off = pose - other
    off[2] = math.remainder(off[2], math.tau)
    return off


def _strayed(match: ScanMatch, guess: Array) -> bool:
    """Whether a match is rejected, or not of the place where it began."""
    return not match.accepted or _apart(match.pose, guess)


def _apart(one: Array, other: Array) -> bool:
    """Whether two poses are not of the same place."""
    off = between(one, other)
    same_place = (0.5, 0.2)  # two poses are of the same place if they differ by less, m and rad
    return math.hypot(off[0], off[1]) > same_place[0] or abs(float(off[2])) > same_place[1]


def patch_of(saved: SavedMap) -> GridPatch:
    """The saved grid as it is published."""
    return GridPatch(saved.grid.cells, saved.grid.origin, saved.grid.resolution)
