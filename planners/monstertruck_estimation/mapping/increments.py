"""How the base moved between two matched scans, by the scans alone: what odometry may be corrected by."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.mapping.exchange import Moved
from monstertruck_estimation.slam.frontend import Match
from monstertruck_estimation.slam.se2 import between, rotation

Array = NDArray[np.float64]

UNKNOWN: Final = np.diag((1e-4, 1e-4, 1e-2))
"""Added to every information: what a scan does not tell has a standard deviation of 100 m, or of 10 rad."""
FLOOR: Final = (0.002, 0.001)
"""Standard deviation of any match, m and rad: the cells of the map are not finer."""


class Increments:
    """Relates every match to the one before; what was rejected is stepped over."""

    def __init__(self) -> None:
        self._last: tuple[int, Array] | None = None

    def take(self, stamp: int, match: Match, pose: Array, *, corrected: bool = False) -> Moved | None:
        """The motion since the last match that was accepted.

        Args:
            stamp: of the scan, ns.
            match: the scan's place; its covariance contains the guess, its information does not.
            pose: shape (3,), the same place after the step, when a loop may have been closed.
            corrected: the map was changed at this step: the next motion begins at ``pose``.
        """
        if not match.accepted or match.information is None:
            if corrected:
                self._last = None
            return None
        last, self._last = self._last, (stamp, pose.copy() if corrected else match.pose)
        if last is None:
            return None
        since, origin = last
        turn = np.eye(3)
        turn[:2, :2] = rotation(-match.pose[2])
        covariance = turn @ np.linalg.inv(_known(match, match.information) + UNKNOWN) @ turn.T
        covariance = (covariance + covariance.T) / 2 + np.diag(np.square((FLOOR[0], FLOOR[0], FLOOR[1])))
        x, y, yaw = between(origin, match.pose).tolist()
        return Moved(since, (x, y, yaw), tuple(covariance.ravel().tolist()))

    def forget(self) -> None:
        """What was before cannot be compared with what comes."""
        self._last = None


def _known(match: Match, information: Array) -> Array:
    """Information without what a degenerate match says along its weak direction.

    That comes from no wall, but from the ends of the walls in sight, which go along with the robot.
    """
    if not match.degenerate:
        return information
    along = np.array((math.cos(match.direction), math.sin(match.direction), 0.0))
    weight = information @ along
    return information - np.outer(weight, weight) / max(float(along @ weight), 1e-9)
