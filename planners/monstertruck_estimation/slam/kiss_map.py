"""kiss-icp's registration and voxel map (Vizzo et al. 2023) for planar scans.

All points are kept: the package's own second downsampling leaves too few of a planar scan.
"""

import math

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.mapping import VoxelHashMap
from kiss_icp.registration import get_registration

from monstertruck_kinematics.elementary import Array


class KissMap:
    """Points in one frame, to which scans are registered."""

    def __init__(self) -> None:
        config = KISSConfig()
        config.registration.max_num_threads = 1
        self._registration = get_registration(config)
        voxel = 0.1  # edge of the voxels of its map, m
        max_distance = 100.0  # points of the map farther away are forgotten by the package, m
        per_voxel = 20
        self._map = VoxelHashMap(voxel, max_distance, per_voxel)

    def clear(self) -> None:
        """Forget all points."""
        self._map.clear()

    def add(self, points: Array) -> None:
        """Take points, (n, 2), m."""
        self._map.add_points(_spatial(points))

    def update(self, points: Array, pose: Array) -> None:
        """Take the points, (n, 2), of a scan at ``pose``, (3,), and forget those that are far from it."""
        self._map.update(_spatial(points), _matrix(pose))

    def align(self, points: Array, guess: Array) -> Array:
        """Pose, (3,), of a scan; the guess where the map is empty. Not finite where the registration failed."""
        if self._map.empty():
            return guess
        reach = 0.5  # greatest distance of a pair, m
        found = self._registration.align_points_to_map(
            points=_spatial(points),
            voxel_map=self._map,
            initial_guess=_matrix(guess),
            max_correspondance_distance=reach,
            kernel=0.1,  # distance at which a pair's influence drops, m
        )
        return np.array((found[0, 3], found[1, 3], math.atan2(found[1, 0], found[0, 0])))


def _spatial(points: Array) -> Array:
    """Points (n, 2) as points (n, 3) at height 0, m."""
    return np.column_stack((points, np.zeros(len(points))))


def _matrix(pose: Array) -> Array:
    """A planar pose (3,), m and rad, as a homogeneous matrix (4, 4)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    result = np.eye(4)
    result[:2, :2] = (c, -s), (s, c)
    result[:2, 3] = pose[:2]
    return result
