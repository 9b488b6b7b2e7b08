"""Localisation in a saved map: tracking by scan matching, and the search over the whole map for a kidnapped robot.

While searching, a small map of its own grows from the start of the search (one scan of a 4 m lidar is alike in many
rooms); it is looked for as a whole in the saved one by branch and bound (Hess et al. 2016, section V). A place counts
at once if no other is nearly as good, otherwise when a second look from elsewhere finds the same.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.se2 import between, compose, compose_jacobians, inverse
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.correlation import Submap, correlate, merged
from monstertruck_estimation.slam.frontend import DOUBTFUL, Match, Planar, Verdict, deviations, rejected
from monstertruck_estimation.slam.mapping import LOST_AFTER, Event, Mapper, estimate, standing_of
from monstertruck_estimation.slam.motion import Increments, MotionModel, OffsetWatch
from monstertruck_estimation.slam.registration import Cloud, register
from monstertruck_estimation.slam.scans import Scan, spread
from monstertruck_estimation.slam.storage import Graph, SavedMap, surfaces_of
from monstertruck_estimation.slam.worker_io import Estimate, Patch, ScanInput, Vector
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.health import Standing

Array = NDArray[np.float64]

LEVELS: Final = 7
QUERY_POINTS: Final = 300
QUERY_KEYS: Final = 6
"""Newest key scans that make the query: more would carry the drift of a search without odometry."""
LEAST_SCORE: Final = 0.6
LEAST_OVERLAP: Final = 0.85
"""Share of the query's points that must fit the place found: in a recording from an office right places had 0.92 and
more, wrong ones 0.84 at most."""
UNIQUE: Final = 0.85
"""A place is the only one if the next best scores less than this part of it."""
BEST: Final = 0.97
"""A place is no place at all if another scores this part of it."""
APART: Final = 1.0
"""Distance at which places are different, m."""
AGREE: Final = (0.3, 0.1)
"""Two looks found the same if they differ by less, m and rad."""
BASELINE: Final = 0.5
"""Way between two looks that count as two, m."""
FOUND: Final = (0.05, 0.02)
"""Standard deviation of a place that was found, m and rad."""
WANDERED: Final = (1.0, 0.5)
"""Standard deviation at which the pose is worth nothing, m and rad."""


def submap_of(saved: SavedMap) -> Submap:
    """All surfaces of a saved map.

    Raises:
        InputError: it has none.
    """
    if saved.graph is not None and saved.graph.scans:
        return Submap(Cloud.of(merged(saved.graph.scans, saved.graph.poses)))
    surfaces = surfaces_of(saved.grid)
    if not len(surfaces):
        msg = "the map has no occupied cells beside free ones: nothing to localise in"
        raise InputError(msg)
    return Submap(Cloud.of(surfaces))


class Searcher:
    """Finds where on a map the robot is.

    Args:
        submap: surfaces of the whole map.
        config: of the small map that grows meanwhile.
    """

    def __init__(self, submap: Submap, config: MapperConfig) -> None:
        self._submap = submap
        self._mapper = Mapper(config)
        self._looks: list[tuple[Array, Array]] = []
        low, high = submap.cloud.points.min(axis=0), submap.cloud.points.max(axis=0)
        self._middle = np.array((*((low + high) / 2), 0.0))
        self._half = float((high - low).max() / 2) + 1.0

    def step(self, scan: Scan, stamp: int, odom: Array | None) -> Array | None:
        """Take a scan; pose of base in the map, shape (3,), once it is known."""
        step = self._mapper.step(scan, stamp, odom)
        if step is None or Event.KEY not in step.events:
            return None
        here = self._mapper.map.poses[-1]
        query = self._query(here)
        found = self._look(query)
        if found is None:
            return None
        pose, unique = found
        if unique or self._confirmed(here, pose):
            return pose
        self._looks.append((here.copy(), pose))
        return None

    def _query(self, here: Array) -> Scan:
        known = self._mapper.map
        numbers = known.around(len(known) - 1, QUERY_KEYS)
        return merged([known.keys[k].scan for k in numbers], between(here, known.poses[numbers]))

    def _look(self, query: Scan) -> tuple[Array, bool] | None:
        """Best pose of the query on the map, and whether it is the only one."""
        kept = spread(query.points, 0.1)
        if len(kept) > QUERY_POINTS:
            kept = kept[np.linspace(0, len(kept) - 1, QUERY_POINTS).astype(np.intp)]
        points = query.points[kept]
        if len(points) < 30:
            return None
        anywhere = (1e6, 1e6)
        grid = self._submap.grid(LEVELS)
        peak = correlate(grid, points, self._middle, (self._half, math.pi), anywhere, LEAST_SCORE, APART)
        if peak is None or peak.rival > BEST * peak.score:
            return None
        fit = register(query, self._submap.cloud, peak.pose)
        if fit.overlap < LEAST_OVERLAP:
            return None
        return fit.pose, peak.rival < UNIQUE * peak.score

    def _confirmed(self, here: Array, pose: Array) -> bool:
        for then, found in self._looks:
            step = between(then, here)
            off = between(compose(found, step), pose)
            if math.hypot(step[0], step[1]) >= BASELINE and math.hypot(off[0], off[1]) < AGREE[0]:
                return abs(float(off[2])) < AGREE[1]
        return False


class LocalisingEstimator:
    """An ``Estimator`` in a saved map.

    Args:
        saved: the map.
        config: noise models.
        start: base in map, if it is known about; None = anywhere.
    """

    def __init__(self, saved: SavedMap, config: MapperConfig, start: Vector | None = None) -> None:
        self._saved = saved
        self._config = config
        self._submap = submap_of(saved)
        self._front = Planar()
        self._motion = MotionModel(config)
        self._searcher = Searcher(self._submap, config) if start is None else None
        self._pose = np.array(start or (0.0, 0.0, 0.0))
        self._covariance = np.diag((0.2**2, 0.2**2, 0.1**2))
        self._stamp: int | None = None
        self._misfits = 0
        self._told = False
        self._offset = OffsetWatch()
        self._increments = Increments()
        self.counts = {"scans": 0, "keys": 0, "closures": 0, "rejected": 0, "searches": int(start is None)}

    @property
    def twist(self) -> Vector:
        """See ``Estimator``."""
        return self._motion.twist

    def step(self, scan: Scan, inputs: ScanInput) -> Estimate | None:
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
        if self._searcher is None:
            match, standing = self._track(scan, delta, guess, covariance)
            self._motion.learn(dt, delta, noise, between(self._pose, match.pose), match)
            events: tuple[str, ...] = () if match.accepted else ("rejected",)
        else:
            match, standing, events = self._search(scan, guess, covariance, odom)
        if "found" in events:
            self._increments.forget()
        moved = self._increments.take(stamp, match, match.pose, alone=odom is None)
        self._pose, self._covariance = match.pose, match.covariance
        if inputs.odom is not None and match.accepted:
            self._offset.add(stamp, float(match.pose[2]), inputs.odom[2])
        correction = None if odom is None else compose(self._pose, inverse(odom))
        placed = (self._pose, self._covariance, correction)
        return estimate(stamp, placed, match, standing, events, self._offset.offset, moved)

    def changes(self) -> tuple[list[Patch], bool]:
        """See ``Estimator``: a saved map never changes, but is told once."""
        told, self._told = self._told, True
        return [], not told

    def patch(self) -> Patch:
        """See ``Estimator``."""
        return patch_of(self._saved)

    def graph(self) -> Graph | None:
        """See ``Estimator``."""
        return self._saved.graph

    def finish(self) -> None:
        """See ``Estimator``: there is nothing to fit."""

    def _track(self, scan: Scan, delta: Array, guess: Array, covariance: Array) -> tuple[Match, Standing]:
        match = self._front.locate(scan, delta, guess, covariance, self._submap)
        place, turn = deviations(match.covariance)
        fits = match.accepted and match.overlap >= DOUBTFUL
        # What stands where the map was free lowers the overlap; only a pose that may be anywhere is searched for.
        self._misfits = 0 if fits else self._misfits + 1
        self.counts["rejected"] += not match.accepted
        if self._misfits >= 3 * LOST_AFTER or place > WANDERED[0] or turn > WANDERED[1]:
            self._searcher = Searcher(self._submap, self._config)
            self.counts["searches"] += 1
            return match, Standing.SEARCHING
        lost = self._misfits >= LOST_AFTER and not match.accepted
        return match, Standing.LOST if lost else standing_of(match, Standing.LOCALISED)

    def _search(
        self, scan: Scan, guess: Array, covariance: Array, odom: Array | None
    ) -> tuple[Match, Standing, tuple[str, ...]]:
        assert self._searcher is not None
        assert self._stamp is not None
        pose = self._searcher.step(scan, self._stamp, odom)
        if pose is None:
            return rejected(guess, covariance, Verdict.EMPTY), Standing.SEARCHING, ()
        self._searcher, self._misfits = None, 0
        match, standing = self._track(scan, np.zeros(3), pose, np.diag((FOUND[0] ** 2, FOUND[0] ** 2, FOUND[1] ** 2)))
        return match, standing, ("found",)


def patch_of(saved: SavedMap) -> Patch:
    """The saved grid as it is published."""
    return Patch(saved.grid.cells, saved.grid.origin, saved.grid.resolution)
