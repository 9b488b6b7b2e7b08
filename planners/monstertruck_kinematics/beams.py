"""Beams of a scanner by their directions: equally spaced, clockwise or counter-clockwise, up to a full turn."""

import math

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array


def nearest_beams(bearings: NDArray[np.floating], start: float | Array, step: float | Array) -> NDArray[np.intp]:
    """Return the number of the beam nearest to each bearing.

    Where no beam points in this direction, the result is at least the number of beams.

    Args:
        bearings: shape (n,) or (m, n), rad.
        start: bearing of the first beam, or of the first beams of m scans (m, 1), rad.
        step: angle from each beam to the next, negative clockwise, rad; shape as ``start``. 0: there is a single beam,
            which is the nearest one to all bearings.

    Returns:
        Shape as ``bearings``, never negative.
    """
    sense = np.where(np.less(step, 0.0), -1.0, 1.0)
    width = np.where(np.equal(step, 0.0), math.tau, np.abs(step))
    turned = np.remainder((bearings - start) * sense + width / 2, math.tau) - width / 2
    return np.maximum(np.rint(turned / width), 0.0).astype(np.intp)


def is_full_turn(count: int, step: float) -> bool:
    """Whether the last of ``count`` beams, ``step`` rad apart, is a neighbour of the first."""
    return count > 1 and (count + 0.5) * abs(step) > math.tau
