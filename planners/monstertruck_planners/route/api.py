"""Interface of the route planners: map, vehicle, budget, result. Loads numba."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from dataclasses import field as attribute
from typing import Any, Literal, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import OCCUPIED, DiscFootprint, DistanceField, Footprint, boxes_of
from monstertruck_planners.distance_kernels import Box
from monstertruck_planners.route.catalog import ROUTE_PLANNERS
from monstertruck_planners.route.config import DriveCosts, GoalConfig, Unknown
from monstertruck_planners.route.heuristic import CellRule, fill_cell_costs
from monstertruck_planners.route.motion import MotionPath, moved
from monstertruck_planners.route.reeds_shepp import ReedsShepp
from monstertruck_planners.route.search import CostLayer
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import Steering
from monstertruck_schemas.reasons import Reason

Clock = Callable[[], float]


TerrainWeights = tuple[float, float, float]
"""Extra costs (m): per metre on unknown ground, per radian of tilt, per metre of roughness."""


class RouteCosts(NamedTuple):
    """Ground costs of a vehicle."""

    terrain: TerrainWeights
    clearance: float
    """Distance from the footprint's side to obstacles beyond which they cost nothing (m)."""
    clearance_cost: float
    """Extra cost per metre in contact (m)."""
    closed: float
    """Minimum distance of the vehicle's point to obstacles (m)."""
    side: float
    """Half the width of the footprint (m)."""
    wide: float
    """Distance to obstacles that leaves room for turning (m)."""

    @classmethod
    def of(cls, vehicle: "Vehicle", config: DriveCosts) -> "RouteCosts":
        """Return the cost model of a vehicle with the weights of a configuration."""
        footprint = vehicle.footprint.data()
        side = footprint.half_width or footprint.radius
        return cls(
            (config.unknown_cost, config.tilt_cost, config.roughness_cost), config.clearance or 1.0,
            config.clearance_cost if config.clearance > 0.0 else 0.0, footprint.inscribed + config.margin, side,
            side + 0.25 * vehicle.radius,
        )  # fmt: skip


