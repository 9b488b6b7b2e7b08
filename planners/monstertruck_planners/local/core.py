"""Shared parts of the local planners: the route cut to the window, the rest of the last path, the local search.

Loads numba.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import points_relative
from monstertruck_planners.collision import DistanceField
from monstertruck_planners.collision_kernels import FieldData, FootprintData, safe_distance
from monstertruck_planners.local.api import LocalPlan, LocalPlannerState
from monstertruck_planners.local.config import LocalPlannerConfig
from monstertruck_planners.local.elastic_band import CoveringDiscs, clearance, cover_footprint
from monstertruck_planners.pose_path import CUSP_REACHED, PosePath, direction_runs, nearest_pose, pose_distance
from monstertruck_planners.route.api import RouteMap, Vehicle
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.hybrid import RESOLUTIONS, HybridPlanner
from monstertruck_planners.route.motion import MotionPath, advance
from monstertruck_planners.route.search import CHECK_MARGIN
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.reasons import Reason

PATH_CUSP_REACHED = 0.02
"""Distance to a cusp of its path within which the truck continues with the part after the cusp (m)."""


@njit(cache=True)
def escape_motion(
    field: FieldData, footprint: FootprintData, cover: CoveringDiscs, pose: Array, primitives: Array, margin: float
) -> Array:
    """Return the shortest motion to a pose that keeps the margin, with no part of the truck nearing an obstacle.

    Args:
        field: distance field of the obstacles.
        footprint: footprint for the margin.
        cover: discs of the footprint for clearances, see ``cover_footprint``.
        pose: pose of the truck, shape (3,), nearer to an obstacle than the margin.
        primitives: permitted segments, shape (n, 3): signs, curvatures and sideslips. Of equally long motions the first
            one is chosen.
        margin: required at the end (m).

    Returns:
        A motion segment, shape (1, 3), or none, shape (0, 3).
    """
    least = clearance(field, cover, pose[0], pose[1], pose[2])
    escape_step = 0.01  # distance between two checks of an escape motion, m
    best, shortest = -1, 0.3 + escape_step  # maximum length of an escape motion, m
    if least >= -0.05:  # a truck with a larger overlap has no escape motion, m
        for i in range(len(primitives)):
            sign = 1.0 if primitives[i, 0] > 0.0 else -1.0
            known, travelled = least, escape_step
            while travelled < shortest - 0.5 * escape_step:
                x, y, yaw = advance(pose[0], pose[1], pose[2], sign * travelled, primitives[i, 1], primitives[i, 2])
                present = clearance(field, cover, x, y, yaw)
                if present < known - 2e-3:  # clearances that differ by less count as equal, m
                    break
                known = max(known, present)
                if safe_distance(field, footprint, margin, x, y, yaw) >= 0.0:
                    best, shortest = i, travelled
                    break
                travelled += escape_step
    result = np.empty((1 if best >= 0 else 0, 3))
    if best >= 0:
        result[0, 0] = shortest if primitives[best, 0] > 0.0 else -shortest
        result[0, 1], result[0, 2] = primitives[best, 1], primitives[best, 2]
    return result


@dataclass(frozen=True)
class CycleStart:
    """State at the start of a cycle."""

    robot_pose: Array
    """Pose of the truck, shape (3,)."""
    band: PosePath
    """Route in the window, from the truck to the last free pose."""
    state: LocalPlannerState
    """State with the new band."""


class LocalPlannerCore:
    """Window, collision checks and local search of one vehicle.

    Args:
        vehicle: steered vehicle.
        config: configuration of the local planner.
        search: costs and effort of the local search; the margin is that of ``config``.
    """

    def __init__(self, vehicle: Vehicle, config: LocalPlannerConfig, search: HybridConfig | None = None) -> None:
        self.vehicle, self.config = vehicle, config
        self.cover = cover_footprint(vehicle.footprint)
        search = search or HybridConfig(effort=config.effort)
        margins = dict.fromkeys((config.margin, 0.0))
        self._planners = [
            HybridPlanner(vehicle, search.model_copy(update={"margin": m}), departs=False) for m in margins
        ]
        self._primitives = self._planners[0].motion_model(RESOLUTIONS[0], vehicle.crab_angle).primitives

    def begin(
        self, route: PosePath, obstacles: DistanceField, pose: ArrayLike, state: LocalPlannerState
    ) -> CycleStart | LocalPlan:
        """Cut the route to the window for one cycle, see ``LocalPlanner``; return the result if none of it is free.

        Raises:
            InputError: the pose is not finite or has a wrong shape.
        """
        robot_pose = checked_pose(pose)
        if state.route is not route:
            state = LocalPlannerState(route=route)
        cut = self.cut(route, obstacles, robot_pose, state)
        if cut is None:
            return LocalPlan(Reason.PATH_BLOCKED, state, text="no pose of the route within the window is free")
        band, entered = cut
        return CycleStart(robot_pose, band, replace(state, band=band, entered=entered))

    def cut(
        self, route: PosePath, obstacles: DistanceField, pose: Array, state: LocalPlannerState
    ) -> tuple[PosePath, int] | None:
        """Return the rest of the last cycle's band from the truck on, with the route poses new in the window.

        Returns:
            The band, and the number of route poses that are in it or behind the truck; None if no route pose in the
            window is free.
        """
        band, entered = state.band, state.entered
        if band is None:
            entered = int(np.argmin(pose_distance(route.poses, pose)))
            near = None
        else:
            near = remaining_band(band, pose)
        ahead = route.part(entered, len(route.poses)) if entered < len(route.poses) else None
        count = 0 if ahead is None else self._entered(ahead, near, obstacles, pose)
        if ahead is not None and count:
            fresh = ahead.part(0, count)
            near = fresh if near is None else near.then(fresh)
            entered += count
        if near is None:
            return None
        return near, entered

    def _entered(self, ahead: PosePath, near: PosePath | None, obstacles: DistanceField, pose: Array) -> int:
        """Return the number of route poses that join the band: up to the last free one within the window and reach."""
        begin = 0.0 if near is None else near.travelled[-1]
        inside = self._in_window(ahead.poses, obstacles, self.config.inset)
        inside &= begin + ahead.travelled <= self.config.reach
        stop = int(np.argmin(inside)) if not inside.all() else len(inside)
        free = obstacles.free(self.vehicle.footprint, ahead.poses[:stop], self.config.margin)
        return int(np.flatnonzero(free)[-1]) + 1 if free.any() else 0

    def _in_window(self, poses: Array, obstacles: DistanceField, inset: float) -> NDArray[np.bool_]:
        """Whether the circle around the footprint is ``inset`` inside the window, for each pose."""
        rows, columns = (n - 2 for n in obstacles.data().occupied.shape)
        size = np.array([columns, rows]) * obstacles.resolution
        places = points_relative(poses, obstacles.origin)
        inset += self.vehicle.footprint.circumscribed_radius
        return np.asarray(((places > inset) & (places < size - inset)).all(axis=1))

    def free(self, obstacles: DistanceField, path: MotionPath) -> bool:
        """Whether a path keeps the margin throughout."""
        return self._planners[0].free(RouteMap(obstacles), path)

    def free_length(self, obstacles: DistanceField, path: MotionPath) -> float:
        """Return the length of a path before the first pose without the margin (m)."""
        samples = path.sample(0.02)
        free = obstacles.free(self.vehicle.footprint, samples.poses, self.config.margin)
        if free.all():
            return path.length
        return float(samples.travelled[max(int(np.argmin(free)) - 1, 0)])

    def search(
        self, obstacles: DistanceField, pose: Array, band: PosePath, failed: int, *, final: bool
    ) -> tuple[MotionPath | None, PosePath | None, Reason]:
        """Search a path along the band with little effort, with the margin or at least without contact.

        It leads to the band's end, or to its last free pose in the window: the band may be the path of an earlier
        search, and the truck may have backed off so far that its end is out of the window.

        Args:
            obstacles: obstacles in the window.
            pose: pose of the truck.
            band: route in the window.
            failed: number of successive searches without a result.
            final: whether the band ends with the route; otherwise other headings are accepted.

        Returns:
            The path and the band that follows from it, or the reason why there are none.
        """
        free = obstacles.free(self.vehicle.footprint, band.poses, self.config.margin)
        inside = np.flatnonzero(self._in_window(band.poses, obstacles, 0.0) & free)
        last = int(inside[-1]) if len(inside) else len(band.poses) - 1
        goal = band.poses[last].copy()
        # headings tried at the goal of a local search, relative to the route, rad
        goal_headings = (0.0, 1.0, -1.0)
        if last < len(band.poses) - 1 or not final:
            # 5: number of searches without a result before another heading is tried
            goal[2] += goal_headings[failed // 5 % len(goal_headings)]
        path, reason = self._search_to(obstacles, pose, goal)
        if path is None:
            return None, None, reason
        found = path.along()
        rest = band.part(last + 1, len(band.poses)) if last + 1 < len(band.poses) else None
        return path, found if rest is None else found.then(rest), Reason.OK

    def _search_to(self, obstacles: DistanceField, pose: Array, goal: Array) -> tuple[MotionPath | None, Reason]:
        """Search a path to a goal; a truck nearer to an obstacle than the margin first moves away."""
        out = self.leave_margin(obstacles, pose)
        if out is not None:
            pose = out.end
        reason = Reason.PATH_BLOCKED
        for planner in self._planners:
            result = planner.plan(RouteMap(obstacles), pose, goal)
            if result.path is not None and len(result.path.segments):
                return result.path if out is None else out.then(result.path), Reason.OK
            reason = result.reason
            if reason is not Reason.START_BLOCKED and reason is not Reason.GOAL_BLOCKED:
                break
        return None, reason

    def leave_margin(self, obstacles: DistanceField, pose: Array) -> MotionPath | None:
        """Return a motion to a pose that keeps the margin; None if the truck keeps it, or there is no such motion."""
        if obstacles.free(self.vehicle.footprint, pose[None], self.config.margin)[0]:
            return None
        footprint, margin = self._planners[0].footprint, self.config.margin + CHECK_MARGIN
        segments = escape_motion(obstacles.data(), footprint, self.cover, pose, self._primitives, margin)
        return MotionPath(pose, segments, self.vehicle.steering, self.vehicle.reference) if len(segments) else None

    def partial(
        self,
        state: LocalPlannerState,
        obstacles: DistanceField,
        pose: Array,
        rest: MotionPath | None,
        why: Reason,
    ) -> LocalPlan:
        """Return a result without a complete path: the free part of the last path, or an approach along the route."""
        reason = why if why is Reason.START_BLOCKED else Reason.PATH_BLOCKED
        text = f"local search: {why.text}"
        after = replace(state, path=None, failed=state.failed + 1)
        if rest is not None:
            length = self.free_length(obstacles, rest)
            length -= self.config.shortest if length < rest.length else 0.0
            if length >= self.config.shortest:
                return LocalPlan(Reason.PATH_PARTIAL, replace(after, path=rest), rest.part(0.0, length), text=text)
        if state.band is not None and reason is Reason.PATH_BLOCKED:
            path = self._approach(state.band, obstacles, pose)
            if path is not None:
                return LocalPlan(Reason.PATH_PARTIAL, replace(after, path=path), path, text=text)
        return LocalPlan(reason, after, text=text)

    def _approach(self, band: PosePath, obstacles: DistanceField, robot_pose: Array) -> MotionPath | None:
        """Return the motion along the band to 0.5 m before the obstacle; None if the truck is already there."""
        free = obstacles.free(self.vehicle.footprint, band.poses, self.config.margin)
        broken = len(free) if free.all() else int(np.argmin(free))
        travelled = band.travelled
        first_run = next(end for _, end in direction_runs(band.directions))
        # 0.5: distance at which a truck without a way around an obstacle stops its approach along the route, m
        near = np.flatnonzero(travelled[:first_run] <= travelled[max(broken - 1, 0)] - 0.5)
        if not len(near) or travelled[near[-1]] < self.config.shortest:
            return None
        path = self.vehicle.reeds_shepp().path(robot_pose, band.poses[near[-1]])
        return path if path.cusps == 0 and self.free(obstacles, path) else None


def checked_pose(pose: ArrayLike) -> Array:
    """Return a valid pose (x, y, yaw).

    Raises:
        InputError: it is invalid.
    """
    robot_pose = np.array(pose, dtype=np.float64)
    if robot_pose.shape != (3,) or not np.isfinite(robot_pose).all():
        raise InputError("local planner: expected the robot's pose as three finite numbers")
    return robot_pose


def costs_of(config: LocalPlannerConfig) -> HybridConfig:
    """Return the costs of local searches and motions."""
    names = ("reverse_cost", "cusp_cost", "crab_cost", "clearance_cost", "effort")
    return HybridConfig(**{name: getattr(config, name) for name in names})


def remaining_band(band: PosePath, pose: Array) -> PosePath:
    """Return the band from the truck on; a reached cusp belongs to the following direction."""
    at = nearest_pose(band, pose)
    rest = band.part(at, len(band.poses))
    if len(rest.poses) > 1 and math.hypot(*(rest.poses[0] - pose)[:2]) <= CUSP_REACHED:
        directions = rest.directions.copy()
        directions[0] = directions[1]
        return PosePath(rest.poses, directions)
    return rest


def remaining_path(path: MotionPath, pose: Array) -> tuple[MotionPath, float]:
    """Return a path from its pose nearest to the truck on, and the distance of that pose, see ``pose_distance``."""
    samples = path.sample(0.05)  # sampling of a path to find the nearest pose on it, m
    best, begin, far = math.inf, 0.0, math.inf
    first = 0
    for cut in [*np.flatnonzero(np.diff(samples.direction)).tolist(), len(samples.travelled) - 1]:
        s, away = _nearest_on_path(path, samples.poses, samples.travelled, first, cut, pose)
        if away < best:
            best, begin, far = away, s, away
        if samples.travelled[cut] - begin > PATH_CUSP_REACHED:
            break
        first = cut
    return path.part(begin, math.inf), far


def _nearest_on_path(
    path: MotionPath, poses: Array, travelled: Array, first: int, last: int, pose: Array
) -> tuple[float, float]:
    """Return the length along the path (m) to the pose nearest to the truck between two samples, and its distance."""
    near = first + int(np.argmin(pose_distance(poses[first : last + 1], pose)))
    low, high = travelled[max(near - 1, first)], travelled[min(near + 1, last)]
    x, y, _ = poses[near]
    course = poses[min(near + 1, last), :2] - poses[max(near - 1, first), :2]
    long = math.hypot(*course)
    ahead = 0.0 if long < 1e-9 else float(((pose[0] - x) * course[0] + (pose[1] - y) * course[1]) / long)
    s = min(max(float(travelled[near]) + ahead, float(low)), float(high))
    foot = path.part(s, s + 1e-3).start
    return s, float(pose_distance(foot, pose))


def starting_at(band: PosePath, robot_pose: Array) -> PosePath:
    """Return a band that begins at the truck; its first pose is dropped if it lies behind or at the truck."""
    first = band.poses[0]
    if len(band.poses) > 1:
        step = band.poses[1, :2] - first[:2]
        behind = float((first[:2] - robot_pose[:2]) @ step) <= 0.02 * float(np.hypot(*step))
        if behind and band.directions[0] == band.directions[1]:
            band = band.part(1, len(band.poses))
    return PosePath(robot_pose[None], band.directions[:1]).then(band)


def ends_at(path: MotionPath, goal: Array) -> bool:
    """Whether a path ends at a pose, within 5 cm and 0.09 rad."""
    away = path.end - goal
    turned = abs(float(np.remainder(away[2] + np.pi, 2 * np.pi) - np.pi))
    return float(np.hypot(away[0], away[1])) < 0.05 and turned < 0.09
