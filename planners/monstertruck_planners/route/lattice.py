"""State-lattice planner: A* over cells and headings, repeated with a smaller heuristic weight within the budget.

Cells and headings are exact; one obstacle-free motion reaches the goal. There are 16 headings, along the grid's short
vectors. A turn to the next heading is line, arc, line with the largest radius that fits; the shortest turn is chosen
among all cells that it could end at. The primitives are computed for each vehicle, because stored sets that keep their
cells at another cell size would turn tighter than the car.

Loads numba.
"""

import math
from math import cos, inf, sin, sqrt
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
from monstertruck_planners.route.config import LatticeConfig
from monstertruck_planners.route.departure import plan_between
from monstertruck_planners.route.heuristic import (
    UNIT,
    UNREACHED,
    CostToGo,
    cell_at,
    cost_at,
    cost_to_go,
)
from monstertruck_planners.route.motion import MotionPath
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
    drop,
    layer_cost,
    push,
    segments_cost,
    segments_free,
)
from monstertruck_schemas.plan import MAX_RUNS
from monstertruck_schemas.reasons import Reason

VECTORS = (
    (1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1),
    (-1, 0), (-2, -1), (-1, -1), (-1, -2), (0, -1), (1, -2), (1, -1), (2, -1),
)  # fmt: skip
ANGLES = np.array([math.atan2(y, x) for x, y in VECTORS])
HEADINGS = len(VECTORS)
LONG_PRIMITIVE = 8
"""Approximate length of the long straight primitive (cells)."""
MAX_PRIMITIVE_SEGMENTS = 3


class Primitives(NamedTuple):
    """Motion primitives by initial heading."""

    segments: Array
    """Up to three segments per primitive, shape (headings, k, 3, 3); unused ones have length 0."""
    shift: IntArray
    """Displacements in columns, rows and headings, shape (headings, k, 3)."""
    cost: Array
    """Costs, shape (headings, k) (m)."""
    used: IntArray
    """Number of primitives, shape (headings,)."""


def make_primitives(
    radius: float, crab_angle: float, cell: float, factors: tuple[float, float, float] = (2.0, 3.0, 5.0)
) -> Primitives:
    """Motion primitives of one vehicle.

    Args:
        radius: minimum turning radius (m).
        crab_angle: maximum angle of a translation (rad); 0 for none.
        cell: cell size (m).
        factors: cost factors of a turn forward, a line backward, a turn or translation backward.
    """
    table = [_primitives_from(h, radius, crab_angle, cell, factors) for h in range(len(VECTORS))]
    most = max(map(len, table))
    segments = np.zeros((len(VECTORS), most, MAX_PRIMITIVE_SEGMENTS, 3))
    shift, cost = np.zeros((len(VECTORS), most, 3), np.int64), np.zeros((len(VECTORS), most))
    for h, primitives in enumerate(table):
        for k, (pieces, where, price) in enumerate(primitives):
            segments[h, k, : len(pieces)] = pieces
            shift[h, k], cost[h, k] = where, price
    return Primitives(segments, shift, cost, np.array([len(primitives) for primitives in table]))


_Segment = tuple[float, float, float]
_Primitive = tuple[list[_Segment], tuple[int, int, int], float]


