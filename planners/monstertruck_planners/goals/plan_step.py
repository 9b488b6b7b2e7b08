"""The planning step: map and newest scan in, a drivable path out. For workers.

It remembers the map, the obstacles that scans showed and the map does not hold, and the route, which is kept while it
is good.

An obstacle is kept until a scan sees through its place: a robot that looks ahead alone must not forget what stands
behind it, so nothing is forgotten by age.
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, placed, points_placed, points_relative
from monstertruck_planners.collision import OCCUPIED, DistanceField, Footprint, rectangle_distance
from monstertruck_planners.goals.escape import escape
from monstertruck_planners.goals.exchange import PlanTask, RouteAnswer, Setup, explained_within
from monstertruck_planners.goals.unseen import Unseen, unseen_around
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.api import Clock, RouteMap, RoutePlanner, RouteResult, Vehicle, make_planner, warm_up
from monstertruck_planners.route.config import GoalConfig, GridAstarConfig, HybridConfig, LatticeConfig
from monstertruck_planners.route.departure import leaving
from monstertruck_planners.route.motion import MotionPath, moved
from monstertruck_planners.route.replan import ViaPoint, replan, with_headings
from monstertruck_runtime.clock import processor_time
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import load_map
from monstertruck_schemas.plan import MAX_COORDINATE, MAX_POSES, MAX_RUNS, Steering
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GROUND_UNKNOWN, ROUGHNESS_STEP, TILT_STEP, Grid, Ground

log = logging.getLogger(__name__)

Cells = NDArray[np.int8]

SQUARE: Final = 0.05
"""Side of the squares by which obstacles that are not in the map are remembered, m."""
NEARBY: Final = 1.5
"""Distance within which obstacles count when backing out, and are kept, m."""


OVERLAPPING: Final = frozenset({Reason.START_BLOCKED, Reason.GOAL_UNREACHABLE})
"""Why there is no route for a truck that overlaps an obstacle where it stands."""
ASSUMED_FREE: Final = 0.15
"""Unknown ground within this distance of the truck counts as free, m."""

BEAM_WIDTH: Final = 0.012
"""Difference in bearing up to which a beam shows a place, rad: two steps of a URG-04LX."""
SEEN_BEYOND: Final = 0.10
"""Distance by which all these beams must reach beyond it, m."""


class ObstacleMemory:
    """Places of obstacles in the map's frame, at most one for each square.

    Args:
        square: m.
    """

    def __init__(self, square: float) -> None:
        self._square = square
        self.places: Array = np.empty((0, 2))
        """Shape (n, 2), m."""
        self.suspended: Array = np.empty((0, 2))
        """Shape (k, 2), m: cleared by the map, not seen free by a scan. They count where the lidar does not look."""

    def look(self, points: Array, sensor: Array) -> None:
        """Remove places that a scan shows to be free; a bearing without a return does not.

        Args:
            points: shape (n, 2), the scan's returns.
            sensor: shape (2,), where it was taken.
        """
        self.places = self.places[~seen_through(self.places, points, sensor)]
        self.suspended = self.suspended[~seen_through(self.suspended, points, sensor)]

    def keep(self, points: Array) -> None:
        """Remember places, shape (n, 2)."""
        self.places = _one_per_square(np.vstack((self.places, points)), self._square)

    def suspend(self, where: NDArray[np.bool_]) -> None:
        """Mark places, shape (n,), as suspended: they no longer count where the lidar looks."""
        self.suspended = _one_per_square(np.vstack((self.suspended, self.places[where])), self._square)
        self.places = self.places[~where]

    def restore(self, where: NDArray[np.bool_]) -> None:
        """Count suspended places, shape (k,), again."""
        self.keep(self.suspended[where])
        self.suspended = self.suspended[~where]

    def drop_explained(self, unexplained: Callable[[Array], NDArray[np.bool_]]) -> None:
        """Keep the places, shape (n, 2), of which ``unexplained`` is true, shape (n,)."""
        self.places = self.places[unexplained(self.places)]
        self.suspended = self.suspended[unexplained(self.suspended)]


def seen_through(places: Array, points: Array, sensor: Array) -> NDArray[np.bool_]:
    """Whether each place is free as a scan shows it: all its returns in that direction lie beyond.

    Args:
        places: shape (n, 2).
        points: shape (m, 2), the scan's returns.
        sensor: shape (2,), where it was taken.

    Returns:
        Shape (n,).
    """
    if not len(places) or not len(points):
        return np.zeros(len(places), dtype=np.bool_)
    bearings, ranges = _polar(points - sensor)
    order = np.argsort(bearings)
    bearings, ranges = bearings[order], ranges[order]
    # Once round on both sides, so that no window is cut at +-pi.
    bearings = np.concatenate((bearings - 2 * np.pi, bearings, bearings + 2 * np.pi))
    ranges = np.tile(ranges, 3)
    towards, far = _polar(places - sensor)
    first, last = (np.searchsorted(bearings, towards + side) for side in (-BEAM_WIDTH, BEAM_WIDTH))
    nearest = np.minimum.reduceat(np.append(ranges, np.inf), np.column_stack((first, last)).ravel())[::2]
    return np.asarray((last > first) & (nearest > far + SEEN_BEYOND))


def _polar(points: Array) -> tuple[Array, Array]:
    return np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])


def _one_per_square(points: Array, square: float) -> Array:
    """The first point of each square."""
    _, first = np.unique(np.floor(points / square).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)])


class StaticMap:
    """The configured or built map.

    Args:
        cells: shape (rows, columns), percent, -1 unknown; row 0 at the lowest y.
        resolution: m.
        origin: pose of the outer corner of cell (0, 0).
        previous: the last map: only differences are computed again.
    """

    def __init__(self, cells: Cells, resolution: float, origin: Pose2, previous: "StaticMap | None" = None) -> None:
        self.cells = cells
        self.resolution = resolution
        self.origin = origin
        known = None if previous is None else previous.walls
        self.walls: DistanceField = DistanceField(cells >= OCCUPIED, resolution, origin, known)
        """Distance to the map's obstacles."""

    @classmethod
    def of(cls, grid: Grid, previous: "StaticMap | None" = None) -> "StaticMap":
        """From a message."""
        cells = grid.cells.reshape(grid.height, grid.width)
        return cls(cells, grid.resolution, (grid.origin.x, grid.origin.y, grid.origin.yaw), previous)

    def unexplained(self, points: Array, tolerance: float) -> NDArray[np.bool_]:
        """Which points (n, 2) are further than ``tolerance`` from all obstacles of the map, m."""
        return np.asarray(self.walls.lookup(points) > tolerance + self.resolution / 2)

    def with_points(self, points: Array) -> Cells:
        """Cells with the points' ones occupied."""
        return np.where(
            marked(np.zeros(self.cells.shape, np.bool_), points, self.resolution, self.origin), 100, self.cells
        )

    def obstacles(self, cells: Cells, pose: Pose2, reach: float) -> Array:
        """Centres of the occupied cells round a pose, shape (n, 2), in the frame of the pose."""
        rows, columns = np.nonzero(cells >= OCCUPIED)
        centres = np.column_stack((columns + 0.5, rows + 0.5)) * self.resolution
        there = points_relative(points_placed(centres, self.origin), pose)
        return np.asarray(there[np.hypot(there[:, 0], there[:, 1]) < reach])


