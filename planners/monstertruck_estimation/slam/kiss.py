"""Front end over kiss-icp: its point-to-point ICP on a voxel map, seeded by the wheels and judged by us.

All points are kept: the package's own second downsampling leaves too few of a planar scan. It tells neither a score nor
a failure, so every result is registered once more by the common measure (overlap, residual, information) and gated.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.frontend import LEAST_PAIRS, Match, Verdict, judge, rejected
from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.submap import Submap

Array = NDArray[np.float64]

VOXEL: Final = 0.1
"""Edge of the voxels of its map, m."""
FARTHEST: Final = 100.0
"""Points of the map farther away are forgotten by the package, m."""
PER_VOXEL: Final = 20
REACH: Final = 0.5
"""Greatest distance of a pair, m."""
KERNEL: Final = 0.1
"""Distance at which a pair's influence drops, m."""


class Kiss:
    """``KissOdometry`` as a front end, judged against the submap."""

    def __init__(self) -> None:
        self._odometry = KissOdometry()

    def locate(self, scan: Scan, delta: Array, guess: Array, covariance: Array, submap: Submap) -> Match:
        """See ``FrontEnd``."""
        if len(scan) < LEAST_PAIRS or len(submap.cloud) < LEAST_PAIRS:
            return rejected(guess, covariance, Verdict.EMPTY)
        moved = self._odometry.register(scan.points, delta)
        pose = compose(compose(guess, inverse(delta)), moved)
        return judge(measure(scan, submap.cloud, pose), guess, covariance)


def _matrix(pose: Array) -> Array:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    result = np.eye(4)
    result[:2, :2] = (c, -s), (s, c)
    result[:2, 3] = pose[:2]
    return result
