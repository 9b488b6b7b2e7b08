"""Loop closure: candidates, their verification by scan matching, and their consistency with the pose graph.

Candidates are keyframes that may be near within the bound of the drift: the likeliest by position, and the most similar
by descriptor. The surroundings of the latest keyframe are matched to those of the candidate by branch and bound, then
by ICP; a single scan would look the same all along a corridor. A match in a small window is accepted at once. A match
in a wide window is pending until others, from different places, agree with it (pairwise consistency: Mangelson et al.
2018). A closure that the optimised graph contradicts is removed.

A place that is revisited from the other side overlaps little. At the end of a run (``review``), where the drift is
small, a match is also accepted if the part within view of the place fits and no beams of either side pass through the
other's walls. A single match of this kind is insufficient, so it needs supporting matches in every window.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_estimation.slam.budget import Pieces, PiecewiseSearch, ScanBudget, Work, finished
from monstertruck_estimation.slam.correlation import Submap, correlate, look_ups, merged
from monstertruck_estimation.slam.graph import optimise, residuals, robust_weights
from monstertruck_estimation.slam.keyframes import KeyframeMap
from monstertruck_estimation.slam.registration import measure, register
from monstertruck_estimation.slam.scan_matcher import LIKELY, degeneracy, deviations
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose, inverse, rotation, transform

VIEW: Final = 2.5
"""Maximum distance of two keyframes with a common view (m)."""
QUERY_KEYS: Final = 12
"""Maximum number of keyframes in the query."""
CONTRADICTION: Final = 0.15
"""Maximum share of points that scans of the other side look through; a match above it is wrong."""
PART_CONTRADICTION: Final = 0.05
"""Partial match: maximum share of points that the other side looks through."""
MIN_SUPPORT: Final = 3
"""Minimum number of matches that support one of a wide search, and as many more for each contradicting one."""
BASELINE: Final = 1.0
"""Minimum length of the trajectory between the first and the last of these matches (m)."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopMatch:
    """Verified match: keyframe ``target`` found near ``origin``; compared by identity."""

    origin: int
    target: int
    measured: Array
    information: Array
    spread: tuple[float, float]
    """Variances of position and yaw that the submaps add (m^2, rad^2)."""
    made: int
    """Number of the latest keyframe at the time of the match."""


