"""Options of explorers: the frontiers of a map, a viewpoint for each, and the paths there. Loads numba."""

import math
from dataclasses import dataclass
from dataclasses import field as attribute
from typing import Final, Protocol, cast

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.explore.catalog import EXPLORERS
from monstertruck_planners.explore.config import ExplorerConfig
from monstertruck_planners.explore.exchange import ExploreSetup, Point, Viewpoint
from monstertruck_planners.explore.frontier import FrontierMap
from monstertruck_planners.explore.kernels import far_from_obstacles, new_areas, shares_seen
from monstertruck_planners.goals.plan_step import ASSUMED_FREE, standing_free
from monstertruck_planners.route.api import RouteCosts, RouteMap, Vehicle
from monstertruck_planners.route.config import DriveCosts
from monstertruck_planners.route.heuristic import (
    UNIT,
    UNREACHED,
    CostToGo,
    cell_ahead,
    cell_at,
    cells_to_goal,
    complete,
    cost_to_go,
)

AROUND: Final = 3.0
"""Maximum distance of a viewpoint from its frontier (m)."""
LEAST_NEW_AREA: Final = 0.06
"""Minimum new area of a viewpoint (m^2)."""
BEHIND: Final = 4
"""Number of coarse cells used to measure the direction of a path."""
SIDEWARD: Final = 0.4
"""Margin of a frontier inside the angle of view (rad)."""
ASIDE: Final = tuple(math.radians(angle) for angle in (0.0, 45.0, -45.0, 90.0, -90.0))
"""Headings to try, relative to the direction of the frontier (rad), if the robot has no room to face it."""


@dataclass(frozen=True)
class Frontier:
    """Connected cells at the edge of the known area."""

    points: Array
    """Cell centres in the map frame (m), shape (n, 2)."""
    middle: Point
    """Cell centre nearest to the mean (m)."""
    length: float
    """Approximate length (m)."""


@dataclass(frozen=True)
class Viewpoints:
    """Viewpoints of a frontier; valid until the map changes around it."""

    change: int
    """Number of the latest map change."""
    reached: int
    """Number of reachable coarse cells around the frontier."""
    places: Array = attribute(default_factory=lambda: np.empty((0, 2)))
    """Positions (m), shape (n, 2)."""
    bearings: Array = attribute(default_factory=lambda: np.empty(0))
    """Directions of the frontier from the positions (rad), shape (n,)."""
    headings: Array = attribute(default_factory=lambda: np.empty(0))
    """Headings with the frontier in view and room for the robot (rad), shape (n,)."""
    gains: Array = attribute(default_factory=lambda: np.empty(0))
    """New area seen with these headings (m^2), shape (n,)."""


@dataclass(frozen=True)
class Option:
    """A frontier and its viewpoint."""

    frontier: Frontier
    pose: Pose2
    path_length: float
    """Path length (m), with a penalty in narrow places."""
    gain: float
    """Expected new area (m^2)."""
    turn: float
    """Angle between the heading of the robot and the first part of the path (rad), 0 to pi."""

    @property
    def target(self) -> Viewpoint:
        """Viewpoint for the goal service."""
        return Viewpoint(self.pose, self.frontier.middle, self.path_length, self.gain)


class Explorer(Protocol):
    """Chooses the next viewpoint; called repeatedly while the robot drives."""

    def choose(
        self, view: "ExplorationView", pursued: Viewpoint | None, still: Option | None, seconds: float
    ) -> Viewpoint | None:
        """Return the next viewpoint; ``pursued`` itself to continue.

        Args:
            view: map and options.
            pursued: current viewpoint.
            still: option that now corresponds to ``pursued``; None if its frontier is gone.
            seconds: time since the robot set course for ``pursued`` (s).
        """


@dataclass
class Remembered:
    """Cached results, recomputed only where the map has changed."""

    route_map: RouteMap | None = None
    looks: dict[bytes, Viewpoints] = attribute(default_factory=dict)
    """Viewpoints by the cells of a frontier."""


