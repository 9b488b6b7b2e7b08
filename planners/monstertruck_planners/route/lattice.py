"""State-lattice planner with moves of exact radius; searched again less greedily while time is left. Compiled."""

import math
from dataclasses import dataclass
from math import cos, inf, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision_kernels import BodyData, FieldData
from monstertruck_planners.route.api import Budget, Clock, Ends, RouteMap, RouteResult, Vehicle, check_ends
from monstertruck_planners.route.config import LatticeConfig
from monstertruck_planners.route.heuristic import COARSE, FAR, UNIT, ToGo, cell_at, spread, tolls
from monstertruck_planners.route.motion import MotionPath
from monstertruck_planners.route.reeds_shepp import COST, connect
from monstertruck_planners.route.search import (
    EXHAUSTED,
    FOUND,
    RUNNING,
    Car,
    Layer,
    drop,
    push,
    row_price,
    rows_cost,
    rows_free,
)
from monstertruck_schemas.reasons import Reason

IntArray = NDArray[np.int64]

VECTORS = (
    (1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1),
    (-1, 0), (-2, -1), (-1, -1), (-1, -2), (0, -1), (1, -2), (1, -1), (2, -1),
)  # fmt: skip
ANGLES = np.array([math.atan2(y, x) for x, y in VECTORS])
LONG = 8
"""Cells of the long straight move, about."""
MOST_MOVE_ROWS = 3


@dataclass(frozen=True)
class Moves:
    """All moves, by the heading they start at.

    ``rows[h, k]`` are up to three motion rows (unused ones of length 0), ``shift[h, k]`` the columns, rows and headings
    moved on, ``cost[h, k]`` the price in metres, ``number[h]`` their number.
    """

    rows: Array
    shift: IntArray
    cost: Array
    number: IntArray


def make_moves(
    radius: float, crab_angle: float, cell: float, factors: tuple[float, float, float] = (2.0, 3.0, 5.0)
) -> Moves:
    """Moves of one truck.

    Args:
        radius: least turning radius, m.
        crab_angle: largest angle of a translation, rad; 0: none.
        cell: m.
        factors: on the cost of a turn forward, a line backward, a turn or translation backward.
    """
    table = [_moves_from(h, radius, crab_angle, cell, factors) for h in range(len(VECTORS))]
    most = max(map(len, table))
    rows = np.zeros((len(VECTORS), most, MOST_MOVE_ROWS, 3))
    shift, cost = np.zeros((len(VECTORS), most, 3), np.int64), np.zeros((len(VECTORS), most))
    for h, moves in enumerate(table):
        for k, (pieces, where, price) in enumerate(moves):
            rows[h, k, : len(pieces)] = pieces
            shift[h, k], cost[h, k] = where, price
    return Moves(rows, shift, cost, np.array([len(moves) for moves in table]))


Move = tuple[list[tuple[float, float, float]], tuple[int, int, int], float]


def _moves_from(h: int, radius: float, crab: float, cell: float, factors: tuple[float, float, float]) -> list[Move]:
    turn_factor, back_factor, back_turn_factor = factors
    x, y = VECTORS[h]
    moves: list[Move] = []
    for steps in (1, max(round(LONG / math.hypot(x, y)), 2)):
        length = steps * math.hypot(x, y) * cell
        moves.append(([(length, 0.0, 0.0)], (steps * x, steps * y, 0), length))
        if steps == 1:
            moves.append(([(-length, 0.0, 0.0)], (-x, -y, 0), back_factor * length))
    for turn in (1, -1):
        pieces, (dx, dy) = _turn(h, turn, radius, cell)
        length = sum(abs(row[0]) for row in pieces)
        moves.append((pieces, (dx, dy, turn), turn_factor * length))
    for turn in (1, -1):
        # Backward into the next heading: the way of a turn from there, driven back.
        pieces, (dx, dy) = _turn((h + turn) % 16, -turn, radius, cell)
        length = sum(abs(row[0]) for row in pieces)
        back = [(-s, k, b) for s, k, b in reversed(pieces)]
        moves.append((back, (-dx, -dy, turn), back_turn_factor * length))
    for side in (1, -1) if crab > 0.0 else ():
        for dx, dy, angle in _translations(h, side, crab):
            length = math.hypot(dx, dy) * cell
            moves.append(([(length, 0.0, angle)], (dx, dy, 0), length))
            moves.append(([(-length, 0.0, angle)], (-dx, -dy, 0), back_turn_factor * length))
    return moves


