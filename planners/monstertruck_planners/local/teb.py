"""Timed elastic band (TEB): poses and times of shortest time, with clearance, within the truck's limits. Loads numba.

The band keeps its homotopy class and its changes of direction; where it is broken a local search finds a new one. At
the end, remaining violations of constraints are removed: segments within the limits are driven from the truck's pose,
so the path is exactly drivable, and it is checked for collisions. Source of the timed band: C. Roesmann and others,
"Trajectory modification considering dynamic constraints of autonomous robots", 2012.

Least squares with analytic derivatives and banded normal equations. The unknowns are x, y, yaw of each pose and the
time of the interval before it. A residual depends on at most three neighbouring poses, so the normal matrix has eleven
diagonals next to the main one. An interval is expressed in the frame of its middle heading: ``a`` metres along, ``b``
across, turned by ``d``. The front axle has then moved b + l_f d sideways and the rear axle b - l_r d, and the tangents
of their angles are these over a: linear where a curvature would be singular.
"""

import math
from dataclasses import replace
from math import cos, hypot, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DistanceField
from monstertruck_planners.collision_kernels import FieldData
from monstertruck_planners.local.api import LocalPlan, LocalPlannerState
from monstertruck_planners.local.config import TebConfig
from monstertruck_planners.local.core import (
    LocalPlannerCore,
    costs_of,
    ends_at,
    remaining_path,
    starting_at,
)
from monstertruck_planners.local.elastic_band import CoveringDiscs, band_parameters, distance_and_gradient, relax_band
from monstertruck_planners.pose_path import PosePath, direction_runs
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.motion import MotionPath
from monstertruck_schemas.reasons import Reason

WIDTH = 12
"""Number of unknowns per residual, and of diagonals of the matrix."""

LEAST_STEP = 0.01
"""Minimum distance in an interval (m)."""

LEAST_TIME = 0.02
"""Minimum time of an interval (s)."""


class TebParameters(NamedTuple):
    """Vehicle, limits and weights."""

    l_f: float
    l_r: float
    """Distances of the axles ahead of and behind the reference point (m)."""
    front: float
    rear: float
    """Maximum tangents of the axle angles."""
    rate: float
    """Maximum rate of both tangents (1/s)."""
    speed: float
    reverse: float
    acceleration: float
    clearance: float
    """Preferred clearance (m)."""
    w_obstacle: float
    w_steering: float
    w_rate: float
    w_smooth: float
    w_crab: float
    w_time: float


class NormalEquations(NamedTuple):
    """Normal equations of one linearisation."""

    matrix: Array
    """Shape (4 n, WIDTH): lower diagonals; [i, k] couples the unknowns i and i - k."""
    gradient: Array
    jacobian: Array
    """Derivatives of the current residual, shape (WIDTH,)."""


@njit(cache=True)
def _add(system: NormalEquations, base: int, residual: float) -> float:
    """Add a residual with its derivatives in ``jacobian``, first unknown ``base``; clear the jacobian."""
    jacobian = system.jacobian
    for i in range(WIDTH):
        if jacobian[i] == 0.0:
            continue
        system.gradient[base + i] += jacobian[i] * residual
        for j in range(i + 1):
            system.matrix[base + i, i - j] += jacobian[i] * jacobian[j]
    for i in range(WIDTH):
        jacobian[i] = 0.0
    return residual * residual


@njit(cache=True)
def _interval(band: Array, i: int, out: Array) -> None:
    """Compute a, b, d, and cosine and sine of the middle heading, of the interval before pose i."""
    middle = 0.5 * (band[i - 1, 2] + band[i, 2])
    c, s = cos(middle), sin(middle)
    dx, dy = band[i, 0] - band[i - 1, 0], band[i, 1] - band[i - 1, 1]
    out[0], out[1], out[2] = c * dx + s * dy, c * dy - s * dx, band[i, 2] - band[i - 1, 2]
    out[3], out[4] = c, s


@njit(cache=True)
def _spread(jacobian: Array, at: int, v: Array, da: float, db: float, dd: float, dt: float) -> None:
    """Add the derivatives by the unknowns, from those by a, b, d, t of an interval; ``at``: index of its first x."""
    c, s = v[3], v[4]
    gx, gy = da * c - db * s, da * s + db * c
    turn = 0.5 * (da * v[1] - db * v[0])
    jacobian[at] -= gx
    jacobian[at + 1] -= gy
    jacobian[at + 2] += turn - dd
    jacobian[at + 4] += gx
    jacobian[at + 5] += gy
    jacobian[at + 6] += turn + dd
    jacobian[at + 7] += dt


