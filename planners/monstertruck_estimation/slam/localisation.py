"""Localisation in a saved map: tracking by scan matching, and the search over the whole map for a kidnapped robot.

During the search a local map is built (one scan of a 4 m lidar looks alike in many rooms); it is matched as a whole to
the saved one by branch and bound (Hess et al. 2016, section V). A place is accepted
at once if no other is nearly as good, otherwise when a second search from elsewhere finds the same.
"""

import math
from typing import Final

import numpy as np

from monstertruck_estimation.se2 import Vector, between, compose, compose_jacobians, inverse
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.correlation import Submap, correlate, merged
from monstertruck_estimation.slam.mapping import LOST_AFTER, Mapper, MappingEvent, estimate, status_of
from monstertruck_estimation.slam.motion import ClockOffsetEstimator, MotionPredictor, ScanOdometry
from monstertruck_estimation.slam.registration import Cloud, register
from monstertruck_estimation.slam.scan_matcher import (
    LOW_OVERLAP,
    MatchStatus,
    PlanarMatcher,
    ScanMatch,
    deviations,
    rejected,
)
from monstertruck_estimation.slam.scans import Scan, downsample_indices
from monstertruck_estimation.slam.storage import SavedGraph, SavedMap, surface_elements
from monstertruck_estimation.slam.worker_io import GridPatch, ScanInput, SlamEstimate
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.health import LocalisationStatus, OdometryUse

LEVELS: Final = 7
QUERY_POINTS: Final = 300
QUERY_KEYS: Final = 6
"""Newest keyframes that make the query: more would carry the drift of a search without odometry."""
MIN_SCORE: Final = 0.6
MIN_OVERLAP: Final = 0.85
"""Share of the query's points that must fit the place found: in a recording from an office right places had 0.92 and
more, wrong ones 0.84 at most."""
UNIQUE_RATIO: Final = 0.85
"""A place is unique if the next best scores less than this share of it."""
AMBIGUOUS_RATIO: Final = 0.97
"""A place is ambiguous if another scores more than this share of it."""
MIN_SEPARATION: Final = 1.0
"""Distance at which places are different, m."""
CONFIRM_TOLERANCE: Final = (0.3, 0.1)
"""Two hypotheses found the same if they differ by less, m and rad."""
BASELINE: Final = 0.5
"""Way between two hypotheses that count as two, m."""
FOUND_DEVIATION: Final = (0.05, 0.02)
"""Standard deviation of a pose found by global localisation, m and rad."""
LOST_DEVIATION: Final = (1.0, 0.5)
"""Standard deviation from which the robot is searched for on the whole map, m and rad."""


def submap_of(saved: SavedMap) -> Submap:
    """All surfaces of a saved map.

    Raises:
        InputError: it has none.
    """
    if saved.graph is not None and saved.graph.scans:
        return Submap(Cloud.of(merged(saved.graph.scans, saved.graph.poses)))
    surfaces = surface_elements(saved.grid)
    if not len(surfaces):
        msg = "the map has no occupied cells beside free ones: nothing to localise in"
        raise InputError(msg)
    return Submap(Cloud.of(surfaces))


class GlobalLocaliser:
    """Global localisation: finds the robot anywhere on a map.

    Args:
        submap: surfaces of the whole map.
        config: of the local map.
    """

    def __init__(self, submap: Submap, config: MapperConfig) -> None:
        self._submap = submap
        self._mapper = Mapper(config)
        self._hypotheses: list[tuple[Array, Array]] = []
        low, high = submap.cloud.points.min(axis=0), submap.cloud.points.max(axis=0)
        self._middle = np.array((*((low + high) / 2), 0.0))
        self._half = float((high - low).max() / 2) + 1.0

    def step(self, scan: Scan, stamp: int, odom: Array | None) -> Array | None:
        """Add a scan; returns the pose of base in the map, shape (3,), once it is found."""
        step = self._mapper.step(scan, stamp, odom)
        if step is None or MappingEvent.KEY not in step.events:
            return None
        here = self._mapper.map.poses[-1]
        query = self._query(here)
        found = self._search_map(query)
        if found is None:
            return None
        pose, unique = found
        if unique or self._confirmed(here, pose):
            return pose
        self._hypotheses.append((here.copy(), pose))
        return None

    def _query(self, here: Array) -> Scan:
        known = self._mapper.map
        numbers = known.around(len(known) - 1, QUERY_KEYS)
        return merged([known.frames[k].scan for k in numbers], between(here, known.poses[numbers]))

    def _search_map(self, query: Scan) -> tuple[Array, bool] | None:
        """Best pose of the query on the map, and whether it is the only one."""
        kept = downsample_indices(query.points, 0.1)
        if len(kept) > QUERY_POINTS:
            kept = kept[np.linspace(0, len(kept) - 1, QUERY_POINTS).astype(np.intp)]
        points = query.points[kept]
        if len(points) < 30:
            return None
        anywhere = (1e6, 1e6)
        grid = self._submap.grid(LEVELS)
        peak = correlate(grid, points, self._middle, (self._half, math.pi), anywhere, MIN_SCORE, MIN_SEPARATION)
        if peak is None or peak.rival > AMBIGUOUS_RATIO * peak.score:
            return None
        fit = register(query, self._submap.cloud, peak.pose)
        if fit.overlap < MIN_OVERLAP:
            return None
        return fit.pose, peak.rival < UNIQUE_RATIO * peak.score

    def _confirmed(self, here: Array, pose: Array) -> bool:
        for then, found in self._hypotheses:
            step = between(then, here)
            off = between(compose(found, step), pose)
            if math.hypot(step[0], step[1]) >= BASELINE and math.hypot(off[0], off[1]) < CONFIRM_TOLERANCE[0]:
                return abs(float(off[2])) < CONFIRM_TOLERANCE[1]
        return False


