"""Hybrid-A*: poses grown by drivable moves, guided by two heuristics, compiled.

Beside the short moves a node tries the best obstacle-free motion to the goal and to places further along the way of
``distance_to_go``, so that open ground is crossed in leaps. Source of the idea of analytic expansions: D. Dolgov and
others, "Practical search techniques in path planning for autonomous driving", 2008.
"""

import math
from dataclasses import dataclass
from math import atan2, floor, pi, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import BodyData, FieldData
from monstertruck_planners.route.api import Budget
from monstertruck_planners.route.heuristic import ToGo, cell_at, estimate, walk
from monstertruck_planners.route.motion import advance
from monstertruck_planners.route.reeds_shepp import COST, MOST_ROWS, connect
from monstertruck_planners.route.search import EXHAUSTED, FOUND, RUNNING, Car, Layer, drop, push, rows_cost, rows_free

IntArray = NDArray[np.int64]


LEAP = -1
"""Action of a node reached by ``connect``; others are numbers of moves."""


class Nodes(NamedTuple):
    """Memory of one search."""

    pose: Array
    """Shape (n, 3)."""
    cost: Array
    parent: IntArray
    action: IntArray
    sense: Array
    """+1 or -1: direction at the end; 0 at the start."""
    closed: NDArray[np.bool_]
    keys: Array
    items: IntArray
    """The heap."""
    table: NDArray[np.int32]
    """Shape (rows, columns, headings): number of the node in each cell plus one, 0 = none."""
    cell: float
    counts: IntArray
    """Used nodes, size of the heap, nodes expanded so far, the node that saw the goal."""


USED, WAITING, EXPANDED, LAST = 0, 1, 2, 3


@njit(cache=True)
def add(
    field: FieldData, go: ToGo, table: NDArray[np.float32], car: Car, goal: Array, nodes: Nodes, greed: float,
    x: float, y: float, yaw: float, cost: float, parent: int, action: int, sense: float, bound: float,
) -> None:  # fmt: skip
    """Put a pose on the open list if it is the cheapest in its cell and may lead to a solution below ``bound``."""
    if nodes.counts[USED] >= len(nodes.cost):
        return
    left = estimate(field, go, table, car.radius, goal, x, y, yaw)
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
def _target(field: FieldData, go: ToGo, x: float, y: float, leap: float, turn: float, target: Array) -> bool:
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
    goal: Array, nodes: Nodes, greed: float, bound: float, sight: float, count: int,
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
def trace(car: Car, goal: Array, nodes: Nodes) -> Array:
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


CHUNK = 256
"""Nodes expanded between two looks at the budget."""

MOST_NODES = 400_000
"""In one """


MOST_POSES = 1 << 26
"""Told apart in one search: a table of 256 MB, of which only what is visited takes memory."""


@dataclass(frozen=True)
class Level:
    """How finely poses are told apart."""

    cell: float
    """In turning radii."""
    move: float
    """The same."""
    headings: int = 36

    def fitting(self, field: FieldData, radius: float) -> "Level":
        """This level, or on a map too large for it a coarser one.

        Args:
            field: the map.
            radius: turning radius, m.
        """
        poses = field.occupied.size * (field.resolution / (self.cell * radius)) ** 2 * self.headings
        factor = max(math.sqrt(poses / MOST_POSES), 1.0)
        return Level(self.cell * factor, self.move * factor, self.headings)


LEVELS = (Level(0.35, 0.55), Level(0.15, 0.25), Level(0.06, 0.1, 72))
"""The second one is for narrow places, where the first finds nothing soon; the third where that is at its end."""


@dataclass(frozen=True)
class Question:
    """What is looked for."""

    field: FieldData
    body: BodyData
    layer: Layer
    table: NDArray[np.float32]
    """See ``turning_table``."""
    start: Array
    goal: Array
    """Poses, shape (3,)."""
    greed: float
    budget: Budget
    """Takes down the nodes expanded."""
    statistics: dict[str, float]
    """The same, under "expanded"."""


class Hunt:
    """One search.

    Args:
        question: what is looked for.
        car: what may be driven, with moves of the level.
        go: ways to the goal.
        level: how fine.
        sight: the goal is tried directly from this near, m.
    """

    def __init__(self, question: Question, car: Car, go: ToGo, level: Level, sight: float = np.inf) -> None:
        self._asked, self._car, self._go, self._sight = question, car, go, sight
        self._nodes = _room(question.field, level.cell * car.radius, level.headings)
        self.exhausted = False
        """Whether there is nothing left to look at."""
        (x, y, yaw), greed = question.start, question.greed
        add(
            question.field, go, question.table, car, question.goal, self._nodes, greed, x, y, yaw, 0.0, -1,
            LEAP, 0.0, np.inf,
        )  # fmt: skip

    def go_on(self, count: int, reserve: float = 0.0) -> Array | None:
        """Expand about ``count`` more nodes, while more than ``reserve`` of the budget is left.

        Returns:
            Motion rows from start to goal, if they were found.
        """
        asked, nodes = self._asked, self._nodes
        first = int(nodes.counts[EXPANDED])
        status = EXHAUSTED if self.exhausted else RUNNING
        while status == RUNNING and asked.budget.left() > reserve:
            before = int(nodes.counts[EXPANDED])
            if before - first >= count:
                break
            status = expand(
                asked.field, asked.body, asked.layer, self._go, asked.table, self._car, asked.goal, nodes, asked.greed,
                np.inf, self._sight, CHUNK,
            )  # fmt: skip
            done = int(nodes.counts[EXPANDED]) - before
            asked.budget.work += done
            asked.statistics["expanded"] += done
        self.exhausted = status == EXHAUSTED
        return trace(self._car, asked.goal, nodes) if status == FOUND else None


def _room(field: FieldData, cell: float, headings: int) -> Nodes:
    """Memory for the nodes of a search."""
    n = MOST_NODES
    rows, columns = (int(count * field.resolution / cell) + 1 for count in field.occupied.shape)
    return Nodes(
        np.empty((n, 3)), np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n),
        np.empty(n, np.bool_), np.empty(n), np.empty(n, np.int64),
        np.zeros((rows, columns, headings), np.int32), cell, np.zeros(4, np.int64),
    )  # fmt: skip
