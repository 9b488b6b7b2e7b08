"""Scan matcher over kiss-icp: its point-to-point ICP on a voxel map, started at the predicted pose.

All points are kept: the package's own second downsampling leaves too few of a planar scan. It returns neither a score
nor a failure, so every result is measured as ours are (overlap, residual, information) and passes the same gate.
"""

from typing import Final

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.mapping import VoxelHashMap
from kiss_icp.registration import get_registration

from monstertruck_estimation.slam.correlation import Submap
from monstertruck_estimation.slam.registration import measure
from monstertruck_estimation.slam.scan_matcher import MIN_PAIRS, MatchStatus, ScanMatch, gated, rejected
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array

VOXEL: Final = 0.1
"""Edge of the voxels of its map, m."""
MAX_CORRECTION: Final = 100.0
"""Points of the map farther away are forgotten by the package, m."""
PER_VOXEL: Final = 20
REACH: Final = 0.5
"""Greatest distance of a pair, m."""
KERNEL: Final = 0.1
"""Distance at which a pair's influence drops, m."""


class KissMatcher:
    """See ``ScanMatcher``; the map it registers to is the mapper's submap, so that loop closures move it too."""

    def __init__(self) -> None:
        config = KISSConfig()
        config.registration.max_num_threads = 1
        self._registration = get_registration(config)
        self._map = VoxelHashMap(VOXEL, MAX_CORRECTION, PER_VOXEL)
        self._submap: Submap | None = None

    def match(self, scan: Scan, delta: Array, guess: Array, covariance: Array, submap: Submap) -> ScanMatch:
        """See ``ScanMatcher``."""
        if len(scan) < MIN_PAIRS or len(submap.cloud) < MIN_PAIRS:
            return rejected(guess, covariance, MatchStatus.EMPTY)
        if submap is not self._submap:
            self._submap = submap
            self._map.clear()
            self._map.add_points(spatial(submap.cloud.points))
        found = self._registration.align_points_to_map(
            points=spatial(scan.points),
            voxel_map=self._map,
            initial_guess=matrix(guess),
            max_correspondance_distance=REACH,
            kernel=KERNEL,
        )
        pose = np.array((found[0, 3], found[1, 3], np.arctan2(found[1, 0], found[0, 0])))
        if not np.isfinite(pose).all():
            return rejected(guess, covariance, MatchStatus.FAR)
        return gated(measure(scan, submap.cloud, pose), guess, covariance)


def spatial(points: Array) -> Array:
    """Points (n, 2) as points (n, 3) at height 0, m."""
    return np.column_stack((points, np.zeros(len(points))))


def matrix(pose: Array) -> Array:
    """A planar pose (3,), m and rad, as a homogeneous matrix (4, 4)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    result = np.eye(4)
    result[:2, :2] = (c, -s), (s, c)
    result[:2, 3] = pose[:2]
    return result