class LoopCloser:
    """Finds, checks and adds loop closures."""

    def __init__(self) -> None:
        self._hits: list[LoopMatch] = []
        self._tried: dict[int, int] = {}
        self._fingerprints: dict[int, Array] = {}
        self._waiting: list[int] = []
        self._progress: PiecewiseSearch[bool] | None = None
        self.searches = 0
        """Number of searches."""
        self.refused = 0
        """Number of closures removed because the optimised graph contradicted them."""

    @property
    def busy(self) -> bool:
        """Whether a search is running."""
        return self._progress is not None

    def watch(self, at: int) -> None:
        """Queue a search from keyframe ``at``; beyond 20 queued searches the oldest are dropped."""
        self._waiting = [*self._waiting, at][-20:]

    def step(self, keyframes: KeyframeMap, budget: ScanBudget) -> bool:
        """Continue the searches; return whether a closure has moved the poses."""
        while self._progress is not None or self._waiting:
            if self._progress is None:
                self._progress = PiecewiseSearch(self._close(keyframes, self._waiting.pop(0)))
            if not self._progress.run(budget):
                return False
            closed, self._progress = self._progress.result, None
            if closed:
                return True
        return False

    def _close(self, keyframes: KeyframeMap, at: int) -> Pieces[bool]:
        """Search for loops from keyframe ``at``; return whether a closure has moved the poses."""
        yield 2 * Work.EDGE * len(keyframes.edges)
        own, query = surroundings(keyframes, at)
        self._fingerprints[at] = describe(query.points)
        covariances, far = keyframes.drift(at)
        max_age = 60  # maximum age of an unsupported match, in keyframes
        self._hits = [hit for hit in self._hits if at - hit.made < max_age]
        search_interval = 4  # minimum number of keyframes between two searches in the same place
        self._tried = {place: when for place, when in self._tried.items() if at - when < search_interval}
        for candidate in self._candidates(keyframes, at, covariances, far):
            self._tried[candidate] = at
            window = _window(covariances[candidate])
            min_overlap = 0.55  # minimum share of fitting points of the query
            hit = yield from self._search(keyframes, query, own, at, candidate, window, least=min_overlap)
            if hit is None:
                continue
            yield Work.EDGE_OPTIMISED * len(keyframes.edges)
            if self._accepted(keyframes, hit, sure=_is_small(window)):
                return True
        return False

    def join(self, keyframes: KeyframeMap, at: int, part: int) -> Pieces[bool | None]:
        """Verify the place of keyframe ``at`` in submap ``part``, another submap than its own.

        Like a match of a wide search, it needs the support of other matches, and of all keyframes of one submap near
        the other's. Returns True if the submaps were joined, False if the match waits for others, None without a match.
        """
        yield 2 * Work.EDGE * len(keyframes.edges)
        own_part = int(keyframes.part[at])
        numbers = np.flatnonzero(keyframes.part == part)
        candidate = int(numbers[np.argmin(_distance(keyframes, at)[numbers])])
        own, query = surroundings(keyframes, at)
        join_overlap = 0.75  # minimum share of fitting points of a submap in a search of the whole map
        window = _window(np.zeros((3, 3)))
        hit = yield from self._search(keyframes, query, own, at, candidate, window, least=join_overlap)
        if hit is None:
            return None
        yield Work.EDGE_OPTIMISED * len(keyframes.edges)
        poses, count = keyframes.poses, len(keyframes.edges)
        join_baseline = 2.0  # minimum length of the trajectory between the matches that join two submaps, m
        if not self._accepted(keyframes, hit, sure=False, baseline=join_baseline):
            return False
        robots, other = (part, own_part) if part == keyframes.part[-1] else (own_part, part)
        submaps = np.flatnonzero(keyframes.part == robots), np.flatnonzero(keyframes.part == other)
        if finished(opposed(keyframes, *submaps)):
            keyframes.poses = poses
            keyframes.edges.keep(slice(count))
            self.refused += 1
            return None
        keyframes.join(own_part, part)
        return True

    def review(self, keyframes: KeyframeMap) -> bool:
        """Search from all keyframes for places that were only partly seen before (seconds of work).

        It runs at the end of a run, when the surroundings of a place include later keyframes. Returns whether a closure
        has moved the poses.
        """
        self._tried.clear()
        count = len(keyframes)
        reviewed = 250  # maximum number of keyframes that the review searches
        places = np.unique(np.linspace(0, count - 1, min(count, reviewed)).astype(np.intp)).tolist()
        hits = [hit for at in places if (hit := self._partial_match(keyframes, at)) is not None]
        closed = False
        while group := consistent_group(keyframes, hits):
            closed |= self._added(keyframes, group)
            hits = [hit for hit in hits if hit not in group]
        return closed

    def forget(self, kept: NDArray[np.bool_]) -> None:
        """Renumber the keyframes after pruning, which keeps only the marked ones."""
        self._hits.clear()
        self._tried.clear()
        self._waiting.clear()
        self._progress = None
        number = np.cumsum(kept) - 1
        self._fingerprints = {int(number[k]): one for k, one in self._fingerprints.items() if kept[k]}

    def _partial_match(self, keyframes: KeyframeMap, at: int) -> LoopMatch | None:
        """Return the match of keyframe ``at`` with the likeliest earlier place, if there are few alternatives."""
        covariances, far = keyframes.drift(at)
        numbers = self._possible(keyframes, at, covariances, far)
        if not len(numbers):
            return None
        window = _window(covariances[numbers[0]])
        if not _is_small(window):
            return None
        place, turn = window
        own, query = surroundings(keyframes, at)
        # Partial match: allowance in the half width of the search for scans that drift beyond their covariance, m and
        # rad.
        part_wider = (1.0, 2.0)
        windows = [(place * wider, turn * wider) for wider in part_wider]
        # 0.7: minimum share of fitting points within view of the place
        tries = (
            finished(self._search(keyframes, query, own, at, int(numbers[0]), window, part=True, least=0.7))
            for window in windows
        )
        return next((hit for hit in tries if hit is not None), None)

    def _candidates(self, keyframes: KeyframeMap, newest: int, covariances: Array, far: Array) -> list[int]:
        """Return up to two candidates: the likeliest by position, and the most similar of another place."""
        numbers = self._possible(keyframes, newest, covariances, far)
        if not len(numbers):
            return []
        first = int(numbers[0])
        elsewhere = np.sort(numbers[_distance(keyframes, first)[numbers] > VIEW])
        elsewhere = elsewhere[[int(k) in self._fingerprints for k in elsewhere]]
        if not len(elsewhere):
            return [first]
        similarity = likeness(self._fingerprints[newest], np.array([self._fingerprints[k] for k in elsewhere]))
        best = int(np.argmax(similarity))
        min_likeness = 0.8  # minimum similarity of a candidate's descriptor
        return [first, int(elsewhere[best])] if similarity[best] > min_likeness else [first]

    def _possible(self, keyframes: KeyframeMap, at: int, covariances: Array, far: Array) -> NDArray[np.intp]:
        """Return the keyframes before ``at`` that may be near it within the drift, the likeliest first."""
        off = between(keyframes.poses[at], keyframes.poses)
        distance = np.hypot(off[:, 0], off[:, 1])
        reach = _limited(LIKELY * np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1]))[0]
        possible = np.isfinite(far) & (far > keyframes.config.local_spread**2) & (distance < VIEW + reach)
        possible[at:] = False
        for place in self._tried:
            possible &= _distance(keyframes, place) > VIEW
        numbers = np.flatnonzero(possible)
        cost = distance[numbers] / (VIEW + reach[numbers]) + 0.15 * np.abs(off[numbers, 2])
        return np.asarray(numbers[np.argsort(cost, kind="stable")])

    def _search(
        self,
        keyframes: KeyframeMap,
        query: Scan,
        own: NDArray[np.intp],
        at: int,
        candidate: int,
        window: tuple[float, float],
        *,
        least: float,
        part: bool = False,
    ) -> Pieces[LoopMatch | None]:
        """Match ``query``, the surroundings of keyframe ``at`` or a part of them, to the surroundings of ``candidate``.

        A share of at least ``least`` of the points must fit.
        """
        self.searches += 1
        window = _limited(*window)
        # Search the whole window, not only around the candidate: otherwise a similar place wins for lack of rivals.
        numbers = keyframes.well_known(candidate)
        # The query's own neighbours are left out: a match to them closes no loop.
        numbers = np.setdiff1d(numbers, np.union1d(own, keyframes.well_known(at)))
        numbers = numbers[_distance(keyframes, at)[numbers] < window[0] + keyframes.config.local_reach]
        if not len(numbers):
            return None
        place_keys = 60  # maximum number of keyframes of the searched place
        numbers = numbers[np.linspace(0, len(numbers) - 1, min(len(numbers), place_keys)).astype(np.intp)]
        yield 2 * Work.EDGE * len(keyframes.edges) + Work.ELEMENT * sum(len(keyframes.frames[k].scan) for k in numbers)
        submap = keyframes.submap(numbers)
        levels = 7  # levels of the correlation pyramid
        yield submap.grid_cost(levels)
        grid = submap.grid(levels)
        deviation = max(window[0] / LIKELY, 0.1), max(window[1] / LIKELY, 0.02)
        guess = keyframes.poses[at]
        min_score = 0.45  # minimum mean likelihood of a match
        part_score = 0.1  # partial match (only a part of the surroundings was seen before): minimum mean likelihood
        score = part_score if part else min_score
        yield look_ups(query.points, window, levels)
        work = 40_000  # maximum number of evaluated blocks per search below the coarsest level
        min_separation = 1.0  # minimum distance between different places, m
        peak = correlate(grid, query.points, guess, window, deviation, score, min_separation, work)
        max_rival = 0.9  # a match is ambiguous if another place scores more than this share of its score
        if peak is None or peak.rival > max_rival * peak.score:
            return None
        yield Work.VERIFIED
        fit = register(query, submap.cloud, peak.pose)
        ratio, _ = degeneracy(fit.information)
        moved = between(peak.pose, fit.pose)
        # Minimum ratio of the eigenvalues of the position's information: below it is a corridor, where a fit proves
        # nothing.
        min_ratio = 0.02
        max_correction = 0.3  # maximum distance between the fine and the coarse fit, m
        if ratio < min_ratio or math.hypot(moved[0], moved[1]) > max_correction:
            return None
        off = keyframes.poses[numbers, :2] - fit.pose[:2]
        near = numbers[np.argsort(np.hypot(off[:, 0], off[:, 1]), kind="stable")][:QUERY_KEYS]
        overlap = _overlap_in_view(keyframes, near, query, submap, fit.pose) if part else fit.overlap
        if overlap < least:
            return None
        if _contradiction(keyframes, own, at, near, fit.pose) > (PART_CONTRADICTION if part else CONTRADICTION):
            return None
        origin = int(near[0])
        # The information is in the axes of map; the relation is in the frame of its origin.
        turn = np.eye(3)
        turn[:2, :2] = rotation(keyframes.poses[origin, 2])
        spread = 0.03**2, 0.01**2  # minimum variances of a closure, m^2 and rad^2: its submaps are not rigid
        covariance = np.linalg.inv(turn.T @ fit.information @ turn + np.eye(3)) + np.diag((*spread[:1] * 2, spread[1]))
        measured = between(keyframes.poses[origin], fit.pose)
        return LoopMatch(origin, at, measured, np.linalg.inv(covariance), spread, len(keyframes) - 1)

    def _accepted(self, keyframes: KeyframeMap, hit: LoopMatch, *, sure: bool, baseline: float = BASELINE) -> bool:
        """Add ``hit`` and the agreeing matches to the graph if they are sufficient and the graph accepts them."""
        agreeing, against = _split_by_consistency(keyframes, hit, self._hits)
        witnesses = [hit, *agreeing]
        self._hits.append(hit)
        support = len({witness.target for witness in witnesses})
        enough = support >= MIN_SUPPORT * (1 + len(against)) and _way(keyframes, witnesses) >= baseline
        if not sure and not enough:
            return False
        if not self._added(keyframes, witnesses):
            return False
        self._hits = [other for other in self._hits if other not in witnesses]
        return True

    def _added(self, keyframes: KeyframeMap, hits: list[LoopMatch]) -> bool:
        """Add the matches and optimise; remove them if they, or edges that fitted before, become outliers."""
        before, count = keyframes.poses, len(keyframes.edges)
        edges = keyframes.edges.edges()
        _, squares = residuals(before, edges)
        held = robust_weights(squares, edges.loop) > 0.5
        for hit in hits:
            keyframes.edges.add(hit.origin, hit.target, hit.measured, hit.information, hit.spread, loop=True)
        edges = keyframes.edges.edges()
        poses = optimise(before, edges)
        _, squares = residuals(poses, edges)
        holds = robust_weights(squares, edges.loop) > 0.5
        max_strained = 0.02  # maximum share of edges that become outliers by an accepted closure
        if not holds[count:].all() or np.count_nonzero(held & ~holds[:count]) > max_strained * count:
            keyframes.edges.keep(slice(count))
            self.refused += len(hits)
            return False
        keyframes.poses = poses
        return True


