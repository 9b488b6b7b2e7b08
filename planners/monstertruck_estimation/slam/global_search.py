"""Global localisation: finds the robot's pose on a saved map, or detects that it is not on the map.

A local map is built from the first scans, because single scans of a 4 m lidar look alike in many rooms. At every
keyframe, its surroundings are matched to the whole saved map by branch and bound (Hess et al. 2016, section V), in
pieces over the following scans; the next search begins at the latest keyframe. The result of a search is a hypothesis,
which is accepted under three conditions. It fits again after some distance: in a second search or, if the search ruled
out similar places, at the pose predicted from motion. Everything seen between both fits also matches the map. The beams
since the first search do not contradict the saved grid. Unmapped ground fits nowhere but contradicts nothing, so a
robot that has crossed it is found after its return.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.budget import Pieces, PiecewiseSearch, ScanBudget, Work
from monstertruck_estimation.slam.closure import CONTRADICTION
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
"""Number of keyframes in the query: more would include the drift of a robot without odometry."""
MIN_SEARCH_OVERLAP: Final = (0.85, 0.7)
"""Minimum share of the query's points that fit the place found, and a unique place.

In a recording from an office, correct places had 0.92 and more, wrong ones at most 0.84; at the edge of the map, unique
places with 0.7 were correct.
"""
MAX_CONTRADICTION: Final = (CONTRADICTION, 0.3)
"""Maximum share of beams that contradict the saved grid, for the same two cases.

In a recording from an office, correct places had a median of 0.08, wrong ones 0.45; with beams of 30 m, unique correct
places of another recording had 0.27.
"""
BROKEN: Final = frozenset({MappingEvent.APART, MappingEvent.PRUNED})
"""Events after which keyframes of the local map have moved or changed number, so that the local map restarts."""


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Result of one search of the whole map."""

    key: int
    """Keyframe whose surroundings were searched for."""
    pose: Array
    """Pose of that keyframe in the saved map, shape (3,)."""
    proven: bool
    """Whether no other place scores nearly as well, evaluated or not."""
    ambiguous: bool


@dataclass
class Hypothesis:
    """Place found by a search, with the results of later searches for the same place."""

    pose: Array
    """Pose in the saved map of the keyframe of the latest search that found the place, shape (3,)."""
    searches: list[SearchResult]
    """Every search that found the place."""