def _primitives_from(
    h: int, radius: float, crab: float, cell: float, factors: tuple[float, float, float]
) -> list[_Primitive]:
    turn_factor, back_factor, back_turn_factor = factors
    x, y = VECTORS[h]
    primitives: list[_Primitive] = []
    for steps in (1, max(round(LONG_PRIMITIVE / math.hypot(x, y)), 2)):
        length = steps * math.hypot(x, y) * cell
        primitives.append(([(length, 0.0, 0.0)], (steps * x, steps * y, 0), length))
        if steps == 1:
            primitives.append(([(-length, 0.0, 0.0)], (-x, -y, 0), back_factor * length))
    for turn in (1, -1):
        pieces, (dx, dy) = _turn(h, turn, radius, cell)
        length = sum(abs(piece[0]) for piece in pieces)
        primitives.append((pieces, (dx, dy, turn), turn_factor * length))
    for turn in (1, -1):
        # Backward into the next heading: a turn from there, driven in reverse.
        pieces, (dx, dy) = _turn((h + turn) % HEADINGS, -turn, radius, cell)
        length = sum(abs(piece[0]) for piece in pieces)
        back = [(-s, k, b) for s, k, b in reversed(pieces)]
        primitives.append((back, (-dx, -dy, turn), back_turn_factor * length))
    for side in (1, -1) if crab > 0.0 else ():
        for dx, dy, angle in _translations(h, side, crab):
            length = math.hypot(dx, dy) * cell
            primitives.append(([(length, 0.0, angle)], (dx, dy, 0), length))
            primitives.append(([(-length, 0.0, angle)], (-dx, -dy, 0), back_turn_factor * length))
    return primitives


def _turn(h: int, turn: int, radius: float, cell: float) -> tuple[list[_Segment], tuple[int, int]]:
    """Return the shortest turn to the next heading that ends on a cell, with the largest radius that fits."""
    a, b = ANGLES[h], ANGLES[h] + math.remainder(ANGLES[(h + turn) % HEADINGS] - ANGLES[h], math.tau)
    lines = np.array([[math.cos(a), math.cos(b)], [math.sin(a), math.sin(b)]])
    arc = turn * np.array([math.sin(b) - math.sin(a), math.cos(a) - math.cos(b)])
    reach = math.ceil(2.0 * radius * abs(b - a) / cell) + 6
    side = np.arange(-reach, reach + 1)
    cells = np.stack(np.meshgrid(side, side, indexing="ij")).reshape(2, -1)
    slope = np.linalg.solve(lines, arc)
    fixed = np.linalg.solve(lines, cells * cell)
    possible = (fixed - radius * slope[:, None] >= -1e-12).all(axis=0)
    cells, fixed = cells[:, possible], fixed[:, possible]
    # Both lines shrink as the radius grows, until the first has length 0.
    shrinking = slope > 1e-12
    gone = fixed[shrinking] / slope[shrinking, None]
    widest = (
        np.maximum(gone.min(axis=0, initial=math.inf), radius) if shrinking.any() else np.full(len(fixed.T), radius)
    )
    ends = np.maximum(fixed - widest * slope[:, None], 0.0)
    lengths = np.round(ends.sum(axis=0) + widest * abs(b - a), 9)
    best = int(np.argmin(lengths))
    arc_length, curvature = float(widest[best]) * abs(b - a), turn / float(widest[best])
    pieces = [(float(ends[0, best]), 0.0, 0.0), (arc_length, curvature, 0.0), (float(ends[1, best]), 0.0, 0.0)]
    return [piece for piece in pieces if piece[0] > 1e-9], (int(cells[0, best]), int(cells[1, best]))


def _translations(h: int, side: int, crab: float) -> list[tuple[int, int, float]]:
    """Return the steepest translation to one side within LONG cells: columns, rows, angle."""
    found = []
    for dx in range(-LONG_PRIMITIVE, LONG_PRIMITIVE + 1):
        for dy in range(-LONG_PRIMITIVE, LONG_PRIMITIVE + 1):
            angle = math.remainder(math.atan2(dy, dx) - ANGLES[h], math.tau)
            if (dx or dy) and 1e-9 < side * angle <= crab + 1e-12:
                found.append((-round(abs(angle), 9), math.hypot(dx, dy), dx, dy, angle))
    return [(dx, dy, angle) for _, _, dx, dy, angle in sorted(found)[:1]]


class Lattice(NamedTuple):
    """Primitives and frame of a search: the start is cell (0, 0), heading 0."""

    primitives: Primitives
    cell: float
    frame: Array
    """Start pose, shape (3,)."""