def _split_by_consistency(
    keyframes: KeyframeMap, hit: LoopMatch, others: list[LoopMatch]
) -> tuple[list[LoopMatch], list[LoopMatch]]:
    """Return those of ``others`` that form a consistent loop with ``hit``, and those that contradict it.

    The rest is undecided.
    """
    agreeing: list[LoopMatch] = []
    against: list[LoopMatch] = []
    others = [other for other in others if other.target != hit.target]
    if not others:
        return agreeing, against
    at_target, _ = keyframes.drift(hit.target)
    at_origin, _ = keyframes.drift(hit.origin)
    for other in others:
        # The matches' loop (origin, target, the other's target, its origin) against the graph's relation of both
        # origins.
        step = between(keyframes.poses[hit.target], keyframes.poses[other.target])
        there = compose(compose(hit.measured, step), inverse(other.measured))
        off = between(between(keyframes.poses[hit.origin], keyframes.poses[other.origin]), there)
        drifts = at_target[other.target] + at_origin[other.origin]
        place, turn = deviations(drifts + np.linalg.inv(hit.information) + np.linalg.inv(other.information))
        if place <= 1.0:  # maximum drift between two matches with a consistency test, m
            # Squared Mahalanobis distance of agreeing matches (99 % of chi-square with three degrees of freedom).
            consistent = 11.3
            agrees = (off[0] ** 2 + off[1] ** 2) / place**2 + (off[2] / turn) ** 2 < consistent
            (agreeing if agrees else against).append(other)
    return agreeing, against


