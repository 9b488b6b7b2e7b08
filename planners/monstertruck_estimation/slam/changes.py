"""Detect that the mapped surroundings of the robot are gone: a lift has taken it to another floor, or walls moved.

The latest keyframes are compared with older ones of the submap that scans are matched to, whose relative drift is
small. Both sides look through each other's walls then, although scan after scan fits.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.budget import finished
from monstertruck_estimation.slam.closure import STRETCH, crossings, stretch_contradicts
from monstertruck_estimation.slam.keyframes import KeyframeMap
from monstertruck_kinematics.elementary import Array


class ChangeDetector:
    """Compare every new keyframe with what the map shows around it."""

    def __init__(self) -> None:
        self._counts: deque[Array] = deque(maxlen=STRETCH)
        self._changed = False

    def take(self, keyframes: KeyframeMap, local: NDArray[np.intp]) -> bool:
        """Return whether the latest keyframe completes a stretch in which the map has changed.

        Args:
            keyframes: all keyframes.
            local: numbers of those in the submap around the latest one.
        """
        newest = len(keyframes) - 1
        older = local[local < newest - STRETCH]
        counts = finished(crossings(keyframes, np.array([newest]), older)) if len(older) else np.zeros((0, 2))
        if not counts[:, 1].any():  # nothing of what is in view was mapped before
            self._counts.clear()
        self._counts.extend(counts)
        before, self._changed = self._changed, stretch_contradicts(np.array(self._counts))
        return self._changed and not before

    def forget(self) -> None:
        """Begin anew: keyframes have moved."""
        self._counts.clear()
        self._changed = False
