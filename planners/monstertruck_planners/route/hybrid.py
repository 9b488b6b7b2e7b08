"""The main route planner: Hybrid-A* for a first route, then path smoothing and alternatives while there is time.

Loads numba.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.route import heuristic, search
from monstertruck_planners.route.api import (
    Budget,
    Clock,
    Endpoints,
    RouteCosts,
    RouteMap,
    RouteResult,
    Vehicle,
    check_endpoints,
)
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.corridors import cheapest_unmarked, close_narrow_gaps, mark_corridor
from monstertruck_planners.route.hybrid_search import (
    MAX_NODES,
    RESOLUTIONS,
    Resolution,
    SearchProblem,
    SearchRun,
)
from monstertruck_planners.route.motion import MotionPath
from monstertruck_planners.route.smoothing import EditablePath, choose_headings, current_segments, editable, shortcut
from monstertruck_schemas.reasons import Reason

BATCH = 1000
"""Smoothing trials between two checks of the budget."""

MAX_IDLE_ROUNDS = 12
"""Rounds of improvement without gain after which the route is taken to be the best."""

FINE_SHIFTS = (0.1, 0.03, 0.01)
"""Shares of a stretch by which poses move in the final smoothing."""

FINAL_SHARE = 0.1
"""Of the budget, for the final smoothing."""

CRAB_SHARE = 0.4
"""Of the budget, for smoothing with translations and for the final smoothing."""

ALTERNATIVE_DISTANCE = 2.5
"""Alternatives are this far from all known ways somewhere, turning radii."""

ALTERNATIVE_LENGTH = 1.15
"""Alternatives are tried up to this factor on the shortest way."""

FIRST_NODES = 512
"""Nodes expanded coarsely before gaps are measured and the fine search takes turns."""

GROWTH = 2
"""Of the nodes expanded in a turn, from one round to the next."""

NARROW = 0.06
"""Nearer than this and half the footprint's width to obstacles a cell may belong to a narrow gap, m."""

GAP_ERROR = 0.01
"""The positions and headings checked may be off the best ones by that much, m."""

GAP_PLAY = 0.005
"""Needed in a gap beyond the margin on both sides: with less no search finds the way through, m."""

GAP_ROUNDS = 30
"""Ways checked for narrow gaps."""

GAP_CORRIDOR = 0.15
"""Checked on both sides of a way on which there is a narrow gap, m."""

NO_SEGMENTS = np.empty((0, 3))

MARGIN_STEP = 0.005
"""From one margin tried to the next, m."""

MARGIN_SHARE = 0.5
"""Of the rest of the budget: for the searches with narrower margins."""

NARROW_COST = 1.0
"""Clearance cost of routes with a narrower margin: they use it only where they have to, m."""

TRY_NARROWER = (Reason.START_BLOCKED, Reason.GOAL_BLOCKED, Reason.GOAL_UNREACHABLE, Reason.ROUTE_TIMEOUT)


@dataclass(frozen=True)
class MarginAttempt:
    """Planning with one of several margins."""

    reserve: float
    """Share of the budget kept for the others."""
    first: bool