def _turn(h: int, turn: int, radius: float, cell: float) -> tuple[list[tuple[float, float, float]], tuple[int, int]]:
    """Shortest turn to the next heading that ends on a cell, with the largest radius that fits."""
    a, b = ANGLES[h], ANGLES[h] + math.remainder(ANGLES[(h + turn) % 16] - ANGLES[h], math.tau)
    lines = np.array([[math.cos(a), math.cos(b)], [math.sin(a), math.sin(b)]])
    arc = turn * np.array([math.sin(b) - math.sin(a), math.cos(a) - math.cos(b)])
    reach = math.ceil(2.0 * radius * abs(b - a) / cell) + 6
    best: tuple[float, Array, float, tuple[int, int]] | None = None
    for dx in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            fixed, slope = np.linalg.solve(lines, np.column_stack((np.array([dx, dy]) * cell, arc))).T
            least = fixed - radius * slope
            if (least < -1e-12).any():
                continue
            # Both lines shrink as the radius grows: to where the first is gone.
            widest = min((f / s for f, s in zip(fixed, slope, strict=True) if s > 1e-12), default=radius)
            widest = max(widest, radius)
            ends = np.maximum(fixed - widest * slope, 0.0)
            length = float(ends.sum() + widest * abs(b - a))
            if best is None or length < best[0] - 1e-9:
                best = (length, ends, widest, (dx, dy))
    assert best is not None
    _, ends, widest, where = best
    pieces = [(float(ends[0]), 0.0, 0.0), (widest * abs(b - a), turn / widest, 0.0), (float(ends[1]), 0.0, 0.0)]
    return [row for row in pieces if row[0] > 1e-9], where


def _translations(h: int, side: int, crab: float) -> list[tuple[int, int, float]]:
    """The steepest translation to one side within LONG cells: columns, rows, angle."""
    found = []
    for dx in range(-LONG, LONG + 1):
        for dy in range(-LONG, LONG + 1):
            angle = math.remainder(math.atan2(dy, dx) - ANGLES[h], math.tau)
            if (dx or dy) and 1e-9 < side * angle <= crab + 1e-12:
                found.append((-round(abs(angle), 9), math.hypot(dx, dy), dx, dy, angle))
    return [(dx, dy, angle) for _, _, dx, dy, angle in sorted(found)[:1]]


HEADINGS = 16
SPREAD = 1 << 15
"""Cells either side of the start."""


class Lattice(NamedTuple):
    """Moves, see ``lattice_moves.Moves``, and the frame: the start is cell (0, 0), heading 0."""

    rows: Array
    shift: IntArray
    cost: Array
    number: IntArray
    cell: float
    frame: Array
    """Shape (3,): the start's pose."""


class States(NamedTuple):
    """Memory of one search; states are numbered in the order they are met."""

    place: IntArray
    """Shape (n, 3): column, row, heading."""
    cost: Array
    parent: IntArray
    move: IntArray
    closed: NDArray[np.bool_]
    keys: Array
    items: IntArray
    buckets: IntArray
    """Hash table, a power of two long: state number plus one; 0 = empty."""
    counts: IntArray
    """States, heap size, expanded, the state that saw the goal."""


@njit(cache=True)
def pose_of(lattice: Lattice, place: IntArray, out: Array) -> None:
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
    field: FieldData, body: BodyData, layer: Layer, go: ToGo, car: Car, lattice: Lattice, goal: Array,
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
def trace(car: Car, lattice: Lattice, goal: Array, states: States) -> Array:
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


CHUNK = 256
MOST_STATES = 1 << 19
CHECK_STEP, SKIN = 0.01, 1e-3