def consistent_group(keyframes: KeyframeMap, hits: list[LoopMatch]) -> list[LoopMatch]:
    """Return the largest group of ``hits`` from one stretch of the trajectory that agree with one of them.

    The result is empty unless the group exceeds the contradicting ones of the same stretch by at least ``MIN_SUPPORT``.
    Matches from further away are not compared: both may be right, and the drift larger than its bound.
    """
    best: list[LoopMatch] = []
    # Length of trajectory with a small drift, m: of two contradicting matches within it, one is false.
    stretch = 3.0
    for hit in hits:
        near = [other for other in hits if _way(keyframes, [hit, other]) < stretch]
        agreeing, against = _split_by_consistency(keyframes, hit, near)
        group = [hit, *agreeing]
        enough = len(group) >= len(against) + MIN_SUPPORT and _way(keyframes, group) >= BASELINE
        if enough and len(group) > len(best):
            best = group
    return best


def _window(covariance: Array) -> tuple[float, float]:
    """Return the half widths of the search (m, rad) for a drift."""
    place, turn = deviations(covariance)
    return LIKELY * place + 0.3, LIKELY * turn + 0.05


def _limited(place: Any, turn: Any = 0.0) -> tuple[Any, Any]:
    """Return the half widths of a search (m, rad), limited to the searched area."""
    return np.minimum(place, 12.0), np.minimum(turn, 1.0)


