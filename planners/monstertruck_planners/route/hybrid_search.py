"""Hybrid-A*: a search over poses grown by motion primitives, guided by two heuristics. Loads numba.

Besides the primitives a node tries analytic expansions: the best obstacle-free motion to the goal, and to poses further
along the cost-to-go path, so that open ground is crossed in few nodes. Source: D. Dolgov and others, "Practical search
techniques in path planning for autonomous driving", 2008.
"""

import math
from dataclasses import dataclass
from math import atan2, floor, pi, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import FieldData, FootprintData
from monstertruck_planners.route.api import Budget
from monstertruck_planners.route.heuristic import CostToGo, cell_ahead, cell_at, heuristic_cost, reeds_shepp_table
from monstertruck_planners.route.motion import advance
from monstertruck_planners.route.reeds_shepp import COST, MAX_SEGMENTS, connect
from monstertruck_planners.route.search import (
    CHUNK,
    EXHAUSTED,
    FOUND,
    RUNNING,
    CostLayer,
    IntArray,
    VehicleMotions,
    count_cusps,
    drop,
    free_length,
    many_cusps_cost,
    push,
    segments_cost,
    segments_free,
)

EXPANSION = -1
"""Action of a node reached by an analytic expansion; others are numbers of primitives, and after these of the arcs of
least radius among them, driven as far as they are free."""

LONGEST_STROKE = 1.0
"""See ``VehicleMotions.strokes``, turning radii."""

MAX_NODES = 400_000
"""Nodes of one search at most."""

MAX_TABLE_CELLS = 1 << 26
"""Cells of one search: a table of 256 MB, of which only what is visited takes memory."""


class Nodes(NamedTuple):
    """Memory of one search."""

    pose: Array
    """Shape (n, 3)."""
    cost: Array
    parent: IntArray
    action: IntArray
    direction: Array
    """+1 or -1: direction at the end; 0 at the start."""
    cusps: IntArray
    """Cusps from the start on."""
    closed: NDArray[np.bool_]
    keys: Array
    items: IntArray
    """The heap of open nodes."""
    table: NDArray[np.int32]
    """Shape (rows, columns, headings): number of the node in each cell plus one, 0 = none."""
    cell: float
    counts: IntArray
    """Used nodes, open nodes, nodes expanded so far."""


USED, OPEN, EXPANDED = 0, 1, 2


@njit(cache=True)
def _open_node(
    field: FieldData, to_go: CostToGo, table: NDArray[np.float32], model: VehicleMotions, goal: Array, nodes: Nodes,
    heuristic_weight: float, x: float, y: float, yaw: float, cost: float, parent: int, action: int, direction: float,
    cusps: int,
) -> None:  # fmt: skip
    """Put a pose on the open list if it is the cheapest in its cell and the goal can be reached from there."""
    if nodes.counts[USED] >= len(nodes.cost) or cusps > model.max_cusps:
        return
    left = heuristic_cost(field, to_go, table, model.radius, goal, x, y, yaw)
    if left == np.inf:
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
    nodes.cost[k], nodes.parent[k], nodes.action[k] = cost, parent, action
    nodes.direction[k], nodes.cusps[k], nodes.closed[k] = direction, cusps, False
    nodes.table[row, column, heading] = k + 1
    nodes.counts[USED] = k + 1
    nodes.counts[OPEN] = push(nodes.keys, nodes.items, nodes.counts[OPEN], cost + heuristic_weight * left, k)


@njit(cache=True)
def _expansion_target(
    field: FieldData, to_go: CostToGo, x: float, y: float, distance: float, look_ahead: float, target: Array
) -> bool:
    """Pose ``distance`` metres along the cost-to-go path, facing along it; False if the goal is nearer."""
    row, column = cell_at(field, to_go.cell, x, y)
    row, column = cell_ahead(to_go.step, row, column, distance / to_go.cell)
    ahead_row, ahead_column = cell_ahead(to_go.step, row, column, look_ahead / to_go.cell)
    if to_go.step[ahead_row, ahead_column] < 0:
        return False
    across, along = (column + 0.5) * to_go.cell, (row + 0.5) * to_go.cell
    target[0] = field.x + across * field.cos - along * field.sin
    target[1] = field.y + across * field.sin + along * field.cos
    target[2] = atan2(ahead_row - row, ahead_column - column) + atan2(field.sin, field.cos)
    return True


