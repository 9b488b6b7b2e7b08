"""Local planning step, for workers: adds a scan to the obstacle window; returns whether the route is free, or a path.

A free route is driven as planned. The local planner is used only from the moment an obstacle is on the route until the
truck is back on the route.
"""

import logging
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from monstertruck_estimation.slam.grid import trace
from monstertruck_kinematics.beams import nearest_beams
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, placed, points_placed, points_relative, poses_relative
from monstertruck_planners.collision import (
    OCCUPIED,
    DistanceField,
    Footprint,
    first_contact,
    on_body,
    scan_points_at,
)
from monstertruck_planners.goals.config import WindowConfig
from monstertruck_planners.goals.exchange import DeformAnswer, DeformTask, Setup, explained_within
from monstertruck_planners.local.api import LocalPlan, LocalPlannerState
from monstertruck_planners.local.catalog import make_local_planner
from monstertruck_planners.local.config import RsbandConfig, TebConfig
from monstertruck_planners.local.people import PeopleTracker, Walker, meets
from monstertruck_planners.pose_path import PosePath, nearest_pose, pose_distance
from monstertruck_planners.route.api import Vehicle, make_planner, warm_up
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.motion import moved
from monstertruck_planners.zones.shapes import ZoneLayer, in_force
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import load_map
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM, LaserScan

log = logging.getLogger(__name__)


