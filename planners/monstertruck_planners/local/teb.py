"""Timed elastic band: poses and times of shortest time that keep off obstacles and within the truck's limits. Compiled.

The band keeps its way round every obstacle and its changes of direction; where it is broken a small search lays a new
one. What the least squares leave of the kinematics is taken off at the end: rows within the limits are driven from
the truck's pose, so the path is drivable exactly, and it is checked.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from monstertruck_planners.collision import DistanceField
from monstertruck_planners.local.api import DeformResult, Guide, Memory
from monstertruck_planners.local.band import rules_of, stretch
from monstertruck_planners.local.config import TebConfig
from monstertruck_planners.local.least_squares import Terms, settle
from monstertruck_planners.local.planner import Local, Surveyor, costs_of, rest_of, runs, ways
from monstertruck_planners.local.rsband import ends_at, with_robot
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.motion import MotionPath
from monstertruck_schemas.reasons import Reason

Array = NDArray[np.float64]

AXLE_LIMIT = 0.4
"""Angle that belongs to the turning radius, for the steering rate of trucks that cannot crab, rad."""

BEFORE_CUSP = 0.25
"""A band that moved its cusp away from the truck for ever would never change direction, m."""

WHOLE = 0.05
"""A path that ends further from its band's end is only a part of it, m."""

TAUT = 0.9
"""Share of the steering that the least squares may use: what they leave over has room."""