@njit(cache=True)
def expand(
    field: FieldData, footprint: FootprintData, layer: CostLayer, to_go: CostToGo, table: NDArray[np.float32],
    model: VehicleMotions, goal: Array, nodes: Nodes, heuristic_weight: float, goal_range: float, count: int,
) -> tuple[int, Array]:  # fmt: skip
    """Expand up to ``count`` nodes.

    Args:
        field: the grid.
        footprint: of the vehicle.
        layer: extra costs.
        to_go: ways to the goal.
        table: see ``reeds_shepp_table``.
        model: limits, costs and primitives of the vehicle.
        goal: shape (3,).
        nodes: memory.
        heuristic_weight: factor on the heuristics.
        goal_range: expansions to the goal are tried from this near, m.
        count: see above.

    Returns:
        RUNNING, FOUND or EXHAUSTED; if FOUND the segments from start to goal, else none.
    """
    segments, best, scratch, target = np.empty((MAX_SEGMENTS, 3)), np.empty(8), np.empty((4, 3)), np.empty(3)
    primitive, nothing = np.empty((1, 3)), np.empty((0, 3))
    for _ in range(count):
        if nodes.counts[OPEN] == 0 or nodes.counts[USED] >= len(nodes.cost):
            return EXHAUSTED, nothing
        n = nodes.items[0]
        nodes.counts[OPEN] = drop(nodes.keys, nodes.items, nodes.counts[OPEN])
        if nodes.closed[n]:
            continue
        nodes.closed[n] = True
        nodes.counts[EXPANDED] += 1
        pose, cost, direction, cusps = nodes.pose[n], nodes.cost[n], nodes.direction[n], nodes.cusps[n]
        away = sqrt((goal[0] - pose[0]) ** 2 + (goal[1] - pose[1]) ** 2)
        if away < goal_range and (away < 6.0 * model.radius or nodes.counts[EXPANDED] % 4 == 1):
            many = connect(pose, goal, model.radius, model.crab, model.weights, segments, best, scratch)
            few = cusps + count_cusps(segments, many, direction) <= model.max_cusps
            if few and segments_free(field, footprint, model, pose, segments, many):
                return FOUND, _trace(field, footprint, model, goal, nodes, n)
        for i in range(len(model.expansion_lengths)):
            distance = model.expansion_lengths[i]
            if not _expansion_target(field, to_go, pose[0], pose[1], distance, model.radius, target):
                continue
            many = connect(pose, target, model.radius, model.crab, model.weights, segments, best, scratch)
            if best[COST] * model.radius < 2.0 * distance + 6.0 * model.radius and segments_free(
                field, footprint, model, pose, segments, many
            ):
                more = count_cusps(segments, many, direction)
                step_cost = segments_cost(field, layer, model, pose, segments, many, direction)
                step_cost += many_cusps_cost(model, cusps, more)
                end = 1.0 if segments[many - 1, 0] > 0.0 else -1.0
                _open_node(field, to_go, table, model, goal, nodes, heuristic_weight, target[0], target[1], target[2],
                           cost + step_cost, n, EXPANSION, end, cusps + more)  # fmt: skip
                break
        for i in range((2 if model.strokes else 1) * len(model.primitives)):
            _write_primitive(field, footprint, model, pose, i, primitive[0])
            if i >= len(model.primitives):
                free = primitive[0, 0] != 0.0
            else:
                free = segments_free(field, footprint, model, pose, primitive, 1)
            if free:
                x, y, yaw = advance(pose[0], pose[1], pose[2], primitive[0, 0], primitive[0, 1], primitive[0, 2])
                more = count_cusps(primitive, 1, direction)
                step_cost = segments_cost(field, layer, model, pose, primitive, 1, direction)
                step_cost += many_cusps_cost(model, cusps, more)
                end = 1.0 if primitive[0, 0] > 0.0 else -1.0
                _open_node(field, to_go, table, model, goal, nodes, heuristic_weight,
                           x, y, yaw, cost + step_cost, n, i, end, cusps + more)  # fmt: skip
    return RUNNING, nothing


@njit(cache=True)
def _write_primitive(
    field: FieldData, footprint: FootprintData, model: VehicleMotions, pose: Array, action: int, out: Array
) -> None:
    """Segment of an action from a pose: a primitive, or an arc driven as far as it is free (length 0: none)."""
    count = len(model.primitives)
    for k in range(3):
        out[k] = model.primitives[action % count, k]
    if action >= count:
        length = 0.0
        if abs(out[1]) * model.radius > 0.99:
            length = free_length(field, footprint, model, pose, out, LONGEST_STROKE * model.radius)
        out[0] = length if out[0] > 0.0 else -length


