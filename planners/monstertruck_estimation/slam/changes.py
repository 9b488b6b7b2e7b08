"""Detection of changed surroundings: a lift has taken the robot to another floor, or walls have moved.

The latest keyframes are compared with older ones of the submap used for matching, whose relative drift is small. After
a change, each side looks through the other's walls, although every single scan fits the previous one.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.budget import finished
from monstertruck_estimation.slam.closure import STRETCH, crossings, stretch_contradicts
from monstertruck_estimation.slam.keyframes import KeyframeMap
from monstertruck_kinematics.elementary import Array


class ChangeDetector:
    """Compare every new keyframe with the mapped surroundings."""

    def __init__(self) -> None:
        self._counts: deque[Array] = deque(maxlen=STRETCH)
        self._changed = False

    def take(self, keyframes: KeyframeMap, local: NDArray[np.intp]) -> bool:
        """Return whether the latest keyframe completes a stretch over which the map has changed.

        Args:
            keyframes: all keyframes.
            local: numbers of the keyframes in the submap around the latest one.
        """
        newest = len(keyframes) - 1
        older = local[local < newest - STRETCH]
        counts = finished(crossings(keyframes, np.array([newest]), older)) if len(older) else np.zeros((0, 2))
        if not counts[:, 1].any():  # no part of the view was mapped before
            self._counts.clear()
        self._counts.extend(counts)
        before, self._changed = self._changed, stretch_contradicts(np.array(self._counts))
        return self._changed and not before

    def forget(self) -> None:
        """Restart the comparison after keyframes have moved."""
        self._counts.clear()
        self._changed = False
