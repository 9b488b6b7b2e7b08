"""Main route planner: Hybrid A* for a first route, then smoothing and alternatives within the budget.

Hybrid A* searches over poses reached by motion primitives, guided by two heuristics. At a node it also tries analytic
expansions: the best obstacle-free motion to the goal, and to poses further along the cost-to-go path, which cross open
ground in few nodes. Source: D. Dolgov and others, "Practical search techniques in path planning for autonomous
driving", 2008. Loads numba.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import FieldData, FootprintData
from monstertruck_planners.route.api import (
    Budget,
    Clock,
    Endpoints,
    RouteCosts,
    RouteMap,
    RouteResult,
    Vehicle,
)
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.corridors import cheapest_unmarked, close_narrow_gaps, mark_corridor
from monstertruck_planners.route.departure import Leaving, leaving, plan_between
from monstertruck_planners.route.heuristic import (
    OVERRUN,
    UNREACHED,
    CostToGo,
    cell_ahead,
    cell_at,
    complete,
    cost_at,
    cost_to_go,
    heuristic_cost,
    reeds_shepp_table,
)
from monstertruck_planners.route.motion import MotionPath, advance, cusps_of
from monstertruck_planners.route.reeds_shepp import COST, MAX_SEGMENTS, connect
from monstertruck_planners.route.search import (
    CHECK_MARGIN,
    CHECK_STEP,
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
    route_cost,
    segments_cost,
    segments_free,
)
from monstertruck_planners.route.segment_buffer import SegmentBuffer, current_segments, editable
from monstertruck_planners.route.smoothing import choose_headings, shortcut
from monstertruck_schemas.plan import MAX_RUNS
from monstertruck_schemas.reasons import Reason

EXPANSION = -1
"""Action of a node reached by an analytic expansion. Other actions:

numbers of primitives, followed by the primitives' tightest arcs, driven as far as they are free.
"""


MAX_NODES = 400_000
"""Maximum number of nodes in a search."""

MAX_TABLE_CELLS = 1 << 26
"""Maximum number of cells in a search: a table of 256 MB, of which only visited parts use memory."""


FIRST_NODES = 512
"""Number of nodes in the coarse search before gaps are measured, and the fine search alternates with it."""


NO_SEGMENTS = np.empty((0, 3))

NO_COSTS = CostLayer(np.zeros((0, 0), np.float32), 0.0, 1.0, 0.0)


TRY_NARROWER = (Reason.START_BLOCKED, Reason.GOAL_BLOCKED, Reason.GOAL_UNREACHABLE, Reason.ROUTE_TIMEOUT)


class Nodes(NamedTuple):
    """Memory of one search."""

    pose: Array
    """Shape (n, 3)."""
    cost: Array
    parent: IntArray
    action: IntArray
    direction: Array
    """Direction at the end, +1 or -1; 0 at the start."""
    cusps: IntArray
    """Number of cusps since the start."""
    closed: NDArray[np.bool_]
    keys: Array
    items: IntArray
    """Heap of open nodes."""
    table: NDArray[np.int32]
    """One plus the number of the node in each cell, shape (rows, columns, headings); 0 for none."""
    cell: float
    counts: IntArray
    """Numbers of used nodes, open nodes, and expanded nodes."""


USED, OPEN, EXPANDED = 0, 1, 2


@njit(cache=True)
def _open_node(
    field: FieldData, to_go: CostToGo, table: NDArray[np.float32], model: VehicleMotions, goal: Array, nodes: Nodes,
    heuristic_weight: float, x: float, y: float, yaw: float, cost: float, parent: int, action: int, direction: float,
    cusps: int,
) -> None:  # fmt: skip
    """Add a pose to the open list if it is the cheapest in its cell and the goal is reachable from it."""
    if nodes.counts[USED] >= len(nodes.cost) or cusps > model.max_cusps:
        return
    left = heuristic_cost(field, to_go, table, model.radius, goal, x, y, yaw)
    if left == np.inf:
        return
    row, column = cell_at(field, nodes.cell, x, y)
    headings = nodes.table.shape[2]
    heading = math.floor(yaw / (2 * math.pi) * headings + 0.5) % headings
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
    """Write the pose ``distance`` metres along the cost-to-go path, facing along it; False if the goal is nearer."""
    row, column = cell_at(field, to_go.cell, x, y)
    row, column = cell_ahead(to_go.step, row, column, distance / to_go.cell)
    ahead_row, ahead_column = cell_ahead(to_go.step, row, column, look_ahead / to_go.cell)
    if to_go.step[ahead_row, ahead_column] < 0:
        return False
    across, along = (column + 0.5) * to_go.cell, (row + 0.5) * to_go.cell
    target[0] = field.x + across * field.cos - along * field.sin
    target[1] = field.y + across * field.sin + along * field.cos
    target[2] = math.atan2(ahead_row - row, ahead_column - column) + math.atan2(field.sin, field.cos)
    return True


@njit(cache=True)
def expand(
    field: FieldData, footprint: FootprintData, layer: CostLayer, to_go: CostToGo, table: NDArray[np.float32],
    model: VehicleMotions, goal: Array, nodes: Nodes, heuristic_weight: float, goal_range: float, count: int,
) -> tuple[int, Array]:  # fmt: skip
    """Expand up to ``count`` nodes.

    Args:
        field: distance field.
        footprint: footprint of the vehicle.
        layer: layer of extra costs.
        to_go: cost-to-go.
        table: see ``reeds_shepp_table``.
        model: limits, costs and primitives of the vehicle.
        goal: goal pose, shape (3,).
        nodes: memory of the search.
        heuristic_weight: factor on the heuristics.
        goal_range: maximum distance for expansions to the goal (m).
        count: maximum number of nodes to expand.

    Returns:
        RUNNING, FOUND or EXHAUSTED; and the segments from start to goal if FOUND, else none.
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
        away = math.sqrt((goal[0] - pose[0]) ** 2 + (goal[1] - pose[1]) ** 2)
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
    """Return the segment of an action from a pose: a primitive, or an arc as far as it is free (length 0: none)."""
    count = len(model.primitives)
    for k in range(3):
        out[k] = model.primitives[action % count, k]
    if action >= count:
        length = 0.0
        if abs(out[1]) * model.radius > 0.99:
            # 1.0: see ``VehicleMotions.strokes``, turning radii
            length = free_length(field, footprint, model, pose, out, 1.0 * model.radius)
        out[0] = length if out[0] > 0.0 else -length