class LatticeStates(NamedTuple):
    """Memory of a search; states are numbered in order of discovery."""

    place: IntArray
    """Column, row, heading, shape (n, 3)."""
    cost: Array
    parent: IntArray
    primitive: IntArray
    closed: NDArray[np.bool_]
    keys: Array
    items: IntArray
    """Heap of open states."""
    buckets: IntArray
    """Hash table whose length is a power of two: state number plus one; 0 for an empty slot."""
    counts: IntArray
    """Numbers of states, open states and expanded states, and the state before the goal."""


USED, OPEN, EXPANDED, LAST = 0, 1, 2, 3


@njit(cache=True)
def _pose_of(lattice: Lattice, place: IntArray, out: Array) -> None:
    """Return the pose of a state."""
    c, s = cos(lattice.frame[2]), sin(lattice.frame[2])
    x, y = place[0] * lattice.cell, place[1] * lattice.cell
    out[0] = lattice.frame[0] + x * c - y * s
    out[1] = lattice.frame[1] + x * s + y * c
    out[2] = lattice.frame[2] + ANGLES[place[2]]


@njit(cache=True)
def _bucket_of(states: LatticeStates, column: int, row: int, heading: int) -> int:
    """Return the slot of a place in the hash table: its own, or the empty one for it."""
    mask = len(states.buckets) - 1
    max_cells = 1 << 15  # on both sides of the start
    key = ((column + max_cells) << 20) ^ ((row + max_cells) << 4) ^ heading
    i = (key * 0x9E3779B97F4A7C1) >> 12 & mask
    while states.buckets[i] > 0:
        k = states.buckets[i] - 1
        if states.place[k, 0] == column and states.place[k, 1] == row and states.place[k, 2] == heading:
            break
        i = (i + 1) & mask
    return i


@njit(cache=True)
def _open_state(
    field: FieldData, to_go: CostToGo, lattice: Lattice, states: LatticeStates, heuristic_weight: float, bound: float,
    column: int, row: int, heading: int, cost: float, parent: int, primitive: int,
) -> None:  # fmt: skip
    """Add a state to the open list if its cost is its lowest so far and a solution below ``bound`` is possible."""
    where = np.array([column, row, heading])
    pose = np.empty(3)
    _pose_of(lattice, where, pose)
    r, c = cell_at(field, to_go.cell, pose[0], pose[1])
    if not (0 <= r < to_go.cost.shape[0] and 0 <= c < to_go.cost.shape[1]):
        return
    cells = cost_at(to_go, r, c)
    if cells >= UNREACHED:
        return
    left = cells * to_go.cell / UNIT
    if cost + left >= bound:
        return
    i = _bucket_of(states, column, row, heading)
    k = states.buckets[i] - 1
    if k < 0:
        k = states.counts[USED]
        if k >= len(states.cost):
            return
        states.counts[USED] = k + 1
        states.buckets[i] = k + 1
        states.place[k, 0], states.place[k, 1], states.place[k, 2] = column, row, heading
        states.cost[k] = inf
    if cost >= states.cost[k] - 1e-9 or states.counts[OPEN] >= len(states.keys) - 1:
        return
    states.cost[k], states.parent[k], states.primitive[k], states.closed[k] = cost, parent, primitive, False
    states.counts[OPEN] = push(states.keys, states.items, states.counts[OPEN], cost + heuristic_weight * left, k)