def _is_small(window: tuple[float, float]) -> bool:
    """Whether matches in a window (m, rad) need no support."""
    return window[0] <= 1.5 and window[1] <= 0.3


def _contradiction(
    keyframes: KeyframeMap, own: NDArray[np.intp], newest: int, near: NDArray[np.intp], pose: Array
) -> float:
    """Return the share of points of ``own`` and ``near`` that beams of the others pass through.

    Keyframe ``newest`` is assumed to be at ``pose``.
    """
    placed = compose(pose, between(keyframes.poses[newest], keyframes.poses[own]))
    mine, theirs = ([keyframes.frames[k].scan for k in numbers] for numbers in (own, near))
    return contradiction(mine, placed, theirs, keyframes.poses[near])


def _overlap_in_view(keyframes: KeyframeMap, near: NDArray[np.intp], query: Scan, submap: Submap, pose: Array) -> float:
    """Return the share of fitting points of ``query`` at ``pose`` among those in view of ``near``; 0 for too few."""
    seen = in_view([keyframes.frames[k].scan for k in near], keyframes.poses[near], transform(pose, query.points))
    if np.count_nonzero(seen) < 20:  # partial match: minimum number of points in view
        return 0.0
    return measure(query.chosen(seen), submap.cloud, pose).overlap


def crossings(keyframes: KeyframeMap, own: NDArray[np.intp], others: NDArray[np.intp]) -> Pieces[Array]:
    """Compare the latest keyframes of ``own`` with those of ``others`` around them.

    Returns:
        Shape (k, 2), one row per keyframe in their order: number of points that beams of the opposite side pass
        through, and number of points in its view. A point of ``own`` counts as passed through if beams of more of the
        others pass through it than end at it. The points of ``others`` are weighted by the inverse of their number of
        keyframes, because these show the same walls many times.
    """
    off = keyframes.poses[own, None, :2] - keyframes.poses[others, :2]
    far = np.hypot(off[..., 0], off[..., 1])
    crossed_keys = 24  # maximum number of a submap's latest keyframes that are compared with another submap
    crossed_reach = 5.0  # maximum distance of these keyframes, m
    met = np.flatnonzero(far.min(axis=1, initial=np.inf) < crossed_reach)[-crossed_keys:]
    counts = np.zeros((len(met), 2))
    for row, k in enumerate(met.tolist()):
        yield Work.CROSSED
        near = others[far[k] < crossed_reach]
        crossed_near = 12  # maximum number of keyframes of the other submap, evenly chosen, that each is compared with
        near = near[np.linspace(0, len(near) - 1, min(len(near), crossed_near)).astype(np.intp)]
        points, place = keyframes.frames[int(own[k])].scan.points, keyframes.poses[own[k]]
        view, votes = _view(points), np.zeros((len(points), 2), np.int64)
        for j in near.tolist():
            at, seen = keyframes.poses[j], keyframes.frames[j].scan.points
            _vote(_view(seen), transform(between(at, place), points), votes)
            counts[row] += np.array(_looked_through(view, transform(between(place, at), seen))) / len(near)
        counts[row] += np.count_nonzero(votes[:, 0] > votes[:, 1]), np.count_nonzero(votes.any(axis=1))
    return counts


