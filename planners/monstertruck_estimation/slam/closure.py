"""Loop closure: where the robot may have come back to, whether it has, and whether that agrees with everything else.

Candidates are key scans that the drift bound lets lie near though the graph is not sure of them: the likeliest by
place, and the most alike by descriptor. The robot's own surroundings (not one scan: a corridor looks like itself
everywhere) are searched for in the candidate's by branch and bound and fitted finely. A hit in a small window counts at
once; in a wide one it waits until others, found from different places, agree with it (pairwise consistency: Mangelson
et al. 2018). After the optimisation a closure that the graph resists is taken back.

A place seen again from the other side shows little of what it showed before. At the end of a run (``review``), where
the drift is small, so that little else is possible, a hit also counts if what must have been in view of the place fits,
and neither side looked through the other's walls: one such hit proves nothing, so they need witnesses in any window.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_estimation.se2 import between, compose, inverse, rotation, transform
from monstertruck_estimation.slam.correlation import Submap, correlate, merged
from monstertruck_estimation.slam.frontend import degeneracy, deviations
from monstertruck_estimation.slam.graph import optimise, residuals, trust
from monstertruck_estimation.slam.keyframes import KeyMap
from monstertruck_estimation.slam.registration import measure, register
from monstertruck_estimation.slam.scans import Scan

Array = NDArray[np.float64]

VIEW: Final = 2.5
"""Two key scans this near see enough of the same, m."""
WINDOW: Final = 3.0
"""Half width of a search in standard deviations of the drift."""
MARGIN: Final = (0.3, 0.05)
"""What is added to that, m and rad."""
WIDEST: Final = (12.0, 1.0)
"""Half width of a search at most, m and rad."""
SURE: Final = (1.5, 0.3)
"""Hits in windows up to this need no witness, m and rad."""
LEVELS: Final = 7
"""Levels of the pyramid."""
QUERY_KEYS: Final = 12
"""Key scans of the query at most."""
QUERY_REACH: Final = 3.0
"""They are this near to the newest, m."""
QUERY_CELL: Final = 0.1
"""About one of their points is used per square of this edge, m."""
QUERY_POINTS: Final = 320
"""Points of the query at most."""
PLACE_KEYS: Final = 60
"""Key scans of the place it is searched in, at most."""
LEAST_SCORE: Final = 0.45
"""Mean likelihood of surroundings found again."""
LEAST_OVERLAP: Final = 0.55
"""Share of their points that must fit."""
LEAST_RATIO: Final = 0.02
"""Of the eigenvalues of the information on the position: less is a corridor, where a fit proves nothing."""
FARTHEST: Final = 0.3
"""The fine fit ends this near to the coarse one, m."""
CONTRADICTION: Final = 0.15
"""Share of the points looked through by scans of the other side, from which a place is another one."""
PART_SCORE: Final = 0.1
"""Mean likelihood of surroundings of which only a part was seen before,"""
PART_OVERLAP: Final = 0.7
"""share of their points in view of the place that must fit,"""
PART_POINTS: Final = 20
"""least number of those,"""
PART_CONTRADICTION: Final = 0.05
"""share that may be looked through,"""
PART_WIDER: Final = (1.0, 2.0)
"""and how much wider the search is: scans alone drift further than any covariance says."""
REVIEWED: Final = 250
"""Key scans from which it begins, at most."""
RIVAL: Final = 0.9
"""A second place this nearly as good makes the first one worthless."""
APART: Final = 1.0
"""Distance at which places are different, m."""
LEAST_LIKENESS: Final = 0.8
"""Of a candidate by descriptor."""
FLOOR: Final = (0.03, 0.03, 0.01)
"""Standard deviation of a closure, m and rad: its submaps are not rigid."""
WITNESSES: Final = 3
"""Hits that must agree before a wide search is believed, and so many more for each that contradicts."""
BASELINE: Final = 1.0
"""Way between the first and the last of them, m."""
CONSISTENT: Final = 11.3
"""Squared Mahalanobis distance of agreeing hits (99 % of chi-square with three degrees of freedom)."""
STRETCH: Final = 3.0
"""Way on either side of a hit within which the drift is small, so that of two contradicting hits one is false, m."""
VAGUE: Final = 1.0
"""Agreement proves nothing where the drift between the hits is greater, m."""
FORGET: Final = 60
"""Key scans after which a hit without witnesses is forgotten."""
REST: Final = 4
"""Key scans between two searches in the same place."""
BROKEN: Final = 0.02
"""Share of the relations that a closure may strain before it is taken back."""


@dataclass(frozen=True, slots=True, eq=False)
class Hit:
    """The key scan ``target`` found near ``origin``; each is one of its own."""

    origin: int
    target: int
    measured: Array
    information: Array


class LoopCloser:
    """Finds, checks and adds closures."""

    def __init__(self) -> None:
        self._hits: list[Hit] = []
        self._tried: dict[int, int] = {}
        self._fingerprints: list[Array] = []
        self.searches = 0
        """Searches made."""
        self.refused = 0
        """Closures taken back because the graph resisted."""

    def close(self, keymap: KeyMap) -> bool:
        """Search from the newest key scan; True if a closure has moved the poses."""
        newest = len(keymap) - 1
        own = keymap.around(newest, QUERY_KEYS, QUERY_REACH)
        query = _surroundings(keymap, own, newest)
        while len(self._fingerprints) < newest:
            self._fingerprints.append(np.zeros_like(describe(query.points)))
        self._fingerprints.append(describe(query.points))
        covariances, far = keymap.drift(newest)
        self._hits = [hit for hit in self._hits if newest - hit.target < FORGET]
        self._tried = {place: when for place, when in self._tried.items() if newest - when < REST}
        for candidate in self._candidates(keymap, newest, covariances, far):
            self._tried[candidate] = newest
            window = _window(covariances[candidate])
            hit = self._search(keymap, query, own, newest, candidate, window)
            sure = window[0] <= SURE[0] and window[1] <= SURE[1]
            if hit is not None and self._believed(keymap, hit, sure=sure):
                return True
        return False

    def review(self, keymap: KeyMap) -> bool:
        """Search from everywhere (seconds of work) for places of which only a part was seen before.

        For the end of a run: what came after a place belongs to its surroundings then, too. True if a closure has moved
        the poses.
        """
        self._tried.clear()
        count = len(keymap)
        places = np.unique(np.linspace(0, count - 1, min(count, REVIEWED)).astype(np.intp)).tolist()
        hits = [hit for at in places if (hit := self._seen_in_part(keymap, at)) is not None]
        closed = False
        while group := agreed(keymap, hits):
            closed |= self._added(keymap, group)
            hits = [hit for hit in hits if hit not in group]
        return closed

    def forget(self, kept: NDArray[np.bool_]) -> None:
        """Only the marked key scans are left, with new numbers."""
        self._hits.clear()
        self._tried.clear()
        self._fingerprints = [one for one, left in zip(self._fingerprints, kept.tolist(), strict=False) if left]

    def _seen_in_part(self, keymap: KeyMap, at: int) -> Hit | None:
        """Key scan ``at`` found near the likeliest place before it, if little else is possible."""
        covariances, far = keymap.drift(at)
        numbers = self._possible(keymap, at, covariances, far)
        if not len(numbers):
            return None
        place, turn = _window(covariances[numbers[0]])
        if place > SURE[0] or turn > SURE[1]:
            return None
        own = keymap.around(at, QUERY_KEYS, QUERY_REACH)
        query = _surroundings(keymap, own, at)
        tries = (
            self._search(keymap, query, own, at, int(numbers[0]), (place * wider, turn * wider), part=True)
            for wider in PART_WIDER
        )
        return next((hit for hit in tries if hit is not None), None)

    def _candidates(self, keymap: KeyMap, newest: int, covariances: Array, far: Array) -> list[int]:
        """At most two key scans: the likeliest by place, and one elsewhere that looks most alike."""
        numbers = self._possible(keymap, newest, covariances, far)
        if not len(numbers):
            return []
        first = int(numbers[0])
        elsewhere = np.sort(numbers[_distance(keymap, first)[numbers] > VIEW])
        if not len(elsewhere):
            return [first]
        alike = likeness(self._fingerprints[newest], np.array([self._fingerprints[k] for k in elsewhere]))
        best = int(np.argmax(alike))
        return [first, int(elsewhere[best])] if alike[best] > LEAST_LIKENESS else [first]

    def _possible(self, keymap: KeyMap, at: int, covariances: Array, far: Array) -> NDArray[np.intp]:
        """Key scans before ``at`` that may be near it, though the graph is not sure of them, the likeliest first."""
        off = between(keymap.poses[at], keymap.poses)
        distance = np.hypot(off[:, 0], off[:, 1])
        reach = np.minimum(WINDOW * np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1]), WIDEST[0])
        possible = (far > keymap.config.local_spread**2) & (distance < VIEW + reach)
        possible[at:] = False
        for place in self._tried:
            possible &= _distance(keymap, place) > VIEW
        numbers = np.flatnonzero(possible)
        cost = distance[numbers] / (VIEW + reach[numbers]) + 0.15 * np.abs(off[numbers, 2])
        return np.asarray(numbers[np.argsort(cost, kind="stable")])

    def _search(
        self,
        keymap: KeyMap,
        query: Scan,
        own: NDArray[np.intp],
        at: int,
        candidate: int,
        window: tuple[float, float],
        *,
        part: bool = False,
    ) -> Hit | None:
        """Look for ``query``, the surroundings of key scan ``at``, or a part of it, in those of ``candidate``."""
        self.searches += 1
        window = min(window[0], WIDEST[0]), min(window[1], WIDEST[1])
        # All of the window, not only what is round the candidate: a place that looks alike must not win by default.
        numbers = keymap.sure(candidate)
        numbers = numbers[~np.isin(numbers, own)]
        numbers = numbers[_distance(keymap, at)[numbers] < window[0] + keymap.config.local_reach]
        if not len(numbers):
            return None
        numbers = numbers[np.linspace(0, len(numbers) - 1, min(len(numbers), PLACE_KEYS)).astype(np.intp)]
        submap = keymap.submap(numbers)
        deviation = max(window[0] / WINDOW, 0.1), max(window[1] / WINDOW, 0.02)
        guess = keymap.poses[at]
        least = PART_SCORE if part else LEAST_SCORE
        peak = correlate(submap.grid(LEVELS), query.points, guess, window, deviation, least, APART)
        if peak is None or peak.rival > RIVAL * peak.score:
            return None
        fit = register(query, submap.cloud, peak.pose)
        ratio, _ = degeneracy(fit.information)
        moved = between(peak.pose, fit.pose)
        if ratio < LEAST_RATIO or math.hypot(moved[0], moved[1]) > FARTHEST:
            return None
        off = keymap.poses[numbers, :2] - fit.pose[:2]
        near = numbers[np.argsort(np.hypot(off[:, 0], off[:, 1]), kind="stable")][:QUERY_KEYS]
        overlap = _overlap_in_view(keymap, near, query, submap, fit.pose) if part else fit.overlap
        if overlap < (PART_OVERLAP if part else LEAST_OVERLAP):
            return None
        if _contradiction(keymap, own, at, near, fit.pose) > (PART_CONTRADICTION if part else CONTRADICTION):
            return None
        origin = int(near[0])
        # The information is about x, y in map; the relation is in the frame of its origin.
        turn = np.eye(3)
        turn[:2, :2] = rotation(keymap.poses[origin, 2])
        covariance = np.linalg.inv(turn.T @ fit.information @ turn + np.eye(3)) + np.diag(np.square(FLOOR))
        return Hit(origin, at, between(keymap.poses[origin], fit.pose), np.linalg.inv(covariance))

    def _believed(self, keymap: KeyMap, hit: Hit, *, sure: bool) -> bool:
        """Add ``hit`` and what agrees with it to the graph if that is enough, and if the graph bears it."""
        agreeing, against = _compared(keymap, hit, self._hits)
        witnesses = [hit, *agreeing]
        self._hits.append(hit)
        enough = len(witnesses) >= WITNESSES * (1 + len(against)) and _way(keymap, witnesses) >= BASELINE
        if not sure and not enough:
            return False
        if not self._added(keymap, witnesses):
            return False
        self._hits = [other for other in self._hits if other not in witnesses]
        return True

    def _added(self, keymap: KeyMap, hits: list[Hit]) -> bool:
        """Add the hits and optimise; take them back if they do not hold or break what held."""
        before, count = keymap.poses, len(keymap.edges)
        edges = keymap.edges.edges()
        _, squares = residuals(before, edges)
        held = trust(squares, edges.loop) > 0.5
        for hit in hits:
            spread = (FLOOR[0] ** 2, FLOOR[2] ** 2)
            keymap.edges.add(hit.origin, hit.target, hit.measured, hit.information, spread, loop=True)
        edges = keymap.edges.edges()
        poses = optimise(before, edges)
        _, squares = residuals(poses, edges)
        holds = trust(squares, edges.loop) > 0.5
        if not holds[count:].all() or np.count_nonzero(held & ~holds[:count]) > BROKEN * count:
            keymap.edges.cut(count)
            self.refused += len(hits)
            return False
        keymap.poses = poses
        return True


def _compared(keymap: KeyMap, hit: Hit, others: list[Hit]) -> tuple[list[Hit], list[Hit]]:
    """Which of ``others`` form a consistent loop with ``hit``, and which contradict it; of neither nothing is known."""
    agreeing: list[Hit] = []
    against: list[Hit] = []
    others = [other for other in others if other.target != hit.target]
    if not others:
        return agreeing, against
    at_target, _ = keymap.drift(hit.target)
    at_origin, _ = keymap.drift(hit.origin)
    for other in others:
        # Origin to target to the other's target to its origin, against the graph's own way from origin to origin.
        step = between(keymap.poses[hit.target], keymap.poses[other.target])
        there = compose(compose(hit.measured, step), inverse(other.measured))
        off = between(between(keymap.poses[hit.origin], keymap.poses[other.origin]), there)
        drifts = at_target[other.target] + at_origin[other.origin]
        place, turn = deviations(drifts + np.linalg.inv(hit.information) + np.linalg.inv(other.information))
        if place <= VAGUE:
            agrees = (off[0] ** 2 + off[1] ** 2) / place**2 + (off[2] / turn) ** 2 < CONSISTENT
            (agreeing if agrees else against).append(other)
    return agreeing, against


def agreed(keymap: KeyMap, hits: list[Hit]) -> list[Hit]:
    """The most of ``hits`` from one stretch of the way that agree with one of them.

    None if they are not at least ``WITNESSES`` more than those of the same stretch that contradict it. What is further
    away on the way says nothing: both may be right, and the drift more than the graph thinks.
    """
    best: list[Hit] = []
    for hit in hits:
        near = [other for other in hits if _way(keymap, [hit, other]) < STRETCH]
        agreeing, against = _compared(keymap, hit, near)
        group = [hit, *agreeing]
        enough = len(group) >= len(against) + WITNESSES and _way(keymap, group) >= BASELINE
        if enough and len(group) > len(best):
            best = group
    return best


def _window(covariance: Array) -> tuple[float, float]:
    """Half widths of the search, m and rad, for this drift."""
    place, turn = deviations(covariance)
    return WINDOW * place + MARGIN[0], WINDOW * turn + MARGIN[1]


def _contradiction(keymap: KeyMap, own: NDArray[np.intp], newest: int, near: NDArray[np.intp], pose: Array) -> float:
    """Share of the points of ``own`` and ``near`` looked through by the others, were ``newest`` at ``pose``."""
    placed = compose(pose, between(keymap.poses[newest], keymap.poses[own]))
    mine, theirs = ([keymap.keys[k].scan for k in numbers] for numbers in (own, near))
    return contradiction(mine, placed, theirs, keymap.poses[near])


def _overlap_in_view(keymap: KeyMap, near: NDArray[np.intp], query: Scan, submap: Submap, pose: Array) -> float:
    """Share of the points of ``query`` at ``pose`` that fit, of those that ``near`` would have seen; 0 if few."""
    seen = in_view([keymap.keys[k].scan for k in near], keymap.poses[near], transform(pose, query.points))
    if np.count_nonzero(seen) < PART_POINTS:
        return 0.0
    return measure(query.chosen(seen), submap.cloud, pose).overlap


def _surroundings(keymap: KeyMap, numbers: NDArray[np.intp], centre: int) -> Scan:
    """What the numbered key scans saw, in the frame of ``centre``."""
    poses = between(keymap.poses[centre], keymap.poses[numbers])
    return merged([keymap.keys[k].scan for k in numbers], poses).thinned(QUERY_CELL, QUERY_POINTS)


def _distance(keymap: KeyMap, place: int) -> Array:
    off = keymap.poses[:, :2] - keymap.poses[place, :2]
    return np.asarray(np.hypot(off[:, 0], off[:, 1]))


def _way(keymap: KeyMap, hits: list[Hit]) -> float:
    """Way between the places the hits were made from, m."""
    first, last = min(hit.target for hit in hits), max(hit.target for hit in hits)
    steps = np.diff(keymap.poses[first : last + 1, :2], axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())


VIEW_SECTORS: Final = 180
"""Sectors of a scan's view all round."""
VIEW_MARGIN: Final = 0.25
"""Points this much in front of what was seen behind them were looked through, m."""
VIEW_SLACK: Final = 0.04
"""And this share of their range: for the yaw's error."""


