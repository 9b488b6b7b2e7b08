"""The planning step: map and newest scan in, a drivable way out. Compiled, for workers.

It remembers the map, the obstacles that scans showed beside it, and the route, which is kept while it is good.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import OCCUPIED, DistanceField, rectangle_distance
from monstertruck_planners.goals.escape import escape, placed, seen_from
from monstertruck_planners.goals.exchange import PlanAnswer, PlanTask, Pose, Setup
from monstertruck_planners.goals.memory import ObstacleMemory
from monstertruck_planners.route.api import Clock, RouteMap, Vehicle
from monstertruck_planners.route.catalog import make_planner
from monstertruck_planners.route.motion import MotionPath, moved
from monstertruck_planners.route.replan import ViaPoint, replan, with_headings
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import load_map
from monstertruck_schemas.plan import Steering
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Grid

Cells = NDArray[np.int8]

SAMPLE: Final = 0.05
"""Metres between two poses of an answer."""
SQUARE: Final = 0.05
"""Obstacles beside the map are remembered by squares of this size, m."""
NEARBY: Final = 1.5
"""Obstacles this near count when backing out, and are not forgotten, m."""


class Ground:
    """The map, and what the last scans showed beside it.

    Args:
        cells: shape (rows, columns), percent, -1 unknown; row 0 at the lowest y.
        resolution: m.
        origin: pose of the outer corner of cell (0, 0).
    """

    def __init__(self, cells: Cells, resolution: float, origin: Pose) -> None:
        self.cells = cells
        self.resolution = resolution
        self.origin = origin
        self._walls = DistanceField(cells >= OCCUPIED, resolution, origin)

    @classmethod
    def of(cls, grid: Grid) -> "Ground":
        """Of a message."""
        cells = grid.cells.reshape(grid.height, grid.width)
        return cls(cells, grid.resolution, (grid.origin.x, grid.origin.y, grid.origin.yaw))

    def beside(self, points: Array, tolerance: float) -> NDArray[np.bool_]:
        """Whether no obstacle of the map explains each point (n, 2): it is further than ``tolerance`` from all, m."""
        return np.asarray(self._walls.lookup(points) > tolerance + self.resolution / 2)

    def with_points(self, points: Array) -> Cells:
        """Cells with the points' ones occupied."""
        column, row = (np.floor(v / self.resolution).astype(np.int64) for v in seen_from(points, self.origin).T)
        rows, columns = self.cells.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        cells = self.cells.copy()
        cells[row[inside], column[inside]] = 100
        return cells

    def obstacles(self, cells: Cells, pose: Pose, reach: float) -> Array:
        """Centres of the occupied cells round a pose, shape (n, 2), in the frame of the pose."""
        rows, columns = np.nonzero(cells >= OCCUPIED)
        centres = (np.column_stack((columns, rows)) + 0.5) * self.resolution
        flat = np.column_stack((centres, np.zeros(len(centres))))
        there = seen_from(placed(flat, self.origin)[:, :2], pose)
        return np.asarray(there[np.hypot(there[:, 0], there[:, 1]) < reach])


