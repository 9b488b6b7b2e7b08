"""The best chain of motions over places along a path, the truck facing either way at each, compiled.

Shortening finds the nearest optimum only: it never turns a truck round that drives a long way forward where backward is
shorter. Here dynamic programming decides at which places the truck faces ahead and where it changes direction.
"""

from math import inf, pi, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.collision_kernels import BodyData, FieldData
from monstertruck_planners.route.crab_words import MOST_ROWS, connect
from monstertruck_planners.route.hybrid_search import Car, rows_cost, rows_free
from monstertruck_planners.route.pricing import Layer
from monstertruck_planners.route.reeds_shepp_words import COST

FloatArray = NDArray[np.float64]


@njit(cache=True)
def redraft(
    field: FieldData, body: BodyData, layer: Layer, car: Car, places: FloatArray, travelled: FloatArray, reach: float
) -> FloatArray:
    """Cheapest free chain from the first place to the last.

    Args:
        field: the grid.
        body: the footprint.
        layer: prices.
        car: limits and costs.
        places: shape (n, 3), poses in the order driven.
        travelled: shape (n,), m.
        reach: a motion leads at most this far along the path, m.

    Returns:
        Motion rows, shape (k, 3); none if no chain is free.
    """
    n = len(places)
    cost, sense = np.full((n, 2), inf), np.zeros((n, 2))
    before = np.full((n, 2), -1, np.int64)
    poses = np.empty((n, 2, 3))
    for i in range(n):
        for k in range(2):
            poses[i, k, 0], poses[i, k, 1], poses[i, k, 2] = places[i, 0], places[i, 1], places[i, 2] + k * pi
    rows, best, scratch = np.empty((MOST_ROWS, 3)), np.empty(8), np.empty((4, 3))
    cost[0, 0] = 0.0
    for j in range(1, n):
        for i in range(j - 1, -1, -1):
            if travelled[j] - travelled[i] > reach and i < j - 1:
                break
            for k in range(4):
                # At the end the truck faces as it has to.
                if j == n - 1 and k >= 2:
                    continue
                a, b, limit = poses[i, k & 1], poses[j, k >> 1], cost[j, k >> 1] - cost[i, k & 1]
                if limit <= sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2):
                    continue
                many = connect(a, b, car.radius, car.crab, car.weights, rows, best, scratch)
                if best[COST] * car.radius >= limit:
                    continue
                price = rows_cost(field, layer, car, a, rows, many, sense[i, k & 1])
                if price < limit and rows_free(field, body, car, a, rows, many):
                    cost[j, k >> 1], before[j, k >> 1] = cost[i, k & 1] + price, 2 * i + (k & 1)
                    sense[j, k >> 1] = rows[many - 1, 0] if many > 0 else sense[i, k & 1]
    return _spelled(car, poses, before)


@njit(cache=True)
def _spelled(car: Car, poses: FloatArray, before: NDArray[np.int64]) -> FloatArray:
    """Rows of the chain that ends at the last place."""
    n = len(poses)
    if before[n - 1, 0] < 0:
        return np.empty((0, 3))
    rows, best, scratch = np.empty((MOST_ROWS, 3)), np.empty(8), np.empty((4, 3))
    chain = np.empty(n, np.int64)
    chain[0] = 2 * (n - 1)
    depth = 1
    while chain[depth - 1] > 0:
        chain[depth] = before[chain[depth - 1] // 2, chain[depth - 1] % 2]
        depth += 1
    result = np.empty((depth * MOST_ROWS, 3))
    used = 0
    for m in range(depth - 1, 0, -1):
        a, b = poses[chain[m] // 2, chain[m] % 2], poses[chain[m - 1] // 2, chain[m - 1] % 2]
        many = connect(a, b, car.radius, car.crab, car.weights, rows, best, scratch)
        for r in range(many):
            result[used, 0], result[used, 1], result[used, 2] = rows[r, 0], rows[r, 1], rows[r, 2]
            used += 1
    return result[:used].copy()