def marked(cells: NDArray[np.bool_], points: Array, resolution: float, origin: Pose2) -> NDArray[np.bool_]:
    """Cells of a grid (rows, columns) with those set that hold a point; points (n, 2) in the frame of ``origin``."""
    column, row = (np.floor(v / resolution).astype(np.int64) for v in points_relative(points, origin).T)
    rows, columns = cells.shape
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    cells[row[inside], column[inside]] = True
    return cells


def standing_free(
    cells: Cells, resolution: float, origin: Pose2, footprint: Footprint, pose: Pose2, beside: float = 0.0
) -> Cells:
    """Cells with those under the truck set free: unknown ones, and obstacles that it overlaps by its edge only.

    A map is as exact as its cells: a truck next to a wall overlaps it by up to a cell. What it overlaps by more stays,
    for then map or pose is wrong.

    Args:
        cells: shape (rows, columns), percent, -1 unknown.
        resolution: m.
        origin: pose of the outer corner of cell (0, 0).
        footprint: the truck.
        pose: of it, in the map's frame.
        beside: unknown cells this near to it are free too, m.
    """
    at = points_relative(np.array([pose[:2]]), origin)[0] / resolution
    reach = math.ceil((footprint.circumscribed_radius + beside) / resolution) + 1
    rows, columns = cells.shape
    row, column = np.mgrid[
        max(int(at[1]) - reach, 0) : min(int(at[1]) + reach + 1, rows),
        max(int(at[0]) - reach, 0) : min(int(at[0]) + reach + 1, columns),
    ].reshape(2, -1)
    centres = np.column_stack((column + 0.5, row + 0.5)) * resolution
    gap = rectangle_distance(footprint, np.array([pose]), points_placed(centres, origin))[0]
    unknown, touched = cells[row, column] < 0, resolution * math.sqrt(0.5)
    # 1.5: cells by which the truck may overlap an obstacle of the map where it stands
    freed = np.where(unknown, gap < touched + beside, (gap < touched) & (gap > -1.5 * resolution))
    kept = cells.copy()
    kept[row[freed], column[freed]] = 0
    return kept


