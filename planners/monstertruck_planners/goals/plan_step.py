"""Planning step: computes a drivable path from the map and the latest scan. For workers.

It keeps the map, the obstacles that scans show but the map lacks, and the route, which is reused while it is valid.

An obstacle is kept until a scan sees through its place. Obstacles do not expire by age, because a robot that only looks
ahead must not forget those behind it.
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, placed, points_placed, points_relative
from monstertruck_planners.collision import OCCUPIED, DistanceField, Footprint, rectangle_distance
from monstertruck_planners.goals.escape import escape
from monstertruck_planners.goals.exchange import PlanTask, RouteAnswer, Setup, explained_within
from monstertruck_planners.goals.unseen import BESIDE, Unseen, unseen_around
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.api import Clock, RouteMap, RoutePlanner, RouteResult, Vehicle, make_planner, warm_up
from monstertruck_planners.route.config import GoalConfig, GridAstarConfig, HybridConfig, LatticeConfig
from monstertruck_planners.route.departure import leaving
from monstertruck_planners.route.motion import MotionPath, moved
from monstertruck_planners.route.replan import ViaPoint, replan, with_headings
from monstertruck_planners.zones.shapes import ZoneLayer, in_force
from monstertruck_runtime.clock import processor_time
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import load_map
from monstertruck_schemas.plan import MAX_COORDINATE, MAX_POSES, MAX_RUNS, Steering
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GROUND_UNKNOWN, ROUGHNESS_STEP, TILT_STEP, Grid, Ground
from monstertruck_schemas.zones import Zone

log = logging.getLogger(__name__)

Cells = NDArray[np.int8]

SQUARE: Final = 0.05
"""Grid size of the remembered obstacles that are not in the map (m)."""
NEARBY: Final = 1.5
"""Radius of the obstacles that are considered for backing out, and kept on ``clear`` (m)."""


OVERLAPPING: Final = frozenset({Reason.START_BLOCKED, Reason.GOAL_UNREACHABLE})
"""Reasons for no route if the truck overlaps an obstacle at its current pose."""
ASSUMED_FREE: Final = 0.15
"""Unknown ground within this distance of the truck is assumed free (m)."""

BEAM_WIDTH: Final = 0.012
"""Maximum bearing difference between a beam and a place it shows (rad): two steps of a URG-04LX."""
SEEN_BEYOND: Final = 0.10
"""Minimum reach of all these beams beyond the place (m)."""


class ObstacleMemory:
    """Obstacle places in the map frame, at most one per square.

    Args:
        square: side of the squares (m).
    """

    def __init__(self, square: float) -> None:
        self._square = square
        self.places: Array = np.empty((0, 2))
        """Active places (m), shape (n, 2)."""
        self.suspended: Array = np.empty((0, 2))
        """Places cleared but not seen free by a scan (m), shape (k, 2); active only where the lidar does not look."""

    def look(self, points: Array, sensor: Array) -> None:
        """Remove places that a scan shows to be free; a bearing without a return shows nothing.

        Args:
            points: returns of the scan, shape (n, 2).
            sensor: position of the sensor, shape (2,).
        """
        self.places = self.places[~seen_through(self.places, points, sensor)]
        self.suspended = self.suspended[~seen_through(self.suspended, points, sensor)]

    def keep(self, points: Array) -> None:
        """Add places, shape (n, 2)."""
        self.places = _one_per_square(np.vstack((self.places, points)), self._square)

    def suspend(self, where: NDArray[np.bool_]) -> None:
        """Suspend the places in the mask ``where``, shape (n,): they are ignored where the lidar looks."""
        self.suspended = _one_per_square(np.vstack((self.suspended, self.places[where])), self._square)
        self.places = self.places[~where]

    def restore(self, where: NDArray[np.bool_]) -> None:
        """Reactivate the suspended places in the mask ``where``, shape (k,)."""
        self.keep(self.suspended[where])
        self.suspended = self.suspended[~where]

    def drop_explained(self, unexplained: Callable[[Array], NDArray[np.bool_]]) -> None:
        """Keep only places with ``unexplained`` true; it maps shape (n, 2) to (n,)."""
        self.places = self.places[unexplained(self.places)]
        self.suspended = self.suspended[unexplained(self.suspended)]


def seen_through(places: Array, points: Array, sensor: Array) -> NDArray[np.bool_]:
    """Return whether a scan shows each place to be free: all its returns in that direction lie beyond.

    Args:
        places: places to test, shape (n, 2).
        points: returns of the scan, shape (m, 2).
        sensor: position of the sensor, shape (2,).

    Returns:
        Mask of shape (n,).
    """
    if not len(places) or not len(points):
        return np.zeros(len(places), dtype=np.bool_)
    bearings, ranges = _polar(points - sensor)
    order = np.argsort(bearings)
    bearings, ranges = bearings[order], ranges[order]
    # Repeat the circle on both sides, so that no window is cut at +-pi.
    bearings = np.concatenate((bearings - 2 * np.pi, bearings, bearings + 2 * np.pi))
    ranges = np.tile(ranges, 3)
    towards, far = _polar(places - sensor)
    first, last = (np.searchsorted(bearings, towards + side) for side in (-BEAM_WIDTH, BEAM_WIDTH))
    nearest = np.minimum.reduceat(np.append(ranges, np.inf), np.column_stack((first, last)).ravel())[::2]
    return np.asarray((last > first) & (nearest > far + SEEN_BEYOND))


def _polar(points: Array) -> tuple[Array, Array]:
    return np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])


def _one_per_square(points: Array, square: float) -> Array:
    """Return the first point of each square."""
    _, first = np.unique(np.floor(points / square).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)])


class StaticMap:
    """Configured or built map.

    Args:
        cells: occupancy (percent, -1 unknown), shape (rows, columns); row 0 at the lowest y.
        resolution: cell size (m).
        origin: pose of the outer corner of cell (0, 0).
        previous: last map; only differences are recomputed.
    """

    def __init__(self, cells: Cells, resolution: float, origin: Pose2, previous: "StaticMap | None" = None) -> None:
        self.cells = cells
        self.resolution = resolution
        self.origin = origin
        known = None if previous is None else previous.walls
        self.walls: DistanceField = DistanceField(cells >= OCCUPIED, resolution, origin, known)
        """Distance to the map obstacles."""

    @classmethod
    def of(cls, grid: Grid, previous: "StaticMap | None" = None) -> "StaticMap":
        """Create the map from a message."""
        cells = grid.cells.reshape(grid.height, grid.width)
        return cls(cells, grid.resolution, (grid.origin.x, grid.origin.y, grid.origin.yaw), previous)

    def unexplained(self, points: Array, tolerance: float) -> NDArray[np.bool_]:
        """Return which points (n, 2) are further than ``tolerance`` (m) from all map obstacles."""
        return np.asarray(self.walls.lookup(points) > tolerance + self.resolution / 2)

    def with_points(self, points: Array) -> Cells:
        """Return the cells, with every cell that contains a point occupied."""
        return np.where(
            marked(np.zeros(self.cells.shape, np.bool_), points, self.resolution, self.origin), 100, self.cells
        )

    def obstacles(self, cells: Cells, pose: Pose2, reach: float) -> Array:
        """Return the centres of occupied cells around a pose, in the frame of the pose, shape (n, 2)."""
        rows, columns = np.nonzero(cells >= OCCUPIED)
        centres = np.column_stack((columns + 0.5, rows + 0.5)) * self.resolution
        there = points_relative(points_placed(centres, self.origin), pose)
        return np.asarray(there[np.hypot(there[:, 0], there[:, 1]) < reach])


def marked(cells: NDArray[np.bool_], points: Array, resolution: float, origin: Pose2) -> NDArray[np.bool_]:
    """Set and return the grid cells (rows, columns) that contain a point; points (n, 2) in the frame of ``origin``."""
    column, row = (np.floor(v / resolution).astype(np.int64) for v in points_relative(points, origin).T)
    rows, columns = cells.shape
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    cells[row[inside], column[inside]] = True
    return cells


def standing_free(
    cells: Cells, resolution: float, origin: Pose2, footprint: Footprint, pose: Pose2, beside: float = 0.0
) -> Cells:
    """Return the cells with those under the truck freed: unknown cells, and obstacles overlapped only at its edge.

    A map is as accurate as its cells: a truck next to a wall overlaps it by up to a cell. Deeper overlaps stay, as they
    mean that the map or the pose is wrong.

    Args:
        cells: occupancy (percent, -1 unknown), shape (rows, columns).
        resolution: cell size (m).
        origin: pose of the outer corner of cell (0, 0).
        footprint: footprint of the truck.
        pose: pose of the truck in the map frame.
        beside: unknown cells within this distance of the truck are freed too (m).
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
    # 1.5: maximum overlap of the standing truck with a map obstacle (cells)
    freed = np.where(unknown, gap < touched + beside, (gap < touched) & (gap > -1.5 * resolution))
    kept = cells.copy()
    kept[row[freed], column[freed]] = 0
    return kept


