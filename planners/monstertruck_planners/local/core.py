"""What all deformers do in each cycle: cut the route to the window, keep what is still good, search where it is not.

Compiled.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DistanceField
from monstertruck_planners.collision_kernels import FieldData, FootprintData, safe_distance
from monstertruck_planners.local.api import DeformResult, Guide, Memory, apart
from monstertruck_planners.local.config import DeformConfig
from monstertruck_planners.local.elastic_band import Cover, clearance, cover_of
from monstertruck_planners.route.api import RouteMap, Vehicle
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.hybrid import HybridPlanner
from monstertruck_planners.route.hybrid_search import RESOLUTIONS
from monstertruck_planners.route.motion import MotionPath, advance
from monstertruck_planners.route.search import CHECK_MARGIN
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.reasons import Reason

STEP = 0.01
"""Between two looks, m."""

FURTHEST = 0.3
"""Longest way out, m."""

DEEPEST = -0.05
"""A truck that overlaps an obstacle by more does not stand beside it but in it, m."""

SLACK = 2e-3
"""Clearances are told apart by more than this, m."""


@njit(cache=True)
def loosen(field: FieldData, body: FootprintData, cover: Cover, pose: Array, moves: Array, margin: float) -> Array:
    """Shortest motion out of the margin.

    Args:
        field: obstacles.
        body: footprint, for the margin.
        cover: the same, for clearances, see ``band.cover_of``.
        pose: shape (3,), where the truck stands.
        moves: shape (n, 3): motion segments that it may drive; their signs count, their lengths do not. Of equally
            long ways out the first one is taken.
        margin: wanted at the end, m.

    Returns:
        A motion row, shape (1, 3), or none, shape (0, 3).
    """
    least = clearance(field, cover, pose[0], pose[1], pose[2])
    best, shortest = -1, FURTHEST + STEP
    if least >= DEEPEST:
        for i in range(len(moves)):
            sign = 1.0 if moves[i, 0] > 0.0 else -1.0
            known, travelled = least, STEP
            while travelled < shortest - 0.5 * STEP:
                x, y, yaw = advance(pose[0], pose[1], pose[2], sign * travelled, moves[i, 1], moves[i, 2])
                here = clearance(field, cover, x, y, yaw)
                if here < known - SLACK:
                    break
                known = max(known, here)
                if safe_distance(field, body, margin, x, y, yaw) >= 0.0:
                    best, shortest = i, travelled
                    break
                travelled += STEP
    result = np.empty((1 if best >= 0 else 0, 3))
    if best >= 0:
        result[0, 0] = shortest if moves[best, 0] > 0.0 else -shortest
        result[0, 1], result[0, 2] = moves[best, 1], moves[best, 2]
    return result


CUSP_REACHED = 0.1
"""Nearer than this to a cusp of its band the truck goes on with what follows, m."""

RUN_ENDED = 0.02
"""The same on its path, m."""

STANDOFF = 0.5
"""Where nothing leads round an obstacle the truck goes on along the route up to this far before it, m."""

TURNED = (0.0, 1.0, -1.0)
"""Headings at the end of the way round, beside the route's, rad."""

PATIENCE = 5
"""Searches that fail before another heading is tried."""

LOOK_BACK = 0.05
"""Sampling of a path where the truck looks for its place on it, m."""


@dataclass(frozen=True)
class Local:
    """The route in the window."""

    band: Guide
    """From near the truck to the last pose that may be taken."""
    entered: int
    """Poses of the guide in the band, or behind."""
    final: bool
    """Whether the band ends where the guide does."""


@dataclass(frozen=True)
class Cycle:
    """How a cycle begins."""

    here: Array
    """Shape (3,): the truck's pose."""
    local: Local
    memory: Memory
    """With the band and what of the guide is in it."""