def contradiction(one: list[Scan], poses: Array, others: list[Scan], other_poses: Array) -> float:
    """Share of the points in view of the opposite scans, 0..1, that those looked through; 0 if none is in view.

    Args:
        one: scans, points in base.
        poses: shape (n, 3), of ``one``.
        others: the scans they are held against.
        other_poses: shape (m, 3), in the same frame.
    """
    through, judged = 0, 0
    for viewers, at, seen, seen_at in ((one, poses, others, other_poses), (others, other_poses, one, poses)):
        for viewer, pose in zip(viewers, at, strict=True):
            view = _view(viewer.points)
            for scan, place in zip(seen, seen_at, strict=True):
                counts = _looked_through(view, transform(between(pose, place), scan.points))
                through += counts[0]
                judged += counts[1]
    return through / judged if judged else 0.0


def in_view(viewers: list[Scan], poses: Array, points: Array) -> NDArray[np.bool_]:
    """Which of ``points``, shape (n, 2), at least one of the scans would have seen: no nearer wall hides them.

    Args:
        viewers: scans, points in base.
        poses: shape (m, 3), of ``viewers``, in the frame of ``points``.
        points: shape (n, 2), m.
    """
    seen = np.zeros(len(points), bool)
    for viewer, pose in zip(viewers, poses, strict=True):
        _mark_seen(_view(viewer.points), transform(inverse(pose), points), seen)
    return seen