def ground_layers(ground: Ground, grid: StaticMap, reach: float) -> tuple[Array, Array]:
    """Worst tilt, rad, and roughness, m, within ``reach`` (m) of a map's cells, 0 where nothing is known.

    Both of the map's shape: what a vehicle meets whose middle is there.
    """
    pad = math.ceil(reach / ground.resolution)
    shape = np.array((ground.height, ground.width)) + 2 * pad
    origin = (ground.origin.x, ground.origin.y, ground.origin.yaw)
    x0, y0 = points_placed(np.full((1, 2), -pad * ground.resolution), origin)[0].tolist()
    corner = (x0, y0, origin[2])
    row, column = _cells_within(grid, corner, shape * ground.resolution)
    centres = np.column_stack((column + 0.5, row + 0.5)) * grid.resolution
    there = points_relative(points_placed(centres, grid.origin), corner) / ground.resolution
    x, y = np.floor(there).astype(int).T
    inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
    row, column, x, y = row[inside], column[inside], x[inside], y[inside]
    layers = []
    for layer, step in ((ground.tilt, TILT_STEP), (ground.roughness, ROUGHNESS_STEP)):
        known = np.where(layer == GROUND_UNKNOWN, 0.0, layer * step).reshape(ground.height, ground.width)
        worst = maximum_filter(np.pad(known, pad), 2 * pad + 1)
        cells = np.zeros(grid.cells.shape)
        cells[row, column] = worst[y, x]
        layers.append(cells)
    return layers[0], layers[1]