class GlobalLocaliser:
    """Finds the robot anywhere on a map.

    Args:
        submap: surfaces of the whole map.
        evidence: grid of the map.
        config: settings of the local map.
    """

    def __init__(self, submap: Submap, evidence: EvidenceGrid, config: MapperConfig) -> None:
        self._submap, self._evidence, self._config = submap, evidence, config
        self._mount = np.zeros(2)
        self._running: PiecewiseSearch[SearchResult | None] | None = None
        self._begin_local_map()
        self._seen_on_map: int | None = None
        """Stamp of the latest search that found any place, or of the first scan (ns)."""
        self._fruitless = False
        """Whether the last search found no place."""
        self.outside = False
        """Whether no search has found a place for 10 s."""
        submap.grid(LEVELS)  # takes longer than a scan may
        low, high = submap.cloud.points.min(axis=0), submap.cloud.points.max(axis=0)
        self._middle = np.array((*((low + high) / 2), 0.0))
        self._half = float((high - low).max() / 2) + 1.0

    def step(self, scan: Scan, stamp: int, odom: Array | None, mount: Pose2 = (0.0, 0.0, 0.0)) -> Array | None:
        """Add a scan; return the pose of base in the map, shape (3,), once it is certain.

        Args:
            scan: points in base.
            stamp: stamp of the scan (ns).
            odom: base in odom, shape (3,); None without odometry.
            mount: planar pose of the sensor in base (m, rad).
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
        outside_after = 10 * SECOND  # maximum search time without a place, ns; then the robot is outside the map
        self.outside = self._fruitless and stamp - self._seen_on_map >= outside_after
        if found is None or step is None:
            return None
        return compose(found, between(self._mapper.map.poses[-1], step.pose))

    def _kept(self) -> Array | None:
        """Return the pose of the latest keyframe if a unique place still fits after the baseline.

        A rival place would have to fit at both poses; the search that found this place has ruled that out.
        """
        newest = len(self._mapper.map) - 1
        for hypothesis in self._hypotheses:
            last = hypothesis.searches[-1]
            if not last.proven or not self._far_apart(last.key, newest, proven=True):
                continue
            numbers, led = self._surroundings(newest), self._led(hypothesis, newest)
            fit = register(self._merged(numbers, newest), self._submap.cloud, led)
            if fit.overlap < MIN_SEARCH_OVERLAP[False] or not _near(led, fit.pose):
                continue
            if self._contradiction(numbers, newest, fit.pose) > MAX_CONTRADICTION[False]:
                continue
            there = Hypothesis(fit.pose, [*hypothesis.searches, replace(last, key=newest, pose=fit.pose)])
            if self._foreseen(there, last.key, unique=False):
                return fit.pose
        return None

    def _surroundings(self, key: int) -> NDArray[np.intp]:
        """Return the keyframes in the query of a search at ``key``."""
        return self._mapper.map.around(key, QUERY_KEYS)

    def _led(self, hypothesis: Hypothesis, key: int) -> Array:
        """Return the pose of keyframe ``key`` in the saved map that a hypothesis implies."""
        poses = self._mapper.map.poses
        return compose(hypothesis.pose, between(poses[hypothesis.searches[-1].key], poses[key]))

    def _searched(self, stamp: int) -> Array | None:
        """Continue the search; return the pose of the latest keyframe in the map once it is certain."""
        if self._running is None:
            if not self._due:
                return None
            self._due, self._running = False, PiecewiseSearch(self._search())
        # Share of ``Work.SCAN`` for the search, 14 to 18 ms a scan: the local map searches for loops as well.
        share = 0.7
        if not self._running.run(ScanBudget(share * Work.SCAN)):
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
        """Distance travelled at every keyframe (m)."""
        self._hypotheses: list[Hypothesis] = []
        self._running = None
        self._due = False
        """Whether a keyframe was added without a search."""

    def _search(self) -> Pieces[SearchResult | None]:
        """Search the whole map for the surroundings of the latest keyframe; None if they fit no place."""
        known = self._mapper.map
        newest = len(known) - 1
        numbers = self._surroundings(newest)
        query = self._merged(numbers, newest)
        kept = downsample_indices(query.points, 0.1)
        # Search time is proportional to this number; with 300, right places scored the same to 0.04 as with 160.
        query_points = 100
        if len(kept) > query_points:
            kept = kept[np.linspace(0, len(kept) - 1, query_points).astype(np.intp)]
        points = query.points[kept]
        min_points = 30
        if len(points) < min_points:
            return None
        anywhere = (1e6, 1e6)
        grid, window = self._submap.grid(LEVELS), (self._half, math.pi)
        unique_ratio = 0.85  # a place is unique if the next best scores less than this share of its score
        ambiguous_ratio = 0.97  # a place is ambiguous if another scores more than this share of its score
        rivals = RivalSearch(1.0, unique_ratio, ambiguous_ratio)  # minimum distance between different places, m
        min_score = 0.6
        work = 3e6  # maximum number of blocks evaluated, each for the search and its rival, before it ends early
        peak = yield from correlation(grid, points, self._middle, window, anywhere, min_score, rivals, work)
        if peak is None:
            return None
        yield Work.VERIFIED
        ambiguous = peak.rival > ambiguous_ratio * peak.score
        unique = peak.rival < unique_ratio * peak.score
        proven = unique and peak.unseen < unique_ratio * peak.score
        fit = register(query, self._submap.cloud, peak.pose)
        if fit.overlap < MIN_SEARCH_OVERLAP[unique]:
            return None
        if self._contradiction(numbers, newest, fit.pose) > MAX_CONTRADICTION[unique]:
            return None
        return SearchResult(newest, fit.pose, proven, ambiguous)

    def _confirmed(self, result: SearchResult) -> Array | None:
        """Compare a result with the hypotheses; return the pose of the latest keyframe if one becomes certain."""
        known = self._mapper.map
        same = next((h for h in self._hypotheses if _near(self._led(h, result.key), result.pose)), None)
        if same is None:
            self._hypotheses.append(Hypothesis(result.pose, [result]))
            return None
        same.pose = result.pose
        same.searches.append(result)
        since = self._far_enough(same)
        if since is None or not self._foreseen(same, *since):
            return None
        return compose(result.pose, between(known.poses[result.key], known.poses[-1]))

    def _far_enough(self, hypothesis: Hypothesis) -> tuple[int, bool] | None:
        """Return the last search far enough from the latest one for certainty; None without one.

        The result holds its keyframe, and whether both searches proved the place unique.
        """
        newest = hypothesis.searches[-1]
        for earlier in reversed(hypothesis.searches):
            proven = newest.proven and earlier.proven
            if self._far_apart(earlier.key, newest.key, proven=proven):
                return earlier.key, proven
        return None

    def _far_apart(self, key: int, newest: int, *, proven: bool) -> bool:
        """Whether two fits are far enough apart for certainty: both proven unique, or at most one of them."""
        return self._ways[newest] - self._ways[key] >= (0.8 if proven else 3.0)

    def _foreseen(self, hypothesis: Hypothesis, since: int, unique: bool) -> bool:
        """Whether everything seen since keyframe ``since`` fits the map, and nothing since the first search refutes it.

        No single stretch may contradict the map either: a robot may soon leave a room that only looks like a mapped
        one.
        """
        centre, newest = hypothesis.searches[-1].key, len(self._mapper.map) - 1
        query = self._merged(np.arange(since, newest + 1), centre)
        if measure(query, self._submap.cloud, hypothesis.pose).overlap < MIN_SEARCH_OVERLAP[unique]:
            return False
        numbers = np.arange(hypothesis.searches[0].key, newest + 1)
        stretches = np.array_split(numbers, math.ceil(len(numbers) / QUERY_KEYS))
        if any(self._contradiction(some, centre, hypothesis.pose) > MAX_CONTRADICTION[1] for some in stretches):
            return False
        return self._contradiction(numbers, centre, hypothesis.pose) <= MAX_CONTRADICTION[unique]

    def _merged(self, numbers: NDArray[np.intp], centre: int) -> Scan:
        """Return the numbered keyframes, merged in the frame of ``centre``."""
        known = self._mapper.map
        return merged([known.frames[k].scan for k in numbers], between(known.poses[centre], known.poses[numbers]))

    def _contradiction(self, numbers: NDArray[np.intp], centre: int, pose: Array) -> float:
        """Return the contradiction of the numbered keyframes, with ``centre`` at ``pose``."""
        known = self._mapper.map
        placed = compose(pose, between(known.poses[centre], known.poses[numbers]))
        scans = (known.frames[k].scan.points for k in numbers)
        judged = (self._evidence.judge(at, points, self._mount) for at, points in zip(placed, scans, strict=True))
        return sum(judged, Evidence()).contradiction


def _near(led: Array, pose: Array) -> bool:
    """Whether a pose is at the place that a hypothesis predicts."""
    off = between(led, pose)
    confirm_tolerance = (0.3, 0.1)  # maximum difference of two searches that found the same place (m, rad)
    return math.hypot(off[0], off[1]) < confirm_tolerance[0] and abs(float(off[2])) < confirm_tolerance[1]
