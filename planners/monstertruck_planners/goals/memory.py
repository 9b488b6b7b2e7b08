"""Obstacles that scans showed beside the map, kept until a scan sees through their place.

A robot that looks ahead alone must not forget what stands behind it; so nothing here grows old by itself.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array

BESIDE: Final = 0.012
"""Beams this near in bearing tell of a place, rad: two steps of a URG-04LX."""
THROUGH: Final = 0.10
"""Metres by which all of them must reach beyond it."""


class ObstacleMemory:
    """ActorFactory of obstacles in the map's frame, at most one for each square.

    Args:
        square: m.
    """

    def __init__(self, square: float) -> None:
        self._square = square
        self.places: Array = np.empty((0, 2))
        """Shape (n, 2), m."""

    def look(self, points: Array, sensor: Array) -> None:
        """Forget what a scan saw through. A bearing without a return says nothing.

        Args:
            points: shape (n, 2), the scan's returns.
            sensor: shape (2,), where it was taken.
        """
        self.places = self.places[~seen_through(self.places, points, sensor)]

    def keep(self, points: Array) -> None:
        """Remember places, shape (n, 2)."""
        self.places = _thinned(np.vstack((self.places, points)), self._square)

    def forget(self, where: NDArray[np.bool_]) -> None:
        """Drop those places; shape (n,)."""
        self.places = self.places[~where]


def seen_through(places: Array, points: Array, sensor: Array) -> NDArray[np.bool_]:
    """Whether each place is free as a scan shows it: all its returns in that direction lie beyond.

    Args:
        places: shape (n, 2).
        points: shape (m, 2), the scan's returns.
        sensor: shape (2,), where it was taken.

    Returns:
        Shape (n,).
    """
    if not len(places) or not len(points):
        return np.zeros(len(places), dtype=np.bool_)
    bearings, ranges = _polar(points - sensor)
    order = np.argsort(bearings)
    bearings, ranges = bearings[order], ranges[order]
    # Once round on both sides, so that no window is cut at +-pi.
    bearings = np.concatenate((bearings - 2 * np.pi, bearings, bearings + 2 * np.pi))
    ranges = np.tile(ranges, 3)
    towards, far = _polar(places - sensor)
    first, last = (np.searchsorted(bearings, towards + side) for side in (-BESIDE, BESIDE))
    nearest = np.minimum.reduceat(np.append(ranges, np.inf), np.column_stack((first, last)).ravel())[::2]
    return np.asarray((last > first) & (nearest > far + THROUGH))


def _polar(points: Array) -> tuple[Array, Array]:
    return np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])


def _thinned(points: Array, square: float) -> Array:
    """The first point of each square."""
    _, first = np.unique(np.floor(points / square).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)])