@njit(cache=True)
def _interval_terms(
    parameters: TebParameters, band: Array, direction: Array, i: int, system: NormalEquations, v: Array
) -> float:
    """Add the residuals of the interval before pose i."""
    total = 0.0
    base = 4 * (i - 1)
    jacobian, sign, t = system.jacobian, direction[i], band[i, 3]
    _interval(band, i, v)
    ahead = sign * v[0]
    if ahead < LEAST_STEP:
        _spread(jacobian, 0, v, -sign * parameters.w_steering, 0.0, 0.0, 0.0)
        total += _add(system, base, parameters.w_steering * (LEAST_STEP - ahead))
    for axle in range(2):
        arm = parameters.l_f if axle == 0 else -parameters.l_r
        limit = parameters.front if axle == 0 else parameters.rear
        aside = v[1] + arm * v[2]
        over = abs(aside) - limit * max(ahead, 0.0)
        if over > 0.0:
            side = 1.0 if aside > 0.0 else -1.0
            w = parameters.w_steering
            _spread(jacobian, 0, v, -w * limit * sign if ahead > 0.0 else 0.0, w * side, w * side * arm, 0.0)
            total += _add(system, base, w * over)
    jacobian[7] = parameters.w_time
    total += _add(system, base, parameters.w_time * t)
    limit = parameters.speed if sign > 0.0 else parameters.reverse
    long = hypot(v[0], v[1])
    if long > limit * t and long > 1e-9:
        w = 10.0 * parameters.w_rate
        _spread(jacobian, 0, v, w * v[0] / long, w * v[1] / long, 0.0, -w * limit)
        total += _add(system, base, w * (long - limit * t))
    if t < LEAST_TIME:
        jacobian[7] = -10.0
        total += _add(system, base, 10.0 * (LEAST_TIME - t))
    if parameters.rear > 0.0:
        _spread(jacobian, 0, v, 0.0, parameters.w_crab * 10.0, 0.0, 0.0)
        total += _add(system, base, parameters.w_crab * 10.0 * v[1])
    return total


@njit(cache=True)
def _pair_terms(
    parameters: TebParameters, band: Array, direction: Array, i: int, system: NormalEquations, v: Array, u: Array
) -> float:
    """Add the residuals of the intervals before and after pose i."""
    total = 0.0
    base, jacobian = 4 * (i - 1), system.jacobian
    _interval(band, i, v)
    _interval(band, i + 1, u)
    t0, t1 = band[i, 3], band[i + 1, 3]
    v0, v1 = v[0] / t0, u[0] / t1
    change = v1 - v0
    over = abs(change) - parameters.acceleration * 0.5 * (t0 + t1)
    if over > 0.0:
        w = parameters.w_rate * (1.0 if change > 0.0 else -1.0)
        half = 0.5 * parameters.w_rate * parameters.acceleration
        _spread(jacobian, 0, v, -w / t0, 0.0, 0.0, w * v0 / t0 - half)
        _spread(jacobian, 4, u, w / t1, 0.0, 0.0, -w * v1 / t1 - half)
        total += _add(system, base, parameters.w_rate * over)
    if direction[i] != direction[i + 1] or abs(v[0]) < LEAST_STEP or abs(u[0]) < LEAST_STEP:
        return total
    for axle in range(2):
        if axle == 1 and parameters.rear <= 0.0:
            continue
        arm = parameters.l_f if axle == 0 else -parameters.l_r
        f0, f1 = (v[1] + arm * v[2]) / v[0], (u[1] + arm * u[2]) / u[0]
        turned = f1 - f0
        over = abs(turned) - parameters.rate * 0.5 * (t0 + t1)
        for kind in range(2):
            if kind == 1 and over <= 0.0:
                continue
            w = parameters.w_smooth if kind == 0 else parameters.w_rate * (1.0 if turned > 0.0 else -1.0)
            half = 0.0 if kind == 0 else 0.5 * parameters.w_rate * parameters.rate
            _spread(jacobian, 0, v, w * f0 / v[0], -w / v[0], -w * arm / v[0], -half)
            _spread(jacobian, 4, u, -w * f1 / u[0], w / u[0], w * arm / u[0], -half)
            total += _add(system, base, w * turned if kind == 0 else parameters.w_rate * over)
    return total


