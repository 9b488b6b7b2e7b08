"""A second opinion on the motion: scan odometry by kiss-icp on a map of its own, compared with the estimate.

It shares nothing with the estimate but the points of the scans: no wheels, no submaps, no pose graph. Each guess is the
motion before (Vizzo et al. 2023). It drifts, so only motions over some seconds are compared.
"""

import math
from collections import deque
from typing import Final

import numpy as np

from monstertruck_estimation.slam.kiss_map import KissMap
from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.worker_io import SlamEstimate
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import LocalisationStatus

JUMPS: Final = frozenset({"closed", "joined", "found", "refuted"})
"""Events after which the estimate's next motion does not follow its last pose."""
COMPARABLE: Final = frozenset({LocalisationStatus.MAPPING, LocalisationStatus.LOCALISED})
"""Elsewhere the estimate says itself that it is in doubt, or in a corridor, where scans do not constrain the motion."""


class KissWitness:
    """Compares the estimate's motion with that by kiss-icp alone."""

    def __init__(self) -> None:
        self._map = KissMap()
        self._pose, self._motion = np.zeros(3), np.zeros(3)
        self._poses: deque[tuple[int, Array, Array]] = deque()
        """Stamp, pose by kiss-icp, pose of the estimate."""

    def compare(self, scan: Scan, estimate: SlamEstimate) -> float | None:
        """Take a scan with the estimate of its pose; how far both motions are apart, m, if that is too much."""
        guess = compose(self._pose, self._motion)
        pose = self._map.align(scan.points, guess)
        if not np.isfinite(pose).all():
            pose = guess
        self._map.update(scan.points, pose)
        self._motion, self._pose = between(self._pose, pose), pose
        if estimate.status not in COMPARABLE or JUMPS.intersection(estimate.events):
            self._poses.clear()
            return None
        self._poses.append((estimate.stamp, pose, np.array(estimate.pose)))
        compared = 5 * SECOND  # time over which motions are compared, ns
        while estimate.stamp - self._poses[0][0] > compared:
            self._poses.popleft()
        _, by_kiss, by_estimate = self._poses[0]
        off = between(between(by_kiss, pose), between(by_estimate, np.array(estimate.pose)))
        distance = math.hypot(off[0], off[1])
        if distance <= 0.2:  # difference of those that is reported, m
            return None
        self._poses.clear()
        return distance
