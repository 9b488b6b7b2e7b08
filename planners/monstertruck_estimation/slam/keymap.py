"""The map as key scans and relations: what is near, what is sure, submaps, and growing and thinning of the graph."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.frontend import deviations
from monstertruck_estimation.slam.graph import drift, optimise
from monstertruck_estimation.slam.refinement import refine
from monstertruck_estimation.slam.registration import Cloud, register
from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.se2 import between
from monstertruck_estimation.slam.store import EdgeStore, Key
from monstertruck_estimation.slam.submap import Submap, merged
from monstertruck_estimation.slam.thinning import thinned

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]

RECENT: Final = 5
"""Key scans this few apart are neighbours in time: their relation is no loop."""
LEAST_OVERLAP: Final = 0.4
LEAST_PAIRS: Final = 20
FARTHEST: Final = (0.15, 0.1)
"""Two key scans that the submap put right do not move further than this against each other, m and rad."""
FLOOR: Final = (0.005, 0.005, 0.002)
"""Standard deviation of any relation between scans, m and rad."""
VIEW: Final = 0.7
"""A radian between two views counts as this many metres."""


class KeyMap:
    """Key scans with poses in map, and the graph between them.

    Args:
        config: noise and limits.
    """

    def __init__(self, config: MapperConfig) -> None:
        self.config = config
        self.keys: list[Key] = []
        self.poses: Array = np.zeros((0, 3))
        self.edges = EdgeStore()

    def __len__(self) -> int:
        return len(self.keys)

    def add(self, scan: Scan, stamp: int, pose: Array) -> None:
        """A new key scan, without relations."""
        kept = scan.thinned(self.config.key_cell, self.config.key_points)
        self.keys.append(Key(stamp, kept, Cloud.of(kept)))
        self.poses = np.vstack((self.poses, pose))

    def relate_by_odometry(self, delta: Array, covariance: Array) -> None:
        """The way from the last key scan but one to the last."""
        new = len(self) - 1
        place, turn = deviations(covariance)
        information: Array = np.asarray(np.linalg.inv(covariance + 1e-6 * np.eye(3)), dtype=np.float64)
        self.edges.add(new - 1, new, delta, information, (place**2, turn**2), odometry=True)

    def relate_by_scans(self, local: Numbers) -> None:
        """Relations of the newest key scan to those of ``local`` that it overlaps, the nearest first."""
        new = len(self) - 1
        order = local[np.argsort(self._closeness(local, self.poses[new]), kind="stable")]
        linked = 0
        for other in (new - 1, *(int(k) for k in order if k != new - 1)):
            linked += self._link(other, new)
            if linked == self.config.neighbours:
                break

    def _link(self, origin: int, target: int) -> bool:
        """Relate two key scans that overlap where they are now; False if they do not fit."""
        config = self.config
        guess = between(self.poses[origin], self.poses[target])
        fit = register(self.keys[target].scan, self.keys[origin].cloud, guess)
        off = between(guess, fit.pose)
        far = math.hypot(off[0], off[1]) > FARTHEST[0] or abs(off[2]) > FARTHEST[1]
        if far or fit.overlap < LEAST_OVERLAP or fit.pairs < LEAST_PAIRS:
            return False
        place = config.drift_distance[0] + config.drift_distance[1] * math.hypot(guess[0], guess[1])
        turn = config.drift_turn[0] + config.drift_turn[1] * abs(float(guess[2]))
        covariance: Array = np.asarray(np.linalg.inv(fit.information + np.eye(3)), dtype=np.float64)
        weakest, _ = deviations(covariance)
        information = np.linalg.inv(covariance + np.diag(np.square(FLOOR)))
        spread = (place**2 + weakest**2, turn**2)
        self.edges.add(origin, target, fit.pose, information, spread, loop=origin < target - RECENT)
        return True

    def drift(self, source: int) -> tuple[Array, Array]:
        """Bound of the drift against ``source``: covariances in its frame, and summed variances."""
        return drift(self.poses, self.edges.edges(), self.edges.spread, source)

    def sure(self, source: int) -> Numbers:
        """Numbers, rising, of the key scans that are sure against ``source``."""
        _, far = self.drift(source)
        return np.asarray(np.flatnonzero(far <= self.config.local_spread**2))

    def around(self, source: int, most: int, reach: float | None = None) -> Numbers:
        """Numbers of the key scans near ``source`` that are sure against it, nearest first."""
        near, centre = self.sure(source), self.poses[source]
        off = self.poses[near, :2] - centre[:2]
        near = near[np.hypot(off[:, 0], off[:, 1]) <= (reach or self.config.local_reach)]
        order = np.argsort(self._closeness(near, centre), kind="stable")
        return np.asarray(near[order][:most])

    def local(self) -> Numbers:
        """Numbers, rising, of the key scans that make the submap around the newest one."""
        newest = len(self) - 1
        return np.union1d(self.around(newest, self.config.local_keys), np.arange(max(newest - 2, 0), newest + 1))

    def submap(self, numbers: Numbers) -> Submap:
        """Cloud of the numbered key scans in map."""
        return Submap(Cloud.of(merged([self.keys[k].scan for k in numbers], self.poses[numbers])))

    def optimise(self) -> None:
        """Fit all poses to all relations; the first stays."""
        self.poses = optimise(self.poses, self.edges.edges())

    def refine(self) -> None:
        """Register all key scans jointly: seconds of work."""
        if len(self) > 1:
            edges = self.edges.edges()
            self.poses = refine(self.keys, self.poses, edges.chosen(self.edges.odometry), edges.chosen(edges.loop))

    def thin(self) -> tuple[NDArray[np.bool_], NDArray[np.int64], Array]:
        """Leave out key scans that others stand in for.

        Returns:
            For every former key scan whether it is kept, (n,), the number by which it is known now, (n,), and its pose
            in the frame of the key scan of that number, (n, 3).
        """
        gone, stand_in, edges, spread, odometry = thinned(
            self.poses, self.edges.edges(), self.edges.spread, self.edges.odometry, self.config.thinning
        )
        offset = between(self.poses[stand_in], self.poses)
        number = np.cumsum(~gone) - 1
        self.edges.replace(edges.renumbered(number), spread, odometry)
        self.keys = [key for key, left_out in zip(self.keys, gone.tolist(), strict=True) if not left_out]
        self.poses = self.poses[~gone]
        return ~gone, number[stand_in], offset

    def _closeness(self, numbers: Numbers, pose: Array) -> Array:
        off = between(pose, self.poses[numbers])
        return np.asarray(np.hypot(off[:, 0], off[:, 1]) + VIEW * np.abs(off[:, 2]))