@njit(cache=True)
def _trace(
    field: FieldData, footprint: FootprintData, model: VehicleMotions, goal: Array, nodes: Nodes, last_node: int
) -> Array:
    """Return the segments from the start over a node to the goal, with a direct motion from the node."""
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
    """Resolution of a search: cell size and length of the primitives."""

    cell: float
    """Cell size (turning radii)."""
    primitive: float
    """Length of a primitive (turning radii)."""
    headings: int = 36

    def fitted(self, field: FieldData, radius: float) -> "Resolution":
        """Return this resolution, or a coarser one for a map that is too large for it.

        Args:
            field: distance field of the map.
            radius: turning radius (m).
        """
        cells = field.occupied.size * (field.resolution / (self.cell * radius)) ** 2 * self.headings
        factor = max(math.sqrt(cells / MAX_TABLE_CELLS), 1.0)
        return Resolution(self.cell * factor, self.primitive * factor, self.headings)


RESOLUTIONS = (Resolution(0.35, 0.55), Resolution(0.15, 0.25), Resolution(0.06, 0.1, 72))
"""The second resolution is for narrow places, after a failed first search; the third follows an exhausted one."""


@dataclass(frozen=True)
class SearchProblem:
    """Search problem."""

    field: FieldData
    footprint: FootprintData
    layer: CostLayer
    start: Array
    goal: Array
    """Poses, shape (3,)."""
    heuristic_weight: float
    budget: Budget
    """Budget of the expanded nodes."""
    statistics: dict[str, float]
    """Statistics; the same number as "expanded"."""