class Surveyor:
    """Shared by the deformers of one vehicle.

    Args:
        vehicle: what is driven.
        config: of the deformer.
        search: costs and effort of the local search; the margin is that of ``config``.
    """

    def __init__(self, vehicle: Vehicle, config: DeformConfig, search: HybridConfig | None = None) -> None:
        self.vehicle, self.config = vehicle, config
        self.cover = cover_of(vehicle.footprint)
        search = search or HybridConfig(effort=config.effort)
        margins = dict.fromkeys((config.margin, 0.0))
        self._planners = [HybridPlanner(vehicle, search.model_copy(update={"margin": m})) for m in margins]
        self._primitives = self._planners[0].motion_model(RESOLUTIONS[0]).primitives

    def begin(self, guide: Guide, surroundings: DistanceField, pose: ArrayLike, memory: Memory) -> Cycle | DeformResult:
        """The route cut to the window for one cycle, see ``api.Deformer``, or the result if nothing of it is free.

        Raises:
            InputError: a pose that is none.
        """
        here = checked(pose)
        if memory.guide is not guide:
            memory = Memory(guide=guide)
        local = self.cut(guide, surroundings, here, memory)
        if local is None:
            return DeformResult(Reason.PATH_BLOCKED, memory, text="no pose of the route in the window is free")
        return Cycle(here, local, replace(memory, band=local.band, entered=local.entered))

    def cut(self, guide: Guide, surroundings: DistanceField, pose: Array, memory: Memory) -> Local | None:
        """The band of the cycle before from the truck on, and poses of the guide that came into the window since.

        Returns:
            None: no pose of the route in the window may be taken.
        """
        band, entered = memory.band, memory.entered
        if band is None:
            entered = int(np.argmin(apart(guide.poses, pose)))
            near = None
        else:
            near = onward(band, pose)
        ahead = guide.part(entered, len(guide.poses)) if entered < len(guide.poses) else None
        count = 0 if ahead is None else self._seen(ahead, near, surroundings, pose)
        if ahead is not None and count:
            fresh = ahead.part(0, count)
            near = fresh if near is None else near.then(fresh)
            entered += count
        if near is None:
            return None
        return Local(near, entered, entered == len(guide.poses))

    def _seen(self, ahead: Guide, near: Guide | None, surroundings: DistanceField, pose: Array) -> int:
        """Number of guide poses that come into the band: up to the last free one that is in the window and in reach."""
        begin = 0.0 if near is None else near.travelled[-1]
        inside = self._in_window(ahead.poses, surroundings, self.config.inset)
        inside &= begin + ahead.travelled <= self.config.reach
        stop = int(np.argmin(inside)) if not inside.all() else len(inside)
        free = surroundings.free(self.vehicle.footprint, ahead.poses[:stop], self.config.margin)
        return int(np.flatnonzero(free)[-1]) + 1 if free.any() else 0

    def _in_window(self, poses: Array, surroundings: DistanceField, inset: float) -> NDArray[np.bool_]:
        """Whether the circle round the footprint is ``inset`` inside the window, for each pose."""
        rows, columns = (n - 2 for n in surroundings.data().occupied.shape)
        size = np.array([columns, rows]) * surroundings.resolution
        x, y, yaw = surroundings.origin
        dx, dy = poses[:, 0] - x, poses[:, 1] - y
        c, s = math.cos(yaw), math.sin(yaw)
        places = np.column_stack((dx * c + dy * s, dy * c - dx * s))
        inset += self.vehicle.footprint.circumscribed_radius
        return np.asarray(((places > inset) & (places < size - inset)).all(axis=1))

    def free(self, surroundings: DistanceField, path: MotionPath) -> bool:
        """Whether a path keeps the margin all the way."""
        return self._planners[0].free(RouteMap(surroundings), path)

    def free_length(self, surroundings: DistanceField, path: MotionPath) -> float:
        """Metres of a path before the first pose that does not keep the margin."""
        samples = path.sample(0.02)
        free = surroundings.free(self.vehicle.footprint, samples.poses, self.config.margin)
        if free.all():
            return path.length
        return float(samples.travelled[max(int(np.argmin(free)) - 1, 0)])

    def search(
        self, surroundings: DistanceField, pose: Array, local: Local, failed: int
    ) -> tuple[MotionPath | None, Guide | None, Reason]:
        """Way along the band by a small search, with the margin or at least without contact.

        It leads to the band's end, or if the truck has backed off so far that this is out of the window, to the last
        free pose that is not: the band may hold the way found before.

        Args:
            surroundings: obstacles.
            pose: of the truck.
            local: the band; where it does not end with the route, other headings will do there.
            failed: searches in a row that found nothing.

        Returns:
            The path and the band that follows from it, or why there are none.
        """
        band = local.band
        free = surroundings.free(self.vehicle.footprint, band.poses, self.config.margin)
        inside = np.flatnonzero(self._in_window(band.poses, surroundings, 0.0) & free)
        last = int(inside[-1]) if len(inside) else len(band.poses) - 1
        goal = band.poses[last].copy()
        if last < len(band.poses) - 1 or not local.final:
            goal[2] += TURNED[failed // PATIENCE % len(TURNED)]
        path, reason = self._way(surroundings, pose, goal)
        if path is None:
            return None, None, reason
        found = Guide.from_motion(path)
        rest = band.part(last + 1, len(band.poses)) if last + 1 < len(band.poses) else None
        return path, found if rest is None else found.then(rest), Reason.OK

    def _way(self, surroundings: DistanceField, pose: Array, goal: Array) -> tuple[MotionPath | None, Reason]:
        """Path to a goal; a truck nearer to something than the margin first goes away from it."""
        out = self.loosened(surroundings, pose)
        if out is not None:
            pose = out.end
        reason = Reason.PATH_BLOCKED
        for planner in self._planners:
            result = planner.plan(RouteMap(surroundings), pose, goal)
            if result.path is not None and len(result.path.segments):
                return result.path if out is None else out.then(result.path), Reason.OK
            reason = result.reason
            if reason is not Reason.START_BLOCKED and reason is not Reason.GOAL_BLOCKED:
                break
        return None, reason

    def loosened(self, surroundings: DistanceField, pose: Array) -> MotionPath | None:
        """Way out of the margin of what is too near; None if nothing is, or there is no such way."""
        if surroundings.free(self.vehicle.footprint, pose[None], self.config.margin)[0]:
            return None
        segments = loosen(
            surroundings.data(),
            self._planners[0].footprint,
            self.cover,
            pose,
            self._primitives,
            self.config.margin + CHECK_MARGIN,
        )
        return MotionPath(pose, segments, self.vehicle.steering, self.vehicle.reference) if len(segments) else None

    def cost(self, surroundings: DistanceField, path: MotionPath) -> float:
        """What a path costs, m."""
        return self._planners[0].cost(RouteMap(surroundings), path)

    def partial(
        self, memory: Memory, surroundings: DistanceField, here: Array, rest: MotionPath | None, why: Reason
    ) -> DeformResult:
        """What may be driven though there is no way on: the beginning of the path so far, or of the route."""
        reason = why if why is Reason.START_BLOCKED else Reason.PATH_BLOCKED
        text = f"the local search says: {why.text}"
        if rest is not None:
            length = self.free_length(surroundings, rest)
            length -= self.config.shortest if length < rest.length else 0.0
            if length >= self.config.shortest:
                part = rest.part(0.0, length)
                return DeformResult(
                    Reason.PATH_PARTIAL, replace(memory, path=rest, failed=memory.failed + 1), part, text=text
                )
        if memory.band is not None and reason is Reason.PATH_BLOCKED:
            way = self._approach(memory.band, surroundings, here)
            if way is not None:
                return DeformResult(
                    Reason.PATH_PARTIAL, replace(memory, path=way, failed=memory.failed + 1), way, text=text
                )
        return DeformResult(reason, replace(memory, path=None, failed=memory.failed + 1), text=text)

    def _approach(self, band: Guide, surroundings: DistanceField, here: Array) -> MotionPath | None:
        """Motion along the band to some distance before what blocks it; None if the truck is there."""
        free = surroundings.free(self.vehicle.footprint, band.poses, self.config.margin)
        broken = len(free) if free.all() else int(np.argmin(free))
        travelled = band.travelled
        first_run = next(end for _, end in runs(band.directions))
        near = np.flatnonzero(travelled[:first_run] <= travelled[max(broken - 1, 0)] - STANDOFF)
        if not len(near) or travelled[near[-1]] < self.config.shortest:
            return None
        path = self.vehicle.reeds_shepp().path(here, band.poses[near[-1]])
        return path if path.cusps == 0 and self.free(surroundings, path) else None


def checked(pose: ArrayLike) -> Array:
    """A pose (x, y, yaw).

    Raises:
        InputError: it is none.
    """
    here = np.array(pose, dtype=np.float64)
    if here.shape != (3,) or not np.isfinite(here).all():
        raise InputError("deformation: expected the truck's pose as three finite numbers")
    return here


def costs_of(config: DeformConfig) -> HybridConfig:
    """Costs of local searches and motions."""
    names = ("reverse_cost", "cusp_cost", "crab_cost", "clearance_cost", "effort")
    return HybridConfig(**{name: getattr(config, name) for name in names})


def onward(band: Guide, pose: Array) -> Guide:
    """The band from the truck on; a cusp that is reached belongs to what follows it."""
    at = passed(band, pose)
    rest = band.part(at, len(band.poses))
    if len(rest.poses) > 1 and math.hypot(*(rest.poses[0] - pose)[:2]) <= CUSP_REACHED:
        directions = rest.directions.copy()
        directions[0] = directions[1]
        return Guide(rest.poses, directions)
    return rest


def passed(band: Guide, pose: Array) -> int:
    """Index of the band's pose nearest to the truck, not beyond a cusp that the truck has not reached."""
    for begin, end in runs(band.directions):
        at = begin + int(np.argmin(apart(band.poses[begin:end], pose)))
        last = band.poses[end - 1]
        if end == len(band.poses) or math.hypot(last[0] - pose[0], last[1] - pose[1]) > CUSP_REACHED:
            return at
    return 0


def runs(directions: Array) -> Iterator[tuple[int, int]]:
    """Runs of one direction as index ranges; the pose at a cusp, which ends one, also begins the next one."""
    cuts = [*np.flatnonzero(np.diff(directions)).tolist(), len(directions) - 1]
    begin = 0
    for cut in cuts:
        yield begin, cut + 1
        begin = cut


def rest_of(path: MotionPath, pose: Array) -> tuple[MotionPath, float]:
    """A path from the place nearest to the truck on, and how far (m, plus 0.3 m a radian) the truck is from it."""
    samples = path.sample(LOOK_BACK)
    best, begin, far = math.inf, 0.0, math.inf
    first = 0
    for cut in [*np.flatnonzero(np.diff(samples.direction)).tolist(), len(samples.travelled) - 1]:
        s, away = _place(path, samples.poses, samples.travelled, first, cut, pose)
        if away < best:
            best, begin, far = away, s, away
        if samples.travelled[cut] - begin > RUN_ENDED:
            break
        first = cut
    return path.part(begin, math.inf), far


def _place(path: MotionPath, poses: Array, travelled: Array, first: int, last: int, pose: Array) -> tuple[float, float]:
    """Metres along the path to the pose nearest to the truck among two samples and all between, and how far it is."""
    near = first + int(np.argmin(apart(poses[first : last + 1], pose)))
    low, high = travelled[max(near - 1, first)], travelled[min(near + 1, last)]
    x, y, _ = poses[near]
    course = poses[min(near + 1, last), :2] - poses[max(near - 1, first), :2]
    long = math.hypot(*course)
    ahead = 0.0 if long < 1e-9 else float(((pose[0] - x) * course[0] + (pose[1] - y) * course[1]) / long)
    s = min(max(float(travelled[near]) + ahead, float(low)), float(high))
    foot = path.part(s, s + 1e-3).start
    return s, float(apart(foot, pose))


def ways(vehicle: Vehicle, segments: Array) -> tuple[str, ...]:
    """How each row's wheels are set."""
    names = []
    for _, turn, slip in segments.tolist():
        names.append(vehicle.steering if slip == 0.0 else "hybrid" if turn else "crab")
    return tuple(names)
