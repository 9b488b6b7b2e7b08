"""kiss-icp (Vizzo et al. 2023) for planar scans: its map and registration as a scan matcher.

All points are kept, because the package's own second downsampling leaves too few of a planar scan. The matcher returns
neither a score nor a failure, so every result is evaluated like those of the built-in matcher (overlap, residual,
information) and passes the same gate.
"""

import math

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.mapping import VoxelHashMap
from kiss_icp.registration import get_registration

from monstertruck_estimation.slam.correlation import Submap
from monstertruck_estimation.slam.registration import measure
from monstertruck_estimation.slam.scan_matcher import MatchStatus, ScanMatch, enough, gated, rejected
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array


class KissMap:
    """Points in one frame, for the registration of scans."""

    def __init__(self) -> None:
        config = KISSConfig()
        config.registration.max_num_threads = 1
        self._registration = get_registration(config)
        voxel = 0.1  # edge of the voxels of its map, m
        max_distance = 100.0  # distance beyond which the package forgets points of the map, m
        per_voxel = 20
        self._map = VoxelHashMap(voxel, max_distance, per_voxel)

    def clear(self) -> None:
        """Forget all points."""
        self._map.clear()

    def add(self, points: Array) -> None:
        """Add points, (n, 2) (m)."""
        self._map.add_points(_spatial(points))

    def update(self, points: Array, pose: Array) -> None:
        """Add the points, (n, 2), of a scan at ``pose``, (3,), and forget distant points."""
        self._map.update(_spatial(points), _matrix(pose))

    def align(self, points: Array, guess: Array) -> Array:
        """Return a scan's pose, (3,): the guess for an empty map, not finite if the registration failed."""
        if self._map.empty():
            return guess
        reach = 0.5  # maximum distance of a pair, m
        found = self._registration.align_points_to_map(
            points=_spatial(points),
            voxel_map=self._map,
            initial_guess=_matrix(guess),
            max_correspondance_distance=reach,
            kernel=0.1,  # distance at which a pair's influence drops, m
        )
        return np.array((found[0, 3], found[1, 3], math.atan2(found[1, 0], found[0, 0])))


def _spatial(points: Array) -> Array:
    """Return points (n, 2) as points (n, 3) at height 0 (m)."""
    return np.column_stack((points, np.zeros(len(points))))


def _matrix(pose: Array) -> Array:
    """Return a planar pose (3,) (m, rad) as a homogeneous matrix (4, 4)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    result = np.eye(4)
    result[:2, :2] = (c, -s), (s, c)
    result[:2, 3] = pose[:2]
    return result


class KissMatcher:
    """``ScanMatcher`` that registers to the mapper's submap, so that its map moves with loop closures."""

    def __init__(self) -> None:
        self._map = KissMap()
        self._submap: Submap | None = None

    def match(self, scan: Scan, delta: Array, guess: Array, covariance: Array, submap: Submap) -> ScanMatch:
        """See ``ScanMatcher``."""
        if not (enough(len(scan)) and enough(len(submap.cloud))):
            return rejected(guess, covariance, MatchStatus.EMPTY)
        if submap is not self._submap:
            self._submap = submap
            self._map.clear()
            self._map.add(submap.cloud.points)
        pose = self._map.align(scan.points, guess)
        if not np.isfinite(pose).all():
            return rejected(guess, covariance, MatchStatus.FAR)
        return gated(measure(scan, submap.cloud, pose), guess, covariance)