@njit(cache=True)
def _trace(
    field: FieldData, footprint: FootprintData, model: VehicleMotions, goal: Array, nodes: Nodes, last_node: int
) -> Array:
    """Segments from the start over a node, from which the goal is reached directly, to the goal."""
    segments, best, scratch = np.empty((MAX_SEGMENTS, 3)), np.empty(8), np.empty((4, 3))
    depth, n = 1, last_node
    while nodes.parent[n] >= 0:
        depth += 1
        n = nodes.parent[n]
    chain = np.empty(depth, np.int64)
    n = last_node
    for i in range(depth - 1, -1, -1):
        chain[i] = n
        n = nodes.parent[n]
    result = np.empty((depth * MAX_SEGMENTS, 3))
    used = 0
    for i in range(depth):
        n = chain[i]
        last = i == depth - 1
        if not last and nodes.action[chain[i + 1]] >= 0:
            _write_primitive(field, footprint, model, nodes.pose[n], nodes.action[chain[i + 1]], result[used])
            used += 1
            continue
        target = goal if last else nodes.pose[chain[i + 1]]
        many = connect(nodes.pose[n], target, model.radius, model.crab, model.weights, segments, best, scratch)
        for j in range(many):
            for k in range(3):
                result[used, k] = segments[j, k]
            used += 1
    return result[:used].copy()


@dataclass(frozen=True)
class Resolution:
    """Size of the search's cells, and length of its primitives."""

    cell: float
    """Size of a cell, in turning radii."""
    primitive: float
    """Length of a primitive, in turning radii."""
    headings: int = 36

    def fitted(self, field: FieldData, radius: float) -> "Resolution":
        """This resolution, or on a map too large for it a coarser one.

        Args:
            field: the map.
            radius: turning radius, m.
        """
        cells = field.occupied.size * (field.resolution / (self.cell * radius)) ** 2 * self.headings
        factor = max(math.sqrt(cells / MAX_TABLE_CELLS), 1.0)
        return Resolution(self.cell * factor, self.primitive * factor, self.headings)


RESOLUTIONS = (Resolution(0.35, 0.55), Resolution(0.15, 0.25), Resolution(0.06, 0.1, 72))
"""The second one is for narrow places, where the first finds nothing soon; the third where that is exhausted."""


@dataclass(frozen=True)
class SearchProblem:
    """What is searched for."""

    field: FieldData
    footprint: FootprintData
    layer: CostLayer
    start: Array
    goal: Array
    """Poses, shape (3,)."""
    heuristic_weight: float
    budget: Budget
    """Counts the nodes expanded."""
    statistics: dict[str, float]
    """The same, under "expanded"."""


class SearchRun:
    """One search, which can be interrupted and continued.

    Args:
        problem: what is searched for.
        model: limits and costs of the vehicle, with primitives of the resolution.
        to_go: ways to the goal.
        resolution: of the search.
        goal_range: expansions to the goal are tried from this near, m.
    """

    def __init__(
        self, problem: SearchProblem, model: VehicleMotions, to_go: CostToGo, resolution: Resolution,
        goal_range: float = np.inf,
    ) -> None:  # fmt: skip
        self._problem, self._model, self._to_go, self._goal_range = problem, model, to_go, goal_range
        self._table = reeds_shepp_table(model.crab)
        self._nodes = _allocate(problem.field, resolution.cell * model.radius, resolution.headings, problem.start)
        self.exhausted = False
        """Whether no node is left to expand."""

    def run(self, count: int, reserve: float = 0.0) -> Array | None:
        """Expand about ``count`` more nodes, while more than ``reserve`` of the budget is left.

        Returns:
            Segments from start to goal, if they were found.
        """
        problem, nodes = self._problem, self._nodes
        first = int(nodes.counts[EXPANDED])
        status, segments = EXHAUSTED if self.exhausted else RUNNING, None
        while status == RUNNING and problem.budget.remaining() > reserve:
            before = int(nodes.counts[EXPANDED])
            if before - first >= count:
                break
            status, segments = expand(
                problem.field, problem.footprint, problem.layer, self._to_go, self._table, self._model,
                problem.goal, nodes, problem.heuristic_weight, self._goal_range, CHUNK,
            )  # fmt: skip
            expanded = int(nodes.counts[EXPANDED]) - before
            problem.budget.work += expanded
            problem.statistics["expanded"] += expanded
        self.exhausted = status == EXHAUSTED
        return segments if status == FOUND else None


def _allocate(field: FieldData, cell: float, headings: int, start: Array) -> Nodes:
    """Memory for the nodes of a search, of which the start is the first."""
    n = MAX_NODES
    rows, columns = (int(count * field.resolution / cell) + 1 for count in field.occupied.shape)
    nodes = Nodes(
        np.empty((n, 3)), np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n), np.empty(n, np.int64),
        np.empty(n, np.bool_), np.empty(n), np.empty(n, np.int64),
        np.zeros((rows, columns, headings), np.int32), cell, np.array([1, 1, 0]),
    )  # fmt: skip
    nodes.pose[0], nodes.parent[0], nodes.action[0] = start, -1, EXPANSION
    for zero in (nodes.cost, nodes.direction, nodes.cusps, nodes.closed, nodes.keys, nodes.items):
        zero[0] = 0
    return nodes