@dataclass(frozen=True)
class RouteMap:
    """Map for planning; the costs of its cells are computed on first use and kept.

    Args:
        field: distance field of the obstacles.
        unknown: mask of unknown cells, which cost extra, in the shape of the field's grid; None without any.
        tilt: tilt in the same shape (rad), 0 where unknown; None for level ground.
        roughness: roughness in the same shape (m); None for smooth ground.

    Raises:
        InputError: a layer has another shape than the field.
    """

    field: DistanceField
    unknown: NDArray[np.bool_] | None = None
    tilt: Array | None = None
    roughness: Array | None = None
    terrains: dict[TerrainWeights, NDArray[np.float32]] = attribute(default_factory=dict, init=False, repr=False)
    """Extra cost per metre in each cell of the ringed grid, as far as computed."""
    coarse: dict[RouteCosts, NDArray[np.int16]] = attribute(default_factory=dict, init=False, repr=False)
    """Result of ``cell_costs``, as far as computed."""

    def __post_init__(self) -> None:
        shape = tuple(n - 2 for n in self.field.data().occupied.shape)
        for name in ("unknown", "tilt", "roughness"):
            layer = getattr(self, name)
            if layer is not None and layer.shape != shape:
                raise InputError(f"route map: {name} of shape {layer.shape}: expected that of the grid, {shape}")

    @classmethod
    def from_cells(
        cls, cells: NDArray[np.int8], resolution: float, origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        unknown: Unknown = "blocked", tilt: Array | None = None, roughness: Array | None = None,
        previous: "RouteMap | None" = None, unseen: NDArray[np.bool_] | None = None,
    ) -> "RouteMap":  # fmt: skip
        """Map of cells (rows, columns), -1 unknown, 0 free to 100 occupied, row 0 at the lowest y.

        ``previous`` is the last map, whose results are reused for unchanged parts. Routes never reverse onto the
        ``unseen`` cells.
        """
        occupied = cells >= OCCUPIED
        missing = cells < 0
        if unknown == "blocked":
            occupied = occupied | missing
        distances = DistanceField(occupied, resolution, origin, previous.field if previous else None, unseen)
        result = cls(distances, missing if unknown == "dear" else None, tilt, roughness)
        if previous is not None and distances.changes is not None:
            result._take_over(previous, distances.changes)
        return result

    def _take_over(self, previous: "RouteMap", changes: list[Box]) -> None:
        """Copy the costs of the last map, and recompute those that differ."""
        for name in ("unknown", "tilt", "roughness"):
            new, old = getattr(self, name), getattr(previous, name)
            if (new is None) != (old is None):
                return
            if new is not None and new is not old:
                changes = changes + [(r + 1, c + 1, r1 + 1, c1 + 1) for r, c, r1, c1 in boxes_of(new != old)]
        factor = self.coarse_factor
        for weights, terrain in previous.terrains.items():
            self.terrains[weights] = terrain.copy()
            for box in changes:
                self._fill_terrain(weights, self.terrains[weights], box)
        for costs, cells in previous.coarse.items():
            self.coarse[costs] = cells.copy()
            layer, rule = self.cost_layer(costs), self._rule(costs)
            for r, c, r1, c1 in changes:
                box = (r // factor, c // factor, -(-r1 // factor), -(-c1 // factor))
                fill_cell_costs(self.field.data().distance, layer, rule, box, self.coarse[costs])

    @property
    def coarse_factor(self) -> int:
        """Cells of the grid per cell of the coarse one, each way."""
        # Approximate maximum size of a coarse cell (m).
        return max(round(0.1 / self.field.resolution), 1)

    @property
    def coarse_cell(self) -> float:
        """Size of a coarse cell (m)."""
        return self.coarse_factor * self.field.resolution

    def cost_layer(self, costs: RouteCosts) -> CostLayer:
        """Extra costs of all cells."""
        terrain = self.terrains.get(costs.terrain)
        if terrain is None:
            terrain = self.terrains[costs.terrain] = np.zeros(self._terrain_shape(costs.terrain), np.float32)
            self._fill_terrain(costs.terrain, terrain, (0, 0, *terrain.shape))
        contact = costs.side + 0.5 * self.field.resolution
        return CostLayer(terrain, contact, costs.clearance, costs.clearance_cost)

    def cell_costs(self, costs: RouteCosts) -> NDArray[np.int16]:
        """Cost of a straight step into each coarse cell, 0 for closed cells; read-only."""
        cells = self.coarse.get(costs)
        if cells is None:
            distance, factor = self.field.data().distance, self.coarse_factor
            cells = self.coarse[costs] = np.empty([-(-n // factor) for n in distance.shape], np.int16)
            fill_cell_costs(distance, self.cost_layer(costs), self._rule(costs), (0, 0, *cells.shape), cells)
        return cells

    def _rule(self, costs: RouteCosts) -> CellRule:
        return CellRule(self.coarse_factor, costs.closed, costs.side, costs.wide)

    def _weighted_layers(self, weights: TerrainWeights) -> list[tuple[NDArray[Any], float]]:
        amounts = (self.unknown, self.tilt, self.roughness)
        return [(a, w) for a, w in zip(amounts, weights, strict=True) if a is not None and w > 0.0]

    def _terrain_shape(self, weights: TerrainWeights) -> tuple[int, int]:
        rows, columns = self.field.data().distance.shape
        return (rows, columns) if self._weighted_layers(weights) else (0, 0)

    def _fill_terrain(self, weights: TerrainWeights, terrain: NDArray[np.float32], box: Box) -> None:
        """Write a rectangle of the ground costs; the ring costs nothing."""
        top, left, bottom, right = (np.clip(v, 1, n - 1) for v, n in zip(box, 2 * terrain.shape, strict=True))
        if terrain.size:
            inner, outer = np.s_[top - 1 : bottom - 1, left - 1 : right - 1], np.s_[top:bottom, left:right]
            terrain[outer] = sum(weight * np.abs(amount[inner]) for amount, weight in self._weighted_layers(weights))


@dataclass(frozen=True)
class Vehicle:
    """Footprint and limits of the vehicle.

    Args:
        footprint: footprint relative to the reference point.
        radius: minimum turning radius of the reference point (m).
        crab_angle: maximum angle of a translation (rad); 0 for a vehicle that cannot crab.
        steering: steering mode of arcs and lines.
        reference: x of the reference point in base (m).
    """

    footprint: Footprint | DiscFootprint
    radius: float
    crab_angle: float = 0.0
    steering: Steering = "counter"
    reference: float = 0.0

    @classmethod
    def truck(
        cls,
        steering: Literal["2ws", "counter", "4ws"] = "4ws",
        *,
        angle: float = 0.362,
        geometry: FourWheelSteering | None = None,
        footprint: Footprint | None = None,
    ) -> "Vehicle":
        """Return the truck with front steering (about the rear axle) or counter steering (about the centre)."""
        geometry, footprint = geometry or FourWheelSteering(), footprint or Footprint()
        if steering == "2ws":
            radius = geometry.minimum_radius("front", angle)
            footprint = replace(footprint, offset=footprint.offset + geometry.l_r)
            return cls(footprint, radius, 0.0, "front", -geometry.l_r)
        crab = angle if steering == "4ws" else 0.0
        return cls(footprint, geometry.minimum_radius("counter", angle), crab, "counter", 0.0)

    def reference_pose(self, base: ArrayLike) -> Array:
        """Return the pose of the reference point for a pose of the base."""
        return moved(np.asarray(base, dtype=np.float64), self.reference)

    def reeds_shepp(self, costs: DriveCosts | None = None) -> ReedsShepp:
        """Return the cheapest or the shortest obstacle-free motions."""
        weights = (costs.reverse_cost, costs.cusp_cost, costs.crab_cost) if costs else (1.0, 0.0, 1.0)
        return ReedsShepp(self.radius, self.crab_angle, *weights, self.steering, self.reference)


class Budget:
    """Budget of a planner: a time in seconds, or an amount of work.

    Args:
        seconds: time limit from now on, if there is a clock.
        now: clock of processor time (s), so that a busy computer does not shorten the search.
        effort: number of expanded nodes and smoothing trials, if there is no clock.
    """

    def __init__(self, seconds: float, now: Clock | None, effort: int) -> None:
        self._now = now
        self._begin = now() if now else 0.0
        self._seconds = seconds
        self._effort = effort
        self.work = 0

    @property
    def elapsed(self) -> float:
        """Seconds since the start; 0 without a clock."""
        return self._now() - self._begin if self._now else 0.0

    def remaining(self) -> float:
        """Remaining share of the budget, at most 1."""
        used = self.elapsed / self._seconds if self._now else self.work / self._effort
        return max(1.0 - used, 0.0)


@dataclass(frozen=True)
class RouteResult:
    """A route, or the reason for its absence."""

    reason: Reason
    path: MotionPath | None = None
    poses: Array | None = None
    """Poses x, y, yaw of the reference point, shape (n, 3), from planners whose routes are not drivable motions."""
    cost: float = math.inf
    """Cost including all extra costs (m)."""
    text: str = ""
    """Details of the reason."""
    statistics: dict[str, float] = attribute(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether there is a route."""
        return self.reason is Reason.OK

    @property
    def end(self) -> Array:
        """Last pose of the reference point, shape (3,).

        Raises:
            ValueError: there is no route.
        """
        if self.path is not None:
            return self.path.end
        if self.poses is None:
            raise ValueError("no route, no end")
        return np.asarray(self.poses[-1])


class RoutePlanner(Protocol):
    """Route planner; without a clock, equal arguments give equal results."""

    @property
    def vehicle(self) -> Vehicle:
        """Vehicle."""
        ...

    @property
    def config(self) -> GoalConfig:
        """Settings of the planner."""
        ...

    def plan(self, route_map: RouteMap, start: ArrayLike, goal: ArrayLike, now: Clock | None = None) -> RouteResult:
        """Plan a route between two poses (x, y, yaw) of the vehicle's reference point.

        Args:
            route_map: obstacles and costs.
            start: pose in the map's frame (m, m, rad).
            goal: pose in the map's frame (m, m, rad).
            now: clock of the budget (s of processor time); None: the budget is an amount of work, and the result is
                reproducible.
        """


@dataclass(frozen=True)
class Endpoints:
    """Free start and goal."""

    start: Array
    goal: Array


def check_endpoints(
    route_map: RouteMap, vehicle: Vehicle, start: ArrayLike, goal: ArrayLike, position: float, yaw: float,
    margin: float, *, start_margin: float | None = None,
) -> Endpoints | RouteResult:  # fmt: skip
    """Return free start and goal, the goal within its tolerance, or the result that refuses them.

    Args:
        route_map: map with the obstacles.
        vehicle: vehicle with its footprint.
        start: pose of the reference point.
        goal: pose of the reference point.
        position: tolerance of the goal's position (m).
        yaw: tolerance of the goal's yaw (rad).
        margin: clearance at both poses (m).
        start_margin: clearance at the start instead (m).
    """
    try:
        a, b = (np.array(p, dtype=np.float64).reshape(3) for p in (start, goal))
    except (TypeError, ValueError):
        return RouteResult(Reason.BAD_INPUT, text="start and goal: expected x, y, yaw")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return RouteResult(Reason.NOT_FINITE, text="start and goal: expected finite numbers")
    field, footprint = route_map.field, vehicle.footprint
    if not field.free(footprint, a[None], margin if start_margin is None else start_margin)[0]:
        return RouteResult(Reason.START_BLOCKED, text=f"start {_refused(field, footprint, a, margin)}")
    if not field.inside(b[:2]):
        return RouteResult(Reason.GOAL_OUTSIDE, text=f"goal {_format_pose(b)}: outside the map")
    if field.free(footprint, b[None], margin)[0]:
        return Endpoints(a, b)
    candidates = np.vstack([b + d for d in _tolerance_offsets(position, yaw)])
    free = field.free(footprint, candidates, margin)
    if not free.any():
        return RouteResult(Reason.GOAL_BLOCKED, text=f"goal {_refused(field, footprint, b, margin)}")
    return Endpoints(a, candidates[int(np.argmax(free))])


def _refused(field: DistanceField, footprint: Footprint | DiscFootprint, pose: Array, margin: float) -> str:
    """Return the reason for refusing a pose without the margin."""
    overlaps = not field.free(footprint, pose[None])[0]
    why = "the footprint overlaps an obstacle" if overlaps else f"an obstacle is closer than {margin:g} m"
    return f"{_format_pose(pose)}: {why}"


def _tolerance_offsets(position: float, yaw: float) -> list[Array]:
    """Return small displacements within the tolerances, the smallest first."""
    around = [(0.0, 0.0)]
    around += [
        (s * position * math.cos(k), s * position * math.sin(k))
        for s in (0.5, 0.98)
        for k in np.arange(8) * math.pi / 4
    ]
    return [np.array([x, y, t * yaw]) for x, y in around for t in (0.0, 0.5, -0.5, 0.98, -0.98)][1:]


def _format_pose(pose: Array) -> str:
    return f"({pose[0]:g}, {pose[1]:g}, {pose[2]:g})"


def warm_up(planner: RoutePlanner) -> None:
    """Plan on two small maps, so that numba compiles everything (or loads its cache) beforehand.

    The second map is the first one with a wall whose gap is too narrow. The last route leaves the edge of the map.
    """
    # distance from the start of the last route to the edge of the map, m: less than the margin
    warm_up_clearance = 0.02
    margin = max(planner.config.margin, 2 * warm_up_clearance)
    config = planner.config.model_copy(update={"effort": 6000, "margin": margin})  # see ``GoalConfig.effort``
    planner = make_planner(planner.vehicle, config)
    ends = (2.0, 4.0, 0.0), (6.0, 4.0, 1.0)
    cells = np.zeros((80, 80), np.int8)
    cells[38:42, 36:44] = 100
    route_map = RouteMap.from_cells(cells, 0.1)
    path = planner.plan(route_map, *ends).path
    if path is not None:
        path.part(0.1, path.length).base_poses(0.1)
    cells[:60, 40] = cells[63:, 40] = 100
    planner.plan(RouteMap.from_cells(cells, 0.1, previous=route_map), *ends)
    footprint = planner.vehicle.footprint.data()
    beside = (footprint.half_width or footprint.radius) + warm_up_clearance
    planner.plan(route_map, (2.0, beside, 0.0), ends[1])


def make_planner(vehicle: Vehicle, config: GoalConfig) -> RoutePlanner:
    """Build the route planner of a configuration.

    Raises:
        InputError: the settings name no kind of route planner, or a required package is not installed.
    """
    return cast("RoutePlanner", ROUTE_PLANNERS.build(config, vehicle, config))