@njit(cache=True)
def _obstacles(
    field: FieldData, cover: CoveringDiscs, parameters: TebParameters, band: Array, i: int, system: NormalEquations
) -> float:
    """Add the residuals of the clearance of pose i."""
    total = 0.0
    x, y = band[i, 0], band[i, 1]
    c, s = cos(band[i, 2]), sin(band[i, 2])
    for k in range(len(cover.x)):
        ox, oy = cover.x[k] * c - cover.y[k] * s, cover.x[k] * s + cover.y[k] * c
        value, gx, gy = distance_and_gradient(field, x + ox, y + oy)
        lack = parameters.clearance - (value - cover.radius[k])
        if lack > 0.0:
            w = parameters.w_obstacle / sqrt(len(cover.x))
            system.jacobian[0], system.jacobian[1], system.jacobian[2] = -w * gx, -w * gy, -w * (gy * ox - gx * oy)
            total += _add(system, 4 * i, w * lack)
    return total


@njit(cache=True)
def _assemble(
    field: FieldData,
    cover: CoveringDiscs,
    parameters: TebParameters,
    band: Array,
    direction: Array,
    system: NormalEquations,
) -> float:
    """Add all residuals of a band; return the sum of their squares."""
    n = len(band)
    system.matrix[:] = 0.0
    system.gradient[:] = 0.0
    system.jacobian[:] = 0.0
    v, u = np.empty(5), np.empty(5)
    total = 0.0
    for i in range(1, n):
        total += _interval_terms(parameters, band, direction, i, system, v)
        if i < n - 1:
            total += _pair_terms(parameters, band, direction, i, system, v, u)
            total += _obstacles(field, cover, parameters, band, i, system)
    return total


@njit(cache=True)
def _solve(matrix: Array, vector: Array) -> bool:
    """Solve a banded positive definite system in place (Cholesky); return False if it is not definite."""
    n = len(vector)
    for i in range(n):
        first = max(0, i - WIDTH + 1)
        for j in range(first, i + 1):
            value = matrix[i, i - j]
            for k in range(max(first, j - WIDTH + 1), j):
                value -= matrix[i, i - k] * matrix[j, j - k]
            if i == j:
                if value <= 0.0:
                    return False
                matrix[i, 0] = sqrt(value)
            else:
                matrix[i, i - j] = value / matrix[j, 0]
    for i in range(n):
        value = vector[i]
        for k in range(max(0, i - WIDTH + 1), i):
            value -= matrix[i, i - k] * vector[k]
        vector[i] = value / matrix[i, 0]
    for i in range(n - 1, -1, -1):
        value = vector[i]
        for k in range(i + 1, min(n, i + WIDTH)):
            value -= matrix[k, k - i] * vector[k]
        vector[i] = value / matrix[i, 0]
    return True


@njit(cache=True)
def optimise(
    field: FieldData, cover: CoveringDiscs, parameters: TebParameters, band: Array, direction: Array, iterations: int
) -> tuple[float, int]:
    """Execute Levenberg-Marquardt steps; the first and the last pose stay.

    Args:
        field: obstacles.
        cover: footprint.
        parameters: vehicle, limits, weights.
        band: shape (n, 4): x, y, yaw (continuous), seconds of the interval before; changed in place.
        direction: shape (n,), +1 or -1: direction of the interval before.
        iterations: maximum number of steps.

    Returns:
        Half the sum of squares at the end, and the number of successful steps.
    """
    n = len(band)
    size = 4 * n
    system = NormalEquations(np.zeros((size + WIDTH, WIDTH)), np.zeros(size + WIDTH), np.zeros(WIDTH))
    total = _assemble(field, cover, parameters, band, direction, system)
    damping, gained = 1e-3, 0
    trial = band.copy()
    for _ in range(iterations):
        matrix, step = system.matrix[:size].copy(), -system.gradient[:size]
        for i in range(size):
            matrix[i, 0] += damping * (matrix[i, 0] + 1.0)
        for i in range(size):
            if i < 4 or size - 4 <= i < size - 1:
                matrix[i, 0] += 1.0e9  # added to the diagonal of fixed unknowns
                step[i] = 0.0
        if not _solve(matrix, step):
            damping *= 10.0
            continue
        for i in range(1, n):
            for k in range(3):
                trial[i, k] = band[i, k] + step[4 * i + k]
            trial[i, 3] = max(band[i, 3] + step[4 * i + 3], 0.5 * LEAST_TIME)
        new = _assemble(field, cover, parameters, trial, direction, system)
        if new < total:
            gained += 1
            done = total - new < 1e-4 * total
            band[:] = trial
            total, damping = new, max(0.3 * damping, 1e-6)
            if done:
                break
        else:
            damping *= 8.0
            _assemble(field, cover, parameters, band, direction, system)
    return 0.5 * total, gained