class Window:
    """Obstacles around the truck in a grid aligned with the frame.

    Unseen cells are free unless they lie just behind an obstacle; cells out of sight keep their last state.

    Args:
        config: size and resolution.
    """

    def __init__(self, config: WindowConfig | None = None) -> None:
        self.config = config or WindowConfig()
        count = round(self.config.size / self.config.resolution)
        self._odds: NDArray[np.int16] = np.zeros((count, count), np.int16)
        self._marks: NDArray[np.uint16] = np.zeros((count, count), np.uint16)
        self._mark = 0
        self._corner: tuple[int, int] | None = None

    def add_scan(
        self, sensor: tuple[float, float], base: tuple[float, float], ends: Array, hit: NDArray[np.bool_]
    ) -> None:
        """Add a scan.

        Args:
            sensor: x, y of the lidar (m).
            base: x, y of the truck, the new centre of the window (m).
            ends: end of each beam (m), shape (n, 2).
            hit: whether each beam hit an obstacle at its end, shape (n,).

        Raises:
            InputError: shapes that do not match.
        """
        if ends.ndim != 2 or ends.shape[1] != 2 or hit.shape != (len(ends),):
            raise InputError(f"scan of {ends.shape} ends, {hit.shape} hits: expected (n, 2) and (n,)")
        self._move(base)
        res = self.config.resolution
        corner, count = np.array(self.corner), len(self._odds)
        start, beams = (np.array(sensor) - corner) / res, (ends - np.array(sensor)) / res
        lengths = np.hypot(beams[:, 0], beams[:, 1])
        if not ((start >= 0) & (start < count)).all():
            return
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = np.where(beams > 0, (count - start) / beams, -start / beams)
        inside = np.where(beams == 0, np.inf, inside).min(axis=1)
        near = hit & (lengths <= self.config.mark / res) & (inside > 1.0)
        share = np.minimum(inside, self.config.clear / res / np.maximum(lengths, 1e-9))
        tips = start + beams * np.where(near, 1.0, np.minimum(share, 1.0))[:, None]
        cells = np.clip(np.floor(np.vstack((start, tips[near], tips[~near]))), 0, count - 1).astype(np.int32)
        self._mark = self._mark % np.iinfo(np.uint16).max + 1
        if self._mark == 1:
            self._marks[:] = 0
        odds, marks = self._odds.reshape(-1), self._marks.reshape(-1)
        # (2, -2, 1): steps of a hit and of a pass, and the limit: a single scan can set a cell to either state
        trace(odds, marks, count, cells, np.zeros(2, np.int64), self._mark, (2, -2, 1), np.count_nonzero(near))

    @property
    def cells(self) -> NDArray[np.bool_]:
        """Occupied cells, shape (rows, columns), row 0 at the lowest y."""
        return np.asarray(self._odds > 0)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Seen cells, same shape as ``cells``."""
        return np.asarray(self._odds != 0)

    @property
    def obstacles(self) -> Array:
        """Centres of the occupied cells (m), shape (n, 2)."""
        return np.asarray((np.argwhere(self.cells)[:, ::-1] + 0.5) * self.config.resolution + self.corner)

    @property
    def corner(self) -> tuple[float, float]:
        """Outer corner of cell (0, 0) (m)."""
        column, row = self._corner or (0, 0)
        return column * self.config.resolution, row * self.config.resolution

    def discs(self, places: Array, radius: float, footprint: Footprint, pose: Pose2) -> NDArray[np.bool_]:
        """Return the cells within ``radius`` (m) of places (n, 2) that lie clear of a footprint at a pose."""
        clear = ~on_body(footprint, points_relative(places, pose), radius)
        rows, columns = np.indices(self._odds.shape)
        middles = (np.stack((columns, rows), axis=-1) + 0.5) * self.config.resolution + self.corner
        away = np.hypot(*np.moveaxis(middles[:, :, None] - places[clear], -1, 0))
        return np.asarray((away < radius).any(axis=-1))

    def field(self, known: DistanceField | None = None, closed: NDArray[np.bool_] | None = None) -> DistanceField:
        """Return the distance field of the window.

        Args:
            known: map obstacles, added to the seen ones; outside the map nothing is added.
            closed: further cells to keep out of, same shape as ``cells``.
        """
        x, y = self.corner
        res = self.config.resolution
        occupied = self.cells
        layers = round(self.config.thickness / res)
        if layers and occupied.any():
            occupied = occupied | (binary_dilation(occupied, iterations=layers) & ~self.seen)
        if known is not None:
            rows, columns = occupied.shape
            px, py = np.meshgrid(x + (np.arange(columns) + 0.5) * res, y + (np.arange(rows) + 0.5) * res)
            middles = np.stack((px, py), axis=-1)
            near = known.lookup(middles) < 0.5 * max(res, known.resolution)
            occupied = occupied | (near & known.inside(middles))
        if closed is not None:
            occupied = occupied | closed
        return DistanceField(occupied, res, (x, y, 0.0))

    def _move(self, base: tuple[float, float]) -> None:
        count = len(self._odds)
        corner = tuple(math.floor(v / self.config.resolution) - count // 2 for v in base)
        if self._corner is not None and corner != self._corner:
            columns, rows = corner[0] - self._corner[0], corner[1] - self._corner[1]
            self._odds = _moved(self._odds, rows, columns)
        self._corner = (corner[0], corner[1])


def _moved(cells: NDArray[np.int16], rows: int, columns: int) -> NDArray[np.int16]:
    """Return the cells of a window moved up by ``rows`` and right by ``columns``."""
    count = len(cells)
    fresh = np.zeros_like(cells)
    if abs(columns) < count and abs(rows) < count:
        old = cells[max(rows, 0) : count + min(rows, 0), max(columns, 0) : count + min(columns, 0)]
        r, c = max(-rows, 0), max(-columns, 0)
        fresh[r : r + old.shape[0], c : c + old.shape[1]] = old
    return fresh


class DeformStep:
    """Answers each scan; equal scans give equal answers."""

    def __init__(self) -> None:
        self._setup: Setup | None = None
        self._walls: DistanceField | None = None
        self._layer = ZoneLayer()
        self._number = 0
        """Number of the route; 0 before the first one."""
        self._rest: PosePath | None = None
        """Rest of the route from the start of its deformation; None while the route is free."""
        self._people: PeopleTracker | None = None
        self._yielding: int | None = None
        """Stamp of the first scan of a continuous approach to people (ns)."""

    def step(self, task: DeformTask) -> DeformAnswer:
        """Process a scan and return the result for the route.

        Raises:
            InputError: the first task had no setup, or no deformer is configured.
        """
        if task.setup is not None:
            self._set_up(task.setup)
        setup = self._setup
        if setup is None:
            raise InputError("deforming: expected a setup message first")
        if task.grid is not None:
            self._walls = DistanceField.from_grid(task.grid, unknown_blocks=False)
        if task.zones is not None:
            self._layer = ZoneLayer(in_force(task.zones), self._layer)
        zones, margin = self._layer.outside(setup.footprint, task.pose), setup.zone_margin
        points, mapped, walkers = self._observe(setup, task)
        if task.route is not None:
            self._begin(task.route, task.number, drivable=task.drivable)
        if not self._number:
            return DeformAnswer(0, "idle")
        here = self._vehicle.reference_pose(task.pose)
        self._advance(here)
        if self._yields(setup, task, here, walkers):
            self._state = LocalPlannerState()
            return DeformAnswer(self._number, "yields", Reason.YIELDS, place=self._place)
        if (
            self._drivable
            and self._free(setup, here, task.pose, points, mapped)
            and self._outside(setup, here, task.pose, zones, margin)
        ):
            self._rest, self._state = None, LocalPlannerState()
            return DeformAnswer(self._number, "free", place=self._place, complete=True)
        if self._rest is None:
            self._rest = self._guide.part(self._place, len(self._guide.poses))
        result = self._planner.plan(
            self._rest, self._field(setup, task.pose, zones, margin, walkers), here, self._state
        )
        self._state = result.state
        return self._answer(result)

    def _set_up(self, setup: Setup) -> None:
        config = setup.config
        if config.local_planner is None:
            raise InputError("deforming: expected planner.local_planner")
        self._setup, self._number = setup, 0
        self._vehicle = Vehicle.truck(
            config.steering, angle=config.angle, geometry=setup.geometry, footprint=setup.footprint
        )
        self._planner = make_local_planner(self._vehicle, config.local_planner)
        self._window = Window(config.local.window)
        people = config.local.people
        self._people = None if people is None else PeopleTracker(people)
        self._yielding = None
        if config.map is not None:
            self._walls = _walls_of(config.map)

    def _begin(self, route: PosePath, number: int, *, drivable: bool) -> None:
        self._number, self._drivable, self._place = number, drivable, 0
        self._guide = PosePath(moved(route.poses, self._vehicle.reference), route.directions)
        self._travelled = self._guide.travelled
        self._rest, self._state = None, LocalPlannerState()

    def _observe(self, setup: Setup, task: DeformTask) -> tuple[Array, NDArray[np.bool_], tuple[Walker, ...]]:
        """Add a scan to the window; return the obstacles in base, which of them the map explains, and the walkers.

        The obstacles are the scan points and, outside the view of the lidar and at blind beams, earlier ones. Points
        of walkers are no obstacles while the robot lets them pass.
        """
        pose, points = task.pose, scan_points_at(task.scan, setup.lidar, task.stamp, task.twist)
        (sensor,) = placed(np.array([setup.lidar]), pose)
        ends = points_placed(points, pose)
        mapped = self._mapped(setup, task, ends)
        walkers, walking = self._walkers(setup, task, points, mapped)
        self._window.add_scan((sensor[0], sensor[1]), pose[:2], ends, ~walking)
        before = self._window.obstacles
        beams = _beams(points_relative(before, tuple(sensor)), task.scan)
        hidden = np.isin(beams, blind_beams(task.scan)) | (beams >= len(task.scan.codes))
        points = np.vstack((points[~walking], points_relative(before[hidden], pose)))
        return points, np.concatenate((mapped[~walking], self._mapped(setup, task, before[hidden]))), walkers

    def _mapped(self, setup: Setup, task: DeformTask, ends: Array) -> NDArray[np.bool_]:
        """Whether the map explains each point (n, 2) of its frame."""
        if self._walls is None:
            return np.zeros(len(ends), np.bool_)
        tolerance = explained_within(setup.config, task.deviation) + self._walls.resolution / 2
        return np.asarray(self._walls.lookup(ends) <= tolerance)

    def _walkers(
        self, setup: Setup, task: DeformTask, points: Array, mapped: NDArray[np.bool_]
    ) -> tuple[tuple[Walker, ...], NDArray[np.bool_]]:
        """Return the walking people, and the points in base of those exempt from the obstacles."""
        none = np.zeros(len(points), np.bool_)
        if self._people is None:
            return (), none
        base = task.odometry or task.pose
        (sensor,) = points_placed(np.array([setup.lidar[:2]]), base)
        walkers, walking = self._people.observe(task.scan.stamp, points_placed(points, base), mapped, sensor)
        placed_in_map = tuple(walker.carried(base, task.pose) for walker in walkers)
        return placed_in_map, walking if self._waits(setup, task) else none

    def _waits(self, setup: Setup, task: DeformTask) -> bool:
        people, since = setup.config.local.people, self._yielding
        return since is None or (people is not None and task.scan.stamp - since <= people.patience * SECOND)

    def _yields(self, setup: Setup, task: DeformTask, here: Array, walkers: tuple[Walker, ...]) -> bool:
        """Whether the robot stops to let people pass instead of approaching them."""
        people = setup.config.local.people
        if people is None or not walkers:
            self._yielding = None
            return False
        reach = setup.speed * people.horizon
        ahead = self._ahead(here, reach)
        if self._rest is not None and self._state.path is not None:
            ahead = moved(self._state.path.part(0.0, reach).sample(0.05).poses, -self._vehicle.reference)
        times = np.linspace(0.0, people.horizon, 9)
        travelled = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(ahead[:, :2], axis=0).T))))
        poses = ahead[np.minimum(np.searchsorted(travelled, setup.speed * times), len(ahead) - 1)]
        poses[0] = task.pose
        met = meets(walkers, poses, times, setup.footprint, people.distance, people.spread)
        if met and self._yielding is None:
            self._yielding = task.scan.stamp
        # Once its patience has ended, the robot waits again when all people stand or have left.
        waits = self._waits(setup, task)
        if waits and not met:
            self._yielding = None
        return met and waits

    def _advance(self, here: Array) -> None:
        """Find the truck's place on the route, near the last place and not beyond a cusp it has not reached."""
        guide, travelled, at = self._guide, self._travelled, self._place
        # 0.5: length of route behind the truck to search (m)
        reach = np.array([-0.5, self._window.config.size / 2])
        first, last = np.searchsorted(travelled, travelled[at] + reach).tolist()
        cusps = np.flatnonzero(np.diff(guide.directions[first : at + 2]))
        first += int(cusps[-1]) if len(cusps) else 0
        directions = guide.directions[first : last + 1].copy()
        directions[:1] = directions[1:2] if len(directions) > 1 else directions
        self._place = first + nearest_pose(PosePath(guide.poses[first : last + 1], directions), here)

    def _free(self, setup: Setup, here: Array, pose: Pose2, points: Array, mapped: NDArray[np.bool_]) -> bool:
        """Whether the truck can drive the route as planned; returning to the route has stricter conditions.

        The route keeps its clearance from map obstacles. If they appear nearer, the pose is inaccurate, so only contact
        with them blocks the route.
        """
        local, guide, at = setup.config.local, self._guide, self._place
        deformed = self._rest is not None
        if deformed and pose_distance(guide.poses[at], here) > local.rejoin_distance:
            return False
        margin = local.clearance + (local.rejoin_clearance if deformed else 0.0)
        relative = poses_relative(self._ahead(here, setup.config.look_ahead), pose)
        return (
            first_contact(setup.footprint, relative, points[~mapped], margin) is None
            and first_contact(setup.footprint, relative, points[mapped]) is None
        )

    def _outside(self, setup: Setup, here: Array, pose: Pose2, zones: ZoneLayer, margin: float) -> bool:
        """Whether the route ahead keeps ``margin`` (m) away from the zones."""
        reach = setup.config.look_ahead
        edges = zones.keepout_near(pose[:2], reach + setup.footprint.circumscribed_radius + margin)
        relative = poses_relative(self._ahead(here, reach), pose)
        return first_contact(setup.footprint, relative, points_relative(edges, pose), margin) is None

    def _ahead(self, here: Array, reach: float) -> Array:
        """Return the poses of the base here and on the route ahead, up to ``reach`` (m), shape (m, 3)."""
        at = self._place
        end = int(np.searchsorted(self._travelled, self._travelled[at] + reach)) + 1
        return moved(np.vstack((here, self._guide.poses[at + 1 : end])), -self._vehicle.reference)

    def _field(
        self, setup: Setup, pose: Pose2, zones: ZoneLayer, margin: float, walkers: tuple[Walker, ...]
    ) -> DistanceField:
        """Return the distance field of window, map obstacles, zones and predicted places of people."""
        window = self._window
        closed = np.zeros(window.cells.shape, np.bool_)
        if zones.shapes:
            corner = (*window.corner, 0.0)
            closed |= zones.keepout_cells(window.cells.shape, window.config.resolution, corner, margin)
        people = setup.config.local.people
        if people is not None:
            for walker in walkers:
                # Paths lead behind a person: the ground ahead is closed over the predicted distance.
                places = walker.at(np.linspace(0.0, people.horizon, 9))
                closed |= window.discs(places, walker.radius + setup.config.local.clearance, setup.footprint, pose)
        return window.field(self._walls, closed)

    def _answer(self, result: LocalPlan) -> DeformAnswer:
        number, path = self._number, result.path
        shortest = 0.02  # minimum length of a deformed path (m)
        if path is not None and path.length < shortest and self._place == len(self._guide.poses) - 1:
            return DeformAnswer(number, "kept", result.reason, place=self._place, complete=True)
        if path is None or path.length < shortest:
            why = Reason.PATH_BLOCKED if result.reason is Reason.OK else result.reason
            return DeformAnswer(number, "blocked", why, result.text, self._place)
        if result.statistics.get("kept"):
            return DeformAnswer(number, "kept", result.reason, result.text, self._place, result.complete)
        new = path.base_path()
        return DeformAnswer(number, "new", result.reason, result.text, self._place, result.complete, new)