class HybridPlanner:
    """Routes for one vehicle.

    Args:
        vehicle: what is driven.
        config: costs, tolerances, budget.
    """

    def __init__(self, vehicle: Vehicle, config: HybridConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or HybridConfig()
        self.reeds_shepp = vehicle.reeds_shepp(self.config)
        self.table = heuristic.reeds_shepp_table(vehicle.crab_angle)
        self.footprint = vehicle.footprint.data()
        self.costs = RouteCosts.of(vehicle, self.config)
        self._models = {resolution: self._motion_model(resolution) for resolution in RESOLUTIONS}
        self._narrower = [HybridPlanner(vehicle, narrow) for narrow in narrower_configs(self.config)]

    def plan(self, route_map: RouteMap, start: ArrayLike, goal: ArrayLike, now: Clock | None = None) -> RouteResult:
        """Route of the vehicle's reference point, see ``RoutePlanner``; ``statistics["margin"]`` is the margin kept."""
        budget = Budget(self.config.budget, now, self.config.effort)
        planners, share = [self, *self._narrower], 1.0
        for planner in planners:
            share *= MARGIN_SHARE
            attempt = MarginAttempt(0.0 if planner is planners[-1] else share, planner is self)
            result = planner.plan_with_margin(budget, route_map, start, goal, attempt)
            if result.reason not in TRY_NARROWER:
                break
        return replace(result, statistics={**result.statistics, "margin": planner.config.margin})

    def plan_with_margin(
        self, budget: Budget, route_map: RouteMap, start: ArrayLike, goal: ArrayLike, attempt: MarginAttempt
    ) -> RouteResult:
        """Route with the margin of this planner's settings, see ``plan``."""
        position, yaw, margin = self.config.position_tolerance, self.config.yaw_tolerance, self.config.margin
        ends = check_endpoints(route_map, self.vehicle, start, goal, position, yaw, margin)
        if isinstance(ends, RouteResult):
            return ends
        return _PlanningRun(self, route_map, ends, budget, attempt).route()

    def planner_for(self, margin: float) -> "HybridPlanner":
        """The planner of the greatest margin tried that is not above this one; of the narrowest, if all are."""
        planners = [self, *self._narrower]
        return next((planner for planner in planners if planner.config.margin <= margin), planners[-1])

    @property
    def tolerance(self) -> float:
        """Greatest deviation of a route's end from the goal, m and rad."""
        return max(self.config.position_tolerance, self.config.yaw_tolerance)

    def free(self, route_map: RouteMap, path: MotionPath) -> bool:
        """Whether a path of the reference point is free of collisions."""
        segments, model = np.ascontiguousarray(path.segments), self.motion_model(RESOLUTIONS[0])
        field = route_map.field.data()
        return bool(search.segments_free(field, self.footprint, model, path.start, segments, len(segments)))

    def cost(self, route_map: RouteMap, path: MotionPath) -> float:
        """Cost of a path, m."""
        segments, model = np.ascontiguousarray(path.segments), self.motion_model(RESOLUTIONS[0])
        field, layer = route_map.field.data(), route_map.cost_layer(self.costs)
        return float(search.segments_cost(field, layer, model, path.start, segments, len(segments), 0.0))

    def motion_model(self, resolution: Resolution) -> search.VehicleMotions:
        """The vehicle's limits and costs, with motion primitives of a resolution."""
        return self._models.get(resolution) or self._motion_model(resolution)

    def _motion_model(self, resolution: Resolution) -> search.VehicleMotions:
        radius, crab = self.vehicle.radius, self.vehicle.crab_angle
        length = resolution.primitive * radius
        primitives = [(s * length, k / radius, 0.0) for s in (1.0, -1.0) for k in (0.0, 1.0, -1.0, 0.5, -0.5)]
        if crab > 0.0:
            primitives += [(s * length, 0.0, b) for s in (1.0, -1.0) for b in (crab, -crab)]
        return search.VehicleMotions(
            radius, crab, self.reeds_shepp.weights, self.config.swing_cost, np.array(primitives),
            np.array([16.0, 8.0, 4.0, 2.0]) * radius, search.CHECK_STEP,
            self.config.margin + search.CHECK_MARGIN,
        )  # fmt: skip


def narrower_configs(config: HybridConfig) -> list[HybridConfig]:
    """Settings with the margins that are tried after that of ``config``."""
    spare = config.margin - config.narrow_margin
    if spare <= 0.0:
        return []
    margins = np.linspace(config.margin, config.narrow_margin, math.ceil(spare / MARGIN_STEP - 1e-6) + 1)[1:].tolist()
    cost = max(config.clearance_cost, NARROW_COST)
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
        self.model = planner.motion_model(RESOLUTIONS[0])
        self.random = np.random.default_rng(0)
        self.statistics: dict[str, float] = {"expanded": 0, "trials": 0, "kept": 0, "alternatives": 0}
        self.problem = SearchProblem(
            self.field, self.footprint, self.layer, planner.table, self.start, self.goal,
            self.config.heuristic_weight, budget, self.statistics,
        )  # fmt: skip

    def route(self) -> RouteResult:
        segments = self._direct()
        if segments is None:
            segments, reason, text = self._search(self._cost_to_go())
            if segments is None:
                return RouteResult(reason, text=text, statistics=self._final_statistics())
        self.statistics["first_s"] = self.budget.elapsed
        self.statistics["first_length"] = float(np.abs(segments[:, 0]).sum())
        if self.config.improve:
            segments = self._improve(segments)
        path = MotionPath(self.start, segments, self.vehicle.steering, self.vehicle.reference)
        return RouteResult(Reason.OK, path, cost=self._cost(segments), statistics=self._final_statistics())

    def _final_statistics(self) -> dict[str, float]:
        return {**self.statistics, "elapsed_s": self.budget.elapsed}

    def _cell_of(self, pose: Array) -> tuple[int, int]:
        return heuristic.cell_at(self.field, self.cell, pose[0], pose[1])

    @cached_property
    def cell_cost(self) -> NDArray[np.int16]:
        """Cost of entering each coarse cell; narrow gaps are closed here."""
        return self.route_map.cell_costs(self.planner.costs).copy()

    def _cost_to_go(
        self, cell_cost: NDArray[np.int16] | None = None, overrun: float = heuristic.OVERRUN
    ) -> heuristic.CostToGo:
        cell_cost = self.cell_cost if cell_cost is None else cell_cost
        return heuristic.cost_to_go(
            cell_cost, self.cell, self._cell_of(self.goal), self._cell_of(self.start), overrun=overrun
        )

    def _direct(self) -> Array | None:
        """The best motion without obstacles, if it is free."""
        segments = np.ascontiguousarray(self.planner.reeds_shepp.path(self.start, self.goal).segments)
        free = search.segments_free(self.field, self.footprint, self.model, self.start, segments, len(segments))
        return np.array(segments) if free else None

    def _search(self, to_go: heuristic.CostToGo) -> tuple[Array | None, Reason, str]:
        """First route: a short coarse search, then gaps are measured, and a fine and the coarse one take turns."""
        too_narrow = None, Reason.GOAL_UNREACHABLE, "no way is wide enough"
        if not self._reachable(to_go):
            return too_narrow
        coarse = self._search_run(to_go, RESOLUTIONS[0])
        segments = coarse.run(FIRST_NODES, self.attempt.reserve) if self.attempt.first else None
        if segments is not None:
            return segments, Reason.OK, ""
        if self._close_narrow_gaps(to_go):
            to_go = self._cost_to_go()
            if not self._reachable(to_go):
                return too_narrow
            coarse = self._search_run(to_go, RESOLUTIONS[0])
        fine = self._search_run(to_go, RESOLUTIONS[1])
        segments = self._run_in_turns(fine, coarse)
        if segments is None and fine.exhausted:
            fine = self._search_run(self._cost_to_go(overrun=math.inf), RESOLUTIONS[2])
            segments = fine.run(MAX_NODES, self.attempt.reserve)
        if segments is not None:
            return segments, Reason.OK, ""
        return None, Reason.GOAL_UNREACHABLE if fine.exhausted else Reason.ROUTE_TIMEOUT, "no drivable way found"

    def _search_run(self, to_go: heuristic.CostToGo, resolution: Resolution, goal_range: float = np.inf) -> SearchRun:
        resolution = resolution.fitted(self.field, self.vehicle.radius)
        return SearchRun(self.problem, self.planner.motion_model(resolution), to_go, resolution, goal_range)

    def _run_in_turns(self, fine: SearchRun, coarse: SearchRun) -> Array | None:
        count = FIRST_NODES
        while self.budget.remaining() > self.attempt.reserve and not fine.exhausted:
            for run in (fine, coarse):
                segments = run.run(count, self.attempt.reserve)
                if segments is not None:
                    return segments
            count *= GROWTH
        return None

    def _reachable(self, to_go: heuristic.CostToGo) -> bool:
        return heuristic.cost_at(to_go, *self._cell_of(self.start)) < heuristic.UNREACHED

    def _close_narrow_gaps(self, to_go: heuristic.CostToGo) -> bool:
        """Close the narrow gaps on the shortest way, on the next one around these, and so on; False: there are none."""
        corridor, checked = np.zeros(self.cell_cost.shape, np.bool_), np.zeros(self.cell_cost.shape, np.bool_)
        # Without a margin to spare, gaps that may be just wide enough are left to the search.
        margin = self.config.margin + (GAP_PLAY if self.config.margin >= GAP_ERROR else -GAP_ERROR)
        wide = self.planner.costs.side + self.config.margin + NARROW
        any_closed = False
        for _ in range(GAP_ROUNDS):
            for width in (0.0, GAP_CORRIDOR / self.cell):
                mark_corridor(corridor, to_go.step, *self._cell_of(self.start), width)
                closed = close_narrow_gaps(
                    self.field, self.footprint, margin, self.cell_cost, self.factor, wide, corridor, checked
                )
                if not closed and not width:
                    return any_closed
            any_closed = True
            to_go = self._cost_to_go()
            if not self._reachable(to_go):
                break
        return any_closed

    def _improve(self, segments: Array) -> Array:
        model = self.model
        # Motions without translations are found in half the time: only the middle part allows for these.
        without_crab = self.model = model._replace(crab=0.0)
        share = CRAB_SHARE if model.crab > 0.0 else FINAL_SHARE
        segments = self._improve_in_rounds(segments, self._alternatives(), MAX_IDLE_ROUNDS, share)
        if model.crab > 0.0:
            self.model = model
            segments = self._improve_in_rounds(segments, iter(()), 4, FINAL_SHARE)
            self.model = without_crab
        best = editable(self.start, segments)
        for shift in FINE_SHIFTS:
            self._shortcut(best, 1e-4, shift)
        self.model = model
        return current_segments(best).copy()

    def _improve_in_rounds(self, segments: Array, others: Iterator[Array], max_idle: int, reserve: float) -> Array:
        """Smooth the best route and the others in turn until nothing gains or only the reserve is left."""
        best, cost = self._smoothed(segments, np.inf)
        idle = 0
        while self.budget.remaining() > reserve and idle < max_idle:
            segments = next(others, NO_SEGMENTS)
            segments, other = self._smoothed(segments if len(segments) else best, 1.05 * cost)
            idle = 0 if other < 0.9995 * cost else idle + 1
            if other < cost:
                best, cost = segments, other
        return best

    def _smoothed(self, segments: Array, promising: float) -> tuple[Array, float]:
        """Shortcuts, better headings, shortcuts again; only the first unless the cost gets below ``promising``."""
        path = editable(self.start, segments)
        self._shortcut(path)
        cost = self._cost(current_segments(path))
        if cost < promising and self.budget.remaining() > 0.0:
            other = editable(self.start, self._with_best_headings(path))
            if other.used[0]:
                self._shortcut(other)
                if self._cost(current_segments(other)) < cost:
                    path = other
        segments = current_segments(path).copy()
        return segments, self._cost(segments)

    def _shortcut(self, path: EditablePath, gain: float = 1e-3, shift: float = 0.25) -> None:
        """Shortcut trials until a batch gains less than a share of the cost."""
        last, reach = np.inf, 40.0 * self.vehicle.radius
        while self.budget.remaining() > 0.0 and (cost := self._cost(current_segments(path))) < (1.0 - gain) * last:
            last, random = cost, self.random.random((BATCH, 6))
            kept = shortcut(self.field, self.footprint, self.layer, self.model, path, reach, shift, random)
            self.budget.work += BATCH
            self.statistics["trials"] += BATCH
            self.statistics["kept"] += kept

    def _cost(self, segments: Array) -> float:
        return float(search.segments_cost(self.field, self.layer, self.model, self.start, segments, len(segments), 0.0))

    def _with_best_headings(self, path: EditablePath) -> Array:
        whole = MotionPath(self.start, current_segments(path))
        spacing = max(1.5 * self.vehicle.radius, whole.length / 60) * self.random.uniform(0.7, 1.3)
        samples, reach = whole.sample(spacing), 16.0 * self.vehicle.radius
        return choose_headings(
            self.field, self.footprint, self.layer, self.model, samples.poses, samples.travelled, reach
        )

    def _alternatives(self) -> Iterator[Array]:
        """First routes along all alternatives to the shortest way, the shortest first."""
        to_go = self._cost_to_go()
        columns = self.cell_cost.shape[1]
        start, goal = self._cell_of(self.start), self._cell_of(self.goal)
        from_start = heuristic.cost_to_go(self.cell_cost, self.cell, start, goal)
        for ways in (to_go, from_start):
            heuristic.complete(ways)
        known = np.zeros(self.cell_cost.shape, np.bool_)
        width = ALTERNATIVE_DISTANCE * self.vehicle.radius / self.cell
        limit = int(ALTERNATIVE_LENGTH * to_go.cost[start])
        while (cell := cheapest_unmarked(to_go.cost, from_start.cost, known, limit)) >= 0:
            corridor = np.zeros(self.cell_cost.shape, np.bool_)
            for step in (to_go.step, from_start.step):
                mark_corridor(corridor, step, cell // columns, cell % columns, width)
                mark_corridor(known, step, cell // columns, cell % columns, width)
            self.statistics["alternatives"] += 1
            # From further off the expansion to the goal is not tried: it would leave the corridor.
            near = 3.0 * self.vehicle.radius
            inside = self._cost_to_go(np.where(corridor, self.cell_cost, np.int16(0)))
            segments = self._search_run(inside, RESOLUTIONS[0], near).run(search.CHUNK)
            yield NO_SEGMENTS if segments is None else segments