def _cells_within(grid: StaticMap, corner: Pose2, size: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of a map's cells round a rectangle: the pose of its corner, and its height and width, m."""
    corners = np.array([(x, y) for x in (0.0, size[1]) for y in (0.0, size[0])])
    box = points_relative(points_placed(corners, corner), grid.origin) / grid.resolution
    rows, columns = grid.cells.shape
    left, bottom = np.clip(np.floor(box.min(axis=0)), 0, (columns, rows)).astype(int)
    right, top = np.clip(np.ceil(box.max(axis=0)), 0, (columns, rows)).astype(int)
    row, column = np.mgrid[bottom:top, left:right]
    return row.ravel(), column.ravel()


class PlanningStep:
    """Answers tasks one by one; without a clock equal tasks give equal answers."""

    def __init__(self) -> None:
        self._setup: Setup | None = None
        self._map: StaticMap | None = None
        self._without = Reason.NO_MAP, "no map yet"
        """Why there is no map."""
        self._ground: Ground | None = None
        self._layers: tuple[Array, Array] | None = None
        """Tilt and roughness of the map's cells."""
        self._route_map: RouteMap | None = None
        self._memory = ObstacleMemory(SQUARE)
        self._route: MotionPath | None = None
        self._closed: Array = np.empty((0, 2))
        """Shape (k, 2), m: unseen places onto which the present route must not reverse."""
        self._now: Clock | None = None

    def step(self, task: PlanTask) -> RouteAnswer:
        """Do one task.

        Raises:
            InputError: no setup came first.
        """
        if task.setup is not None:
            self._set_up(task.setup)
        if self._setup is None:
            raise InputError("planning: expected a setup before anything else")
        if task.grid is not None:
            self._map, self._layers = StaticMap.of(task.grid, self._map), None
        if task.ground is not None:
            self._ground, self._layers = task.ground, None
        if self._map is None:
            return RouteAnswer(*self._without)
        places = [value for place in task.via for value in place if value is not None]
        numbers = np.array((*task.pose, *task.goal, *places))
        if not np.isfinite(numbers).all():
            return RouteAnswer(Reason.NOT_FINITE, "expected a finite pose, goal and waypoints")
        if np.abs(numbers).max() > MAX_COORDINATE:
            return RouteAnswer(Reason.BAD_INPUT, f"expected a pose, goal and waypoints of at most {MAX_COORDINATE:g}")
        if task.clear or task.afresh:
            self._route = None
        self._observe(self._setup, self._map, task)
        return self._escape(self._map, task) if task.what == "escape" else self._plan(self._map, task)

    def _set_up(self, setup: Setup) -> None:
        config = setup.config
        self._setup = setup
        self._vehicle = Vehicle.truck(
            config.steering, angle=config.angle, geometry=setup.geometry, footprint=setup.footprint
        )
        self._planner = make_planner(self._vehicle, config.route)
        wide = max(config.route.margin, setup.cusp_clearance)
        self._wide = make_planner(self._vehicle, config.route.model_copy(update={"margin": wide}))
        if setup.timed:
            self._now = processor_time
        if config.map is not None:
            try:
                world = load_map(config.map)
            except InputError as error:
                self._without = error.reason, str(error)
                return
            for remark in world.remarks:
                log.warning("%s", remark)
            self._layers = None
            self._map = StaticMap(world.cells, world.resolution, (*world.origin, 0.0))

    def _observe(self, setup: Setup, static_map: StaticMap, task: PlanTask) -> None:
        """Update the remembered obstacles by a scan and by the newest map."""
        memory = self._memory
        for scan in task.seen:
            memory.look(scan.points, scan.sensor)
            memory.keep(scan.points)
        if task.clear:
            memory.suspend(np.hypot(*(memory.places - task.pose[:2]).T) > NEARBY)
        memory.look(task.points, points_placed(np.array([setup.lidar[:2]]), task.pose)[0])
        memory.keep(task.points)
        tolerance = explained_within(setup.config, task.deviation)
        memory.drop_explained(lambda places: static_map.unexplained(places, tolerance))

    def _plan(self, static_map: StaticMap, task: PlanTask) -> RouteAnswer:
        """A route that does not reverse onto unseen ground, or one to where that can be seen.

        What one route would cover is closed to the next.
        """
        self._closed = np.empty((0, 2))
        answer = self._plan_known(static_map, task)
        unseen = self._unseen(task)
        if unseen is None or not answer.drivable or not len(met := self._met(unseen, answer)):
            return answer
        x, y = met.mean(axis=0).tolist()
        for _ in range(2):  # routes planned around unseen ground, at most; each closes more of it
            self._closed, self._route = np.vstack((self._closed, met)), None
            answer = self._plan_known(static_map, task)
            if answer.path is None:
                break
            if not len(met := self._met(unseen, answer)):
                return answer
        self._route = None
        look = self._look(static_map, task, unseen)
        remedy = "drive it forward by hand first, or back with the second control"
        text = f"every way found leads back onto ground that no sensor has seen, at {x:.1f}, {y:.1f}: {remedy}"
        return look or RouteAnswer(Reason.UNSEEN_STOP, text)

    def _look(self, static_map: StaticMap, task: PlanTask, unseen: Unseen) -> RouteAnswer | None:
        """A route to a place from which the closed ground can be seen; None if none was found."""
        assert self._route_map is not None
        lookouts = unseen.lookouts(self._closed, self._route_map.field, self._planner.config.margin)
        if not len(lookouts):
            return None
        # 5.0: weight of a metre backward where those are chosen: the robot comes to them forward
        ahead = replace(self._vehicle.reeds_shepp(), reverse_cost=5.0)
        there = np.array([self._vehicle.reference_pose(pose) for pose in lookouts])
        far = ahead.distance(np.tile(self._vehicle.reference_pose(task.pose), (len(there), 1)), there)
        for index in np.argsort(far)[:4].tolist():  # places to look at it from to which a route is planned, at most
            x, y, yaw = lookouts[index].tolist()
            answer = self._plan_known(static_map, replace(task, goal=(x, y, yaw), via=()))
            self._route = None
            if answer.path is not None and not len(self._met(unseen, answer)):
                text = f"{answer.length:.2f} m to look at ground that no sensor has seen"
                return replace(answer, text=text, complete=False)
        return None

    def _met(self, unseen: Unseen, answer: RouteAnswer) -> Array:
        """See ``Unseen.met``."""
        assert self._route_map is not None
        return np.empty((0, 2)) if answer.path is None else unseen.met(answer.path, self._route_map.field)

    def _unseen(self, task: PlanTask) -> Unseen | None:
        """Unseen ground around the robot; None where it may reverse anywhere."""
        assert self._setup is not None
        seen, keep = task.ground_seen, self._setup.seen_for
        return (
            None
            if seen is None or keep is None
            else unseen_around(seen, keep, self._setup.lidar, self._setup.footprint)
        )

    def _plan_known(self, static_map: StaticMap, task: PlanTask) -> RouteAnswer:
        """A route that does not reverse into suspended places: those near it count again, then all."""
        answer = self._plan_once(static_map, task)
        for nearby in (NEARBY, math.inf):
            suspended = self._memory.suspended
            touched = self._backs_into(answer, suspended)
            if not touched.any():
                break
            apart = np.hypot(*(suspended[:, None] - suspended[touched]).transpose(2, 0, 1)).min(axis=1)
            self._memory.restore(apart <= nearby)
            self._route = None
            answer = self._plan_once(static_map, task)
        return answer

    def _backs_into(self, answer: RouteAnswer, places: Array) -> NDArray[np.bool_]:
        """Whether the backward motions of a route touch each place; shape (k,)."""
        assert self._setup is not None
        if answer.path is None or not len(places):
            return np.zeros(len(places), dtype=np.bool_)
        backward = answer.path.poses[answer.path.directions < 0]
        if not len(backward):
            return np.zeros(len(places), dtype=np.bool_)
        gaps = rectangle_distance(self._setup.footprint, backward, places).min(axis=0)
        return np.asarray(gaps < self._setup.config.route.margin + SQUARE / 2)

    def _plan_once(self, static_map: StaticMap, task: PlanTask) -> RouteAnswer:
        assert self._setup is not None
        points = self._memory.places
        if len(points):
            # An obstacle that touches the standing truck would make every route impossible; the gate checks it.
            pose = np.array([task.pose])
            touching = rectangle_distance(self._setup.footprint, pose, points)[0] < 1.5 * static_map.resolution
            points = points[~touching]
        cells = static_map.with_points(points) if len(points) else static_map.cells
        self._route_map = route_map = self._map_of(cells, static_map)
        start, goal = (self._vehicle.reference_pose(p) for p in (task.pose, task.goal))
        through = with_headings(task.pose, [ViaPoint(*place) for place in (*task.via, task.goal)])
        via = [self._vehicle.reference_pose(pose) for pose in through[:-1]]

        def plan(planner: RoutePlanner) -> RouteResult:
            return replan(planner, route_map, self._route, start, goal, self._now, via=via)

        result = plan(self._planner)
        if result.reason in OVERLAPPING:
            self._route_map = route_map = self._standing(static_map, cells, task.pose)
            result = plan(self._planner)
        elif (room := self._cusp_clearance(route_map, result)) < self._setup.cusp_clearance:
            wider = plan(self._wide)
            result = wider if self._cusp_clearance(route_map, wider) > room else result
        if not result.ok:
            return RouteAnswer(result.reason, result.text)
        self._route = result.path
        if result.path is not None:
            path = result.path.base_path()
            kept = bool(result.statistics["kept_route"])
            answer = shortened(RouteAnswer(Reason.OK, "", path, result.path.length, result.cost, kept=kept))
            assert answer.path is not None
            return replace(answer, path=replace(answer.path, clearance=self._clearance(route_map, answer.path)))
        if result.poses is None or self._setup.config.local_planner is None:
            return RouteAnswer(
                Reason.BAD_INPUT, "this planner's routes are no motions of the robot: set planner.local_planner"
            )
        path = PosePath(moved(result.poses, -self._vehicle.reference), np.ones(len(result.poses)))
        return RouteAnswer(Reason.OK, "", path, path.length, result.cost, drivable=False)

    def _map_of(self, cells: Cells, static_map: StaticMap) -> RouteMap:
        assert self._setup is not None
        if self._ground is not None and self._layers is None:
            self._layers = ground_layers(self._ground, static_map, self._setup.footprint.width / 2)
        tilt, roughness = self._layers or (None, None)
        return RouteMap.from_cells(
            cells,
            static_map.resolution,
            static_map.origin,
            self._setup.config.route.unknown,
            tilt,
            roughness,
            previous=self._route_map,
            unseen=self._closed_cells(cells.shape, static_map.resolution, static_map.origin),
        )

    def _closed_cells(self, shape: tuple[int, ...], resolution: float, origin: Pose2) -> NDArray[np.bool_] | None:
        """Cells of a grid with the closed unseen places; None without any."""
        if not len(self._closed):
            return None
        return marked(np.zeros(shape, np.bool_), self._closed, resolution, origin)

    def _standing(self, static_map: StaticMap, cells: Cells, pose: Pose2) -> RouteMap:
        """The map with the ground under the truck free, and with a margin if the truck is at its edge."""
        assert self._setup is not None
        footprint = self._setup.footprint
        margin = math.ceil(2 * footprint.circumscribed_radius / static_map.resolution)
        corner = points_placed(np.full((1, 2), -margin * static_map.resolution), static_map.origin)[0]
        origin = (float(corner[0]), float(corner[1]), static_map.origin[2])
        outside = np.pad(np.zeros(cells.shape, np.bool_), margin, constant_values=True)
        around = np.pad(cells, margin, constant_values=-1)
        freed = standing_free(around, static_map.resolution, origin, footprint, pose, ASSUMED_FREE)
        freed[outside & (freed < 0)] = 100
        tilt, roughness = self._layers or (None, None)
        return RouteMap.from_cells(
            freed,
            static_map.resolution,
            origin,
            self._setup.config.route.unknown,
            None if tilt is None else np.pad(tilt, margin),
            None if roughness is None else np.pad(roughness, margin),
            previous=self._route_map,
            unseen=self._closed_cells(freed.shape, static_map.resolution, origin),
        )

    def _clearance(self, route_map: RouteMap, path: PosePath) -> Array:
        assert self._setup is not None
        # 0.2: clearance of the poses of an answer is measured up to this, m
        return route_map.field.clearance(self._setup.footprint, path.poses, 0.2)

    def _cusp_clearance(self, route_map: RouteMap, result: RouteResult) -> float:
        """Least clearance of the cusps, m; +inf of a route without any, -inf without a route."""
        if result.path is None:
            return math.inf if result.ok else -math.inf
        path = result.path.base_path()
        return float(np.min(self._clearance(route_map, path)[path.stops], initial=math.inf))

    def _escape(self, static_map: StaticMap, task: PlanTask) -> RouteAnswer:
        setup = self._setup
        assert setup is not None
        config = setup.config
        known = np.vstack((self._memory.places, self._memory.suspended))
        near = static_map.obstacles(static_map.with_points(known), task.pose, NEARBY)
        found = escape(
            config.escape,
            setup.geometry,
            setup.footprint,
            near,
            crab=config.steering == "4ws",
            rear=config.steering != "2ws",
            unseen=self._unseen_near(task),
        )
        self._route = None
        if found is None:
            return RouteAnswer(Reason.STUCK, "both ends of the robot are blocked, or ground there was not seen")
        steering: tuple[Steering, ...] = (found.steering,) * len(found.poses)
        directions = np.full(len(found.poses), float(found.direction))
        path = PosePath(placed(found.poses, task.pose), directions, steering)
        return RouteAnswer(Reason.OK, "", path, path.length, path.length)

    def _unseen_near(self, task: PlanTask) -> Array:
        """Unseen places around the robot, in base, shape (n, 2), m."""
        unseen = self._unseen(task)
        return np.empty((0, 2)) if unseen is None else unseen.near(task.pose)


def shortened(answer: RouteAnswer) -> RouteAnswer:
    """The part of a path that fits one message: ``MAX_RUNS`` runs, ``MAX_POSES`` poses."""
    path = answer.path
    assert path is not None
    ends = [*path.stops[:MAX_RUNS].tolist(), len(path.poses) - 1]
    count = min(ends[min(MAX_RUNS, len(ends)) - 1] + 1, MAX_POSES)
    if count == len(path.poses):
        return answer
    first = path.part(0, count)
    text = f"the first {first.length:.2f} m of {answer.length:.2f}"
    return replace(answer, text=text, path=first, length=first.length, complete=False)


class PlanningWorker(PlanningStep):
    """The step in a worker, with its numba code compiled.

    Args:
        configs: route planners whose code is compiled; default: all.
    """

    def __init__(self, configs: Sequence[GoalConfig] = (HybridConfig(), LatticeConfig(), GridAstarConfig())) -> None:
        super().__init__()
        for config in configs:
            warm_up(make_planner(Vehicle.truck(), config))
        Vehicle.truck("2ws").reeds_shepp().distance(np.zeros(3), np.ones(3))
        ahead = MotionPath(np.ones(3), np.array([[0.1, 0.0, 0.0]]))
        leaving(RouteMap.from_cells(np.zeros((20, 20), np.int8), 0.1), Vehicle.truck(), ahead, 0.0, lambda _: True)


def hybrid_worker() -> PlanningWorker:
    """A worker that compiles the code of hybrid A* only, for robots that plan by it."""
    return PlanningWorker((HybridConfig(),))
