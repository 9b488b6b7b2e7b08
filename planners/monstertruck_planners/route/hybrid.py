"""The main route planner: Hybrid-A* for a first route, then shortening and other ways while there is time. Compiled."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.route import heuristic as togo
from monstertruck_planners.route import search
from monstertruck_planners.route.api import Budget, Clock, Ends, RouteMap, RouteResult, Vehicle, check_ends
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.corridors import brush_way, cheapest_new, close_slits
from monstertruck_planners.route.heuristic import turning_table
from monstertruck_planners.route.hybrid_search import CHUNK, LEVELS, MOST_NODES, Hunt, Level, Question
from monstertruck_planners.route.motion import MotionPath
from monstertruck_planners.route.search import Layer
from monstertruck_planners.route.smoothing import Draft, redraft, shorten, tidy
from monstertruck_schemas.reasons import Reason

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

FIRST_LOOK = 512
"""Nodes expanded coarsely before gaps are measured and the fine search takes its turns."""

GROWTH = 2
"""Of the nodes expanded in a turn, from one round to the next."""

SLIT = 0.06
"""Nearer than this and half the footprint's width to obstacles a place may be a slit, m."""

SLIT_SLACK = 0.01
"""By that much the places and headings looked at may be off the best ones, m."""

PLAY = 0.005
"""Needed in a slit beyond the margin on both sides: with less no search finds the way through, m."""

SLIT_ROUNDS = 30
"""Ways looked at for slits."""

SLIT_LANE = 0.15
"""Looked at on both sides of a way on which there is a slit, m."""

EMPTY = np.empty((0, 3))

NARROWER = 0.005
"""From one margin tried to the next, m."""

WIDE_SHARE = 0.5
"""Of what is left of the budget: for searches with narrower margins."""

NARROW_COST = 1.0
"""Clearance cost of routes with the narrow margin: they keep it only where they have to, m."""

TRY_NARROWER = (Reason.START_BLOCKED, Reason.GOAL_BLOCKED, Reason.GOAL_UNREACHABLE, Reason.ROUTE_TIMEOUT)


@dataclass(frozen=True)
class Try:
    """Searching with one of several margins."""

    reserve: float
    """Share of the budget left for the others."""
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
        self.steer = vehicle.steer(self.config)
        self.table = turning_table(vehicle.crab_angle)
        self.body = vehicle.footprint.body()
        self.side = self.body.half_width or self.body.radius
        self._narrow = [HybridPlanner(vehicle, narrow) for narrow in narrower(self.config)]

    def plan(self, ground: RouteMap, start: ArrayLike, goal: ArrayLike, now: Clock | None = None) -> RouteResult:
        """Route of the vehicle's reference point; ``statistics["margin"]`` tells the margin it keeps.

        Args:
            ground: the map.
            start: pose (x, y, yaw) in the map's frame, m, rad.
            goal: the same.
            now: seconds, for the budget; None: the config's ``effort`` limits the work and the result is reproducible.
        """
        budget = Budget(self.config.budget, now, self.config.effort)
        planners, share = [self, *self._narrow], 1.0
        for planner in planners:
            share *= WIDE_SHARE
            last = planner is planners[-1]
            result = planner.within(budget, ground, start, goal, Try(0.0 if last else share, planner is self))
            if result.reason not in TRY_NARROWER:
                break
        return replace(result, statistics={**result.statistics, "margin": planner.config.margin})

    def within(
        self, budget: Budget, ground: RouteMap, start: ArrayLike, goal: ArrayLike, attempt: "Try"
    ) -> RouteResult:
        """Route with one margin, see ``plan``."""
        position, yaw, margin = self.config.position_tolerance, self.config.yaw_tolerance, self.config.margin
        ends = check_ends(ground, self.vehicle, start, goal, position, yaw, margin)
        if isinstance(ends, RouteResult):
            return ends
        return _Run(self, ground, ends, budget, attempt).route()

    def keeping(self, margin: float) -> "HybridPlanner":
        """The planner of the greatest margin tried that is not above this one; of the narrowest, if all are."""
        planners = [self, *self._narrow]
        return next((planner for planner in planners if planner.config.margin <= margin), planners[-1])

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


def narrower(config: HybridConfig) -> list[HybridConfig]:
    """Settings with the margins that are tried after that of ``config``."""
    spare = config.margin - config.narrow_margin
    if spare <= 0.0:
        return []
    margins = np.linspace(config.margin, config.narrow_margin, math.ceil(spare / NARROWER - 1e-6) + 1)[1:].tolist()
    price = max(config.clearance_cost, NARROW_COST)
    return [config.model_copy(update={"margin": m, "narrow_margin": m, "clearance_cost": price}) for m in margins]


