"""Scan matcher over kiss-icp: its point-to-point ICP on a voxel map, started at the predicted pose.

It returns neither a score nor a failure, so every result is measured as ours are (overlap, residual, information) and
passes the same gate.
"""

import numpy as np

from monstertruck_estimation.slam.correlation import Submap
from monstertruck_estimation.slam.kiss_map import KissMap
from monstertruck_estimation.slam.registration import measure
from monstertruck_estimation.slam.scan_matcher import MIN_PAIRS, MatchStatus, ScanMatch, gated, rejected
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array


class KissMatcher:
    """See ``ScanMatcher``; the map it registers to is the mapper's submap, so that loop closures move it too."""

    def __init__(self) -> None:
        self._map = KissMap()
        self._submap: Submap | None = None

    def match(self, scan: Scan, delta: Array, guess: Array, covariance: Array, submap: Submap) -> ScanMatch:
        """See ``ScanMatcher``."""
        if len(scan) < MIN_PAIRS or len(submap.cloud) < MIN_PAIRS:
            return rejected(guess, covariance, MatchStatus.EMPTY)
        if submap is not self._submap:
            self._submap = submap
            self._map.clear()
            self._map.add(submap.cloud.points)
        pose = self._map.align(scan.points, guess)
        if not np.isfinite(pose).all():
            return rejected(guess, covariance, MatchStatus.FAR)
        return gated(measure(scan, submap.cloud, pose), guess, covariance)
