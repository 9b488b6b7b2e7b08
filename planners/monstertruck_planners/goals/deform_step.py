"""The deforming step: a scan in; out whether the route is free, or a path round what stands on it. For workers.

While the route is free it is driven as it was planned: the deformer is used only from the moment something stands on it
until the truck is back on it.
"""

from typing import Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import OCCUPIED, DistanceField, first_contact, placed, poses_relative, scan_points
from monstertruck_planners.goals.exchange import DeformAnswer, DeformTask, Pose, Setup, Way
from monstertruck_planners.goals.plan_step import answer_of
from monstertruck_planners.local.api import LocalPlan, LocalPlannerState, PosePath, pose_distance
from monstertruck_planners.local.catalog import make_local_planner
from monstertruck_planners.local.config import RsbandConfig, TebConfig
from monstertruck_planners.local.core import nearest_pose
from monstertruck_planners.local.window import Window
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.motion import moved
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import load_map
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import LaserScan

LOOK_BACK: Final = 0.5
"""Metres of route behind the truck that still count as near."""
SHORTEST: Final = 0.02
"""A deformed path shorter than this is none, m."""


class DeformStep:
    """Answers scan by scan; equal scans give equal answers."""

    def __init__(self) -> None:
        self._setup: Setup | None = None
        self._walls: DistanceField | None = None
        self._way: Way | None = None
        self._rest: PosePath | None = None
        """The route from where its deformation began; None while it is free."""

    def step(self, task: DeformTask) -> DeformAnswer:
        """Take in a scan, and say what becomes of the route.

        Raises:
            InputError: no setup came first, no deformer is configured, or the map is not readable.
        """
        if task.setup is not None:
            self._set_up(task.setup)
        setup = self._setup
        if setup is None:
            raise InputError("deforming: expected a setup before anything else")
        if task.grid is not None:
            self._walls = DistanceField.from_grid(task.grid, unknown_blocks=False)
        points = self._observe(setup, task.scan, task.pose)
        if task.way is not None:
            self._begin(task.way)
        if self._way is None:
            return DeformAnswer(0, "idle")
        here = self._vehicle.reference_pose(task.pose)
        self._advance(here)
        if self._way.drivable and self._free(setup, here, task.pose, points):
            self._rest, self._state = None, LocalPlannerState()
            return DeformAnswer(self._way.number, "free", place=self._place, complete=True)
        if self._rest is None:
            self._rest = self._guide.part(self._place, len(self._guide.poses))
        result = self._planner.plan(self._rest, self._window.field(self._walls), here, self._state)
        self._state = result.state
        return self._answer(result)

    def _set_up(self, setup: Setup) -> None:
        config = setup.config
        if config.deform is None:
            raise InputError("deforming: expected planner.deform")
        self._setup, self._way = setup, None
        self._vehicle = Vehicle.truck(
            config.steering, angle=config.angle, geometry=setup.geometry, footprint=setup.footprint
        )
        self._planner = make_local_planner(self._vehicle, config.deform)
        self._window = Window()
        if config.map is not None:
            world = load_map(config.map)
            self._walls = DistanceField(world.cells >= OCCUPIED, world.resolution, (*world.origin, 0.0))

    def _begin(self, way: Way) -> None:
        self._way, self._place = way, 0
        self._guide = PosePath(moved(way.poses, self._vehicle.reference), way.directions)
        self._travelled = self._guide.travelled
        self._rest, self._state = None, LocalPlannerState()

    def _observe(self, setup: Setup, scan: LaserScan, pose: Pose) -> Array:
        """Put a scan into the window; returns its points in base. Beams without a return say nothing."""
        points = scan_points(scan, setup.lidar)
        (sensor,) = placed(np.array([setup.lidar]), pose)
        ends = placed(np.column_stack((points, np.zeros(len(points)))), pose)[:, :2]
        self._window.add_scan((sensor[0], sensor[1]), pose[:2], ends, np.ones(len(points), np.bool_))
        return points

    def _advance(self, here: Array) -> None:
        """Find the truck's place on the route: near the last one, not beyond a cusp that it has not reached."""
        guide, travelled, at = self._guide, self._travelled, self._place
        reach = np.array([-LOOK_BACK, self._window.config.size / 2])
        first, last = np.searchsorted(travelled, travelled[at] + reach).tolist()
        cusps = np.flatnonzero(np.diff(guide.directions[first : at + 2]))
        first += int(cusps[-1]) if len(cusps) else 0
        directions = guide.directions[first : last + 1].copy()
        directions[:1] = directions[1:2] if len(directions) > 1 else directions
        self._place = first + nearest_pose(PosePath(guide.poses[first : last + 1], directions), here)

    def _free(self, setup: Setup, here: Array, pose: Pose, points: Array) -> bool:
        """Whether the truck can drive the route as it is: always looked at; to go back to it more is asked."""
        local, guide, at = setup.config.local, self._guide, self._place
        deformed = self._rest is not None
        if deformed and pose_distance(guide.poses[at], here) > local.beside:
            return False
        end = int(np.searchsorted(self._travelled, self._travelled[at] + setup.config.look_ahead)) + 1
        way = np.vstack((here, guide.poses[at + 1 : end]))
        margin = local.clearance + (local.rejoin if deformed else 0.0)
        relative = poses_relative(moved(way, -self._vehicle.reference), pose)
        return first_contact(setup.footprint, relative, points, margin) is None

    def _answer(self, result: LocalPlan) -> DeformAnswer:
        assert self._way is not None
        number, path = self._way.number, result.path
        if path is not None and path.length < SHORTEST and self._place == len(self._guide.poses) - 1:
            return DeformAnswer(number, "kept", result.reason, place=self._place, complete=True)
        if path is None or path.length < SHORTEST:
            why = Reason.PATH_BLOCKED if result.reason is Reason.OK else result.reason
            return DeformAnswer(number, "blocked", why, result.text, self._place)
        if result.statistics.get("kept"):
            return DeformAnswer(number, "kept", result.reason, result.text, self._place, result.complete)
        answer = answer_of(path, cost=path.length)
        return DeformAnswer(number, "new", result.reason, result.text, self._place, result.complete, answer)


class DeformingWorker(DeformStep):
    """The step as a worker's: its code is compiled when it is built."""

    def __init__(self) -> None:
        super().__init__()
        cells = np.zeros((100, 100), np.bool_)
        cells[45:55, 45:55] = True
        poses = np.column_stack((np.linspace(0.5, 3.5, 31), np.full(31, 2.0), np.zeros(31)))
        guide, surroundings = PosePath(poses, np.ones(31)), DistanceField(cells, 0.04)
        for config in (RsbandConfig(effort=200), TebConfig(effort=200)):
            make_local_planner(Vehicle.truck(), config).plan(guide, surroundings, poses[0], LocalPlannerState())
