"""Hybrid-A*: poses grown by drivable moves, guided by two heuristics, compiled.

Beside the short moves a node tries the best obstacle-free motion to the goal and to places further along the way of
``distance_to_go``, so that open ground is crossed in leaps. Source of the idea of analytic expansions: D. Dolgov and
others, "Practical search techniques in path planning for autonomous driving", 2008.
"""

from math import atan2, floor, inf, pi, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_planners.collision_kernels import BodyData, FieldData, row_free
from monstertruck_planners.route.crab_words import MOST_ROWS, connect
from monstertruck_planners.route.distance_to_go import FAR, UNIT, ToGo, cell_at, walk
from monstertruck_planners.route.heap import drop, push
from monstertruck_planners.route.motion_rows import advance
from monstertruck_planners.route.pricing import Layer, row_price
from monstertruck_planners.route.reeds_shepp_words import COST
from monstertruck_planners.route.turning_table import turning_bound

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

RUNNING, FOUND, EXHAUSTED = 0, 1, 2

LEAP = -1
"""Action of a node reached by ``connect``; others are numbers of moves."""


class Car(NamedTuple):
    """What may be driven and what it costs."""

    radius: float
    crab: float
    weights: FloatArray
    """Shape (3,): per metre backward, of a cusp in turning radii, per metre of translation."""
    swing: float
    """Of every row, whose beginning turns the wheels, m."""
    moves: FloatArray
    """Shape (p, 3): the short moves, as motion rows."""
    leaps: FloatArray
    """Lengths of the leaps along the way, m, longest first."""
    step: float
    """Of the collision check, m."""
    margin: float
    """Kept on all sides of the footprint, m."""


class Nodes(NamedTuple):
    """Memory of one search."""

    pose: FloatArray
    """Shape (n, 3)."""
    cost: FloatArray
    parent: IntArray
    action: IntArray
    sense: FloatArray
    """+1 or -1: direction at the end; 0 at the start."""
    closed: NDArray[np.bool_]
    keys: FloatArray
    items: IntArray
    """The heap."""
    table: NDArray[np.int32]
    """Shape (rows, columns, headings): number of the node in each cell plus one, 0 = none."""
    cell: float
    counts: IntArray
    """Used nodes, size of the heap, nodes expanded so far, the node that saw the goal."""


USED, WAITING, EXPANDED, LAST = 0, 1, 2, 3


@njit(cache=True)
def estimate(
    field: FieldData, go: ToGo, table: NDArray[np.float32], car: Car, goal: FloatArray, x: float, y: float, yaw: float
) -> float:
    """The greater of both heuristics, m; inf off the known ways."""
    row, column = cell_at(field, go.cell, x, y)
    if not (0 <= row < go.cost.shape[0] and 0 <= column < go.cost.shape[1]) or go.cost[row, column] >= FAR:
        return inf
    return float(max(go.cost[row, column] * go.cell / UNIT, turning_bound(table, car.radius, x, y, yaw, goal)))


@njit(cache=True)
def rows_cost(
    field: FieldData, layer: Layer, car: Car, pose: FloatArray, rows: FloatArray, count: int, sense: float
) -> float:
    """Cost of rows driven from a pose after a row of direction ``sense``, m."""
    total = 0.0
    x, y, yaw = pose[0], pose[1], pose[2]
    for i in range(count):
        length = rows[i, 0]
        weight = 1.0 if length > 0.0 else car.weights[0]
        if rows[i, 2] != 0.0:
            weight *= car.weights[2]
        total += abs(length) * weight + car.swing
        if length * sense < 0.0:
            total += car.weights[1] * car.radius
        sense = length
        if layer.price.size > 0:
            total += row_price(field, layer, x, y, yaw, length, rows[i, 1], rows[i, 2])
        x, y, yaw = advance(x, y, yaw, length, rows[i, 1], rows[i, 2])
    return total