class Teb:
    """The deformer of kind ``teb``.

    Args:
        vehicle: what is driven.
        config: weights and limits.
    """

    def __init__(self, vehicle: Vehicle, config: TebConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or TebConfig()
        self._surveyor = Surveyor(vehicle, self.config, costs_of(self.config))
        self._rules = rules_of(self.config.band, self._surveyor.cover)
        self.terms = terms_of(vehicle, self.config)

    def deform(self, guide: Guide, surroundings: DistanceField, pose: ArrayLike, memory: Memory) -> DeformResult:
        """One cycle, see ``api.Deformer``.

        Raises:
            InputError: a pose that is none.
        """
        cycle = self._surveyor.begin(guide, surroundings, pose, memory)
        if isinstance(cycle, DeformResult):
            return cycle
        here, local, memory = cycle.here, cycle.local, cycle.memory
        statistics = {"searched": 0.0, "poses": 0.0, "steps": 0.0, "kept": 0.0}
        rest = rest_of(memory.path, here)[0] if memory.path is not None else None
        path = None
        if rest is None or not turns_soon(rest):
            path = self._from_band(local, surroundings, here, statistics)
        if path is None and rest is not None and self._usable(rest, local, surroundings):
            path = rest
            statistics["kept"] = 1.0
        if path is None:
            statistics["searched"] = 1.0
            found, way, why = self._surveyor.search(surroundings, here, local, memory.failed)
            if found is None:
                result = self._surveyor.partial(memory, surroundings, here, rest, why)
                return replace(result, statistics=statistics)
            path = self._settled(Guide.from_motion(found, self.config.spacing), surroundings, statistics) or found
            local = replace(local, band=way or local.band)
        done = local.final and ends_at(path, guide.poses[-1])
        end = local.band.poses[-1]
        whole = math.hypot(*(path.end - end)[:2]) < WHOLE
        band = Guide.from_motion(path, self.config.spacing) if whole else local.band
        after = replace(memory, band=band, path=path, failed=0)
        return DeformResult(Reason.OK, after, path, done, statistics=statistics)

    def _usable(self, rest: MotionPath, local: Local, surroundings: DistanceField) -> bool:
        """Whether the path so far may be kept: long enough, free, and not one that gave up before the band's end."""
        long = rest.length > self.config.shortest
        near = long and math.hypot(*(rest.end - local.band.poses[-1])[:2]) < self.config.reach / 3
        return near and self._surveyor.free(surroundings, rest)

    def _from_band(
        self, local: Local, surroundings: DistanceField, here: Array, statistics: dict[str, float]
    ) -> MotionPath | None:
        """The band at hand, deformed; None if it is broken or does not come free."""
        whole = with_robot(local.band, here)
        if len(whole.poses) < 2:
            return None
        stretched = stretch(whole, surroundings, self._surveyor.cover, self._rules)
        if stretched.guide is None:
            return None
        return self._settled(whole, surroundings, statistics)

    def _settled(self, guide: Guide, surroundings: DistanceField, statistics: dict[str, float]) -> MotionPath | None:
        """A guide after the least squares, as a path, if that is free."""
        even = resampled(guide, self.config.spacing)
        count = len(even.poses)
        band = np.empty((count, 4))
        band[:, :3] = even.poses
        band[:, 2] = np.unwrap(even.poses[:, 2])
        way = np.hypot(*np.diff(even.poses[:, :2], axis=0).T)
        speeds = np.where(even.directions > 0, self.config.speed, self.config.reverse_speed)
        band[0, 3] = 1.0
        band[1:, 3] = np.maximum(way / speeds[1:], 0.05)
        cost, steps = settle(
            surroundings.data(), self._surveyor.cover, self.terms, band, even.directions, self.config.iterations
        )
        statistics["poses"], statistics["steps"], statistics["cost"] = float(count), float(steps), float(cost)
        path = drivable(self.vehicle, self.terms, band, even.directions)
        goal = band[-1, :3]
        statistics["gap"] = float(np.hypot(*(path.end - goal)[:2]))
        if not ends_at(path, goal) or not self._surveyor.free(surroundings, path):
            return None
        return path


def terms_of(vehicle: Vehicle, config: TebConfig) -> Terms:
    """Vehicle and weights for the least squares.

    A truck that crabs has two axles as far from its reference point as its radius says; for one that cannot, the rear
    "axle" is the reference point, which moves along the heading, and the front one is a turning radius ahead.
    """
    if vehicle.crab_angle > 0.0:
        tangent = math.tan(vehicle.crab_angle)
        l_f = l_r = vehicle.radius * tangent
        front = rear = tangent
        rate = config.steering_rate
    else:
        l_f, l_r, front, rear = vehicle.radius, 0.0, 1.0, 0.0
        rate = config.steering_rate / math.tan(AXLE_LIMIT)
    return Terms(
        l_f, l_r, TAUT * front, TAUT * rear, rate, config.speed, config.reverse_speed, config.acceleration,
        config.clearance + config.margin, config.obstacle_weight, config.steering_weight, config.rate_weight,
        config.smooth_weight, config.crab_weight, config.time_weight,
    )  # fmt: skip


def drivable(vehicle: Vehicle, terms: Terms, band: Array, directions: Array) -> MotionPath:
    """Path of one exact motion for each interval, from the first pose, within the steering's limits.

    Args:
        vehicle: what is driven.
        terms: its axles.
        band: shape (n, 4), see ``settle``.
        directions: shape (n,).
    """
    half = 0.5 * np.diff(band[:, 2])
    middle = band[:-1, 2] + half
    dx, dy = np.diff(band[:, 0]), np.diff(band[:, 1])
    along, aside = np.cos(middle) * dx + np.sin(middle) * dy, np.cos(middle) * dy - np.sin(middle) * dx
    along = directions[1:] * np.maximum(directions[1:] * along, 1e-6)
    length = directions[1:] * np.hypot(along, aside) / np.sinc(half / math.pi)
    slip = np.arctan(aside / along)
    turn = 2.0 * half / length / np.cos(slip)
    reach = terms.l_f + terms.l_r
    front = np.clip(np.tan(slip) + terms.l_f * turn, -terms.front / TAUT, terms.front / TAUT)
    rear = np.clip(np.tan(slip) - terms.l_r * turn, -terms.rear / TAUT, terms.rear / TAUT)
    slip = np.arctan((terms.l_r * front + terms.l_f * rear) / reach)
    curvature = np.cos(slip) * (front - rear) / reach
    rows = np.column_stack((length, curvature, slip))[np.abs(length) > 1e-4]
    return MotionPath(band[0, :3], rows, ways(vehicle, rows), vehicle.reference)  # type: ignore[arg-type]


def turns_soon(path: MotionPath) -> bool:
    """Whether the path changes direction within the next metres: there it stays as it is."""
    signs = np.sign(path.rows[:, 0])
    change = np.flatnonzero(np.diff(signs))
    return bool(len(change)) and float(np.abs(path.rows[: change[0] + 1, 0]).sum()) < BEFORE_CUSP


def resampled(guide: Guide, spacing: float) -> Guide:
    """The same line with evenly spaced poses; ends and cusps stay."""
    poses, directions = [guide.poses[:1]], [guide.directions[:1]]
    yaw = np.unwrap(guide.poses[:, 2])
    for begin, end in runs(guide.directions):
        piece = guide.part(begin, end)
        travelled = piece.travelled
        if travelled[-1] < 1e-6:
            continue
        count = max(round(float(travelled[-1]) / spacing), 1)
        s = np.linspace(0.0, travelled[-1], count + 1)[1:]
        columns = [np.interp(s, travelled, v) for v in (*piece.poses[:, :2].T, yaw[begin:end])]
        poses.append(np.column_stack(columns))
        directions.append(np.full(count, guide.directions[end - 1]))
    return Guide(np.vstack(poses), np.concatenate(directions))
