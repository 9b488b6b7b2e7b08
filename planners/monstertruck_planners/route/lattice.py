"""State-lattice planner with moves of exact radius; searched again less greedily while time is left. Compiled."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from monstertruck_planners.collision_kernels import FieldData
from monstertruck_planners.route import distance_to_go as togo
from monstertruck_planners.route import hybrid_search, lattice_search
from monstertruck_planners.route.api import Budget, Clock, Ends, RouteMap, RouteResult, Vehicle, check_ends
from monstertruck_planners.route.config import LatticeConfig
from monstertruck_planners.route.lattice_moves import make_moves
from monstertruck_planners.route.motion import MotionPath
from monstertruck_planners.route.pricing import Layer
from monstertruck_schemas.reasons import Reason

Array = NDArray[np.float64]

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
        self._car = hybrid_search.Car(
            vehicle.radius, vehicle.crab_angle, weights, 0.0, none, np.empty(0), CHECK_STEP, margin
        )

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
        row, column = togo.cell_at(field, go.cell, ends.start[0], ends.start[1])
        if go.cost[row, column] >= togo.FAR:
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
        self, field: FieldData, layer: Layer, go: togo.ToGo, ends: Ends, budget: Budget, greed: float, bound: float,
        statistics: dict[str, float],
    ) -> tuple[Array | None, float, Reason]:  # fmt: skip
        moves, n = self.moves, MOST_STATES
        lattice = lattice_search.Lattice(
            moves.rows, moves.shift, moves.cost, moves.number, self.config.cell, ends.start
        )
        states = lattice_search.States(
            np.empty((n, 3), np.int64), np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64),
            np.empty(n, np.bool_), np.empty(4 * n), np.empty(4 * n, np.int64), np.zeros(2 * n, np.int64),
            np.zeros(4, np.int64),
        )  # fmt: skip
        lattice_search.meet(field, go, lattice, states, greed, bound, 0, 0, 0, 0.0, -1, -1)
        status = hybrid_search.RUNNING
        while status == hybrid_search.RUNNING and budget.left() > 0.0:
            before = int(states.counts[2])
            status = lattice_search.expand(
                field, self._body, layer, go, self._car, lattice, ends.goal, states, greed, bound, CHUNK
            )
            budget.work += int(states.counts[2]) - before
            statistics["expanded"] += int(states.counts[2]) - before
        if status != hybrid_search.FOUND:
            reason = Reason.GOAL_UNREACHABLE if status == hybrid_search.EXHAUSTED else Reason.ROUTE_TIMEOUT
            return None, bound, reason
        last = int(states.counts[3])
        rows = lattice_search.trace(self._car, lattice, ends.goal, states)
        return (
            rows,
            float(states.cost[last]) + _last_leg(self.vehicle, self.config, lattice, states, last, ends),
            Reason.OK,
        )


def _last_leg(
    vehicle: Vehicle, config: LatticeConfig, lattice: lattice_search.Lattice, states: lattice_search.States,
    last: int, ends: Ends,
) -> float:  # fmt: skip
    pose = np.empty(3)
    lattice_search.pose_of(lattice, states.place[last], pose)
    return float(vehicle.steer(config).distance(pose, ends.goal)[0])


def _to_go(
    field: FieldData, price: NDArray[np.float32], closed: float, side: float, wide: float, ends: Ends
) -> togo.ToGo:
    factor = max(round(togo.COARSE / field.resolution), 1)
    cell = factor * field.resolution
    toll = togo.tolls(field, price, factor, closed, side, wide)
    row, column = togo.cell_at(field, cell, ends.goal[0], ends.goal[1])
    cost, step = togo.spread(toll, np.zeros((0, 0), np.bool_), row, column, -1, 1.0)
    return togo.ToGo(cost, step, toll, cell)