class PlanningStep:
    """Answers tasks one by one; without a clock equal tasks give equal answers."""

    def __init__(self) -> None:
        self._setup: Setup | None = None
        self._ground: Ground | None = None
        self._memory = ObstacleMemory(SQUARE)
        self._route: MotionPath | None = None
        self._now: Clock | None = None

    def step(self, task: PlanTask) -> PlanAnswer:
        """Do one task.

        Raises:
            InputError: no setup came first, or the configured map is not readable.
        """
        if task.setup is not None:
            self._set_up(task.setup)
        if self._setup is None:
            raise InputError("planning: expected a setup before anything else")
        if task.grid is not None:
            self._ground = Ground.of(task.grid)
        if self._ground is None:
            return PlanAnswer(Reason.NO_MAP, "no map yet")
        places = [value for place in task.via for value in place if value is not None]
        if not np.isfinite((*task.pose, *task.goal, *places)).all():
            return PlanAnswer(Reason.NOT_FINITE, "expected a finite pose, goal and waypoints")
        if task.clear or task.afresh:
            self._route = None
        self._look(self._setup, self._ground, task)
        return self._escape(self._ground, task) if task.what == "escape" else self._plan(self._ground, task)

    def _set_up(self, setup: Setup) -> None:
        config = setup.config
        self._setup = setup
        self._vehicle = Vehicle.truck(
            config.steering, angle=config.angle, geometry=setup.geometry, footprint=setup.footprint
        )
        self._planner = make_planner(self._vehicle, config.route)
        self._tight = make_planner(self._vehicle, config.route.model_copy(update={"margin": 0.0}))
        if setup.timed:
            clock = WallClock()
            self._now = lambda: clock.now() / SECOND
        if config.map is not None:
            world = load_map(config.map)
            self._ground = Ground(world.cells, world.resolution, (*world.origin, 0.0))

    def _look(self, setup: Setup, ground: Ground, task: PlanTask) -> None:
        """Take in a scan, and what has become of the map."""
        memory = self._memory
        if task.clear:
            memory.forget(np.hypot(*(memory.places - task.pose[:2]).T) > NEARBY)
        memory.look(task.points, placed(np.array([setup.lidar]), task.pose)[0, :2])
        memory.keep(task.points)
        memory.forget(~ground.beside(memory.places, setup.config.scan_tolerance))

    def _plan(self, ground: Ground, task: PlanTask) -> PlanAnswer:
        assert self._setup is not None
        points = self._memory.places
        if len(points):
            # What touches the truck where it stands would only keep it there; the gate watches that.
            pose = np.array([task.pose])
            touching = rectangle_distance(self._setup.footprint, pose, points)[0] < 1.5 * ground.resolution
            points = points[~touching]
        cells = ground.with_points(points) if len(points) else ground.cells
        route_map = RouteMap.from_cells(cells, ground.resolution, ground.origin, self._setup.config.route.unknown)
        start, goal = (self._vehicle.reference_pose(p) for p in (task.pose, task.goal))
        way = with_headings(task.pose, [ViaPoint(*place) for place in (*task.via, task.goal)])
        via = [self._vehicle.reference_pose(pose) for pose in way[:-1]]
        result = replan(self._planner, route_map, self._route, start, goal, self._now, via=via)
        if result.reason is Reason.START_BLOCKED:
            result = replan(self._tight, route_map, self._route, start, goal, self._now, via=via)
        if not result.ok:
            return PlanAnswer(result.reason, result.text)
        self._route = result.path
        if result.path is not None:
            return answer_of(result.path, result.cost, kept=bool(result.statistics["kept_route"]))
        if result.poses is None or self._setup.config.deform is None:
            return PlanAnswer(Reason.BAD_INPUT, "this planner's routes are no motions of the truck: set planner.deform")
        poses = moved(result.poses, -self._vehicle.reference)
        length = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
        return PlanAnswer(Reason.OK, "", poses, np.ones(len(poses)), (), length, result.cost, drivable=False)

    def _escape(self, ground: Ground, task: PlanTask) -> PlanAnswer:
        setup = self._setup
        assert setup is not None
        config = setup.config
        near = ground.obstacles(ground.with_points(self._memory.places), task.pose, NEARBY)
        way = escape(
            config.escape,
            setup.geometry,
            setup.footprint,
            near,
            crab=config.steering == "4ws",
            rear=config.steering != "2ws",
        )
        self._route = None
        if way is None:
            return PlanAnswer(Reason.STUCK, "both ends of the truck are blocked")
        steering: tuple[Steering, ...] = (way.steering,) * len(way.poses)
        poses = placed(way.poses, task.pose)
        length = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
        directions = np.full(len(poses), float(way.direction))
        return PlanAnswer(Reason.OK, "", poses, directions, steering, length, length)


def answer_of(path: MotionPath, cost: float, *, kept: bool = False) -> PlanAnswer:
    """A drivable path as an answer: poses of the base every few centimetres."""
    message = path.message(stamp=0, step=SAMPLE)
    poses, directions = np.array(message.poses).reshape(-1, 3), np.array(message.directions)
    return PlanAnswer(Reason.OK, "", poses, directions, message.steering, path.length, cost, kept=kept)
