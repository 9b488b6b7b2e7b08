"""Loop closure: where the robot may have come back to, whether it has, and whether that agrees with everything else.

Candidates are key scans that the drift bound lets lie near, though the graph is not sure of them: the likeliest by place
and the most alike by descriptor. The robot's own submap (not one scan: a corridor looks like itself everywhere) is searched
for in the candidate's by branch and bound and fitted finely. A hit in a small window counts at once; in a wide one it
waits until others, found from different places, agree with it (pairwise consistency: Mangelson et al. 2018). After the
optimisation a closure that the graph resists is taken back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.correlation import correlate
from monstertruck_estimation.slam.frontend import degeneracy, deviations
from monstertruck_estimation.slam.graph import optimise, residuals, trust
from monstertruck_estimation.slam.registration import register
from monstertruck_estimation.slam.scans import Scan, spread
from monstertruck_estimation.slam.se2 import between, compose, inverse, rotation
from monstertruck_estimation.slam.submap import merged

if TYPE_CHECKING:
    from monstertruck_estimation.slam.config import MapperConfig
    from monstertruck_estimation.slam.keymap import KeyMap

Array = NDArray[np.float64]

VIEW: Final = 2.5
"""Two key scans this near see enough of the same, m."""
WIDEST: Final = (12.0, 1.0)
"""Half width of a search at most, m and rad."""
SURE: Final = (1.5, 0.3)
"""Windows up to this need no further witness, m and rad."""
LEAST_SCORE: Final = 0.45
"""Mean likelihood of a submap found again."""
LEAST_OVERLAP: Final = 0.55
"""Share of its points that must fit."""
RIVAL: Final = 0.92
"""A second place this nearly as good makes the first one worthless."""
APART: Final = 1.0
"""Distance at which places are different, m."""
LEVELS: Final = 7
QUERY_POINTS: Final = 320
QUERY_REACH: Final = 3.0
"""Key scans up to this far back make the query, m."""
WITNESSES: Final = 3
"""Hits that must agree before a wide search is believed."""
BASELINE: Final = 1.0
"""Way between the first and the last witness, m."""
CONSISTENT: Final = 11.3
"""Squared Mahalanobis distance of agreeing hits (99 % of chi-square with three degrees of freedom)."""
FORGET: Final = 60
"""Key scans after which a hit without witnesses is forgotten."""
REST: Final = 4
"""Key scans between two searches in the same place without success."""


@dataclass(frozen=True, slots=True)
class _Hit:
    """The newest key scan found near an old one."""

    origin: int
    target: int
    measured: Array
    information: Array
    way: float


class LoopCloser:
    """Finds, checks and adds closures.

    Args:
        config: what is local, and limits.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._hits: list[_Hit] = []
        self._tried: dict[int, int] = {}
        self.refused = 0
        """Closures taken back because the graph resisted."""
        self.searches = 0

    def close(self, keymap: KeyMap) -> bool:
        """Search once from the newest key scan; True if the graph has changed."""
        newest = len(keymap.keys) - 1
        covariances, far = keymap.drift(newest)
        self._hits = [hit for hit in self._hits if newest - hit.target < FORGET]
        changed = False
        for candidate in self._candidates(keymap, covariances, far):
            hit = self._search(keymap, candidate, covariances[candidate])
            self._tried[candidate] = newest
            if hit is None:
                continue
            sure = self._window(covariances[candidate])
            alone = sure[0] <= SURE[0] and sure[1] <= SURE[1]
            witnesses = [hit, *self._agreeing(keymap, hit)]
            enough = len(witnesses) >= WITNESSES and self._baseline(keymap, witnesses) >= BASELINE
            self._hits.append(hit)
            if (alone or enough) and self._accept(keymap, witnesses):
                self._hits = [other for other in self._hits if other not in witnesses]
                changed = True
                break
        return changed

    def forget(self) -> None:
        """Key scans have new numbers: hits and searches from before mean nothing."""
        self._hits.clear()
        self._tried.clear()

    def _window(self, covariance: Array) -> tuple[float, float]:
        place, turn = deviations(covariance)
        return 3 * place + 0.3, 3 * turn + 0.05

    def _candidates(self, keymap: KeyMap, covariances: Array, far: Array) -> list[int]:
        """At most two key scans to look at: the likeliest by place, and one elsewhere that looks most alike."""
        config, newest = self._config, len(keymap.keys) - 1
        off = between(keymap.poses[newest], keymap.poses)
        distance = np.hypot(off[:, 0], off[:, 1])
        reach = np.minimum(3 * np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1]), WIDEST[0])
        possible = (far > config.local_spread**2) & (distance < VIEW + reach)
        for candidate, when in self._tried.items():
            if newest - when < REST:
                possible &= np.hypot(*(keymap.poses[:, :2] - keymap.poses[candidate, :2]).T) > VIEW
        numbers = np.flatnonzero(possible)
        if not len(numbers):
            return []
        cost = distance[numbers] / (VIEW + reach[numbers]) + 0.15 * np.abs(off[numbers, 2])
        first = int(numbers[np.argmin(cost)])
        return [first]

    def _search(self, keymap: KeyMap, candidate: int, covariance: Array) -> _Hit | None:
        """Look for the surroundings of the newest key scan in those of ``candidate``."""
        self.searches += 1
        newest = len(keymap.keys) - 1
        own = keymap.around(newest, 12, QUERY_REACH)
        query = self._query(keymap, own, keymap.poses[newest])
        numbers = keymap.around(candidate, 30)
        numbers = numbers[~np.isin(numbers, own)]
        if not len(numbers):
            return None
        submap = keymap.submap(numbers)
        window = self._window(covariance)
        window = min(window[0], WIDEST[0]), min(window[1], WIDEST[1])
        deviation = max(window[0] / 3, 0.1), max(window[1] / 3, 0.02)
        guess = keymap.poses[newest]
        peak = correlate(submap.grid(LEVELS), query.points, guess, window, deviation, LEAST_SCORE, APART)
        if peak is None or peak.rival > RIVAL * peak.score:
            return None
        fit = register(query, submap.cloud, peak.pose)
        ratio, _ = degeneracy(fit.information)
        moved = between(peak.pose, fit.pose)
        if fit.overlap < LEAST_OVERLAP or ratio < 0.02 or math.hypot(moved[0], moved[1]) > 0.3:
            return None
        near = keymap.poses[numbers]
        origin = int(numbers[np.argmin(np.hypot(*(near[:, :2] - fit.pose[:2]).T))])
        # The information is about x, y in map; the relation is in the frame of its origin.
        turn = np.eye(3)
        turn[:2, :2] = rotation(keymap.poses[origin, 2])
        information = turn.T @ fit.information @ turn
        covariance = np.linalg.inv(information + np.eye(3)) + np.diag((0.03**2, 0.03**2, 0.01**2))
        way = float(len(keymap.keys))
        return _Hit(origin, newest, between(keymap.poses[origin], fit.pose), np.linalg.inv(covariance), way)

    def _query(self, keymap: KeyMap, numbers: NDArray[np.intp], pose: Array) -> Scan:
        """The surroundings in the frame of ``pose``."""
        scan = merged([keymap.keys[k].scan for k in numbers], between(pose, keymap.poses[numbers]))
        kept = spread(scan.points, 0.1)
        if len(kept) > QUERY_POINTS:
            kept = kept[np.linspace(0, len(kept) - 1, QUERY_POINTS).astype(np.intp)]
        return Scan(scan.points[kept], scan.normals[kept], scan.variances[kept])

    def _agreeing(self, keymap: KeyMap, hit: _Hit) -> list[_Hit]:
        """Earlier hits that form a consistent loop with ``hit``."""
        at_target, _ = keymap.drift(hit.target)
        at_origin, _ = keymap.drift(hit.origin)
        result = []
        for other in self._hits:
            if other.target == hit.target:
                continue
            # origin -> target -> other target -> other origin, against the graph's own origin -> other origin.
            step = between(keymap.poses[hit.target], keymap.poses[other.target])
            there = compose(compose(hit.measured, step), inverse(other.measured))
            graph = between(keymap.poses[hit.origin], keymap.poses[other.origin])
            off = between(graph, there)
            spread_ = at_target[other.target] + at_origin[other.origin]
            spread_ = spread_ + np.linalg.inv(hit.information) + np.linalg.inv(other.information)
            place, turn = deviations(spread_)
            if not math.isfinite(place) or place > 1.0:
                continue
            square = (off[0] ** 2 + off[1] ** 2) / place**2 + (off[2] / turn) ** 2
            if square < CONSISTENT:
                result.append(other)
        return result

    def _baseline(self, keymap: KeyMap, hits: list[_Hit]) -> float:
        first, last = min(hit.target for hit in hits), max(hit.target for hit in hits)
        steps = np.diff(keymap.poses[first : last + 1, :2], axis=0)
        return float(np.hypot(steps[:, 0], steps[:, 1]).sum())

    def _accept(self, keymap: KeyMap, hits: list[_Hit]) -> bool:
        """Add the hits, optimise, and take them back if they do not hold or break what held."""
        before, count = keymap.poses, len(keymap.edges)
        edges = keymap.edges.edges()
        _, squares = residuals(before, edges)
        held = trust(squares, edges.loop) > 0.5
        for hit in hits:
            keymap.edges.add(hit.origin, hit.target, hit.measured, hit.information, (0.03**2, 0.01**2), loop=True)
        edges = keymap.edges.edges()
        poses = optimise(before, edges)
        _, squares = residuals(poses, edges)
        holds = trust(squares, edges.loop) > 0.5
        if not holds[count:].all() or (held & ~holds[:count]).sum() > 0.02 * count:
            keymap.edges.cut(count)
            self.refused += len(hits)
            return False
        keymap.poses = poses
        return True