class SearchRun:
    """A search that can be interrupted and continued.

    Args:
        problem: search problem.
        model: limits and costs of the vehicle, with primitives of the resolution.
        to_go: cost-to-go.
        resolution: resolution of the search.
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
            Segments from start to goal; None until they are found.
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
    """Return the memory of a search, with the start as its first node."""
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


@dataclass(frozen=True)
class MarginAttempt:
    """Planning with one of several margins."""

    reserve: float
    """Share of the budget kept for the other margins."""
    first: bool


class HybridPlanner:
    """Routes for one vehicle.

    Args:
        vehicle: kinematics and footprint.
        config: costs, tolerances, budget.
        departs: whether routes begin with a departure if the start is nearer to an obstacle than the margin; otherwise
            such a start is refused.
    """

    def __init__(self, vehicle: Vehicle, config: HybridConfig | None = None, *, departs: bool = True) -> None:
        self.vehicle, self._departs = vehicle, departs
        self.config = config or HybridConfig()
        self.reeds_shepp = vehicle.reeds_shepp(self.config)
        self.footprint = vehicle.footprint.data()
        self.costs = RouteCosts.of(vehicle, self.config)
        self._models: dict[tuple[Resolution, float], VehicleMotions] = {}
        self._narrower = [HybridPlanner(vehicle, narrow, departs=departs) for narrow in narrower_configs(self.config)]

    def plan(self, route_map: RouteMap, start: ArrayLike, goal: ArrayLike, now: Clock | None = None) -> RouteResult:
        """Plan a route of the vehicle's reference point; ``statistics["margin"]`` is its margin."""
        budget = Budget(self.config.budget, now, self.config.effort)
        planners, share = [self, *self._narrower], 1.0
        for planner in planners:
            share *= 0.5  # share of the remaining budget for the searches with narrower margins
            attempt = MarginAttempt(0.0 if planner is planners[-1] else share, planner is self)
            result = planner.plan_with_margin(budget, route_map, start, goal, attempt)
            if result.reason not in TRY_NARROWER:
                break
        return replace(result, statistics={**result.statistics, "margin": planner.config.margin})

    def plan_with_margin(
        self, budget: Budget, route_map: RouteMap, start: ArrayLike, goal: ArrayLike, attempt: MarginAttempt
    ) -> RouteResult:
        """Plan a route with the margin of this planner's settings, see ``plan``."""
        return plan_between(
            route_map,
            self.vehicle,
            self.config,
            start,
            goal,
            lambda ends: _PlanningRun(self, route_map, ends, budget, attempt).route(),
            budget,
            reserve=attempt.reserve,
            departs=self._departs,
        )

    def planner_for(self, margin: float) -> "HybridPlanner":
        """Return the planner with the largest margin up to this one, or else with the smallest."""
        planners = [self, *self._narrower]
        return next((planner for planner in planners if planner.config.margin <= margin), planners[-1])

    @property
    def tolerance(self) -> float:
        """Maximum deviation of a route's end from the goal (m, rad)."""
        return max(self.config.position_tolerance, self.config.yaw_tolerance)

    def free(self, route_map: RouteMap, path: MotionPath) -> bool:
        """Whether a path of the reference point is free of collisions."""
        start, segments = path.copied()
        model, field = self.motion_model(RESOLUTIONS[0], 0.0), route_map.field.data()
        return bool(segments_free(field, self.footprint, model, start, segments, len(segments)))

    def leaving(self, route_map: RouteMap, path: MotionPath) -> Leaving | None:
        """Return the part of a path before it keeps the margin up to its end; None if it never does."""
        return leaving(route_map, self.vehicle, path, self.config.margin, lambda rest: self.free(route_map, rest))

    def cost(self, route_map: RouteMap, path: MotionPath) -> float:
        """Return the cost of a path (m)."""
        start, segments = path.copied()
        field, layer = route_map.field.data(), route_map.cost_layer(self.costs)
        return float(route_cost(field, layer, self.motion_model(RESOLUTIONS[0], 0.0), start, segments))

    def motion_model(self, resolution: Resolution, crab: float) -> VehicleMotions:
        """Return limits and costs of the vehicle, with primitives of a resolution and translations up to an angle."""
        key = (resolution, crab)
        if key not in self._models:
            self._models[key] = self._motion_model(resolution, crab)
        return self._models[key]

    def _motion_model(self, resolution: Resolution, crab: float) -> VehicleMotions:
        radius = self.vehicle.radius
        length = resolution.primitive * radius
        primitives = [(s * length, k / radius, 0.0) for s in (1.0, -1.0) for k in (0.0, 1.0, -1.0, 0.5, -0.5)]
        if crab > 0.0:
            primitives += [(s * length, 0.0, b) for s in (1.0, -1.0) for b in (crab, -crab)]
        return VehicleMotions(
            radius, crab, self.reeds_shepp.weights, self.config.swing_cost, np.array(primitives),
            np.array([16.0, 8.0, 4.0, 2.0]) * radius, CHECK_STEP,
            self.config.margin + CHECK_MARGIN, self.config.free_cusps, self.config.many_cusps_cost, MAX_RUNS - 1,
            False,
        )  # fmt: skip