@njit(cache=True)
def rows_free(field: FieldData, body: BodyData, car: Car, pose: FloatArray, rows: FloatArray, count: int) -> bool:
    """Whether the footprint may drive the rows from a pose."""
    x, y, yaw = pose[0], pose[1], pose[2]
    for i in range(count):
        if not row_free(field, body, car.margin, car.step, x, y, yaw, rows[i, 0], rows[i, 1], rows[i, 2]):
            return False
        x, y, yaw = advance(x, y, yaw, rows[i, 0], rows[i, 1], rows[i, 2])
    return True


@njit(cache=True)
def add(
    field: FieldData, go: ToGo, table: NDArray[np.float32], car: Car, goal: FloatArray, nodes: Nodes, greed: float,
    x: float, y: float, yaw: float, cost: float, parent: int, action: int, sense: float, bound: float,
) -> None:  # fmt: skip
    """Put a pose on the open list if it is the cheapest in its cell and may lead to a solution below ``bound``."""
    if nodes.counts[USED] >= len(nodes.cost):
        return
    left = estimate(field, go, table, car, goal, x, y, yaw)
    if cost + left >= bound:
        return
    row, column = cell_at(field, nodes.cell, x, y)
    headings = nodes.table.shape[2]
    heading = floor(yaw / (2 * pi) * headings + 0.5) % headings
    if not (0 <= row < nodes.table.shape[0] and 0 <= column < nodes.table.shape[1]):
        return
    other = nodes.table[row, column, heading] - 1
    if other >= 0 and nodes.cost[other] <= cost + 1e-9:
        return
    if other >= 0:
        nodes.closed[other] = True
    k = nodes.counts[USED]
    nodes.pose[k, 0], nodes.pose[k, 1], nodes.pose[k, 2] = x, y, yaw
    nodes.cost[k], nodes.parent[k], nodes.action[k], nodes.sense[k], nodes.closed[k] = (
        cost,
        parent,
        action,
        sense,
        False,
    )
    nodes.table[row, column, heading] = k + 1
    nodes.counts[USED] = k + 1
    nodes.counts[WAITING] = push(nodes.keys, nodes.items, nodes.counts[WAITING], cost + greed * left, k)


@njit(cache=True)
def _target(field: FieldData, go: ToGo, x: float, y: float, leap: float, turn: float, target: FloatArray) -> bool:
    """Pose ``leap`` metres along the way to the goal; False if the goal is nearer."""
    row, column = cell_at(field, go.cell, x, y)
    row, column = walk(go.step, row, column, leap / go.cell)
    ahead_row, ahead_column = walk(go.step, row, column, turn / go.cell)
    if go.step[ahead_row, ahead_column] < 0:
        return False
    across, along = (column + 0.5) * go.cell, (row + 0.5) * go.cell
    target[0] = field.x + across * field.cos - along * field.sin
    target[1] = field.y + across * field.sin + along * field.cos
    target[2] = atan2(ahead_row - row, ahead_column - column) + atan2(field.sin, field.cos)
    return True


