"""Localisation in a saved map: tracking by scan matching, and a search of the whole map for an unknown place.

During the first metres after a search of the whole map, the estimator verifies its result. It also checks every match
against the saved grid, and rejects a match whose beams cross walls of the map. Beams that end in unknown cells are not
matched: at the edge of the map they carry no evidence for or against a pose.
"""

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.correlation import Submap, merged
from monstertruck_estimation.slam.global_search import LEVELS, GlobalLocaliser
from monstertruck_estimation.slam.line_search import best_along
from monstertruck_estimation.slam.map_evidence import EvidenceGrid
from monstertruck_estimation.slam.mapping import LOST_AFTER, estimate, fits, status_of
from monstertruck_estimation.slam.motion import (
    MotionPredictor,
    ScanOdometry,
    constrained,
    without_weak_direction,
)
from monstertruck_estimation.slam.mount import LidarCheck
from monstertruck_estimation.slam.registration import Cloud
from monstertruck_estimation.slam.scan_matcher import (
    MatchStatus,
    PlanarMatcher,
    ScanMatch,
    deviations,
    difference,
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
"""Covariance of a pose from global localisation (m^2, rad^2)."""
MATCH_COVARIANCE: Final = np.diag(np.square((0.02, 0.02, 0.01)))
"""Covariance of a single match (m^2, rad^2)."""
MAX_CONTRADICTION: Final = 0.3
"""Maximum share of a valid match's beams that contradict the saved grid, e.g. because of people or new furniture."""

Predicted = tuple[Array, Array, Array]
"""Pose predicted from motion, shape (3,), with its covariances for the match window and for publishing, (3, 3)."""


def submap_of(saved: SavedMap) -> Submap:
    """Return all surfaces of a saved map as a submap.

    Raises:
        InputError: the map has no surfaces.
    """
    if saved.graph is not None and saved.graph.scans:
        return Submap(Cloud.of(merged(saved.graph.scans, saved.graph.poses)))
    surfaces = surface_elements(saved.grid)
    if not len(surfaces):
        raise InputError("the map has no occupied cells next to free ones, so localisation is impossible")
    return Submap(Cloud.of(surfaces))


class LocalisationEstimator:
    """``Estimator`` that localises in a saved map.

    Args:
        saved: the map.
        config: noise models.
        start: approximate initial pose of base in map; None if unknown.
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
        """Whether the pose is known; a search that still runs verifies it."""
        self._checked = 0.0
        """Distance travelled since the place was found (m)."""
        self._pose = np.array(start or (0.0, 0.0, 0.0))
        self._covariance = np.diag((0.2**2, 0.2**2, 0.1**2))
        """Covariance of the pose from the matches alone, which sets the window of the next match."""
        self._published_covariance = self._covariance
        """Published covariance: from the predicted motion for invalid matches and along a match's weak direction."""
        self._unmeasured = np.zeros(2)
        """Standard deviation in map, shape (2,) (m), of the displacement since a match last measured the full position.

        Its errors do not average out: wheels slip all along a corridor, and a velocity may have changed.
        """
        self._stamp: int | None = None
        self._misfits = 0
        """Number of invalid matches in a row."""
        self._blind = False
        """Whether the last match was degenerate."""
        self._published = False
        self._check = LidarCheck()
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
            # Without odometry, the first match after a corridor corrects the error made there; it does not measure a
            # velocity.
            blind, self._blind = self._blind, match.degenerate
            if not blind or match.degenerate or self.odometry is OdometryUse.USED:
                self._motion.learn(dt, delta, noise, between(self._pose, match.pose), match)
            events = () if match.accepted else ("rejected",)
            if self._global is not None and self._refuted(match.pose, found, delta):
                match, status = self._unknown(guess, covariance)
                events = ("refuted",)
        alone = odom is None or self.odometry is not OdometryUse.USED
        moved = self._scan_odometry.take(stamp, match, match.pose, alone=alone)
        self._unmeasured = self._unmeasured + self._unmeasured_step(match, dt)
        self._pose, self._covariance = match.pose, match.covariance
        if match.information is not None and not self._misfits:
            if not match.degenerate:
                self._unmeasured = np.zeros(2)
            published = np.linalg.inv(constrained(match, match.information) + np.linalg.inv(published))
        self._published_covariance = published
        if match.accepted and not match.degenerate and not events:
            self._check.add(stamp, match.pose, odom, self.odometry)
        else:
            self._check.interrupt()
        odom_now = self._motion.odom
        correction = None if odom is None or odom_now is None else compose(self._pose, inverse(odom_now))
        placed = (self._pose, self._with_unmeasured(published), correction)
        return estimate(stamp, placed, match, status, events, self._check, moved, self.odometry)

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
        """See ``Estimator``: None, because the poses were estimated one by one."""

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
            # The predicted motion may be wrong, because of late odometry or wrong stamps of scans.
            before = compose(guess, inverse(delta)), *predicted[1:]
            still, good = matched(scan, np.zeros(3), before, mount)
            # A partial fit near the prediction is better evidence than scans alone, but weaker than wheels.
            if good or (alone and _strayed(match, guess) and not _strayed(still, before[0])):
                match, guess = still, before[0]
        if match.accepted and not good and (not alone or _strayed(match, guess)):
            match = rejected(guess, covariance, MatchStatus.FAR)
        place, turn = deviations(match.covariance)
        # New obstacles lower the overlap: only a pose with a large covariance triggers a search.
        self._misfits = 0 if good else self._misfits + 1
        self.counts["rejected"] += not match.accepted
        # Standard deviation that triggers a search of the whole map (m, rad).
        lost_deviation = (1.0, 0.5)
        if self._misfits >= 3 * LOST_AFTER or place > lost_deviation[0] or turn > lost_deviation[1]:
            self._global, self._tracking = self._search_anew(), False
            self.counts["searches"] += 1
            return match, LocalisationStatus.SEARCHING
        lost = self._misfits >= LOST_AFTER and not match.accepted
        return match, LocalisationStatus.LOST if lost else status_of(match, LocalisationStatus.LOCALISED)

    def _matched_alone(self, scan: Scan, delta: Array, predicted: Predicted, mount: Pose2) -> tuple[ScanMatch, bool]:
        """Match all beams, as the motion is too uncertain to select those that end on mapped ground."""
        match = self._match(scan, delta, predicted)
        contradiction = self._evidence.judge(match.pose, scan.points, np.array(mount[:2])).contradiction
        return match, fits(match) and contradiction <= MAX_CONTRADICTION

    def _matched(self, scan: Scan, delta: Array, predicted: Predicted, mount: Pose2) -> tuple[ScanMatch, bool]:
        """Match the beams that end on mapped ground; return the match and whether it is valid."""
        guess, covariance, published = predicted
        sensor = np.array(mount[:2])
        mapped = self._evidence.judged(guess, scan.points, sensor)
        share = float(mapped.mean()) if len(mapped) else 0.0
        if share < 0.65:  # minimum share of a scan's beams that end on mapped ground
            return rejected(guess, covariance, MatchStatus.EMPTY), False
        whole = share >= 0.95  # minimum share of beams on mapped ground for matching all beams
        seen = scan if whole else scan.chosen(mapped)
        match = self._match(seen, delta, predicted)
        contradiction = self._evidence.judge(match.pose, seen.points, sensor).contradiction
        # Minimum overlap of the beams on mapped ground if others end elsewhere, and for a match far from the
        # prediction.
        partial_overlap = 0.8
        # Maximum share of these beams that contradict the saved grid: a few walls fit in many places.
        partial_contradiction = 0.15
        clear = match.overlap >= partial_overlap and contradiction <= partial_contradiction
        if _far(match.pose, guess, self._with_unmeasured(published)):
            good = clear and whole and not match.degenerate
        else:
            good = contradiction <= MAX_CONTRADICTION and (clear or whole)
        return match, good and fits(match)

    def _unmeasured_step(self, match: ScanMatch, dt: float) -> Array:
        """Return the standard deviation of the latest displacement, shape (2,) (m), with or without wheels."""
        if self.odometry is OdometryUse.USED:
            return np.asarray(self._config.odometry_distance * (match.pose[:2] - self._pose[:2]))
        if not match.degenerate or not match.accepted:
            return np.zeros(2)
        along = self._config.blind_speed[0] * dt * np.array((math.cos(match.direction), math.sin(match.direction)))
        return along if along @ self._unmeasured >= 0 else -along

    def _with_unmeasured(self, covariance: Array) -> Array:
        """Return ``covariance``, shape (3, 3), plus the variance of the unmeasured displacement."""
        result = covariance.copy()
        result[:2, :2] += np.outer(self._unmeasured, self._unmeasured)
        return result

    def _match(self, scan: Scan, delta: Array, predicted: Predicted) -> ScanMatch:
        """Match ``scan``, and search along the match's weak direction for the best fit within the prediction.

        The match is degenerate if another place in that direction fits as well.
        """
        guess, covariance, published = predicted
        match = self._front.match(scan, delta, guess, covariance, self._submap)
        if not match.accepted:
            return match
        prior = self._with_unmeasured(published)
        place = best_along(self._submap.grid(LEVELS), scan.points, match, guess, prior)
        if place is not None and place.only and place.apart:
            other = self._front.match(scan, delta, place.pose, covariance, self._submap)
            match = other if other.accepted else replace(match, degeneracy=0.0)
        elif place is not None and not place.only:
            match = replace(match, degeneracy=0.0)
        return without_weak_direction(match, guess, published)

    def _search_anew(self) -> GlobalLocaliser:
        return GlobalLocaliser(self._submap, self._evidence, self._config)

    def _unknown(self, guess: Array, covariance: Array) -> tuple[ScanMatch, LocalisationStatus]:
        outside = self._global is not None and self._global.outside
        status = LocalisationStatus.OUTSIDE if outside else LocalisationStatus.SEARCHING
        return rejected(guess, covariance, MatchStatus.EMPTY), status

    def _found(self, scan: Scan, pose: Array, mount: Pose2) -> tuple[ScanMatch, LocalisationStatus]:
        """Track from ``pose`` while the search continues as verification."""
        self._tracking, self._checked, self._misfits = True, 0.0, 0
        return self._track(scan, np.zeros(3), (pose, FOUND_COVARIANCE, FOUND_COVARIANCE), mount)

    def _refuted(self, pose: Array, found: Array | None, delta: Array) -> bool:
        """Whether the verification refutes ``pose``; it ends when it has confirmed the place."""
        assert self._global is not None
        self._checked += math.hypot(delta[0], delta[1])
        if (found is None or not _apart(pose, found)) and not self._global.outside:
            # Distance after which the verification ends (m): after a confirmation, and without one.
            checked_way = (3.0, 9.0)
            if self._checked >= checked_way[0 if found is not None else 1]:
                self._global = None
            return False
        self._global, self._tracking = self._search_anew(), False
        self.counts["searches"] += 1
        return True


def _far(pose: Array, guess: Array, covariance: Array) -> bool:
    """Whether ``pose`` is further from ``guess`` than its ``covariance`` and a match's covariance explain."""
    off = difference(pose, guess)
    distance = math.sqrt(float(off @ np.linalg.solve(covariance + MATCH_COVARIANCE, off)))
    far = 3.0  # standard deviations of the predicted pose beyond which a match is far from the motion
    return distance > far or _apart(pose, guess)


def _strayed(match: ScanMatch, guess: Array) -> bool:
    """Whether a match is rejected or far from the place of its prediction."""
    return not match.accepted or _apart(match.pose, guess)


def _apart(one: Array, other: Array) -> bool:
    """Whether two poses are at different places."""
    off = between(one, other)
    same_place = (0.5, 0.2)  # maximum difference of two poses of the same place (m, rad)
    return math.hypot(off[0], off[1]) > same_place[0] or abs(float(off[2])) > same_place[1]


def patch_of(saved: SavedMap) -> GridPatch:
    """Return the saved grid in its published form."""
    return GridPatch(saved.grid.cells, saved.grid.origin, saved.grid.resolution)