@dataclass
class ExplorationView:
    """Map as seen by an explorer.

    Args:
        known: map with its frontiers.
        setup: robot, sensor and settings.
        pose: pose of the base in the map frame.
        banned: places whose frontiers are not options.
        avoided: places without viewpoints.
        memory: cache of the previous view.
    """

    known: FrontierMap
    setup: ExploreSetup
    pose: Pose2
    banned: tuple[Point, ...]
    avoided: tuple[Point, ...]
    memory: Remembered
    options: list[Option] = attribute(init=False, default_factory=list)
    left_alone: int = attribute(init=False, default=0)
    """Number of banned frontiers."""

    def __post_init__(self) -> None:
        setup, known = self.setup, self.known
        vehicle = Vehicle(setup.footprint, setup.radius)
        place = known.resolution, known.origin
        cells = standing_free(known.cells, *place, setup.footprint, self.pose, ASSUMED_FREE)
        route_map = RouteMap.from_cells(
            cells, known.resolution, known.origin, "blocked", previous=self.memory.route_map
        )
        self.memory.route_map = self._route_map = route_map
        self._field = route_map.field.data()
        self._costs = RouteCosts.of(vehicle, DriveCosts(margin=setup.margin))
        self._cell = route_map.coarse_cell
        self._cell_cost = route_map.cell_costs(self._costs)
        self._to_go = self._flood(self.pose[:2])
        if self._to_go is not None:
            self.options = self._find_options(self._to_go)

    # Path lengths

    def path_length_to(self, place: Point) -> float | None:
        """Return the path length to a place (m), with a penalty in narrow places; None if no path is known."""
        if self._to_go is None:
            return None
        at = self._open_cell(place)
        cost = UNREACHED if at is None else int(self._to_go.cost[at])
        return None if cost >= UNREACHED else cost * self._cell / UNIT

    def free(self, poses: Array) -> NDArray[np.bool_]:
        """Return whether the robot can stand at each pose; poses of shape (n, 3), result of shape (n,)."""
        return np.asarray(self._route_map.field.free(self.setup.footprint, poses, self.setup.margin), np.bool_)

    def _flood(self, place: Point) -> CostToGo | None:
        at = self._open_cell(place)
        if at is None:
            return None
        to_go = cost_to_go(self._cell_cost, self._cell, at, at, 0, math.inf)
        complete(to_go)
        return to_go

    def _open_cell(self, place: Point) -> tuple[int, int] | None:
        """Return the open cell nearest to a place, if there is one nearby."""
        row, column = cell_at(self._field, self._cell, *place)
        reach = math.ceil(0.6 / self._cell)  # maximum distance from the robot to the open cell that starts a path (m)
        top, left = max(row - reach, 0), max(column - reach, 0)
        rows, columns = np.nonzero(self._cell_cost[top : max(row + reach + 1, 0), left : max(column + reach + 1, 0)])
        if not len(rows):
            return None
        nearest = int(np.argmin((rows + top - row) ** 2 + (columns + left - column) ** 2))
        return int(rows[nearest]) + top, int(columns[nearest]) + left

    # Frontiers

    def _find_options(self, to_go: CostToGo) -> list[Option]:
        options = []
        seen: dict[bytes, Viewpoints] = {}
        reached = to_go.cost < UNREACHED
        for frontier in self._frontiers():
            # 0.5: frontiers with their centre within this distance of a banned place are skipped (m)
            if any(math.dist(frontier.middle, place) < 0.5 for place in self.banned):
                self.left_alone += 1
                continue
            key = (frontier.points + self.known.resolution / 4).round(2).tobytes()
            near = self._reached_near(reached, frontier)
            look = self.memory.looks.get(key)
            # 1.0: a result is valid until the map changes within this distance of such places (m)
            if (
                look is None
                or look.reached != len(near)
                or self.known.changed_within(frontier.middle, AROUND + 1.0) > look.change
            ):
                look = self._look(frontier, near)
            seen[key] = look
            option = self._option(frontier, look, to_go)
            if option is not None:
                options.append(option)
        self.memory.looks = seen
        return options

    def _centres(self, coarse: NDArray[np.int64]) -> Array:
        """Return the centres of coarse cells (row, column) (m), shape (n, 2)."""
        return np.asarray((coarse[:, ::-1] + 0.5) * self._cell + (self._field.x, self._field.y), dtype=np.float64)

    def _frontiers(self) -> list[Frontier]:
        known, resolution = self.known, self.known.resolution
        labels, count = label(known.frontier, np.ones((3, 3)))
        if not count:
            return []
        rows, columns = np.nonzero(known.frontier)
        of = labels[rows, columns]
        least = self.setup.config.smallest / resolution
        kept = np.bincount(of)[of] >= least
        rows, columns, of = rows[kept], columns[kept], of[kept]
        if not len(of):
            return []
        centres = (np.column_stack((columns, rows)) + 0.5) * resolution + known.origin[:2]
        # Frontiers between obstacles too close together for the robot are unreachable.
        roomy = far_from_obstacles(known.cells, rows, columns, self._passable / resolution)
        result = []
        order = np.argsort(of, kind="stable")
        for group in np.split(order, np.flatnonzero(np.diff(of[order])) + 1):
            for part in _divided(centres[group], 2.5):  # maximum length of a frontier before it is divided (m)
                members = group[part]
                if len(members) < least or not roomy[members].any():
                    continue
                points = centres[members]
                middle = points[np.argmin(np.hypot(*(points - points.mean(axis=0)).T))]
                result.append(Frontier(points, (float(middle[0]), float(middle[1])), len(members) * resolution))
        return result

    @property
    def _passable(self) -> float:
        return self.setup.footprint.half_width - self.known.resolution / 2

    def _reached_near(self, reached: NDArray[np.bool_], frontier: Frontier) -> NDArray[np.int64]:
        """Return the reachable coarse cells (row, column) in a square around a frontier, shape (n, 2)."""
        row, column = cell_at(self._field, self._cell, *frontier.middle)
        reach = math.ceil(AROUND / self._cell)
        top, left = max(row - reach, 0), max(column - reach, 0)
        near = np.argwhere(reached[top : row + reach + 1, left : column + reach + 1])
        near += (top, left)
        return near

    def _look(self, frontier: Frontier, near: NDArray[np.int64]) -> Viewpoints:
        """Find places with room, a view of enough of the frontier, and nearly as much new area as the best place.

        Free space is checked first: the places with the best view are often at the edge of unknown ground, which
        blocks.
        """
        config, resolution, corner = self.setup.config, self.known.resolution, self.known.origin[:2]
        change, reached = self.known.changes, len(near)
        places = self._centres(near)
        places = places[np.hypot(*(places - frontier.middle).T) < AROUND]
        if not len(places):
            return Viewpoints(change, reached)
        places, bearings, headings = self._with_room(places, frontier)
        if not len(places):
            return Viewpoints(change, reached)
        some = _spread(len(places), 160)  # viewpoints per frontier compared by the visible share of it
        places, bearings, headings = places[some], bearings[some], headings[some]
        sample = frontier.points[_spread(len(frontier.points), 12)]  # frontier cells tested for visibility
        here, there = ((v - corner) / resolution for v in (places, sample))
        # 0.5: margin on the sensor range for visibility (m)
        share = shares_seen(self.known.cells, here, there, (config.reach - 0.5) / resolution)
        if share.max(initial=0.0) == 0.0:
            return Viewpoints(change, reached)
        good = np.flatnonzero(share >= min(0.6, float(share.max())))  # minimum visible share of a frontier
        good = good[_spread(len(good), 32)]  # number of these compared by new area
        gains = self.gains(np.column_stack((places[good], headings[good])))
        # 0.6: minimum new area relative to the best place
        worth = gains >= max(0.6 * float(gains.max()), LEAST_NEW_AREA)
        good = good[worth]
        return Viewpoints(change, reached, places[good], bearings[good], headings[good], gains[worth])

    def _with_room(self, places: Array, frontier: Frontier) -> tuple[Array, Array, Array]:
        """Return the places (n, 2) with room for the footprint, the directions of the frontier there, and headings."""
        bearings = np.arctan2(*(frontier.middle - places).T[::-1])
        aside = [angle for angle in ASIDE if abs(angle) < self.setup.config.view / 2 - SIDEWARD or angle == 0.0]
        headings = bearings[:, None] + aside
        poses = np.column_stack((np.repeat(places, len(aside), axis=0), headings.ravel()))
        free = self.free(poses).reshape(headings.shape)
        room = free.any(axis=1)
        first = np.argmax(free[room], axis=1)
        return places[room], bearings[room], headings[room, first]

    def _option(self, frontier: Frontier, look: Viewpoints, to_go: CostToGo) -> Option | None:
        """Return the nearest viewpoint of a frontier."""
        if not len(look.places):
            return None
        rows, columns = np.floor((look.places - (self._field.x, self._field.y)) / self._cell).astype(int).T[::-1]
        cost = to_go.cost[rows, columns]
        for i in np.argsort(cost, kind="stable"):
            if cost[i] >= UNREACHED:
                break
            x, y = look.places[i].tolist()
            # 0.25: radius around an avoided place without viewpoints (m)
            if any(math.dist((x, y), place) <= 0.25 for place in self.avoided):
                continue
            at = int(rows[i]), int(columns[i])
            yaw = self._heading(to_go, at, float(look.bearings[i]))
            if not self.free(np.array([(x, y, yaw)]))[0]:
                yaw = float(look.headings[i])
            length = float(cost[i]) * self._cell / UNIT
            return Option(frontier, (x, y, yaw), length, float(look.gains[i]), self._turn(to_go, at))
        return None

    def gains(self, poses: Array) -> Array:
        """Return the new area seen from each base pose (m^2), shape (n,); poses of shape (n, 3)."""
        config, resolution = self.setup.config, self.known.resolution
        mx, my, turn = self.setup.lidar
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        sensor = np.column_stack((poses[:, 0] + c * mx - s * my, poses[:, 1] + s * mx + c * my, poses[:, 2] + turn))
        sensor[:, :2] = (sensor[:, :2] - self.known.origin[:2]) / resolution
        depth = getattr(config, "depth", 1.0)  # see ``new_area`` (m)
        cells = new_areas(self.known.cells, sensor, config.view, config.reach / resolution, depth / resolution, 96)
        area: Array = cells * resolution**2
        return area

    def _heading(self, to_go: CostToGo, at: tuple[int, int], bearing: float) -> float:
        """Return the arrival heading at a coarse cell if it has a frontier at ``bearing`` in view, else ``bearing``."""
        before = cell_ahead(to_go.step, *at, float(BEHIND))
        if before == at:
            return bearing
        arriving = math.atan2(at[0] - before[0], at[1] - before[1])
        in_view = abs(math.remainder(bearing - arriving, math.tau)) < self.setup.config.view / 2 - SIDEWARD
        return arriving if in_view else bearing

    def _turn(self, to_go: CostToGo, at: tuple[int, int]) -> float:
        """Return the angle between the heading of the robot and the first part of the path to a cell (rad)."""
        trail = cells_to_goal(to_go.step, *at)
        if len(trail) < 2:
            return 0.0
        there = self._centres(trail[max(len(trail) - 1 - 2 * BEHIND, 0)][None])[0]
        bearing = math.atan2(there[1] - self.pose[1], there[0] - self.pose[0])
        return abs(math.remainder(bearing - self.pose[2], math.tau))


def _spread(count: int, most: int) -> NDArray[np.intp]:
    """Return at most ``most`` evenly spaced numbers below ``count``."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))


def _divided(points: Array, longest: float) -> list[NDArray[np.intp]]:
    """Split points (n, 2) into parts no longer than ``longest`` (m) by halving; return their indices."""
    waiting, parts = [np.arange(len(points))], []
    while waiting:
        part = waiting.pop()
        spread = points[part] - points[part].mean(axis=0)
        _, directions = np.linalg.eigh(spread.T @ spread)
        along = spread @ directions[:, 1]
        if np.ptp(along) <= longest:
            parts.append(part)
        else:
            middle = np.median(along)
            halves = part[along <= middle], part[along > middle]
            waiting.extend(half for half in halves if len(half))
    return parts


def make_explorer(config: ExplorerConfig) -> Explorer:
    """Create the explorer of a configuration.

    Raises:
        InputError: settings without a kind of explorer, or a missing dependency.
    """
    return cast("Explorer", EXPLORERS.build(config, config))
