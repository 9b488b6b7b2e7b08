"""Joint registration of all key scans: the last word on a map, for the end of a run or a quiet moment.

Every key scan is paired with those nearest to it, across time; every round linearises each pair's registration at the
present poses (one Gauss-Newton step's information and wish) and lets the pose graph settle them all at once. That is
iterative closest point over the whole map (Lu, Milios 1997; Borrmann et al. 2008) with surface elements.
"""

import itertools
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.graph import Edges, optimise
from monstertruck_estimation.slam.registration import CELL, normal_equations
from monstertruck_estimation.slam.se2 import between, wrap
from monstertruck_estimation.slam.store import Key

Array = NDArray[np.float64]

NEIGHBOURS: Final = 2
"""Key scans before it that each is paired with anyway."""
PARTNERS: Final = 12
"""Earlier key scans each is paired with, at most."""
REACH: Final = 4.5
"""Distance of a partner at most, m; an angle of view counts as TURN metres per radian."""
TURN: Final = 1.0
SPACING: Final = 1.0
"""Of the key scans on this much way one at most is a partner, beside the neighbours in time, m."""
STRETCH: Final = 4
"""Key scans within which a pair takes the place of a loop's relation."""
LEAST_OVERLAP: Final = 0.4
FARTHEST: Final = 0.2
"""A pair that wishes to move further than this, m, is not believed in this round."""


def partners(poses: Array) -> NDArray[np.int64]:
    """Pairs (earlier, later), shape (n, 2): the two before in time, and the nearest of every stretch of the past."""
    result: list[tuple[int, int]] = []
    steps = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
    stretch = np.floor(np.cumsum(steps) / SPACING).astype(np.int64)
    for k in range(1, len(poses)):
        result += [(j, k) for j in range(max(k - NEIGHBOURS, 0), k)]
        off = between(poses[k], poses[: max(k - NEIGHBOURS, 0)])
        cost = np.hypot(off[:, 0], off[:, 1]) + TURN * np.abs(off[:, 2])
        near = np.flatnonzero(cost < REACH)
        near = near[np.argsort(cost[near], kind="stable")]
        _, first = np.unique(stretch[near], return_index=True)
        result += [(int(j), k) for j in near[np.sort(first)][:PARTNERS]]
    return np.array(result, dtype=np.int64).reshape(-1, 2)


def refine(keys: list[Key], poses: Array, steady: Edges, loops: Edges, rounds: int = 8) -> Array:
    """Poses, shape (n, 3), at which all scans fit each other best.

    Args:
        keys: the key scans.
        poses: shape (n, 3), where they are.
        steady: relations that hold anyway (odometry).
        loops: relations that hold where no pair of scans takes their place: two views of one place from opposite sides
            overlap too little to be a pair, and without their closure what follows it would drift away again.
        rounds: at most.
    """
    pairs = partners(poses)
    for turn in range(rounds):
        reach = CELL if turn < rounds // 2 else CELL / 2
        wishes = _linearised(keys, poses, pairs, reach)
        missed = loops.chosen(~_covered(loops, wishes))
        moved = optimise(poses, steady.joined(missed).joined(wishes), iterations=3)
        change = float(np.abs(between(poses, moved)[:, :2]).max())
        poses = moved
        if change < 5e-4 and reach < CELL:
            break
    return poses


def _covered(loops: Edges, wishes: Edges) -> NDArray[np.bool_]:
    """Which of ``loops`` have a wish between key scans less than about ``STRETCH`` from their own at either end."""
    known = np.unique(_stretches(wishes.origin, wishes.target, 0, 0))
    result = np.zeros(len(loops), bool)
    for i, j in itertools.product((-1, 0, 1), repeat=2):
        result |= np.isin(_stretches(loops.origin, loops.target, i, j), known)
    return result


def _stretches(origin: NDArray[np.int64], target: NDArray[np.int64], i: int, j: int) -> NDArray[np.int64]:
    """One number for the two stretches that a relation joins, each that many further."""
    return np.asarray((origin // STRETCH + i) * (1 << 32) + target // STRETCH + j)


def _linearised(keys: list[Key], poses: Array, pairs: NDArray[np.int64], reach: float) -> Edges:
    """One relation per overlapping pair: where a Gauss-Newton step would take it, and how sure that is."""
    places = between(poses[pairs[:, 0]], poses[pairs[:, 1]])
    measured, information, kept = np.zeros((len(pairs), 3)), np.zeros((len(pairs), 3, 3)), np.zeros(len(pairs), bool)
    for k, (i, j) in enumerate(pairs.tolist()):
        h, g, found = normal_equations(keys[j].scan, keys[i].cloud, places[k], reach)
        if found < LEAST_OVERLAP * len(keys[j].scan):
            continue
        step = -np.linalg.solve(h + np.diag((1.0, 1.0, 1.0)), g)
        if np.hypot(step[0], step[1]) > FARTHEST:
            continue
        measured[k], information[k], kept[k] = places[k] + step, h, True
    measured[:, 2] = wrap(measured[:, 2])
    return Edges(pairs[:, 0], pairs[:, 1], measured, information, pairs[:, 1] - pairs[:, 0] > NEIGHBOURS).chosen(kept)