class LatticePlanner:
    """Routes for one vehicle.

    Args:
        vehicle: what is driven; its moves are made here.
        config: costs, cell, budget.
    """

    def __init__(self, vehicle: Vehicle, config: LatticeConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or LatticeConfig()
        factors = (self.config.turn_factor, self.config.reverse_factor, self.config.reverse_turn_factor)
        self.moves = make_moves(vehicle.radius, vehicle.crab_angle, self.config.cell, factors)
        self._body = vehicle.footprint.body()
        weights, margin = vehicle.steer(self.config).weights, self.config.margin + SKIN
        none = np.empty((0, 3))
        self._car = Car(vehicle.radius, vehicle.crab_angle, weights, 0.0, none, np.empty(0), CHECK_STEP, margin)

    def plan(self, ground: RouteMap, start: ArrayLike, goal: ArrayLike, now: Clock | None = None) -> RouteResult:
        """Route of the vehicle's reference point, see ``HybridPlanner.plan``."""
        config = self.config
        budget = Budget(config.budget, now, config.effort)
        ends = check_ends(
            ground, self.vehicle, start, goal, config.position_tolerance, config.yaw_tolerance, config.margin
        )
        if isinstance(ends, RouteResult):
            return ends
        field = ground.field.data()
        side = self._body.half_width or self._body.radius
        layer = ground.layer(config, side + 0.5 * field.resolution)
        go = _to_go(field, layer.price, self._body.inscribed, side, side + 0.25 * self.vehicle.radius, ends)
        row, column = cell_at(field, go.cell, ends.start[0], ends.start[1])
        if go.cost[row, column] >= FAR:
            return RouteResult(Reason.GOAL_UNREACHABLE, text="no way is wide enough")
        best, cost, statistics = None, np.inf, {"expanded": 0.0}
        for greed in (config.greed, 0.5 * (1 + config.greed), 1.0):
            rows, found, reason = self._search(field, layer, go, ends, budget, greed, cost, statistics)
            if rows is None:
                break
            if best is None:
                statistics["first_s"] = budget.elapsed
            best, cost = rows, found
        statistics["elapsed_s"] = budget.elapsed
        if best is None:
            return RouteResult(reason, text="no drivable way found", statistics=statistics)
        path = MotionPath(ends.start, best, self.vehicle.steering, self.vehicle.reference)
        statistics.setdefault("first_length", path.length)
        return RouteResult(Reason.OK, path, cost=cost, statistics=statistics)

    def _search(
        self, field: FieldData, layer: Layer, go: ToGo, ends: Ends, budget: Budget, greed: float, bound: float,
        statistics: dict[str, float],
    ) -> tuple[Array | None, float, Reason]:  # fmt: skip
        moves, n = self.moves, MOST_STATES
        lattice = Lattice(moves.rows, moves.shift, moves.cost, moves.number, self.config.cell, ends.start)
        states = States(
            np.empty((n, 3), np.int64), np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64),
            np.empty(n, np.bool_), np.empty(4 * n), np.empty(4 * n, np.int64), np.zeros(2 * n, np.int64),
            np.zeros(4, np.int64),
        )  # fmt: skip
        meet(field, go, lattice, states, greed, bound, 0, 0, 0, 0.0, -1, -1)
        status = RUNNING
        while status == RUNNING and budget.left() > 0.0:
            before = int(states.counts[2])
            status = expand(field, self._body, layer, go, self._car, lattice, ends.goal, states, greed, bound, CHUNK)
            budget.work += int(states.counts[2]) - before
            statistics["expanded"] += int(states.counts[2]) - before
        if status != FOUND:
            reason = Reason.GOAL_UNREACHABLE if status == EXHAUSTED else Reason.ROUTE_TIMEOUT
            return None, bound, reason
        last = int(states.counts[3])
        rows = trace(self._car, lattice, ends.goal, states)
        return (
            rows,
            float(states.cost[last]) + _last_leg(self.vehicle, self.config, lattice, states, last, ends),
            Reason.OK,
        )


def _last_leg(
    vehicle: Vehicle, config: LatticeConfig, lattice: Lattice, states: States,
    last: int, ends: Ends,
) -> float:  # fmt: skip
    pose = np.empty(3)
    pose_of(lattice, states.place[last], pose)
    return float(vehicle.steer(config).distance(pose, ends.goal)[0])


def _to_go(field: FieldData, price: NDArray[np.float32], closed: float, side: float, wide: float, ends: Ends) -> ToGo:
    factor = max(round(COARSE / field.resolution), 1)
    cell = factor * field.resolution
    toll = tolls(field, price, factor, closed, side, wide)
    row, column = cell_at(field, cell, ends.goal[0], ends.goal[1])
    cost, step = spread(toll, np.zeros((0, 0), np.bool_), row, column, -1, 1.0)
    return ToGo(cost, step, toll, cell)
