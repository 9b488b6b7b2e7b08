"""The baseline: the kiss-icp package without its second downsampling, with guesses from the wheels."""

import math

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.mapping import get_voxel_hash_map
from kiss_icp.registration import get_registration
from kiss_icp.threshold import get_threshold_estimator

VOXEL = 0.5
"""Edge of a cell of its map, m."""
RANGE = 30.0
"""Distance at which it forgets, m."""


class KissOdometry:
    """Registers scan after scan to the package's own map, without loop closures or failure detection."""

    def __init__(self) -> None:
        config = KISSConfig()
        config.data.max_range, config.data.deskew = RANGE, False
        config.mapping.voxel_size = VOXEL
        config.registration.max_num_threads = 1
        self._map = get_voxel_hash_map(config)
        self._registration = get_registration(config)
        self._threshold = get_threshold_estimator(config)
        self._pose = np.eye(4)

    def register(self, points: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Return the motion, (3,), since the last scan, from the guess ``delta``, (3,); ``points``: shape (n, 2)."""
        cloud = np.column_stack((points, np.zeros(len(points))))
        guess = self._pose @ _matrix(delta)
        sigma = self._threshold.get_threshold()
        pose = self._registration.align_points_to_map(cloud, self._map, guess, 3 * sigma, sigma)
        self._threshold.update_model_deviation(np.linalg.inv(guess) @ pose)
        self._map.update(cloud, pose)
        moved = np.linalg.inv(self._pose) @ pose
        self._pose = pose
        return np.array((moved[0, 3], moved[1, 3], math.atan2(moved[1, 0], moved[0, 0])))


def _matrix(pose: np.ndarray) -> np.ndarray:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    matrix = np.eye(4)
    matrix[:2, :2] = (c, -s), (s, c)
    matrix[:2, 3] = pose[:2]
    return matrix