@njit(cache=True)
def expand(
    field: FieldData, footprint: FootprintData, layer: CostLayer, to_go: CostToGo, model: VehicleMotions,
    lattice: Lattice, goal: Array, states: LatticeStates, heuristic_weight: float, bound: float, count: int,
) -> int:  # fmt: skip
    """Expand up to ``count`` states; only solutions cheaper than ``bound`` (m) are accepted.

    Returns:
        RUNNING, FOUND (the goal is reached from the state ``counts[LAST]``) or EXHAUSTED.
    """
    segments, best, scratch, pose = np.empty((MAX_SEGMENTS, 3)), np.empty(8), np.empty((4, 3)), np.empty(3)
    for _ in range(count):
        if states.counts[OPEN] == 0:
            return EXHAUSTED
        n = states.items[0]
        states.counts[OPEN] = drop(states.keys, states.items, states.counts[OPEN])
        if states.closed[n]:
            continue
        states.closed[n] = True
        states.counts[EXPANDED] += 1
        _pose_of(lattice, states.place[n], pose)
        if sqrt((goal[0] - pose[0]) ** 2 + (goal[1] - pose[1]) ** 2) < 4.0 * model.radius:
            many = connect(pose, goal, model.radius, model.crab, model.weights, segments, best, scratch)
            if (
                states.cost[n] + best[COST] * model.radius < bound
                and states.cost[n] + segments_cost(field, layer, model, pose, segments, many, 0.0) < bound
                and segments_free(field, footprint, model, pose, segments, many)
            ):
                states.counts[LAST] = n
                return FOUND
        heading = states.place[n, 2]
        for k in range(lattice.primitives.used[heading]):
            pieces = lattice.primitives.segments[heading, k]
            used = 0
            while used < MAX_PRIMITIVE_SEGMENTS and pieces[used, 0] != 0.0:
                used += 1
            if not segments_free(field, footprint, model, pose, pieces, used):
                continue
            cost = lattice.primitives.cost[heading, k]
            cost += layer_cost(field, layer, pose[0], pose[1], pose[2], pieces[0, 0], pieces[0, 1], pieces[0, 2])
            shift = lattice.primitives.shift[heading, k]
            column, row = states.place[n, 0] + shift[0], states.place[n, 1] + shift[1]
            _open_state(field, to_go, lattice, states, heuristic_weight, bound, column, row,
                        (heading + shift[2]) % HEADINGS, states.cost[n] + cost, n, k)  # fmt: skip
    return RUNNING


@njit(cache=True)
def _trace(model: VehicleMotions, lattice: Lattice, goal: Array, states: LatticeStates) -> Array:
    """Return the segments of the solution at ``counts[LAST]``, from the start to the goal."""
    depth, n = 0, states.counts[LAST]
    while states.parent[n] >= 0:
        depth += 1
        n = states.parent[n]
    result = np.empty((MAX_PRIMITIVE_SEGMENTS * depth + MAX_SEGMENTS, 3))
    used, n = len(result), states.counts[LAST]
    segments, best, scratch, pose = np.empty((MAX_SEGMENTS, 3)), np.empty(8), np.empty((4, 3)), np.empty(3)
    _pose_of(lattice, states.place[n], pose)
    many = connect(pose, goal, model.radius, model.crab, model.weights, segments, best, scratch)
    for i in range(many - 1, -1, -1):
        used -= 1
        result[used] = segments[i]
    while states.parent[n] >= 0:
        pieces = lattice.primitives.segments[states.place[states.parent[n], 2], states.primitive[n]]
        for i in range(MAX_PRIMITIVE_SEGMENTS - 1, -1, -1):
            if pieces[i, 0] != 0.0:
                used -= 1
                result[used] = pieces[i]
        n = states.parent[n]
    return result[used:].copy()


