"""Bounded memory: key scans that show what others show are left out, and their relations are handed to a neighbour."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.graph import Edges
from monstertruck_estimation.slam.se2 import between, compose, compose_jacobians, inverse

Array = NDArray[np.float64]

FRESH: Final = 60
"""The newest key scans are never left out."""
VIEW: Final = 0.7
"""A radian between two views counts as this many metres."""


def redundancy(poses: Array) -> Array:
    """Distance, m, from every pose to the nearest view of the same; shape (n,). Small means dispensable."""
    result = np.full(len(poses), np.inf)
    for k in range(1, len(poses)):
        off = between(poses[k], poses)
        distance = np.hypot(off[:, 0], off[:, 1]) + VIEW * np.abs(off[:, 2])
        distance[k] = np.inf
        result[k] = distance.min()
    return result


def thinned(
    poses: Array, edges: Edges, spread: Array, odometry: NDArray[np.bool_], share: float
) -> tuple[NDArray[np.bool_], NDArray[np.int64], Edges, Array, NDArray[np.bool_]]:
    """Leave out the most dispensable ``share`` of the poses, no two of them related, never the first.

    Every relation of one left out is composed with its surest relation, so that it holds for the neighbour at that
    one's other end: marginalisation along one edge.

    Returns:
        Marks of those left out (n,), the neighbour that stands in for each (itself if it stays) (n,), and the relations
        of the rest with their ``spread`` and ``odometry`` marks, in the old numbering.
    """
    count = len(poses)
    surest = np.linalg.det(edges.information)
    gone = np.zeros(count, bool)
    stand_in = np.arange(count)
    link = np.full(count, -1)
    touching: list[list[int]] = [[] for _ in range(count)]
    for k, (i, j) in enumerate(zip(edges.origin.tolist(), edges.target.tolist(), strict=True)):
        touching[i].append(k)
        touching[j].append(k)
    allowance = int(share * count)
    for node in np.argsort(redundancy(poses), kind="stable").tolist():
        if not allowance:
            break
        if node == 0 or node >= count - FRESH or not touching[node]:
            continue
        others = {int(edges.origin[k] + edges.target[k] - node) for k in touching[node]}
        if any(gone[other] for other in others):
            continue
        best = max(touching[node], key=lambda k: float(surest[k]))
        gone[node], link[node] = True, best
        stand_in[node] = int(edges.origin[best] + edges.target[best] - node)
        allowance -= 1
    return (gone, stand_in, *_handed_over(edges, spread, odometry, gone, stand_in, link))


def _handed_over(
    edges: Edges,
    spread: Array,
    odometry: NDArray[np.bool_],
    gone: NDArray[np.bool_],
    stand_in: NDArray[np.int64],
    link: NDArray[np.int64],
) -> tuple[Edges, Array, NDArray[np.bool_]]:
    origin, target = edges.origin.copy(), edges.target.copy()
    measured, information, spread = edges.measured.copy(), edges.information.copy(), spread.copy()
    for k in np.flatnonzero(gone[origin] | gone[target]).tolist():
        node = int(origin[k] if gone[origin[k]] else target[k])
        best = int(link[node])
        if k == best:
            continue
        far = int(origin[k] + target[k] - node)
        first, first_spread = _seen_from(edges, best, int(stand_in[node]))
        second, second_spread = _seen_from(edges, k, node)
        by_first, by_second = compose_jacobians(first, second)
        covariance = by_first @ first_spread @ by_first.T + by_second @ second_spread @ by_second.T
        origin[k], target[k] = stand_in[node], far
        measured[k], information[k] = compose(first, second), np.linalg.inv(covariance)
        spread[k] += spread[best]
    kept = (origin != target) & ~gone[origin] & ~gone[target]
    kept &= _surest(origin, target, odometry, np.linalg.det(information))
    moved = Edges(origin[kept], target[kept], measured[kept], information[kept], edges.loop[kept])
    return moved, spread[kept], odometry[kept]


def _surest(
    origin: NDArray[np.int64], target: NDArray[np.int64], odometry: NDArray[np.bool_], sureness: Array
) -> NDArray[np.bool_]:
    """Marks of the best relation of each kind between two key scans.

    Relations handed over share what they were composed with: taken together they would claim more than they know, and
    their number would grow with the way.
    """
    low, high = np.minimum(origin, target), np.maximum(origin, target)
    order = np.lexsort((-sureness, odometry, high, low))
    keys = np.stack((low, high, odometry))[:, order]
    first = np.ones(len(order), bool)
    first[1:] = (keys[:, 1:] != keys[:, :-1]).any(axis=0)
    result = np.zeros(len(order), bool)
    result[order[first]] = True
    return result


def _seen_from(edges: Edges, k: int, node: int) -> tuple[Array, Array]:
    """Measurement and covariance of edge ``k`` with ``node`` as origin."""
    measured, covariance = edges.measured[k], np.linalg.inv(edges.information[k])
    if edges.origin[k] == node:
        return measured, covariance
    c, s = np.cos(measured[2]), np.sin(measured[2])
    back = inverse(measured)
    turn = -np.array(((c, s, -back[1]), (-s, c, back[0]), (0.0, 0.0, 1.0)))
    return back, turn @ covariance @ turn.T