def opposed(keyframes: KeyframeMap, own: NDArray[np.intp], others: NDArray[np.intp]) -> Pieces[bool]:
    """Whether the keyframes ``own`` and ``others`` look through each other's walls too often for one map.

    The limit holds in total and along every stretch of ``own``: a robot may soon leave a room that only looks alike.
    """
    counts = yield from crossings(keyframes, own, others)
    through, judged = counts.sum(axis=0)
    # Maximum contradiction of two submaps (share of the points in view of both that one looked through): correct joins
    # of recordings had at most 0.05, and 0.15 along a stretch.
    join_contradiction = 0.1
    return bool(through > join_contradiction * judged) or stretch_contradicts(counts)


STRETCH: Final = 6
"""Number of keyframes in a stretch."""


def stretch_contradicts(counts: Array) -> bool:
    """Whether too many points are looked through along any stretch of ``counts``, shape (k, 2), of ``crossings``."""
    if len(counts) < STRETCH:
        return False
    stretches = np.lib.stride_tricks.sliding_window_view(counts, STRETCH, axis=0).sum(axis=-1)
    # Maximum share along a stretch: correct joins of recordings had at most 0.15; wrong ones in six of seven drives
    # through equal rooms, 0.18 and more.
    stretch_contradiction = 0.18
    return bool((stretches[:, 0] > stretch_contradiction * stretches[:, 1]).any())


def surroundings(keyframes: KeyframeMap, centre: int) -> tuple[NDArray[np.intp], Scan]:
    """Return the numbers of the keyframes around ``centre``, and their points merged in its frame."""
    query_reach = 3.0  # maximum distance from the latest keyframe, m
    numbers = keyframes.around(centre, QUERY_KEYS, query_reach)
    poses = between(keyframes.poses[centre], keyframes.poses[numbers])
    scan = merged([keyframes.frames[k].scan for k in numbers], poses)
    query_cell = 0.1  # edge of squares with about one point each, m
    return numbers, scan.downsampled(query_cell, 320)  # maximum number of points in the query


def _distance(keyframes: KeyframeMap, place: int) -> Array:
    off = keyframes.poses[:, :2] - keyframes.poses[place, :2]
    return np.asarray(np.hypot(off[:, 0], off[:, 1]))


def _way(keyframes: KeyframeMap, hits: list[LoopMatch]) -> float:
    """Return the length of the trajectory between the targets of the matches (m)."""
    first, last = min(hit.target for hit in hits), max(hit.target for hit in hits)
    steps = np.diff(keyframes.poses[first : last + 1, :2], axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())


def contradiction(one: list[Scan], poses: Array, others: list[Scan], other_poses: Array) -> float:
    """Return the share of points in view of the opposite scans that those looked through, 0..1; 0 if none is in view.

    Args:
        one: scans, points in base.
        poses: poses of ``one``, shape (n, 3).
        others: opposite scans.
        other_poses: poses of ``others`` in the same frame, shape (m, 3).
    """
    through, judged = _counted(one, poses, others, other_poses)
    return through / judged if judged else 0.0


def _counted(one: list[Scan], poses: Array, others: list[Scan], other_poses: Array) -> tuple[int, int]:
    """Return the numbers of points that the opposite scans looked through, and of those in their view."""
    through, judged = 0, 0
    for viewers, at, seen, seen_at in ((one, poses, others, other_poses), (others, other_poses, one, poses)):
        for viewer, pose in zip(viewers, at, strict=True):
            view = _view(viewer.points)
            for scan, place in zip(seen, seen_at, strict=True):
                counts = _looked_through(view, transform(between(pose, place), scan.points))
                through += counts[0]
                judged += counts[1]
    return through, judged


def in_view(viewers: list[Scan], poses: Array, points: Array) -> NDArray[np.bool_]:
    """Return which of ``points``, shape (n, 2), at least one scan would have seen: no nearer wall hides them.

    Args:
        viewers: scans, points in base.
        poses: poses of ``viewers`` in the frame of ``points``, shape (m, 3).
        points: shape (n, 2), m.
    """
    seen = np.zeros(len(points), bool)
    for viewer, pose in zip(viewers, poses, strict=True):
        _mark_seen(_view(viewer.points), transform(inverse(pose), points), seen)
    return seen


@njit(cache=True)
def _sector(x, y, sectors):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    return int((math.atan2(y, x) + math.pi) / (2 * math.pi) * sectors) % sectors