class LatticePlanner:
    """Routes for one vehicle.

    Args:
        vehicle: the vehicle; its primitives are computed here.
        config: costs, cell, budget.
    """

    def __init__(self, vehicle: Vehicle, config: LatticeConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or LatticeConfig()
        factors = (self.config.turn_factor, self.config.reverse_factor, self.config.reverse_turn_factor)
        self.primitives = make_primitives(vehicle.radius, vehicle.crab_angle, self.config.cell, factors)
        self._footprint = vehicle.footprint.data()
        self._reeds_shepp = vehicle.reeds_shepp(self.config)
        self._model = VehicleMotions(
            vehicle.radius, vehicle.crab_angle, self._reeds_shepp.weights, 0.0, np.empty((0, 3)), np.empty(0),
            CHECK_STEP, self.config.margin + CHECK_MARGIN, 0, 0.0, MAX_RUNS - 1, False,
        )  # fmt: skip

    def plan(self, route_map: RouteMap, start: ArrayLike, goal: ArrayLike, now: Clock | None = None) -> RouteResult:
        """Plan a route of the vehicle's reference point, see ``RoutePlanner``."""
        budget = Budget(self.config.budget, now, self.config.effort)
        return plan_between(
            route_map, self.vehicle, self.config, start, goal, lambda ends: self._route(route_map, ends, budget), budget
        )

    def _route(self, route_map: RouteMap, ends: Endpoints, budget: Budget) -> RouteResult:
        """Plan a route that keeps the margin from its start on."""
        config = self.config
        field = route_map.field.data()
        costs = RouteCosts.of(self.vehicle, config)
        layer, cell = route_map.cost_layer(costs), route_map.coarse_cell
        start, goal = (cell_at(field, cell, pose[0], pose[1]) for pose in (ends.start, ends.goal))
        to_go = cost_to_go(route_map.cell_costs(costs), cell, goal, start, overrun=inf)
        if cost_at(to_go, *start) >= UNREACHED:
            return RouteResult(Reason.GOAL_UNREACHABLE, text=f"no passage {2 * costs.closed:.2f} m wide leads there")
        best, cost, statistics = None, np.inf, {"expanded": 0.0}
        for weight in (config.heuristic_weight, 0.5 * (1 + config.heuristic_weight), 1.0):
            segments, found, reason = self._search(field, layer, to_go, ends, budget, weight, cost, statistics)
            if segments is None:
                break
            if best is None:
                statistics["first_s"] = budget.elapsed
            best, cost = segments, found
        statistics["elapsed_s"] = budget.elapsed
        if best is None:
            statistics["exhausted"] = float(budget.remaining() > 0.0)
            return RouteResult(reason, text="no drivable route found", statistics=statistics)
        path = MotionPath(ends.start, best, self.vehicle.steering, self.vehicle.reference)
        statistics.setdefault("first_length", path.length)
        return RouteResult(Reason.OK, path, cost=cost, statistics=statistics)

    def _search(
        self, field: FieldData, layer: CostLayer, to_go: CostToGo, ends: Endpoints, budget: Budget, weight: float,
        bound: float, statistics: dict[str, float],
    ) -> tuple[Array | None, float, Reason]:  # fmt: skip
        """Return segments and cost of a solution cheaper than ``bound``, or the reason for the failure."""
        lattice, n = Lattice(self.primitives, self.config.cell, ends.start), 1 << 19
        states = LatticeStates(
            np.empty((n, 3), np.int64), np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64),
            np.empty(n, np.bool_), np.empty(4 * n), np.empty(4 * n, np.int64), np.zeros(2 * n, np.int64),
            np.zeros(4, np.int64),
        )  # fmt: skip
        _open_state(field, to_go, lattice, states, weight, bound, 0, 0, 0, 0.0, -1, -1)
        status = RUNNING
        while status == RUNNING and budget.remaining() > 0.0:
            before = int(states.counts[EXPANDED])
            status = expand(
                field, self._footprint, layer, to_go, self._model, lattice, ends.goal, states, weight, bound, CHUNK
            )
            budget.work += int(states.counts[EXPANDED]) - before
            statistics["expanded"] += int(states.counts[EXPANDED]) - before
        if status != FOUND:
            return None, bound, Reason.ROUTE_TIMEOUT
        last, pose = int(states.counts[LAST]), np.empty(3)
        _pose_of(lattice, states.place[last], pose)
        cost = float(states.cost[last]) + float(self._reeds_shepp.distance(pose, ends.goal)[0])
        return _trace(self._model, lattice, ends.goal, states), cost, Reason.OK
