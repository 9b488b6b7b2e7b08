"""Pose graph in the plane: sparse Levenberg-Marquardt over relative poses, robust against false loop closures.

The residual of an edge is the pose of ``target`` in the frame of ``origin`` minus its measurement. Loop edges are
weighted by dynamic covariance scaling (Agarwal, Tipaldi, Spinello, Stachniss, Burgard 2013): switchable constraints in
closed form.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import splu

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, wrap

Index = NDArray[np.int64]

SWITCH: Final = 12.0
"""Maximum squared Mahalanobis residual of a loop edge with full weight."""
SETTLED: Final = 1e-4
"""Convergence threshold: maximum change of a pose in the last step, m or rad."""


@dataclass(frozen=True, slots=True)
class Edges:
    """Edges between poses, as arrays with one row per edge."""

    origin: Index
    """Shape (n,)."""
    target: Index
    """Shape (n,)."""
    measured: Array
    """Measured poses of the targets in the frames of their origins, shape (n, 3)."""
    information: Array
    """Shape (n, 3, 3)."""
    loop: NDArray[np.bool_]
    """Whether each edge may be wrong, shape (n,)."""

    def __len__(self) -> int:
        return len(self.origin)

    def chosen(self, kept: NDArray[np.bool_]) -> "Edges":
        """Return the marked edges."""
        return Edges(self.origin[kept], self.target[kept], self.measured[kept], self.information[kept], self.loop[kept])

    def renumbered(self, number: Index) -> "Edges":
        """Return the same edges with pose k renumbered to ``number[k]``."""
        return Edges(number[self.origin], number[self.target], self.measured, self.information, self.loop)

    def joined(self, other: "Edges") -> "Edges":
        """Return the edges of both graphs."""
        return Edges(
            np.concatenate((self.origin, other.origin)),
            np.concatenate((self.target, other.target)),
            np.concatenate((self.measured, other.measured)),
            np.concatenate((self.information, other.information)),
            np.concatenate((self.loop, other.loop)),
        )


def residuals(poses: Array, edges: Edges) -> tuple[Array, Array]:
    """Return residuals, shape (n, 3), and squared Mahalanobis norms, shape (n,), of ``edges``."""
    off = between(poses[edges.origin], poses[edges.target]) - edges.measured
    off[:, 2] = wrap(off[:, 2])
    return off, np.einsum("ni,nij,nj->n", off, edges.information, off)


def robust_weights(squares: Array, loop: NDArray[np.bool_], switch: float = SWITCH) -> Array:
    """Return the weight in (0, 1] of every edge from its squared residual; 1 for all edges but loop closures."""
    scale = np.minimum(1.0, 2 * switch / (switch + squares))
    return np.where(loop, scale**2, 1.0)


def parts(edges: Edges, count: int) -> Index:
    """Return the connected component that each of ``count`` poses belongs to, shape (count,)."""
    graph = csr_matrix((np.ones(len(edges), np.int8), (edges.origin, edges.target)), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    return np.asarray(labels, dtype=np.int64)


def optimise(poses: Array, edges: Edges, iterations: int = 30) -> Array:
    """Return the poses, shape (n, 3), that fit the edges best; the first pose of each component is fixed.

    The optimisation starts from ``poses``. At first, loop edges have full weight however large their residual, and are
    then down-weighted step by step (graduated non-convexity: Yang, Antonante, Tzoumas, Carlone 2020): a true closure of
    a long loop starts as far off as a false one.
    """
    if not len(edges):
        return poses
    _, fixed = np.unique(parts(edges, len(poses)), return_index=True)
    pattern = _Pattern(edges, len(poses), fixed)
    damping = 1e-6
    off, squares = residuals(poses, edges)
    switch = SWITCH * max(1.0, float(squares[edges.loop].max(initial=0.0)) / SWITCH)
    cost = _cost(squares, edges.loop, switch)
    for _ in range(iterations):
        step = pattern.solve(poses, edges, off, robust_weights(squares, edges.loop, switch), damping)
        moved = poses + step
        moved[:, 2] = wrap(moved[:, 2])
        off_now, squares_now = residuals(moved, edges)
        cost_now = _cost(squares_now, edges.loop, switch)
        if cost_now > cost * (1 + 1e-9):
            damping = max(damping * 100, 1e-4)
            if damping > 1e6:
                break
            continue
        poses, off, squares = moved, off_now, squares_now
        damping = max(damping / 10, 1e-9)
        settled = np.abs(step).max() < SETTLED or cost - cost_now < 1e-6 * cost
        if settled and switch == SWITCH:
            break
        doubt = 4.0  # factor of the decrease per step
        switch = max(SWITCH, switch / doubt)
        cost = _cost(squares, edges.loop, switch)
    return poses


def _cost(squares: Array, loop: NDArray[np.bool_], switch: float) -> float:
    """Return the sum of the robust costs that belong to ``robust_weights``."""
    scale = np.minimum(1.0, 2 * switch / (switch + squares))
    robust = scale**2 * squares + switch * (1 - scale) ** 2
    return float(np.where(loop, robust, squares).sum())


class _Pattern:
    """Sparse normal equations of one set of edges: ordered once for low fill-in, assembled again in every step."""

    def __init__(self, edges: Edges, count: int, fixed: Index) -> None:
        self._count = count
        place = _ordering(edges, count)
        self._place, self._fixed = place, place[fixed]
        a, b = place[edges.origin], place[edges.target]
        own = np.arange(count)
        rows = np.concatenate((a, a, b, b, own))
        columns = np.concatenate((a, b, a, b, own))
        keys = rows * count + columns
        unique, slots = np.unique(keys, return_inverse=True)
        self._slots = np.ascontiguousarray(slots[: 4 * len(edges)].reshape(4, -1).T)
        self._diagonal = slots[4 * len(edges) :]
        self._columns = unique % count
        self._offsets = np.searchsorted(unique, np.arange(count + 1) * count)
        self._a, self._b = a, b

    def solve(self, poses: Array, edges: Edges, off: Array, weights: Array, damping: float) -> Array:
        """Return one damped Gauss-Newton step, shape (n, 3)."""
        ground = damping * np.eye(3)
        data = np.zeros((len(self._columns), 3, 3))
        data[self._diagonal] = ground
        data[self._diagonal[self._fixed]] = 1e12 * np.eye(3)
        gradient = np.zeros((self._count, 3))
        ends = poses[edges.origin], poses[edges.target]
        _assemble(*ends, off, edges.information, weights, self._a, self._b, self._slots, data, gradient)
        rows = bsr_matrix((data, self._columns, self._offsets)).tocsr()
        # Symmetric: rows equal columns.
        matrix = csc_matrix((rows.data, rows.indices, rows.indptr), shape=rows.shape)
        factors = splu(matrix, permc_spec="NATURAL", options={"SymmetricMode": True, "DiagPivotThresh": 0.0})
        return -np.asarray(factors.solve(gradient.ravel())).reshape(-1, 3)[self._place]


def _ordering(edges: Edges, count: int) -> Index:
    """Return the position of every pose among the unknowns, shape (count,), by minimum degree on the graph."""
    own = np.arange(count)
    rows = np.concatenate((edges.origin, edges.target, own))
    columns = np.concatenate((edges.target, edges.origin, own))
    ones = np.concatenate((np.full(2 * len(edges), -1.0), np.full(count, 2.0 * len(edges) + 1.0)))
    pattern = csc_matrix((ones, (rows, columns)), shape=(count, count))
    factors = splu(pattern, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True, "DiagPivotThresh": 0.0})
    return np.asarray(factors.perm_c, dtype=np.int64)


@njit(cache=True)
def _assemble(
    origins: Array, targets: Array, off: Array, information: Array, weights: Array, first: Index, second: Index,
    slots: Index, data: Array, gradient: Array,
) -> None:  # fmt: skip
    """Add every edge's blocks to ``data`` at its four ``slots``, and its gradient to ``gradient``."""
    by_origin, by_target = np.zeros((3, 3)), np.zeros((3, 3))
    by_origin[2, 2], by_target[2, 2] = -1.0, 1.0
    for e in range(first.size):
        c, s = math.cos(origins[e, 2]), math.sin(origins[e, 2])
        dx, dy = targets[e, 0] - origins[e, 0], targets[e, 1] - origins[e, 1]
        by_target[0, 0], by_target[0, 1], by_target[1, 0], by_target[1, 1] = c, s, -s, c
        by_origin[0, 0], by_origin[0, 1], by_origin[1, 0], by_origin[1, 1] = -c, -s, s, -c
        by_origin[0, 2], by_origin[1, 2] = -s * dx + c * dy, -c * dx - s * dy
        for i in range(3):
            for m in range(3):
                left, right = 0.0, 0.0
                for k in range(3):
                    left += by_origin[k, i] * information[e, k, m]
                    right += by_target[k, i] * information[e, k, m]
                left *= weights[e]
                right *= weights[e]
                gradient[first[e], i] += left * off[e, m]
                gradient[second[e], i] += right * off[e, m]
                for j in range(3):
                    data[slots[e, 0], i, j] += left * by_origin[m, j]
                    data[slots[e, 1], i, j] += left * by_target[m, j]
                    data[slots[e, 2], i, j] += right * by_origin[m, j]
                    data[slots[e, 3], i, j] += right * by_target[m, j]