def holds_translations(segments: Array) -> bool:
    """Whether any of a route's segments is driven at an angle to the heading."""
    return bool((segments[:, 2] != 0.0).any())


def narrower_configs(config: HybridConfig) -> list[HybridConfig]:
    """Return the settings with the margins to try after ``config``'s margin."""
    spare = config.margin - config.narrow_margin
    if spare <= 0.0:
        return []
    # 0.005: step between tried margins, m
    margins = np.linspace(config.margin, config.narrow_margin, math.ceil(spare / 0.005 - 1e-6) + 1)[1:].tolist()
    # 1.0: clearance cost of routes with a narrower margin, which they then use only where necessary, m
    cost = max(config.clearance_cost, 1.0)
    return [config.model_copy(update={"margin": m, "narrow_margin": m, "clearance_cost": cost}) for m in margins]


class _PlanningRun:
    """One planning request with one margin."""

    def __init__(
        self, planner: HybridPlanner, route_map: RouteMap, ends: Endpoints, budget: Budget, attempt: MarginAttempt
    ) -> None:
        self.planner, self.vehicle, self.config, self.budget = planner, planner.vehicle, planner.config, budget
        self.attempt = attempt
        self.footprint = planner.footprint
        self.start, self.goal = ends.start, ends.goal
        self.field = route_map.field.data()
        self.layer = route_map.cost_layer(planner.costs)
        self.factor, self.cell = route_map.coarse_factor, route_map.coarse_cell
        self.route_map = route_map
        self.crab = planner.vehicle.crab_angle
        self.model = planner.motion_model(RESOLUTIONS[0], 0.0)
        self.random = np.random.default_rng(0)
        self.statistics: dict[str, float] = {"expanded": 0, "trials": 0, "kept": 0, "alternatives": 0}
        self.problem = SearchProblem(
            self.field, self.footprint, self.layer, self.start, self.goal, self.config.heuristic_weight, budget,
            self.statistics,
        )  # fmt: skip

    def route(self) -> RouteResult:
        segments = self._direct(self.crab)
        cheapest = segments is not None and self._is_cheapest(segments)
        if segments is None:
            segments, reason, text = self._first_route((0.0, self.crab) if self.crab else (0.0,), self.attempt.reserve)
            if segments is None:
                return RouteResult(reason, text=text, statistics=self._final_statistics())
        self.statistics["first_s"] = self.budget.elapsed
        self.statistics["first_length"] = float(np.abs(segments[:, 0]).sum())
        if self.config.improve and not cheapest:
            segments = self._improve(segments)
        path = MotionPath(self.start, segments, self.vehicle.steering, self.vehicle.reference)
        return RouteResult(Reason.OK, path, cost=self._cost(segments), statistics=self._final_statistics())

    def _final_statistics(self) -> dict[str, float]:
        return {**self.statistics, "elapsed_s": self.budget.elapsed}

    def _cell_of(self, pose: Array) -> tuple[int, int]:
        return cell_at(self.field, self.cell, pose[0], pose[1])

    @cached_property
    def cell_cost(self) -> NDArray[np.int16]:
        """Cost of entering each coarse cell; narrow gaps are closed in it."""
        return self.route_map.cell_costs(self.planner.costs).copy()

    def _cost_to_go(self, cell_cost: NDArray[np.int16] | None = None, overrun: float = OVERRUN) -> CostToGo:
        cell_cost = self.cell_cost if cell_cost is None else cell_cost
        return cost_to_go(cell_cost, self.cell, self._cell_of(self.goal), self._cell_of(self.start), overrun=overrun)

    def _first_route(self, crabs: tuple[float, ...], reserve: float) -> tuple[Array | None, Reason, str]:
        """Return the direct motion without translations, or the result of the searches with these crab angles."""
        segments = self._direct(0.0)
        return self._search(self._cost_to_go(), crabs, reserve) if segments is None else (segments, Reason.OK, "")

    def _direct(self, crab: float) -> Array | None:
        """Return the best obstacle-free motion with translations up to an angle, if no obstacle touches it."""
        reeds_shepp = replace(self.planner.reeds_shepp, crab_angle=crab)
        _, segments = reeds_shepp.path(self.start, self.goal).copied()
        free = segments_free(self.field, self.footprint, self.model, self.start, segments, len(segments))
        return segments if free else None

    def _is_cheapest(self, segments: Array) -> bool:
        """Whether the best obstacle-free motion is optimal: neither obstacles nor ground add to its cost.

        If metres backward cost more, longer arcs than such a motion has may avoid them.
        """
        free = route_cost(self.field, NO_COSTS, self.model, self.start, segments)
        shortest = self.config.reverse_cost == 1.0 or segments[:, 0].min(initial=0.0) >= 0.0
        return shortest and self._cost(segments) <= free

    def _search(self, to_go: CostToGo, crabs: tuple[float, ...], reserve: float) -> tuple[Array | None, Reason, str]:
        """Find a first route: a coarse search, then closing of narrow gaps, then fine and coarse searches in turn.

        Args:
            to_go: cost-to-go.
            crabs: maximum angles of translations, in the order of the searches.
            reserve: share of the budget to keep.
        """
        width = 2 * (self.planner.costs.side + self._gap_margin)
        too_narrow = None, Reason.GOAL_UNREACHABLE, f"no passage {width:.2f} m wide leads there"
        if not self._reachable(to_go):
            return too_narrow
        coarse = [self._search_run(to_go, RESOLUTIONS[0], crab) for crab in crabs]
        segments = coarse[0].run(FIRST_NODES, reserve) if self.attempt.first else None
        if segments is not None:
            return segments, Reason.OK, ""
        if self._close_narrow_gaps(to_go):
            to_go = self._cost_to_go()
            if not self._reachable(to_go):
                return too_narrow
            coarse = [self._search_run(to_go, RESOLUTIONS[0], crab) for crab in crabs]
        fine = [self._search_run(to_go, RESOLUTIONS[1], crab, strokes=True) for crab in crabs]
        segments = self._run_in_turns(fine, coarse, reserve)
        if segments is None and fine[-1].exhausted:
            fine = [self._search_run(self._cost_to_go(overrun=math.inf), RESOLUTIONS[2], crabs[-1])]
            segments = fine[0].run(MAX_NODES, reserve)
        if segments is not None:
            return segments, Reason.OK, ""
        # An exhausted search proves nothing: there may be a path between its cells and headings.
        self.statistics["exhausted"] = float(fine[-1].exhausted)
        return (
            None,
            Reason.ROUTE_TIMEOUT,
            "no drivable route found" + (", all searches exhausted" if fine[-1].exhausted else ""),
        )

    def _search_run(
        self,
        to_go: CostToGo,
        resolution: Resolution,
        crab: float,
        goal_range: float = np.inf,
        max_cusps: int = MAX_RUNS - 1,
        *,
        strokes: bool = False,
    ) -> SearchRun:
        resolution = resolution.fitted(self.field, self.vehicle.radius)
        model = self.planner.motion_model(resolution, crab)._replace(max_cusps=max_cusps, strokes=strokes)
        return SearchRun(self.problem, model, to_go, resolution, goal_range)

    def _run_in_turns(self, fine: list[SearchRun], coarse: list[SearchRun], reserve: float) -> Array | None:
        """Return the result of the first of several search pairs (fine and coarse) that finds a route."""
        count = FIRST_NODES
        while self.budget.remaining() > reserve and not fine[-1].exhausted:
            for pair in zip(fine, coarse, strict=True):
                for run in pair:
                    segments = run.run(count, reserve)
                    if segments is not None:
                        return segments
            count *= 2  # growth of the number of expanded nodes per turn, from round to round
        return None

    def _reachable(self, to_go: CostToGo) -> bool:
        return cost_at(to_go, *self._cell_of(self.start)) < UNREACHED

    @property
    def _gap_margin(self) -> float:
        """Clearance needed on both sides of a gap (m); without a margin, narrow gaps stay open."""
        gap_error = 0.01  # error of the checked positions and headings against the best ones, m
        # 0.005: width needed in a gap beyond both margins, m: in a narrower gap no search finds a path
        return self.config.margin + (0.005 if self.config.margin >= gap_error else -gap_error)

    def _close_narrow_gaps(self, to_go: CostToGo) -> bool:
        """Close the narrow gaps on the shortest path, then on the next one around them, etc.; False without a path."""
        checked = np.zeros(self.cell_cost.shape, np.bool_)
        # 0.06: maximum distance of a narrow gap's cell from obstacles beyond half the footprint's width, m
        wide = self.planner.costs.side + self.config.margin + 0.06
        any_closed = False
        for _ in range(30):  # maximum number of paths checked for narrow gaps
            for width in (0.0, 0.15 / self.cell):  # width checked on both sides of a path with a narrow gap, m
                closed = close_narrow_gaps(
                    self.field, self.footprint, self._gap_margin, self.cell_cost, self.factor, wide, to_go.step,
                    *self._cell_of(self.start), width, checked,
                )  # fmt: skip
                if not closed and not width:
                    return any_closed
            any_closed = True
            to_go = self._cost_to_go()
            if not self._reachable(to_go):
                break
        return any_closed

    def _improve(self, first: Array) -> Array:
        """Return the best route within the remaining budget.

        Motions without translations are found in half the time. They come first, as for a vehicle without translations,
        and their result is kept unless translations make it shorter at no higher cost. Translations therefore never
        make a route longer.
        """
        segments = first
        if holds_translations(first):
            # 0.5: share of the budget kept for smoothing once a route is known
            plain, _, _ = self._first_route((0.0,), 0.5)
            segments = first if plain is None else plain
        segments = self._with_fewer_cusps(segments)
        segments = self._improve_in_rounds(segments)
        segments = self._polished(segments)
        if self.crab > 0.0:
            self.model = self.planner.motion_model(RESOLUTIONS[0], self.crab)
            routes = [segments, first] if holds_translations(first) else [segments]
            cost = self._cost(segments) + 1e-9
            polished = [route for route in map(self._polished, routes) if self._cost(route) <= cost]
            segments = min((segments, *polished), key=self._detours)
        return segments

    def _detours(self, segments: Array) -> tuple[int, float]:
        """Return the number of cusps with an extra cost (weighted metres)."""
        backward, _, crab = self.model.weights
        metres = np.abs(segments[:, 0]) * np.where(segments[:, 0] < 0.0, backward, 1.0)
        metres *= np.where(segments[:, 2] != 0.0, crab, 1.0)
        return max(cusps_of(segments) - self.config.free_cusps, 0), float(metres.sum())

    def _with_fewer_cusps(self, segments: Array) -> Array:
        """Return the route, or a cheaper one with fewer cusps if it has cusps with extra costs."""
        crabs = (0.0, self.crab) if holds_translations(segments) else (0.0,)
        while (cusps := cusps_of(segments)) > self.config.free_cusps:
            to_go = self._cost_to_go()
            fine, coarse = (
                [self._search_run(to_go, RESOLUTIONS[k], crab, max_cusps=cusps - 1, strokes=True) for crab in crabs]
                for k in (1, 0)
            )
            # 0.3: share of the budget kept during the search for routes with fewer cusps
            other = self._run_in_turns(fine, coarse, 0.3)
            if other is None:
                break
            segments = other
        return segments

    def _improve_in_rounds(self, segments: Array) -> Array:
        """Smooth the best route and alternatives in turn, until nothing improves or only the last share is left."""
        others = self._starts(segments)
        cheapest = next(others)  # along the cheapest path, while the first route may lead straight ahead
        if len(cheapest) and self._cost(cheapest) < self._cost(segments):
            segments = cheapest
        else:
            others = chain([cheapest], others)
        best, cost = self._smoothed(segments, NO_SEGMENTS, np.inf)
        idle = 0
        # 0.2: share of the budget for the final smoothing without and then with translations 12: maximum rounds of
        # smoothing without gain
        while self.budget.remaining() > 0.2 and idle < 12:
            segments = next(others)
            mate = best if len(segments) else NO_SEGMENTS
            # 1.1: maximum cost of another route that is smoothed further, as a factor on the best cost
            segments, other = self._smoothed(segments if len(segments) else best, mate, 1.1 * cost)
            idle = 0 if other < 0.9995 * cost else idle + 1
            if other < cost:
                best, cost = segments, other
        return best

    def _starts(self, first: Array) -> Iterator[Array]:
        """Yield the routes to smooth: the alternatives, then the best route (None) alternating with each of them."""
        found = [first]
        for segments in self._alternatives():
            if len(segments):
                found.append(segments)
            yield segments
        while True:
            for segments in found:
                yield NO_SEGMENTS
                yield segments

    def _polished(self, segments: Array) -> Array:
        """Smooth the route in ever smaller steps."""
        path = editable(self.start, segments)
        for shift in (0.25, 0.1, 0.03, 0.01):  # shifts of poses in the final smoothing, as fractions of a stretch
            self._shortcut(path, 1e-4, shift)
        return current_segments(path).copy()

    def _smoothed(self, segments: Array, mate: Array, promising: float) -> tuple[Array, float]:
        """Take shortcuts, chain the route with its mate, take shortcuts again; only the first unless ``promising``."""
        path = editable(self.start, segments)
        self._shortcut(path)
        cost = self._cost(current_segments(path))
        if cost < promising and self.budget.remaining() > 0.0:
            other = editable(self.start, self._best_chain([current_segments(path), mate]))
            if other.used[0]:
                self._shortcut(other)
                if self._cost(current_segments(other)) < cost:
                    path = other
        segments = current_segments(path).copy()
        return segments, self._cost(segments)

    def _shortcut(self, path: SegmentBuffer, gain: float = 1e-3, shift: float = 0.25) -> None:
        """Try shortcuts until the gain of a batch falls below a share of the cost."""
        last, reach = np.inf, 40.0 * self.vehicle.radius
        batch = 1000  # number of smoothing trials between two checks of the budget
        while self.budget.remaining() > 0.0 and (cost := self._cost(current_segments(path))) < (1.0 - gain) * last:
            last, random = cost, self.random.random((batch, 6))
            kept = shortcut(self.field, self.footprint, self.layer, self.model, path, reach, shift, random)
            self.budget.work += batch
            self.statistics["trials"] += batch
            self.statistics["kept"] += kept

    def _cost(self, segments: Array) -> float:
        return float(route_cost(self.field, self.layer, self.model, self.start, segments))

    def _best_chain(self, routes: list[Array]) -> Array:
        """Chain motions over places of several routes, ordered by their share of the length, with the best headings."""
        paths = [MotionPath(self.start, route) for route in routes if len(route)]
        length = paths[0].length
        spacing = max(1.5 * self.vehicle.radius, length / 60) * self.random.uniform(0.7, 1.3)
        samples = [path.sample(spacing) for path in paths]
        poses = np.vstack([sample.poses for sample in samples])
        travelled = np.concatenate([length / path.length * s.travelled for path, s in zip(paths, samples, strict=True)])
        # The chain starts and ends like the first route.
        last = len(samples[0].poses) - 1
        by_travelled = np.argsort(travelled, kind="stable")
        inner = by_travelled[(travelled[by_travelled] > 1e-6) & (travelled[by_travelled] < length - 1e-6)]
        order = np.concatenate(([0], inner, [last]))
        reach = 16.0 * self.vehicle.radius
        return choose_headings(
            self.field, self.footprint, self.layer, self.model, poses[order], travelled[order], reach
        )

    def _alternatives(self) -> Iterator[Array]:
        """Yield first routes along all alternatives to the shortest path, the shortest first."""
        to_go = self._cost_to_go()
        columns = self.cell_cost.shape[1]
        start, goal = self._cell_of(self.start), self._cell_of(self.goal)
        from_start = cost_to_go(self.cell_cost, self.cell, start, goal)
        for ways in (to_go, from_start):
            complete(ways)
        known = np.zeros(self.cell_cost.shape, np.bool_)
        # 2.5: minimum distance of an alternative from all known routes at one place, turning radii
        width = 2.5 * self.vehicle.radius / self.cell
        # 1.15: maximum length of alternatives, as a factor on the shortest path
        limit = int(1.15 * to_go.cost[start])
        while (cell := cheapest_unmarked(to_go.cost, from_start.cost, known, limit)) >= 0:
            corridor = np.zeros(self.cell_cost.shape, np.bool_)
            for step in (to_go.step, from_start.step):
                mark_corridor(corridor, step, cell // columns, cell % columns, width)
                mark_corridor(known, step, cell // columns, cell % columns, width)
            self.statistics["alternatives"] += 1
            # From further away, an expansion to the goal would leave the corridor.
            near = 3.0 * self.vehicle.radius
            inside = self._cost_to_go(np.where(corridor, self.cell_cost, np.int16(0)))
            segments = self._search_run(inside, RESOLUTIONS[0], 0.0, near).run(CHUNK)
            yield NO_SEGMENTS if segments is None else segments