def _walls_of(place: Path) -> DistanceField | None:
    """Return the distances to map obstacles; None for an unreadable map: then no obstacle is a known wall."""
    try:
        world = load_map(place)
    except InputError as error:
        log.warning("%s; routes are deformed using the lidar only", error)
        return None
    return DistanceField(world.cells >= OCCUPIED, world.resolution, (*world.origin, 0.0))


def blind_beams(scan: LaserScan) -> NDArray[np.intp]:
    """Return the blind beams: like both neighbours, they report neither a range nor "no return".

    Single beams fail on edges and dark surfaces.
    """
    blind = np.pad((scan.codes > NO_ECHO) & (scan.codes != VALID_BEAM), 1, mode="edge")
    return np.flatnonzero(blind[:-2] & blind[1:-1] & blind[2:])


def _beams(points: Array, scan: LaserScan) -> NDArray[np.intp]:
    """Return the beam towards each point, shape (n, 2), in the lidar frame."""
    return nearest_beams(np.arctan2(points[:, 1], points[:, 0]), scan.start_angle, scan.angle_increment)


class DeformingWorker(DeformStep):
    """Deforming step in a worker; compiles its code on construction."""

    def __init__(self) -> None:
        super().__init__()
        cells = np.zeros((100, 100), np.bool_)
        cells[45:55, 45:55] = True
        surroundings = DistanceField(cells, 0.04)
        warm_up(make_planner(Vehicle.truck(), HybridConfig()))
        # Past the box, into it, and with the truck at it.
        for config in (RsbandConfig(effort=200), TebConfig(effort=200)):
            planner = make_local_planner(Vehicle.truck(), config)
            for y, start in ((1.2, 0.5), (2.0, 0.5), (2.36, 2.0)):
                poses = np.column_stack((np.linspace(start, 3.5, 31), np.full(31, y), np.zeros(31)))
                planner.plan(PosePath(poses, np.ones(31)), surroundings, poses[0], LocalPlannerState())
