"""The main route planner: Hybrid-A* for a first route, then shortening and other ways while there is time. Compiled."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from monstertruck_planners.route import distance_to_go as togo
from monstertruck_planners.route import hybrid_search as search
from monstertruck_planners.route.api import Budget, Clock, Ends, RouteMap, RouteResult, Vehicle, check_ends
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.motion import MotionPath
from monstertruck_planners.route.pricing import Layer
from monstertruck_planners.route.redraft import redraft
from monstertruck_planners.route.shorten import Draft, shorten, tidy
from monstertruck_planners.route.turning_table import turning_table
from monstertruck_planners.route.ways import brush_way, cheapest_new
from monstertruck_schemas.reasons import Reason

Array = NDArray[np.float64]

CHUNK = 256
"""Nodes expanded between two looks at the budget."""

CHECK_STEP = 0.01
"""Between two collision checks close to obstacles, m."""

SKIN = 1e-3
"""Kept beside the margin, as the footprint may come nearer between two checks, m."""

BATCH = 1000
"""Trials of shortening between two looks."""

PATIENCE = 12
"""Rounds of improvement without gain after which the route is taken to be the best."""

FINE = (0.1, 0.03, 0.01)
"""Shares of a stretch by which poses move at last."""

FINE_SHARE = 0.1
"""Of the budget, for these."""

LAST_SHARE = 0.4
"""Of the budget, for shortening with translations and for these."""

APART = 2.5
"""Ways differ if they are this far apart somewhere, turning radii."""

DETOUR = 1.15
"""Other ways are tried up to this factor on the shortest."""

MOST_NODES = 400_000
EMPTY = np.empty((0, 3))
HEADINGS = 36


@dataclass(frozen=True)
class Level:
    """How finely poses are told apart, in turning radii."""

    cell: float
    move: float


LEVELS = (Level(0.35, 0.55), Level(0.15, 0.25))
"""The second one is for narrow places, when the first finds nothing."""


class HybridPlanner:
    """Routes for one vehicle.

    Args:
        vehicle: what is driven.
        config: costs, tolerances, budget.
    """

    def __init__(self, vehicle: Vehicle, config: HybridConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or HybridConfig()
        self.steer = vehicle.steer(self.config)
        self.table = turning_table(vehicle.crab_angle)
        self.body = vehicle.footprint.body()
        self.side = self.body.half_width or self.body.radius

    def plan(self, ground: RouteMap, start: ArrayLike, goal: ArrayLike, now: Clock | None = None) -> RouteResult:
        """Route of the vehicle's reference point.

        Args:
            ground: the map.
            start: pose (x, y, yaw) in the map's frame, m, rad.
            goal: the same.
            now: seconds, for the budget; None: the config's ``effort`` limits the work and the result is reproducible.
        """
        config = self.config
        budget = Budget(config.budget, now, config.effort)
        ends = check_ends(
            ground, self.vehicle, start, goal, config.position_tolerance, config.yaw_tolerance, config.margin
        )
        if isinstance(ends, RouteResult):
            return ends
        return _Run(self, ground, ends, budget).route()

    @property
    def tolerance(self) -> float:
        """How far off the goal a route may end, m and rad."""
        return max(self.config.position_tolerance, self.config.yaw_tolerance)

    def free(self, ground: RouteMap, path: MotionPath) -> bool:
        """Whether the vehicle may drive a path of its reference point."""
        rows = np.ascontiguousarray(path.rows)
        return bool(search.rows_free(ground.field.data(), self.body, self.car(LEVELS[0]), path.start, rows, len(rows)))

    def cost(self, ground: RouteMap, path: MotionPath) -> float:
        """What a path costs, m."""
        layer = self.layer(ground)
        rows = np.ascontiguousarray(path.rows)
        car = self.car(LEVELS[0])
        return float(search.rows_cost(ground.field.data(), layer, car, path.start, rows, len(rows), 0.0))

    def layer(self, ground: RouteMap) -> Layer:
        """Prices on a map."""
        return ground.layer(self.config, self.side + 0.5 * ground.field.resolution)

    def car(self, level: Level) -> search.Car:
        """The vehicle as the compiled search takes it, with moves of one level."""
        radius, crab = self.vehicle.radius, self.vehicle.crab_angle
        length = level.move * radius
        moves = [(s * length, k / radius, 0.0) for s in (1.0, -1.0) for k in (0.0, 1.0, -1.0, 0.5, -0.5)]
        if crab > 0.0:
            moves += [(s * length, 0.0, b) for s in (1.0, -1.0) for b in (crab, -crab)]
        leaps = np.array([16.0, 8.0, 4.0, 2.0]) * radius
        weights, swing, margin = self.steer.weights, self.config.swing_cost, self.config.margin + SKIN
        return search.Car(radius, crab, weights, swing, np.array(moves), leaps, CHECK_STEP, margin)


class _Run:
    """One planning request."""

    def __init__(self, planner: HybridPlanner, ground: RouteMap, ends: Ends, budget: Budget) -> None:
        self.planner, self.vehicle, self.config, self.budget = planner, planner.vehicle, planner.config, budget
        self.table, self.body = planner.table, planner.body
        self.start, self.goal = ends.start, ends.goal
        self.field = ground.field.data()
        self.layer = planner.layer(ground)
        self.factor = max(round(togo.COARSE / self.field.resolution), 1)
        self.cell = self.factor * self.field.resolution
        self.car = planner.car(LEVELS[0])
        self.random = np.random.default_rng(0)
        self.statistics: dict[str, float] = {"expanded": 0, "trials": 0, "kept": 0, "ways": 0}

    def route(self) -> RouteResult:
        rows = self._direct()
        if rows is None:
            go = self._ways(np.zeros((0, 0), np.bool_), stretch=1.3)
            row, column = self._cell(self.start)
            if go.cost[row, column] >= togo.FAR:
                return self._none(Reason.GOAL_UNREACHABLE, "no way is wide enough")
            rows, reason = self._first(go)
            if rows is None:
                return self._none(reason, "no drivable way found")
        self.statistics["first_s"] = self.budget.elapsed
        self.statistics["first_length"] = float(np.abs(rows[:, 0]).sum())
        if self.config.improve:
            rows = self._improve(rows)
        path = MotionPath(self.start, rows, self.vehicle.steering, self.vehicle.reference)
        return RouteResult(Reason.OK, path, cost=self._cost(rows), statistics=self._told())

    def _none(self, reason: Reason, text: str) -> RouteResult:
        return RouteResult(reason, text=text, statistics=self._told())

    def _told(self) -> dict[str, float]:
        return {**self.statistics, "elapsed_s": self.budget.elapsed}

    def _cell(self, pose: Array) -> tuple[int, int]:
        return togo.cell_at(self.field, self.cell, pose[0], pose[1])

    @cached_property
    def toll(self) -> NDArray[np.int16]:
        """Cost of entering each coarse cell."""
        side = self.planner.side
        return togo.tolls(
            self.field, self.layer.price, self.factor,
            self.body.inscribed, side, side + 0.25 * self.vehicle.radius,
        )  # fmt: skip

    def _ways(self, allowed: NDArray[np.bool_], stretch: float) -> togo.ToGo:
        row, column = self._cell(self.start)
        cost, step = togo.spread(self.toll, allowed, *self._cell(self.goal), row * self.toll.shape[1] + column, stretch)
        return togo.ToGo(cost, step, self.toll, self.cell)

    def _nodes(self, level: Level) -> search.Nodes:
        cell = level.cell * self.vehicle.radius
        rows, columns = (int(n * self.field.resolution / cell) + 1 for n in self.field.occupied.shape)
        n = MOST_NODES
        return search.Nodes(
            np.empty((n, 3)), np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n),
            np.empty(n, np.bool_), np.empty(n), np.empty(n, np.int64),
            np.zeros((rows, columns, HEADINGS), np.int32), cell, np.zeros(4, np.int64),
        )  # fmt: skip

    def _direct(self) -> Array | None:
        """The best motion without obstacles, if it is free."""
        rows = self.planner.steer.path(self.start, self.goal).rows
        free = search.rows_free(self.field, self.body, self.car, self.start, np.ascontiguousarray(rows), len(rows))
        return np.array(rows) if free else None

    def _first(self, go: togo.ToGo) -> tuple[Array | None, Reason]:
        for level in LEVELS:
            rows, reason = self._search(go, level)
            if rows is not None or reason is Reason.ROUTE_TIMEOUT:
                return rows, reason
        whole = self._ways(np.zeros((0, 0), np.bool_), stretch=1e4)
        return self._search(whole, LEVELS[1])

    def _search(
        self, go: togo.ToGo, level: Level, *, sight: float = np.inf, most: int = MOST_NODES
    ) -> tuple[Array | None, Reason]:
        car, nodes = self.planner.car(level), self._nodes(level)
        field, goal, (x, y, yaw) = self.field, self.goal, self.start
        greed, bound = self.config.greed, np.inf
        search.add(field, go, self.table, car, goal, nodes, greed, x, y, yaw, 0.0, -1, search.LEAP, 0.0, bound)
        status = search.RUNNING
        while status == search.RUNNING and self.budget.left() > 0.0 and nodes.counts[search.EXPANDED] < most:
            before = int(nodes.counts[search.EXPANDED])
            status = search.expand(
                field, self.body, self.layer, go, self.table, car, goal, nodes, greed, bound, sight, CHUNK
            )
            done = int(nodes.counts[search.EXPANDED]) - before
            self.budget.work += done
            self.statistics["expanded"] += done
        if status == search.FOUND:
            return search.trace(car, goal, nodes), Reason.OK
        return None, Reason.GOAL_UNREACHABLE if status == search.EXHAUSTED else Reason.ROUTE_TIMEOUT

    def _improve(self, rows: Array) -> Array:
        car = self.car
        # Motions without translations are found in half the time: only the middle part allows for these.
        plain = self.car = car._replace(crab=0.0)
        rows = self._rounds(rows, self._other_ways(), PATIENCE, LAST_SHARE if car.crab > 0.0 else FINE_SHARE)
        if car.crab > 0.0:
            self.car = car
            rows = self._rounds(rows, iter(()), 4, FINE_SHARE)
            self.car = plain
        best = self._draft(rows)
        for shift in FINE:
            self._settle(best, 1e-4, shift)
        self.car = car
        return best.rows[: best.used[0]].copy()

    def _rounds(self, rows: Array, others: Iterator[Array], patience: int, reserve: float) -> Array:
        """Polish the best route and other drafts in turn until nothing gains or only the reserve is left."""
        best, cost = self._polished(rows, np.inf)
        idle = 0
        while self.budget.left() > reserve and idle < patience:
            rows = next(others, EMPTY)
            rows, other = self._polished(rows if len(rows) else best, 1.05 * cost)
            idle = 0 if other < 0.9995 * cost else idle + 1
            if other < cost:
                best, cost = rows, other
        return best

    def _polished(self, rows: Array, promising: float) -> tuple[Array, float]:
        """Shorten, face the better way everywhere, shorten again; given up early unless the cost gets ``promising``."""
        draft = self._draft(rows)
        self._settle(draft)
        cost = self._cost(draft.rows[: draft.used[0]])
        if cost < promising and self.budget.left() > 0.0:
            other = self._draft(self._redrafted(draft))
            if other.used[0]:
                self._settle(other)
                if self._cost(other.rows[: other.used[0]]) < cost:
                    draft = other
        rows = draft.rows[: draft.used[0]].copy()
        return rows, self._cost(rows)

    def _settle(self, draft: Draft, gain: float = 1e-3, shift: float = 0.25) -> None:
        """Shorten until a batch of trials gains less than a share of the cost."""
        last = np.inf
        while self.budget.left() > 0.0 and (cost := self._cost(draft.rows[: draft.used[0]])) < (1.0 - gain) * last:
            last = cost
            self._trials(draft, BATCH, shift)

    def _cost(self, rows: Array) -> float:
        return float(search.rows_cost(self.field, self.layer, self.car, self.start, rows, len(rows), 0.0))

    def _redrafted(self, draft: Draft) -> Array:
        path = MotionPath(self.start, draft.rows[: draft.used[0]])
        spacing = max(1.5 * self.vehicle.radius, path.length / 60) * self.random.uniform(0.7, 1.3)
        samples = path.sample(spacing)
        return redraft(
            self.field, self.body, self.layer, self.car, samples.poses, samples.travelled, 16.0 * self.vehicle.radius
        )

    def _other_ways(self) -> Iterator[Array]:
        """First drafts along all ways worth a look, the shortest ways first."""
        go = self._ways(np.zeros((0, 0), np.bool_), stretch=1.3)
        columns = self.toll.shape[1]
        whole = np.zeros((0, 0), np.bool_)
        back, back_step = togo.spread(self.toll, whole, *self._cell(self.start), -1, 1.0)
        known = np.zeros(self.toll.shape, np.bool_)
        width = APART * self.vehicle.radius / self.cell
        limit = int(DETOUR * go.cost[self._cell(self.start)])
        while (cell := cheapest_new(go.cost, back, known, limit)) >= 0:
            lane = np.zeros(self.toll.shape, np.bool_)
            for step in (go.step, back_step):
                brush_way(lane, step, cell // columns, cell % columns, width)
                brush_way(known, step, cell // columns, cell % columns, width)
            self.statistics["ways"] += 1
            # From far off the goal is not tried directly: that motion would leave the lane.
            near = 3.0 * self.vehicle.radius
            rows, _ = self._search(self._ways(lane, 1.3), LEVELS[0], sight=near, most=CHUNK)
            yield EMPTY if rows is None else rows

    def _draft(self, rows: Array) -> Draft:
        room = len(rows) + 400
        draft = Draft(np.empty((room, 3)), np.empty((room + 1, 3)), np.empty(room + 1), np.array([len(rows)]))
        draft.rows[: len(rows)] = rows
        draft.poses[0] = self.start
        tidy(draft)
        return draft

    def _trials(self, draft: Draft, count: int, shift: float) -> None:
        reach = 40.0 * self.vehicle.radius
        kept = shorten(self.field, self.body, self.layer, self.car, draft, reach, shift, self.random.random((count, 6)))
        self.budget.work += count
        self.statistics["trials"] += count
        self.statistics["kept"] += kept