class LocalisationEstimator:
    """An ``Estimator`` in a saved map.

    Args:
        saved: the map.
        config: noise models.
        start: base in map, if known approximately; None = anywhere.
    """

    def __init__(self, saved: SavedMap, config: MapperConfig, start: Vector | None = None) -> None:
        self._saved = saved
        self._config = config
        self._submap = submap_of(saved)
        self._front = PlanarMatcher()
        self._motion = MotionPredictor(config)
        self._global = GlobalLocaliser(self._submap, config) if start is None else None
        self._pose = np.array(start or (0.0, 0.0, 0.0))
        self._covariance = np.diag((0.2**2, 0.2**2, 0.1**2))
        self._stamp: int | None = None
        self._misfits = 0
        self._published = False
        self._offset = ClockOffsetEstimator()
        self._scan_odometry = ScanOdometry()
        self.counts = {"scans": 0, "keys": 0, "closures": 0, "rejected": 0, "searches": int(start is None)}

    @property
    def twist(self) -> Vector:
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
        covariance = by_pose @ self._covariance @ by_pose.T + by_delta @ noise @ by_delta.T
        self._stamp = stamp
        self.counts["scans"] += 1
        if self._global is None:
            match, status = self._track(scan, delta, guess, covariance)
            self._motion.learn(dt, delta, noise, between(self._pose, match.pose), match)
            events: tuple[str, ...] = () if match.accepted else ("rejected",)
        else:
            match, status, events = self._search(scan, guess, covariance, odom)
        if "found" in events:
            self._scan_odometry.forget()
        alone = odom is None or self.odometry is not OdometryUse.USED
        moved = self._scan_odometry.take(stamp, match, match.pose, alone=alone)
        self._pose, self._covariance = match.pose, match.covariance
        if inputs.odom is not None and match.accepted:
            self._offset.add(stamp, float(match.pose[2]), inputs.odom[2])
        correction = None if odom is None else compose(self._pose, inverse(odom))
        placed = (self._pose, self._covariance, correction)
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

    def finish(self) -> None:
        """See ``Estimator``: there is nothing to optimise."""

    def _track(self, scan: Scan, delta: Array, guess: Array, covariance: Array) -> tuple[ScanMatch, LocalisationStatus]:
        match = self._front.match(scan, delta, guess, covariance, self._submap)
        place, turn = deviations(match.covariance)
        fits = match.accepted and match.overlap >= LOW_OVERLAP
        # New obstacles lower the overlap; only a pose of large covariance is searched for.
        self._misfits = 0 if fits else self._misfits + 1
        self.counts["rejected"] += not match.accepted
        if self._misfits >= 3 * LOST_AFTER or place > LOST_DEVIATION[0] or turn > LOST_DEVIATION[1]:
            self._global = GlobalLocaliser(self._submap, self._config)
            self.counts["searches"] += 1
            return match, LocalisationStatus.SEARCHING
        lost = self._misfits >= LOST_AFTER and not match.accepted
        return match, LocalisationStatus.LOST if lost else status_of(match, LocalisationStatus.LOCALISED)

    def _search(
        self, scan: Scan, guess: Array, covariance: Array, odom: Array | None
    ) -> tuple[ScanMatch, LocalisationStatus, tuple[str, ...]]:
        assert self._global is not None
        assert self._stamp is not None
        pose = self._global.step(scan, self._stamp, odom)
        if pose is None:
            return rejected(guess, covariance, MatchStatus.EMPTY), LocalisationStatus.SEARCHING, ()
        self._global, self._misfits = None, 0
        match, status = self._track(
            scan,
            np.zeros(3),
            pose,
            np.diag((FOUND_DEVIATION[0] ** 2, FOUND_DEVIATION[0] ** 2, FOUND_DEVIATION[1] ** 2)),
        )
        return match, status, ("found",)


def patch_of(saved: SavedMap) -> GridPatch:
    """The saved grid as it is published."""
    return GridPatch(saved.grid.cells, saved.grid.origin, saved.grid.resolution)