@njit(cache=True)
def expand(
    field: FieldData, body: BodyData, layer: Layer, go: ToGo, table: NDArray[np.float32], car: Car,
    goal: FloatArray, nodes: Nodes, greed: float, bound: float, sight: float, count: int,
) -> int:  # fmt: skip
    """Expand up to ``count`` nodes.

    Args:
        field: the grid.
        body: the footprint.
        layer: prices.
        go: ways to the goal.
        table: see ``turning_table``.
        car: what may be driven.
        goal: shape (3,).
        nodes: memory.
        greed: factor on the heuristics.
        bound: only cheaper solutions count, m.
        sight: the goal is tried directly from this near, m.
        count: see above.

    Returns:
        RUNNING, FOUND (the node ``counts[LAST]`` sees the goal, cheaper than ``bound``) or EXHAUSTED.
    """
    rows, best, scratch, target = np.empty((MOST_ROWS, 3)), np.empty(8), np.empty((4, 3)), np.empty(3)
    row = np.empty((1, 3))
    for _ in range(count):
        if nodes.counts[WAITING] == 0 or nodes.counts[USED] >= len(nodes.cost):
            return EXHAUSTED
        n = nodes.items[0]
        nodes.counts[WAITING] = drop(nodes.keys, nodes.items, nodes.counts[WAITING])
        if nodes.closed[n]:
            continue
        nodes.closed[n] = True
        nodes.counts[EXPANDED] += 1
        pose, cost, sense = nodes.pose[n], nodes.cost[n], nodes.sense[n]
        away = sqrt((goal[0] - pose[0]) ** 2 + (goal[1] - pose[1]) ** 2)
        if away < sight and (away < 6.0 * car.radius or nodes.counts[EXPANDED] % 4 == 1):
            many = connect(pose, goal, car.radius, car.crab, car.weights, rows, best, scratch)
            if (
                cost + best[COST] * car.radius < bound
                and cost + rows_cost(field, layer, car, pose, rows, many, sense) < bound
                and rows_free(field, body, car, pose, rows, many)
            ):
                nodes.counts[LAST] = n
                return FOUND
        for i in range(len(car.leaps)):
            if not _target(field, go, pose[0], pose[1], car.leaps[i], car.radius, target):
                continue
            many = connect(pose, target, car.radius, car.crab, car.weights, rows, best, scratch)
            if best[COST] * car.radius < 2.0 * car.leaps[i] + 6.0 * car.radius and rows_free(
                field, body, car, pose, rows, many
            ):
                price = rows_cost(field, layer, car, pose, rows, many, sense)
                end = rows[many - 1, 0]
                add(field, go, table, car, goal, nodes, greed, target[0], target[1], target[2], cost + price, n, LEAP,
                    1.0 if end > 0.0 else -1.0, bound)  # fmt: skip
                break
        for i in range(len(car.moves)):
            row[0, 0], row[0, 1], row[0, 2] = car.moves[i, 0], car.moves[i, 1], car.moves[i, 2]
            if rows_free(field, body, car, pose, row, 1):
                x, y, yaw = advance(pose[0], pose[1], pose[2], row[0, 0], row[0, 1], row[0, 2])
                price = rows_cost(field, layer, car, pose, row, 1, sense)
                add(field, go, table, car, goal, nodes, greed, x, y, yaw, cost + price, n, i,
                    1.0 if row[0, 0] > 0.0 else -1.0, bound)  # fmt: skip
    return RUNNING


@njit(cache=True)
def trace(car: Car, goal: FloatArray, nodes: Nodes) -> FloatArray:
    """Motion rows of the solution at ``counts[LAST]``, from the start to the goal."""
    rows, best, scratch = np.empty((MOST_ROWS, 3)), np.empty(8), np.empty((4, 3))
    depth, n = 1, nodes.counts[LAST]
    while nodes.parent[n] >= 0:
        depth += 1
        n = nodes.parent[n]
    chain = np.empty(depth, np.int64)
    n = nodes.counts[LAST]
    for i in range(depth - 1, -1, -1):
        chain[i] = n
        n = nodes.parent[n]
    result = np.empty((depth * MOST_ROWS, 3))
    used = 0
    for i in range(depth):
        n = chain[i]
        last = i == depth - 1
        if not last and nodes.action[chain[i + 1]] >= 0:
            move = nodes.action[chain[i + 1]]
            for k in range(3):
                result[used, k] = car.moves[move, k]
            used += 1
            continue
        target = goal if last else nodes.pose[chain[i + 1]]
        many = connect(nodes.pose[n], target, car.radius, car.crab, car.weights, rows, best, scratch)
        for j in range(many):
            for k in range(3):
                result[used, k] = rows[j, k]
            used += 1
    return result[:used].copy()