STEERING_SHARE = 0.9
"""Fraction of the steering range for the least squares; the rest is a reserve for their remaining violations."""


class TebPlanner:
    """Local planner of kind ``teb``.

    Args:
        vehicle: body, axles and limits of the robot.
        config: weights and limits.
    """

    def __init__(self, vehicle: Vehicle, config: TebConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or TebConfig()
        self._core = LocalPlannerCore(vehicle, self.config, costs_of(self.config))
        self._band_parameters = band_parameters(self.config.band, self._core.cover)
        self.parameters = teb_parameters(vehicle, self.config)

    def plan(self, route: PosePath, obstacles: DistanceField, pose: ArrayLike, state: LocalPlannerState) -> LocalPlan:
        """Execute one cycle, see ``LocalPlanner``."""
        cycle = self._core.begin(route, obstacles, pose, state)
        if isinstance(cycle, LocalPlan):
            return cycle
        robot_pose, ahead, state = cycle.robot_pose, cycle.band, cycle.state
        statistics = {"searched": 0.0, "poses": 0.0, "steps": 0.0, "kept": 0.0}
        rest = remaining_path(state.path, robot_pose)[0] if state.path is not None else None
        path = None
        if rest is None or not turns_soon(rest):
            path = self._from_band(ahead, obstacles, robot_pose, statistics)
        if path is None and rest is not None and self._usable(rest, ahead, obstacles):
            path = rest
            statistics["kept"] = 1.0
        if path is None:
            statistics["searched"] = 1.0
            found, way, why = self._core.search(obstacles, robot_pose, ahead, state.failed, final=state.final)
            if found is None:
                result = self._core.partial(state, obstacles, robot_pose, rest, why)
                return replace(result, statistics=statistics)
            path = self._optimised(found.along(self.config.spacing), obstacles, statistics) or found
            ahead = way or ahead
        done = state.final and ends_at(path, route.poses[-1])
        end = ahead.poses[-1]
        # 0.05: distance between the ends of path and band above which the path is only a part, m
        whole = math.hypot(*(path.end - end)[:2]) < 0.05
        band = path.along(self.config.spacing) if whole else ahead
        after = replace(state, band=band, path=path, failed=0)
        return LocalPlan(Reason.OK, after, path, done, statistics=statistics)

    def _usable(self, rest: MotionPath, ahead: PosePath, obstacles: DistanceField) -> bool:
        """Whether the last path can be kept: it is long enough, free, and does not end before the band."""
        long = rest.length > self.config.shortest
        near = long and math.hypot(*(rest.end - ahead.poses[-1])[:2]) < self.config.reach / 3
        return near and self._core.free(obstacles, rest)

    def _from_band(
        self, ahead: PosePath, obstacles: DistanceField, robot_pose: Array, statistics: dict[str, float]
    ) -> MotionPath | None:
        """Return the optimised band; None if it is broken or not free."""
        whole = starting_at(ahead, robot_pose)
        if len(whole.poses) < 2:
            return None
        stretched = relax_band(whole, obstacles, self._core.cover, self._band_parameters)
        if stretched.path is None:
            return None
        return self._optimised(whole, obstacles, statistics)

    def _optimised(self, poses: PosePath, obstacles: DistanceField, statistics: dict[str, float]) -> MotionPath | None:
        """Return the poses after the least squares as a path, if that is free."""
        even = resampled(poses, self.config.spacing)
        count = len(even.poses)
        band = np.empty((count, 4))
        band[:, :3] = even.poses
        band[:, 2] = np.unwrap(even.poses[:, 2])
        way = np.hypot(*np.diff(even.poses[:, :2], axis=0).T)
        speeds = np.where(even.directions > 0, self.config.speed, self.config.reverse_speed)
        band[0, 3] = 1.0
        band[1:, 3] = np.maximum(way / speeds[1:], 0.05)
        cost, steps = optimise(
            obstacles.data(), self._core.cover, self.parameters, band, even.directions, self.config.iterations
        )
        statistics["poses"], statistics["steps"], statistics["cost"] = float(count), float(steps), float(cost)
        path = drivable(self.vehicle, self.parameters, band, even.directions)
        goal = band[-1, :3]
        statistics["gap"] = float(np.hypot(*(path.end - goal)[:2]))
        if not ends_at(path, goal) or not self._core.free(obstacles, path):
            return None
        return path


def teb_parameters(vehicle: Vehicle, config: TebConfig) -> TebParameters:
    """Return vehicle and weights for the least squares.

    The axles of a truck that crabs are as far from its reference point as its radius implies; for one that cannot, the
    rear "axle" is the reference point, which moves along the heading, and the front one is a turning radius ahead.
    """
    if vehicle.crab_angle > 0.0:
        tangent = math.tan(vehicle.crab_angle)
        l_f = l_r = vehicle.radius * tangent
        front = rear = tangent
        rate = config.steering_rate
    else:
        l_f, l_r, front, rear = vehicle.radius, 0.0, 1.0, 0.0
        # 0.4: axle angle at the minimum turning radius, for the steering rate of trucks that cannot crab, rad
        rate = config.steering_rate / math.tan(0.4)
    return TebParameters(
        l_f, l_r, STEERING_SHARE * front, STEERING_SHARE * rear, rate,
        config.speed, config.reverse_speed, config.acceleration,
        config.clearance + config.margin, config.obstacle_weight, config.steering_weight, config.rate_weight,
        config.smooth_weight, config.crab_weight, config.time_weight,
    )  # fmt: skip


def drivable(vehicle: Vehicle, parameters: TebParameters, band: Array, directions: Array) -> MotionPath:
    """Return a path of one exact motion for each interval, from the first pose, within the steering limits.

    Args:
        vehicle: body, axles and limits of the robot.
        parameters: parameters of its axles.
        band: shape (n, 4), see ``optimise``.
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
    reach = parameters.l_f + parameters.l_r
    front = np.clip(
        np.tan(slip) + parameters.l_f * turn, -parameters.front / STEERING_SHARE, parameters.front / STEERING_SHARE
    )
    rear = np.clip(
        np.tan(slip) - parameters.l_r * turn, -parameters.rear / STEERING_SHARE, parameters.rear / STEERING_SHARE
    )
    slip = np.arctan((parameters.l_r * front + parameters.l_f * rear) / reach)
    curvature = np.cos(slip) * (front - rear) / reach
    segments = np.column_stack((length, curvature, slip))[np.abs(length) > 1e-4]
    return MotionPath(band[0, :3], segments, _steering_modes(vehicle, segments), vehicle.reference)  # type: ignore[arg-type]


def turns_soon(path: MotionPath) -> bool:
    """Whether the path changes direction soon."""
    signs = np.sign(path.segments[:, 0])
    change = np.flatnonzero(np.diff(signs))
    # 0.25: distance to a cusp within which the path is kept, m: otherwise a band could move its cusp away forever
    return bool(len(change)) and float(np.abs(path.segments[: change[0] + 1, 0]).sum()) < 0.25


def resampled(path: PosePath, spacing: float) -> PosePath:
    """Return the same line with evenly spaced poses; ends and cusps stay."""
    poses, directions = [path.poses[:1]], [path.directions[:1]]
    yaw = np.unwrap(path.poses[:, 2])
    for begin, end in direction_runs(path.directions):
        piece = path.part(begin, end)
        travelled = piece.travelled
        if travelled[-1] < 1e-6:
            continue
        count = max(round(float(travelled[-1]) / spacing), 1)
        s = np.linspace(0.0, travelled[-1], count + 1)[1:]
        columns = [np.interp(s, travelled, v) for v in (*piece.poses[:, :2].T, yaw[begin:end])]
        poses.append(np.column_stack(columns))
        directions.append(np.full(count, path.directions[end - 1]))
    return PosePath(np.vstack(poses), np.concatenate(directions))


def _steering_modes(vehicle: Vehicle, segments: Array) -> tuple[str, ...]:
    """Return the steering mode of each segment."""
    return tuple(
        vehicle.steering if slip == 0.0 else "hybrid" if curvature else "crab"
        for _, curvature, slip in segments.tolist()
    )