def ground_layers(ground: Ground, grid: StaticMap, reach: float) -> tuple[Array, Array]:
    """Return the worst tilt (rad) and roughness (m) within ``reach`` (m) of each map cell, 0 where unknown.

    Both have the shape of the map: the values for a vehicle with its centre at the cell.
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
    """Return rows and columns of map cells around a rectangle, given its corner pose, height and width (m)."""
    corners = np.array([(x, y) for x in (0.0, size[1]) for y in (0.0, size[0])])
    box = points_relative(points_placed(corners, corner), grid.origin) / grid.resolution
    rows, columns = grid.cells.shape
    left, bottom = np.clip(np.floor(box.min(axis=0)), 0, (columns, rows)).astype(int)
    right, top = np.clip(np.ceil(box.max(axis=0)), 0, (columns, rows)).astype(int)
    row, column = np.mgrid[bottom:top, left:right]
    return row.ravel(), column.ravel()


class PlanningStep:
    """Answers tasks in sequence; without a clock, equal tasks give equal answers."""

    def __init__(self) -> None:
        self._setup: Setup | None = None
        self._map: StaticMap | None = None
        self._without = Reason.NO_MAP, "no map yet"
        """Reason and text if there is no map."""
        self._ground: Ground | None = None
        self._layers: tuple[Array, Array] | None = None
        """Tilt and roughness of the map cells."""
        self._route_map: RouteMap | None = None
        self._layer = ZoneLayer()
        self._keepout: NDArray[np.bool_] | None = None
        """Map cells closed by keepout zones; None if they are to be computed."""
        self._memory = ObstacleMemory(SQUARE)
        self._route: MotionPath | None = None
        self._closed: Array = np.empty((0, 2))
        """Unseen places onto which the current route must not reverse (m), shape (k, 2)."""
        self._now: Clock | None = None

    def step(self, task: PlanTask) -> RouteAnswer:
        """Carry out one task.

        Raises:
            InputError: the first task had no setup.
        """
        if task.setup is not None:
            self._set_up(task.setup)
        if self._setup is None:
            raise InputError("planning: expected a setup message first")
        if task.grid is not None:
            self._map, self._layers, self._keepout = StaticMap.of(task.grid, self._map), None, None
        if task.zones is not None:
            self._layer, self._keepout = ZoneLayer(in_force(task.zones), self._layer), None
        if task.ground is not None:
            self._ground, self._layers = task.ground, None
        if self._map is None:
            return RouteAnswer(*self._without)
        places = [value for place in task.via for value in place if value is not None]
        numbers = np.array((*task.pose, *(task.start or ()), *task.goal, *places))
        if not np.isfinite(numbers).all():
            return RouteAnswer(Reason.NOT_FINITE, "expected a finite pose, goal and waypoints")
        if np.abs(numbers).max() > MAX_COORDINATE:
            return RouteAnswer(Reason.BAD_INPUT, f"expected a pose, goal and waypoints of at most {MAX_COORDINATE:g}")
        if task.clear or task.afresh:
            self._route = None
        self._observe(self._setup, self._map, task)
        if task.start is not None:
            task = replace(task, pose=task.start)
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
            self._layers = self._keepout = None
            self._map = StaticMap(world.cells, world.resolution, (*world.origin, 0.0))

    def _observe(self, setup: Setup, static_map: StaticMap, task: PlanTask) -> None:
        """Update the remembered obstacles from the scans and the latest map."""
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
        """Plan a route that does not reverse onto unseen ground, or one to a viewpoint on that ground.

        Unseen ground covered by one route is closed to the next.
        """
        self._closed = np.empty((0, 2))
        if inside := self._zones_around(task.pose):
            return self._leave(static_map, task, inside)
        answer = self._plan_known(static_map, task)
        unseen = self._unseen(task)
        if unseen is None or not answer.drivable or not len(met := self._met(unseen, answer)):
            return answer
        x, y = met.mean(axis=0).tolist()
        for _ in range(2):  # maximum number of routes around unseen ground; each closes more of it
            self._closed, self._route = np.vstack((self._closed, met)), None
            answer = self._plan_known(static_map, task)
            if answer.path is None:
                break
            if not len(met := self._met(unseen, answer)):
                return answer
        self._route = None
        look = self._look(static_map, task, unseen)
        remedy = "first drive the robot forward by hand, or backward with the second control held"
        text = f"every route found reverses onto ground that no sensor has seen, at {x:.1f}, {y:.1f}: {remedy}"
        return look or RouteAnswer(Reason.UNSEEN_STOP, text)

    def _zones_around(self, pose: Pose2) -> list[Zone]:
        """Return the keepout zones that the robot is in."""
        assert self._setup is not None
        return [shape.zone for shape, limit in self._layer.reached(self._setup.footprint, pose) if limit == 0.0]

    def _leave(self, static_map: StaticMap, task: PlanTask, inside: list[Zone]) -> RouteAnswer:
        """Plan the shortest of some ways out of keepout zones, which are open on this way only."""
        assert self._setup is not None
        if held := [zone.name for zone in inside if zone.inside == "stop"]:
            return RouteAnswer(Reason.KEEPOUT, f"the robot is in the keepout zone {', '.join(held)}")
        names = [zone.name for zone in inside]
        closed = self._map_of(self._with_zones(static_map.cells, static_map), static_map).field
        directions = np.arange(16) * (math.tau / 16)
        # 0.1: distance between tried places (m); 4.0: farthest (m)
        around = [(r, a, yaw) for r in np.arange(0.1, 4.0, 0.1) for a in directions for yaw in directions]
        far, bearing, yaw = np.array(around).T
        poses = np.column_stack(
            (task.pose[0] + far * np.cos(bearing), task.pose[1] + far * np.sin(bearing), task.pose[2] + yaw)
        )
        poses = poses[closed.free(self._setup.footprint, poses, self._planner.config.margin)]
        there = np.array([self._vehicle.reference_pose(pose) for pose in poses]).reshape(-1, 3)
        start = np.tile(self._vehicle.reference_pose(task.pose), (len(there), 1))
        far = self._vehicle.reeds_shepp().distance(start, there) if len(there) else np.empty(0)
        layer, self._layer = (
            self._layer,
            ZoneLayer([shape.zone for shape in self._layer.shapes if shape.zone.name not in names], self._layer),
        )
        self._keepout = self._route = None
        try:
            for index in np.argsort(far)[:4].tolist():  # maximum number of tried places
                x, y, heading = poses[index].tolist()
                answer = self._plan_known(static_map, replace(task, goal=(x, y, heading), via=()))
                if answer.path is not None:
                    text = f"{answer.length:.2f} m out of the keepout zone {', '.join(names)}"
                    return replace(answer, text=text, complete=False)
        finally:
            self._layer, self._keepout, self._route = layer, None, None
        return RouteAnswer(Reason.KEEPOUT, f"no way out of the keepout zone {', '.join(names)} was found")

    def _with_zones(self, cells: Cells, static_map: StaticMap) -> Cells:
        """Return the cells of the map, those of keepout zones occupied."""
        assert self._setup is not None
        if not self._layer.shapes:
            return cells
        if self._keepout is None:
            self._keepout = self._layer.keepout_cells(
                static_map.cells.shape, static_map.resolution, static_map.origin, self._setup.zone_margin
            )
        return np.where(self._keepout, np.int8(100), cells)

    def _look(self, static_map: StaticMap, task: PlanTask, unseen: Unseen) -> RouteAnswer | None:
        """Plan a route to a viewpoint on the closed ground; None if none was found."""
        assert self._route_map is not None
        lookouts = unseen.lookouts(self._closed, self._route_map.field, self._planner.config.margin)
        if not len(lookouts):
            return None
        # 5.0: reverse cost when choosing viewpoints, so that the robot reaches them driving forward
        ahead = replace(self._vehicle.reeds_shepp(), reverse_cost=5.0)
        there = np.array([self._vehicle.reference_pose(pose) for pose in lookouts])
        far = ahead.distance(np.tile(self._vehicle.reference_pose(task.pose), (len(there), 1)), there)
        for index in np.argsort(far)[:4].tolist():  # maximum number of tried viewpoints
            x, y, yaw = lookouts[index].tolist()
            answer = self._plan_known(static_map, replace(task, goal=(x, y, yaw), via=()))
            self._route = None
            if answer.path is not None and not len(self._met(unseen, answer)):
                text = f"{answer.length:.2f} m, to look at ground that no sensor has seen"
                return replace(answer, text=text, complete=False)
        return None

    def _met(self, unseen: Unseen, answer: RouteAnswer) -> Array:
        """See ``Unseen.met``."""
        assert self._route_map is not None
        return np.empty((0, 2)) if answer.path is None else unseen.met(answer.path, self._route_map.field)

    def _unseen(self, task: PlanTask) -> Unseen | None:
        """Return the unseen ground around the robot; None if it may reverse anywhere."""
        assert self._setup is not None
        seen, keep = task.ground_seen, self._setup.seen_for
        return (
            None
            if seen is None or keep is None
            else unseen_around(seen, keep, self._setup.lidar, self._setup.footprint)
        )

    def _plan_known(self, static_map: StaticMap, task: PlanTask) -> RouteAnswer:
        """Plan a route that does not reverse into suspended places; reactivate those near touched ones, then all."""
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
        """Return whether the reverse motions of a route touch each place, shape (k,)."""
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
            # An obstacle touching the standing truck would make every route impossible; the gate checks it.
            pose = np.array([task.pose])
            touching = rectangle_distance(self._setup.footprint, pose, points)[0] < 1.5 * static_map.resolution
            points = points[~touching]
        cells = static_map.with_points(points) if len(points) else static_map.cells
        cells = self._with_zones(cells, static_map)
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
                Reason.BAD_INPUT, "the robot cannot drive this planner's routes directly: set planner.local_planner"
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
        """Return the cells closed to reversing, which reach to ``BESIDE`` from those of closed places; None if none."""
        closed = marked(np.zeros(shape, np.bool_), self._closed, resolution, origin)
        reach = BESIDE + resolution / 2  # from the middle of a closed cell, as a footprint meets a cell at its middle
        return np.asarray(distance_transform_edt(~closed) * resolution < reach) if closed.any() else None

    def _standing(self, static_map: StaticMap, cells: Cells, pose: Pose2) -> RouteMap:
        """Return the map with free ground under the truck, padded in case the truck is at its edge."""
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
        # 0.2: maximum measured clearance of the poses of an answer (m)
        return route_map.field.clearance(self._setup.footprint, path.poses, 0.2)

    def _cusp_clearance(self, route_map: RouteMap, result: RouteResult) -> float:
        """Return the minimum clearance at the cusps (m); +inf without cusps, -inf without a route."""
        if result.path is None:
            return math.inf if result.ok else -math.inf
        path = result.path.base_path()
        return float(np.min(self._clearance(route_map, path)[path.stops], initial=math.inf))

    def _escape(self, static_map: StaticMap, task: PlanTask) -> RouteAnswer:
        setup = self._setup
        assert setup is not None
        config = setup.config
        known = np.vstack((self._memory.places, self._memory.suspended))
        cells = self._with_zones(static_map.with_points(known), static_map)
        near = static_map.obstacles(cells, task.pose, NEARBY)
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
            return RouteAnswer(Reason.STUCK, "both ends of the robot are blocked or face unseen ground")
        steering: tuple[Steering, ...] = (found.steering,) * len(found.poses)
        directions = np.full(len(found.poses), float(found.direction))
        path = PosePath(placed(found.poses, task.pose), directions, steering)
        return RouteAnswer(Reason.OK, "", path, path.length, path.length)

    def _unseen_near(self, task: PlanTask) -> Array:
        """Return the unseen places around the robot in base (m), shape (n, 2)."""
        unseen = self._unseen(task)
        return np.empty((0, 2)) if unseen is None else unseen.near(task.pose)


def shortened(answer: RouteAnswer) -> RouteAnswer:
    """Return the part of a path that fits into one message: ``MAX_RUNS`` runs, ``MAX_POSES`` poses."""
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
    """Planning step in a worker, with its numba code compiled.

    Args:
        configs: route planners to compile; default: all.
    """

    def __init__(self, configs: Sequence[GoalConfig] = (HybridConfig(), LatticeConfig(), GridAstarConfig())) -> None:
        super().__init__()
        for config in configs:
            warm_up(make_planner(Vehicle.truck(), config))
        Vehicle.truck("2ws").reeds_shepp().distance(np.zeros(3), np.ones(3))
        ahead = MotionPath(np.ones(3), np.array([[0.1, 0.0, 0.0]]))
        leaving(RouteMap.from_cells(np.zeros((20, 20), np.int8), 0.1), Vehicle.truck(), ahead, 0.0, lambda _: True)


def hybrid_worker() -> PlanningWorker:
    """Create a worker that compiles only hybrid A*, for robots that plan with it."""
    return PlanningWorker((HybridConfig(),))