def drift(poses: Array, edges: Edges, spread: Array, source: int) -> tuple[Array, Array]:
    """Return the covariance of every pose in the frame of ``source``, along the path of least variance in the graph.

    The result is an upper bound, since other paths are ignored.

    Args:
        poses: poses of the graph, shape (n, 3).
        edges: m edges of the graph.
        spread: variances of each edge's translation (per axis, m^2) and yaw (rad^2), shape (m, 2).
        source: number of the reference pose.

    Returns:
        Covariances, shape (n, 3, 3), infinite for unconnected poses; and the paths' summed variance (m^2), shape (n,).
    """
    count = len(poses)
    lever = 4.0  # lever arm that converts an error of the yaw into an error of the translation, m
    variance = spread[:, 0] + spread[:, 1] * lever**2
    low, high = np.minimum(edges.origin, edges.target), np.maximum(edges.origin, edges.target)
    order = np.lexsort((variance, high, low))
    low, high = low[order], high[order]
    first = np.ones(len(low), bool)
    first[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    kept = order[first]
    low, high = low[first], high[first]
    shape = (count, count)
    graph = csr_matrix((variance[kept], (low, high)), shape=shape)
    far, before = dijkstra(  # type: ignore[call-overload]  # its stubs know no sparse arrays of a fixed type
        graph, directed=False, indices=source, return_predecessors=True
    )
    numbers = low * count + high
    parents = before.astype(np.int64)
    nodes = np.arange(count)
    pair = np.minimum(parents, nodes) * count + np.maximum(parents, nodes)
    taken = kept[np.minimum(np.searchsorted(numbers, pair), len(kept) - 1)] if len(kept) else np.zeros(count, np.int64)
    steps = spread[taken] if len(kept) else np.zeros((count, 2))
    local = between(poses[source], poses)
    covariances = _carry(local, np.argsort(far, kind="stable"), parents, steps, source)
    return covariances, np.asarray(far)


@njit(cache=True)
def _carry(local: Array, order: Index, parents: Index, steps: Array, source: int) -> Array:
    """Compound covariances from parent to child; ``local`` are the poses in the frame of the source."""
    result = np.full((local.shape[0], 3, 3), np.inf)
    result[source] = 0.0
    for node in order:
        parent = parents[node]
        if parent < 0:
            continue
        dx, dy = local[node, 0] - local[parent, 0], local[node, 1] - local[parent, 1]
        turn = np.eye(3)
        turn[0, 2] = -dy
        turn[1, 2] = dx
        carried = turn @ result[parent] @ turn.T
        carried[0, 0] += steps[node, 0]
        carried[1, 1] += steps[node, 0]
        carried[2, 2] += steps[node, 1]
        result[node] = carried
    return result