@njit(cache=True)
def _sector(x, y):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    return int((math.atan2(y, x) + math.pi) / (2 * math.pi) * VIEW_SECTORS) % VIEW_SECTORS


@njit(cache=True)
def _view(points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Least range per sector and its neighbours, m; 0 where any of the three saw nothing."""
    nearest = np.full(VIEW_SECTORS, np.inf)
    for i in range(points.shape[0]):
        k = _sector(points[i, 0], points[i, 1])
        nearest[k] = min(nearest[k], math.hypot(points[i, 0], points[i, 1]))
    view = np.zeros(VIEW_SECTORS)
    for k in range(VIEW_SECTORS):
        a, b, c = nearest[k - 1], nearest[k], nearest[(k + 1) % VIEW_SECTORS]
        if math.isfinite(a + b + c):
            view[k] = min(a, b, c)
    return view


@njit(cache=True)
def _looked_through(view, points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    through, judged = 0, 0
    for i in range(points.shape[0]):
        limit = view[_sector(points[i, 0], points[i, 1])]
        r = math.hypot(points[i, 0], points[i, 1])
        gap = VIEW_MARGIN + VIEW_SLACK * r
        if limit > 0 and r < limit + gap:
            judged += 1
            if r < limit - gap:
                through += 1
    return through, judged


@njit(cache=True)
def _mark_seen(view, points, seen):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    for i in range(points.shape[0]):
        limit = view[_sector(points[i, 0], points[i, 1])]
        r = math.hypot(points[i, 0], points[i, 1])
        if limit > 0 and r < limit + VIEW_MARGIN + VIEW_SLACK * r:
            seen[i] = True


DESCRIPTOR_REACH: Final = 5.0
"""Points up to this far from the robot take part, m."""
DESCRIPTOR_BINS: Final = 20


def describe(points: Array) -> Array:
    """Histogram, shape (DESCRIPTOR_BINS,), of the distances between ``points`` (shape (n, 2), m, about the robot).

    Its sum is 1, or 0 without two points.
    """
    return np.asarray(_distances(points))


def likeness(one: Array, others: Array) -> Array:
    """Histogram intersection, 0..1, of ``one`` (DESCRIPTOR_BINS,) with each of ``others`` (n, DESCRIPTOR_BINS)."""
    return np.asarray(np.minimum(one, others).sum(axis=1))


@njit(cache=True)
def _distances(points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    result = np.zeros(DESCRIPTOR_BINS)
    limit = DESCRIPTOR_REACH * DESCRIPTOR_REACH
    total = 0
    for i in range(points.shape[0]):
        if points[i, 0] ** 2 + points[i, 1] ** 2 > limit:
            continue
        for j in range(i):
            if points[j, 0] ** 2 + points[j, 1] ** 2 > limit:
                continue
            d = np.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            result[min(int(d / (2 * DESCRIPTOR_REACH) * DESCRIPTOR_BINS), DESCRIPTOR_BINS - 1)] += 1.0
            total += 1
    return result / max(total, 1)
