"""How the base moved between two matched scans, by the scans alone: what odometry may be corrected by."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.exchange import Moved
from monstertruck_estimation.slam.frontend import DOUBTFUL, Match
from monstertruck_estimation.slam.se2 import between, rotation

Array = NDArray[np.float64]

UNKNOWN: Final = np.diag((1e-4, 1e-4, 1e-2))
"""Added to every information: what a scan does not tell has a standard deviation of 100 m, or of 10 rad."""
FLOOR: Final = (0.002, 0.001)
"""Standard deviation of any match, m and rad: the cells of the map are not finer."""
SHORT: Final = 0.15
"""So much less than usual a match may overlap to count again after a misfit."""
LEARNING: Final = 0.05
"""Weight of one match in the usual overlap."""


class Increments:
    """Relates every match to the one before it.

    Beside odometry only matches that overlap well tell a motion, and none tells it across a misfit: the robot may have
    been carried, and what fits half at a wrong place does not count before the overlap is as usual again. Where
    nothing else tells any motion, misfits are stepped over, and what was accepted counts.
    """

    def __init__(self) -> None:
        self._last: tuple[int, Array] | None = None
        self._usual = 0.0
        """Overlap of the matches that counted, their running mean; 0 before the first."""
        self._least = DOUBTFUL

    def take(self, stamp: int, match: Match, pose: Array, *, alone: bool, corrected: bool = False) -> Moved | None:
        """The motion since the last match that counts.

        Args:
            stamp: of the scan, ns.
            match: the scan's place; its covariance contains the guess, its information does not.
            pose: shape (3,), the same place after the step, when a loop may have been closed.
            alone: there is no odometry.
            corrected: the map was changed at this step: the next motion begins at ``pose``.
        """
        if match.information is None or not (alone or match.overlap >= self._least):
            self._least = max(DOUBTFUL, self._usual - SHORT)
            if corrected or not alone:
                self._last = None
            return None
        self._least = DOUBTFUL
        self._usual += (match.overlap - self._usual) * (LEARNING if self._usual else 1.0)
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
        self._last, self._least = None, DOUBTFUL


def _known(match: Match, information: Array) -> Array:
    """Information without what a degenerate match says along its weak direction.

    That comes from no wall, but from the ends of the walls in sight, which go along with the robot.
    """
    if not match.degenerate:
        return information
    along = np.array((math.cos(match.direction), math.sin(match.direction), 0.0))
    weight = information @ along
    return information - np.outer(weight, weight) / max(float(along @ weight), 1e-9)