class _Run:
    """One planning request."""

    def __init__(self, planner: HybridPlanner, ground: RouteMap, ends: Ends, budget: Budget, attempt: Try) -> None:
        self.planner, self.vehicle, self.config, self.budget = planner, planner.vehicle, planner.config, budget
        self.attempt = attempt
        self.table, self.body = planner.table, planner.body
        self.start, self.goal = ends.start, ends.goal
        self.field = ground.field.data()
        self.layer = planner.layer(ground)
        self.factor = max(round(togo.COARSE / self.field.resolution), 1)
        self.cell = self.factor * self.field.resolution
        self.car = planner.car(LEVELS[0])
        self.random = np.random.default_rng(0)
        self.statistics: dict[str, float] = {"expanded": 0, "trials": 0, "kept": 0, "ways": 0}
        self.question = Question(
            self.field, self.body, self.layer, self.table, self.start, self.goal, self.config.greed, budget,
            self.statistics,
        )  # fmt: skip

    def route(self) -> RouteResult:
        rows = self._direct()
        if rows is None:
            go = self._ways(np.zeros((0, 0), np.bool_), stretch=1.3)
            rows, reason, text = self._first(go)
            if rows is None:
                return self._none(reason, text)
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
            self.body.inscribed + self.config.margin, side, side + 0.25 * self.vehicle.radius,
        )  # fmt: skip

    def _ways(self, allowed: NDArray[np.bool_], stretch: float) -> togo.ToGo:
        row, column = self._cell(self.start)
        cost, step = togo.spread(self.toll, allowed, *self._cell(self.goal), row * self.toll.shape[1] + column, stretch)
        return togo.ToGo(cost, step, self.toll, self.cell)

    def _direct(self) -> Array | None:
        """The best motion without obstacles, if it is free."""
        rows = self.planner.steer.path(self.start, self.goal).rows
        free = search.rows_free(self.field, self.body, self.car, self.start, np.ascontiguousarray(rows), len(rows))
        return np.array(rows) if free else None

    def _first(self, go: togo.ToGo) -> tuple[Array | None, Reason, str]:
        """A first way: a short coarse search, then gaps are measured, and a fine and the coarse one take turns."""
        narrow = None, Reason.GOAL_UNREACHABLE, "no way is wide enough"
        if not self._known(go):
            return narrow
        coarse = self._hunt(go, LEVELS[0])
        rows = coarse.go_on(FIRST_LOOK, self.attempt.reserve) if self.attempt.first else None
        if rows is not None:
            return rows, Reason.OK, ""
        if self._close_slits(go):
            go = self._ways(np.zeros((0, 0), np.bool_), stretch=1.3)
            if not self._known(go):
                return narrow
            coarse = self._hunt(go, LEVELS[0])
        fine = self._hunt(go, LEVELS[1])
        rows = self._in_turns(fine, coarse)
        if rows is None and fine.exhausted:
            fine = self._hunt(self._ways(np.zeros((0, 0), np.bool_), stretch=1e4), LEVELS[2])
            rows = fine.go_on(MOST_NODES, self.attempt.reserve)
        if rows is not None:
            return rows, Reason.OK, ""
        return None, Reason.GOAL_UNREACHABLE if fine.exhausted else Reason.ROUTE_TIMEOUT, "no drivable way found"

    def _hunt(self, go: togo.ToGo, level: Level, sight: float = np.inf) -> Hunt:
        level = level.fitting(self.field, self.vehicle.radius)
        return Hunt(self.question, self.planner.car(level), go, level, sight)

    def _in_turns(self, fine: Hunt, coarse: Hunt) -> Array | None:
        quota = FIRST_LOOK
        while self.budget.left() > self.attempt.reserve and not fine.exhausted:
            for hunt in (fine, coarse):
                rows = hunt.go_on(quota, self.attempt.reserve)
                if rows is not None:
                    return rows
            quota *= GROWTH
        return None

    def _known(self, go: togo.ToGo) -> bool:
        return bool(go.cost[self._cell(self.start)] < togo.FAR)

    def _close_slits(self, go: togo.ToGo) -> bool:
        """Close the slits on the shortest way, on that round these, and so on; False if there are none."""
        lane, looked = np.zeros(self.toll.shape, np.bool_), np.zeros(self.toll.shape, np.bool_)
        # Without a margin to spare, slits that may do just so are left to the search.
        margin = self.config.margin + (PLAY if self.config.margin >= SLIT_SLACK else -SLIT_SLACK)
        wide = self.planner.side + self.config.margin + SLIT
        any_closed = False
        for _ in range(SLIT_ROUNDS):
            for width in (0.0, SLIT_LANE / self.cell):
                brush_way(lane, go.step, *self._cell(self.start), width)
                closed = close_slits(self.field, self.body, margin, self.toll, self.factor, wide, lane, looked)
                if not closed and not width:
                    return any_closed
            any_closed = True
            go = self._ways(np.zeros((0, 0), np.bool_), stretch=1.3)
            if not self._known(go):
                break
        return any_closed

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
            rows = self._hunt(self._ways(lane, 1.3), LEVELS[0], near).go_on(CHUNK)
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
