"""A place's fingerprint that neither turns nor moves with the view: the histogram of distances between its points.

Shape distribution D2 (Osada, Funkhouser, Chazelle, Dobkin 2002) of the surroundings within a few metres.
"""

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

REACH: Final = 5.0
"""Points up to this far from the robot take part, m."""
BINS: Final = 20


def describe(points: Array) -> Array:
    """Shares, shape (BINS,), of the distances between ``points`` (shape (n, 2), m, about the robot); sums to 1 or 0."""
    return np.asarray(_distances(points))


def likeness(one: Array, others: Array) -> Array:
    """Histogram intersection, 0..1, of ``one`` (BINS,) with each of ``others`` (n, BINS)."""
    return np.asarray(np.minimum(one, others).sum(axis=1))


@njit(cache=True)
def _distances(points):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    result = np.zeros(BINS)
    limit = REACH * REACH
    total = 0
    for i in range(points.shape[0]):
        if points[i, 0] ** 2 + points[i, 1] ** 2 > limit:
            continue
        for j in range(i):
            if points[j, 0] ** 2 + points[j, 1] ** 2 > limit:
                continue
            d = np.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            result[min(int(d / (2 * REACH) * BINS), BINS - 1)] += 1.0
            total += 1
    return result / max(total, 1)
