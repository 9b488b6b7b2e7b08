"""Global localisation: where on a saved map the robot is, or that it is not on it.

A local map is built of the first scans (one scan of a 4 m lidar looks alike in many rooms); at every keyframe its
surroundings are matched to the whole saved map by branch and bound (Hess et al. 2016, section V), in pieces over the
scans that follow; the next search begins at the newest keyframe. What one search finds is a hypothesis. It becomes the
answer when it fits some way further on, by another search or, if no other place came near it, where the motion led,
when what was seen between both fits, too, and when the beams of all the time since the first search do not contradict
the saved grid. Ground that is not on the map fits
nowhere, but contradicts nothing: a robot that has crossed it is found when it is back.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.budget import BUDGET, VERIFIED, Pieces, PiecewiseSearch, ScanBudget
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.correlation import RivalSearch, Submap, correlation, merged
from monstertruck_estimation.slam.map_evidence import Evidence, EvidenceGrid
from monstertruck_estimation.slam.mapping import Mapper, MappingEvent
from monstertruck_estimation.slam.registration import measure, register
from monstertruck_estimation.slam.scans import Scan, downsample_indices
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, between, compose
from monstertruck_runtime.clock import SECOND

LEVELS: Final = 7
QUERY_KEYS: Final = 6
"""Keyframes that make the query: more would carry the drift of a search without odometry."""
MIN_SEARCH_OVERLAP: Final = (0.85, 0.7)
"""Share of the query's points that must fit the place found, and a unique one: in a recording from an office right
places had 0.92 and more, wrong ones 0.84 at most; at the edge of the map unique ones of 0.7 were right."""
MAX_CONTRADICTION: Final = (0.15, 0.3)
"""Greatest share of beams that contradict the saved grid, likewise: of a recording in an office, right places had 0.08
on the median, wrong ones 0.45; with beams of 30 m unique right ones of another had 0.27."""
BASELINE: Final = (0.8, 3.0)
"""Distance between two looks that makes a place certain, m: if both found it unique, and if not."""
BROKEN: Final = frozenset({MappingEvent.APART, MappingEvent.PRUNED})
"""After these events keyframes of the local map are elsewhere, or have other numbers: it starts again."""


@dataclass
class Hypothesis:
    """A place that a search has found, and what later searches found of it."""

    pose: Array
    """Shape (3,), in the saved map: the keyframe of the newest search that found it."""
    searches: list[tuple[int, bool]]
    """Keyframe of every search that found it, and whether it found no other place nearly as good."""


@dataclass(frozen=True, slots=True)
class SearchResult:
    """What one search of the whole map found."""

    key: int
    """Keyframe whose surroundings were searched for."""
    pose: Array
    """Shape (3,): that keyframe in the saved map."""
    unique: bool
    ambiguous: bool


class GlobalLocaliser:
    """Finds the robot anywhere on a map.

    Args:
        submap: surfaces of the whole map.
        evidence: its grid.
        config: of the local map.
    """

    def __init__(self, submap: Submap, evidence: EvidenceGrid, config: MapperConfig) -> None:
        self._submap, self._evidence, self._config = submap, evidence, config
        self._mount = np.zeros(2)
        self._running: PiecewiseSearch[SearchResult | None] | None = None
        self._begin_local_map()
        self._seen_on_map: int | None = None
        """Stamp of the newest search that found any place, or of the first scan, ns."""
        self._fruitless = False
        """The last search found no place."""
        self.outside = False
        """No search has found a place for 10 s."""
        submap.grid(LEVELS)  # takes longer than a scan may
        low, high = submap.cloud.points.min(axis=0), submap.cloud.points.max(axis=0)
        self._middle = np.array((*((low + high) / 2), 0.0))
        self._half = float((high - low).max() / 2) + 1.0

    def step(self, scan: Scan, stamp: int, odom: Array | None, mount: Pose2 = (0.0, 0.0, 0.0)) -> Array | None:
        """Add a scan; returns the pose of base in the map, shape (3,), when it is certain.

        Args:
            scan: points in base.
            stamp: ns.
            odom: shape (3,), base in odom; None without odometry.
            mount: planar pose of the sensor in base, m and rad.
        """
        step = self._mapper.step(scan, stamp, odom)
        if step is not None and not BROKEN.isdisjoint(step.events):
            self._begin_local_map()
            step = self._mapper.step(scan, stamp, odom)
        if self._seen_on_map is None:
            self._seen_on_map = stamp
        if step is not None and MappingEvent.KEY in step.events:
            self._mount = np.array(mount[:2])
            moved = between(*self._mapper.map.poses[-2:])[:2] if self._ways else np.zeros(2)
            self._ways.append((self._ways[-1] if self._ways else 0.0) + math.hypot(*moved))
            self._due = True
            found = self._kept()
        else:
            found = None
        if found is None:
            found = self._searched(stamp)
        outside_after = 10 * SECOND  # time after which a robot that no search has found on the map is outside it, ns
        self.outside = self._fruitless and stamp - self._seen_on_map >= outside_after
        if found is None or step is None:
            return None
        return compose(found, between(self._mapper.map.poses[-1], step.pose))

    def _kept(self) -> Array | None:
        """The pose of the newest keyframe where a unique place still fits after the distance of two looks.

        Another place would have to fit both there and here: the look that found this one has ruled that out.
        """
        newest = len(self._mapper.map) - 1
        for hypothesis in self._hypotheses:
            key, unique = hypothesis.searches[-1]
            if not unique or self._ways[newest] - self._ways[key] < BASELINE[0]:
                continue
            numbers, led = self._surroundings(newest), self._led(hypothesis, newest)
            fit = register(self._merged(numbers, newest), self._submap.cloud, led)
            if fit.overlap < MIN_SEARCH_OVERLAP[False] or not _near(led, fit.pose):
                continue
            if self._contradiction(numbers, newest, fit.pose) > MAX_CONTRADICTION[False]:
                continue
            there = Hypothesis(fit.pose, [*hypothesis.searches, (newest, True)])
            if self._foreseen(there, key, unique=False):
                return fit.pose
        return None

    def _surroundings(self, key: int) -> NDArray[np.intp]:
        """Keyframes that make the query of a search at ``key``."""
        return self._mapper.map.around(key, QUERY_KEYS)

    def _led(self, hypothesis: Hypothesis, key: int) -> Array:
        """Keyframe ``key`` in the saved map, were a hypothesis right."""
        poses = self._mapper.map.poses
        return compose(hypothesis.pose, between(poses[hypothesis.searches[-1][0]], poses[key]))

    def _searched(self, stamp: int) -> Array | None:
        """Continue the search; the pose of the newest keyframe in the map when it is certain."""
        if self._running is None:
            if not self._due:
                return None
            self._due, self._running = False, PiecewiseSearch(self._search())
        # Share of ``BUDGET`` that one scan spends on the search, 14 to 18 ms: the local map searches for loops as well.
        share = 0.7
        if not self._running.run(ScanBudget(share * BUDGET)):
            return None
        result, self._running = self._running.result, None
        self._fruitless = result is None
        if result is None:
            return None
        self._seen_on_map = stamp
        return None if result.ambiguous else self._confirmed(result)

    def _begin_local_map(self) -> None:
        self._mapper = Mapper(self._config)
        self._ways: list[float] = []
        """Distance driven at every keyframe, m."""
        self._hypotheses: list[Hypothesis] = []
        self._running = None
        self._due = False
        """A keyframe was added that no search has begun at."""

    def _search(self) -> Pieces[SearchResult | None]:
        """Search the whole map for the surroundings of the newest keyframe; None if they fit nowhere."""
        known = self._mapper.map
        newest = len(known) - 1
        numbers = self._surroundings(newest)
        query = self._merged(numbers, newest)
        kept = downsample_indices(query.points, 0.1)
        # The time of a search is proportional to it; with 300 right places scored the same to 0.04 as with 160.
        query_points = 100
        if len(kept) > query_points:
            kept = kept[np.linspace(0, len(kept) - 1, query_points).astype(np.intp)]
        points = query.points[kept]
        min_points = 30
        if len(points) < min_points:
            return None
        anywhere = (1e6, 1e6)
        grid, window = self._submap.grid(LEVELS), (self._half, math.pi)
        unique_ratio = 0.85  # a place is unique if the next best scores less than this share of it
        ambiguous_ratio = 0.97  # a place is ambiguous if another scores more than this share of it
        rivals = RivalSearch(1.0, unique_ratio, ambiguous_ratio)  # distance at which places are different, m
        min_score = 0.6
        work = 3e6  # blocks evaluated in a search, and in that for the rival, before it ends with what it has
        peak = yield from correlation(grid, points, self._middle, window, anywhere, min_score, rivals, work)
        if peak is None:
            return None
        yield VERIFIED
        ambiguous = peak.rival > ambiguous_ratio * peak.score
        unique = max(peak.rival, peak.unseen) < unique_ratio * peak.score
        fit = register(query, self._submap.cloud, peak.pose)
        if fit.overlap < MIN_SEARCH_OVERLAP[unique]:
            return None
        if self._contradiction(numbers, newest, fit.pose) > MAX_CONTRADICTION[unique]:
            return None
        return SearchResult(newest, fit.pose, unique, ambiguous)

    def _confirmed(self, result: SearchResult) -> Array | None:
        """Compare a result with the hypotheses; the pose of the newest keyframe if that makes one certain."""
        known = self._mapper.map
        same = next((h for h in self._hypotheses if _near(self._led(h, result.key), result.pose)), None)
        if same is None:
            self._hypotheses.append(Hypothesis(result.pose, [(result.key, result.unique)]))
            return None
        same.pose = result.pose
        same.searches.append((result.key, result.unique))
        since = self._far_enough(same)
        if since is None or not self._foreseen(same, *since):
            return None
        return compose(result.pose, between(known.poses[result.key], known.poses[-1]))

    def _far_enough(self, hypothesis: Hypothesis) -> tuple[int, bool] | None:
        """The last search that is as far from the newest one as ``BASELINE`` asks; None if none is.

        Its keyframe, and whether both found the place unique.
        """
        newest, unique = hypothesis.searches[-1]
        for key, also in reversed(hypothesis.searches):
            if self._ways[newest] - self._ways[key] >= BASELINE[0 if unique and also else 1]:
                return key, unique and also
        return None

    def _foreseen(self, hypothesis: Hypothesis, since: int, unique: bool) -> bool:
        """Whether all seen since keyframe ``since`` fits the map, and nothing since the first search contradicts it.

        Nor may any stretch of it: the way out of a room that only looks like one of the map is short.
        """
        centre, newest = hypothesis.searches[-1][0], len(self._mapper.map) - 1
        query = self._merged(np.arange(since, newest + 1), centre)
        if measure(query, self._submap.cloud, hypothesis.pose).overlap < MIN_SEARCH_OVERLAP[unique]:
            return False
        numbers = np.arange(hypothesis.searches[0][0], newest + 1)
        stretches = np.array_split(numbers, math.ceil(len(numbers) / QUERY_KEYS))
        if any(self._contradiction(some, centre, hypothesis.pose) > MAX_CONTRADICTION[1] for some in stretches):
            return False
        return self._contradiction(numbers, centre, hypothesis.pose) <= MAX_CONTRADICTION[unique]

    def _merged(self, numbers: NDArray[np.intp], centre: int) -> Scan:
        """The numbered keyframes in the frame of ``centre``."""
        known = self._mapper.map
        return merged([known.frames[k].scan for k in numbers], between(known.poses[centre], known.poses[numbers]))

    def _contradiction(self, numbers: NDArray[np.intp], centre: int, pose: Array) -> float:
        """Of the numbered keyframes, were ``centre`` at ``pose``."""
        known = self._mapper.map
        placed = compose(pose, between(known.poses[centre], known.poses[numbers]))
        scans = (known.frames[k].scan.points for k in numbers)
        judged = (self._evidence.judge(at, points, self._mount) for at, points in zip(placed, scans, strict=True))
        return sum(judged, Evidence()).contradiction


def _near(led: Array, pose: Array) -> bool:
    """Whether a pose found is of the place where a hypothesis led."""
    off = between(led, pose)
    confirm_tolerance = (0.3, 0.1)  # two searches found the same place if they differ by less, m and rad
    return math.hypot(off[0], off[1]) < confirm_tolerance[0] and abs(float(off[2])) < confirm_tolerance[1]
