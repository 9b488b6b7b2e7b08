"""A* over a state lattice, compiled: cells and headings are exact, the goal is met by one obstacle-free motion."""

from math import cos, inf, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.collision_kernels import BodyData, FieldData
from monstertruck_planners.route.crab_words import connect
from monstertruck_planners.route.distance_to_go import FAR, UNIT, ToGo, cell_at
from monstertruck_planners.route.heap import drop, push
from monstertruck_planners.route.hybrid_search import EXHAUSTED, FOUND, RUNNING, Car, rows_cost, rows_free
from monstertruck_planners.route.lattice_moves import ANGLES
from monstertruck_planners.route.pricing import Layer, row_price
from monstertruck_planners.route.reeds_shepp_words import COST

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

HEADINGS = 16
SPREAD = 1 << 15
"""Cells either side of the start."""


class Lattice(NamedTuple):
    """Moves, see ``lattice_moves.Moves``, and the frame: the start is cell (0, 0), heading 0."""

    rows: FloatArray
    shift: IntArray
    cost: FloatArray
    number: IntArray
    cell: float
    frame: FloatArray
    """Shape (3,): the start's pose."""


class States(NamedTuple):
    """Memory of one search; states are numbered in the order they are met."""

    place: IntArray
    """Shape (n, 3): column, row, heading."""
    cost: FloatArray
    parent: IntArray
    move: IntArray
    closed: NDArray[np.bool_]
    keys: FloatArray
    items: IntArray
    buckets: IntArray
    """Hash table, a power of two long: state number plus one; 0 = empty."""
    counts: IntArray
    """States, heap size, expanded, the state that saw the goal."""


@njit(cache=True)
def pose_of(lattice: Lattice, place: IntArray, out: FloatArray) -> None:
    """Pose of a state."""
    c, s = cos(lattice.frame[2]), sin(lattice.frame[2])
    x, y = place[0] * lattice.cell, place[1] * lattice.cell
    out[0] = lattice.frame[0] + x * c - y * s
    out[1] = lattice.frame[1] + x * s + y * c
    out[2] = lattice.frame[2] + ANGLES[place[2]]


@njit(cache=True)
def _find(states: States, column: int, row: int, heading: int) -> int:
    """Index in the hash table of a place: its own, or the empty one it would get."""
    mask = len(states.buckets) - 1
    key = ((column + SPREAD) << 20) ^ ((row + SPREAD) << 4) ^ heading
    i = (key * 0x9E3779B97F4A7C1) >> 12 & mask
    while states.buckets[i] > 0:
        k = states.buckets[i] - 1
        if states.place[k, 0] == column and states.place[k, 1] == row and states.place[k, 2] == heading:
            break
        i = (i + 1) & mask
    return i


@njit(cache=True)
def meet(
    field: FieldData, go: ToGo, lattice: Lattice, states: States, greed: float, bound: float,
    column: int, row: int, heading: int, cost: float, parent: int, move: int,
) -> None:  # fmt: skip
    """Note a way to a state, if it is the cheapest so far and may lead to a solution below ``bound``."""
    where = np.array([column, row, heading])
    pose = np.empty(3)
    pose_of(lattice, where, pose)
    r, c = cell_at(field, go.cell, pose[0], pose[1])
    if not (0 <= r < go.cost.shape[0] and 0 <= c < go.cost.shape[1]) or go.cost[r, c] >= FAR:
        return
    left = go.cost[r, c] * go.cell / UNIT
    if cost + left >= bound:
        return
    i = _find(states, column, row, heading)
    k = states.buckets[i] - 1
    if k < 0:
        k = states.counts[0]
        if k >= len(states.cost):
            return
        states.counts[0] = k + 1
        states.buckets[i] = k + 1
        states.place[k, 0], states.place[k, 1], states.place[k, 2] = column, row, heading
        states.cost[k] = inf
    if cost >= states.cost[k] - 1e-9 or states.counts[1] >= len(states.keys) - 1:
        return
    states.cost[k], states.parent[k], states.move[k], states.closed[k] = cost, parent, move, False
    states.counts[1] = push(states.keys, states.items, states.counts[1], cost + greed * left, k)


@njit(cache=True)
def expand(
    field: FieldData, body: BodyData, layer: Layer, go: ToGo, car: Car, lattice: Lattice, goal: FloatArray,
    states: States, greed: float, bound: float, count: int,
) -> int:  # fmt: skip
    """Expand up to ``count`` states; returns as ``hybrid_search.expand`` does."""
    rows, best, scratch, pose = np.empty((5, 3)), np.empty(8), np.empty((4, 3)), np.empty(3)
    for _ in range(count):
        if states.counts[1] == 0:
            return EXHAUSTED
        n = states.items[0]
        states.counts[1] = drop(states.keys, states.items, states.counts[1])
        if states.closed[n]:
            continue
        states.closed[n] = True
        states.counts[2] += 1
        pose_of(lattice, states.place[n], pose)
        if sqrt((goal[0] - pose[0]) ** 2 + (goal[1] - pose[1]) ** 2) < 4.0 * car.radius:
            many = connect(pose, goal, car.radius, car.crab, car.weights, rows, best, scratch)
            if (
                states.cost[n] + best[COST] * car.radius < bound
                and states.cost[n] + rows_cost(field, layer, car, pose, rows, many, 0.0) < bound
                and rows_free(field, body, car, pose, rows, many)
            ):
                states.counts[3] = n
                return FOUND
        heading = states.place[n, 2]
        for k in range(lattice.number[heading]):
            pieces = lattice.rows[heading, k]
            used = 0
            while used < 3 and pieces[used, 0] != 0.0:
                used += 1
            if not rows_free(field, body, car, pose, pieces, used):
                continue
            price = lattice.cost[heading, k]
            if layer.price.size > 0:
                price += row_price(field, layer, pose[0], pose[1], pose[2], pieces[0, 0], pieces[0, 1], pieces[0, 2])
            shift = lattice.shift[heading, k]
            meet(field, go, lattice, states, greed, bound, states.place[n, 0] + shift[0], states.place[n, 1] + shift[1],
                 (heading + shift[2]) % HEADINGS, states.cost[n] + price, n, k)  # fmt: skip
    return RUNNING


@njit(cache=True)
def trace(car: Car, lattice: Lattice, goal: FloatArray, states: States) -> FloatArray:
    """Motion rows from the start to the goal."""
    depth, n = 0, states.counts[3]
    while states.parent[n] >= 0:
        depth += 1
        n = states.parent[n]
    result = np.empty((3 * depth + 5, 3))
    used, n = 3 * depth + 5, states.counts[3]
    rows, best, scratch, pose = np.empty((5, 3)), np.empty(8), np.empty((4, 3)), np.empty(3)
    pose_of(lattice, states.place[n], pose)
    many = connect(pose, goal, car.radius, car.crab, car.weights, rows, best, scratch)
    for i in range(many - 1, -1, -1):
        used -= 1
        result[used] = rows[i]
    while states.parent[n] >= 0:
        pieces = lattice.rows[states.place[states.parent[n], 2], states.move[n]]
        for i in range(2, -1, -1):
            if pieces[i, 0] != 0.0:
                used -= 1
                result[used] = pieces[i]
        n = states.parent[n]
    return result[used:].copy()