@njit(cache=True)
def _view(points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Return the minimum range of each sector and its neighbours (m); 0 if any of the three has no point."""
    sectors = 180  # all round
    nearest = np.full(sectors, np.inf)
    for i in range(points.shape[0]):
        k = _sector(points[i, 0], points[i, 1], sectors)
        nearest[k] = min(nearest[k], math.hypot(points[i, 0], points[i, 1]))
    view = np.zeros(sectors)
    for k in range(sectors):
        a, b, c = nearest[k - 1], nearest[k], nearest[(k + 1) % sectors]
        if math.isfinite(a + b + c):
            view[k] = min(a, b, c)
    return view


@njit(cache=True)
def _sight(view, x, y):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Return the state of a point in a view: 0 out of view, 1 seen, 2 in view and looked through."""
    limit = view[_sector(x, y, len(view))]
    r = math.hypot(x, y)
    # Minimum distance from a point to the surface seen behind it that proves a look through the point, m.
    view_margin = 0.25
    gap = view_margin + 0.04 * r  # allowance for the yaw error, as a share of the range
    if limit <= 0 or r >= limit + gap:
        return 0
    return 2 if r < limit - gap else 1


@njit(cache=True)
def _looked_through(view, points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Return the numbers of points looked through and of points in view."""
    through, judged = 0, 0
    for i in range(points.shape[0]):
        sight = _sight(view, points[i, 0], points[i, 1])
        judged += sight > 0
        through += sight == 2
    return through, judged


@njit(cache=True)
def _vote(view, points, votes):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Count for every point in view whether a scan looks through it (column 0 of ``votes``) or sees it (column 1)."""
    for i in range(points.shape[0]):
        sight = _sight(view, points[i, 0], points[i, 1])
        if sight > 0:
            votes[i, 2 - sight] += 1


@njit(cache=True)
def _mark_seen(view, points, seen):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    for i in range(points.shape[0]):
        if _sight(view, points[i, 0], points[i, 1]) > 0:
            seen[i] = True


def describe(points: Array) -> Array:
    """Return the histogram, shape (20,), of the distances between ``points`` (shape (n, 2), m, about the robot).

    Its sum is 1, or 0 without two points.
    """
    return np.asarray(_distances(points))


def likeness(one: Array, others: Array) -> Array:
    """Return the histogram intersection, 0..1, of ``one``, shape (20,), with each of ``others``, shape (n, 20)."""
    return np.asarray(np.minimum(one, others).sum(axis=1))


@njit(cache=True)
def _distances(points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    descriptor_bins = 20
    result = np.zeros(descriptor_bins)
    descriptor_reach = 5.0  # maximum distance of the descriptor's points from the robot, m
    limit = descriptor_reach * descriptor_reach
    total = 0
    for i in range(points.shape[0]):
        if points[i, 0] ** 2 + points[i, 1] ** 2 > limit:
            continue
        for j in range(i):
            if points[j, 0] ** 2 + points[j, 1] ** 2 > limit:
                continue
            d = np.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            result[min(int(d / (2 * descriptor_reach) * descriptor_bins), descriptor_bins - 1)] += 1.0
            total += 1
    return result / max(total, 1)


class ChangeDetector:
    """Detect changed surroundings: a lift has taken the robot to another floor, or walls have moved.

    The latest keyframes are compared with older ones of the submap used for matching, whose relative drift is small.
    After a change, each side looks through the other's walls, although every single scan fits the previous one.
    """

    def __init__(self) -> None:
        self._counts: deque[Array] = deque(maxlen=STRETCH)
        self._changed = False

    def take(self, keyframes: KeyframeMap, local: NDArray[np.intp]) -> bool:
        """Return whether the latest keyframe completes a stretch over which the map has changed.

        Args:
            keyframes: all keyframes.
            local: numbers of the keyframes in the submap around the latest one.
        """
        newest = len(keyframes) - 1
        older = local[local < newest - STRETCH]
        counts = finished(crossings(keyframes, np.array([newest]), older)) if len(older) else np.zeros((0, 2))
        if not counts[:, 1].any():  # no part of the view was mapped before
            self._counts.clear()
        self._counts.extend(counts)
        before, self._changed = self._changed, stretch_contradicts(np.array(self._counts))
        return self._changed and not before

    def forget(self) -> None:
        """Restart the comparison after keyframes have moved."""
        self._counts.clear()
        self._changed = False
