"""The published planner with the faults of its sources, for comparison. Loads numba.

These faults are kept: the turning radius is 1.0 m for every truck; bubbles use only the inscribed circle, and half of
the clearance; forces and distances ignore headings, and the force before is wrongly summed; the truck's centre must be
outside of the inflation, so a truck near a wall finds no path; headings always point ahead, and a last heading of
exactly 0 is overwritten; ``skip_failures`` leaves a gap after its first motion, where the path ends; only the band is
kept from one cycle to the next; differences of the emergency turn are not wrapped. The sampling tree of its Reeds-Shepp
planner is replaced by our deterministic search, the better of the two.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DiscFootprint, DistanceField
from monstertruck_planners.local import elastic_band
from monstertruck_planners.local.api import LocalPlan, LocalPlannerState
from monstertruck_planners.local.config import BandConfig, PublishedConfig
from monstertruck_planners.local.core import LocalPlannerCore, checked_pose, ends_at
from monstertruck_planners.local.elastic_band import band_parameters, relax_band
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.motion import MotionPath, joined, moved
from monstertruck_schemas.reasons import Reason

AUTHORS = BandConfig(overlap=0.3, significant=0.1, largest=0.276)
"""Parameters of the author's robot."""

TURN_STEP, TURN_MORE = math.radians(45.0), 0.5
"""Angles of an emergency turn (rad)."""


class PublishedPlanner:
    """The local planner of kind ``rsband-as-published``.

    Args:
        vehicle: the robot; results are paths of the base, whatever its reference point.
        config: settings.
    """

    def __init__(self, vehicle: Vehicle, config: PublishedConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or PublishedConfig()
        search = HybridConfig(
            improve=False, effort=self.config.effort, cusp_cost=0.0, swing_cost=0.0, clearance_cost=0.0
        )
        config = self.config.model_copy(update={"margin": 0.0})
        states = Vehicle(DiscFootprint((0.0,), self.config.inflation), self.config.radius, 0.0, vehicle.steering)
        self._states = LocalPlannerCore(states, config, search)
        self._reeds_shepp = states.reeds_shepp()
        # 0.17: half the truck's width, m
        self._band = LocalPlannerCore(replace(states, footprint=DiscFootprint((0.0,), 0.17)), config)
        self._band_parameters = band_parameters(AUTHORS, self._band.cover)._replace(
            scale=0.5, reach=0.0, spacing=math.inf, published=True
        )

    def plan(self, route: PosePath, obstacles: DistanceField, pose: ArrayLike, state: LocalPlannerState) -> LocalPlan:
        """Execute one cycle, see ``LocalPlanner``."""
        robot_pose = moved(checked_pose(pose), -self.vehicle.reference)
        if state.route is not route:
            state = LocalPlannerState(route=route)
        ahead_only = PosePath(moved(route.poses, -self.vehicle.reference), np.ones(len(route.poses)))
        before = replace(state, band=self._pruned(state.band, obstacles, robot_pose))
        cut = self._band.cut(ahead_only, obstacles, robot_pose, before)
        if cut is None:
            return LocalPlan(Reason.PATH_BLOCKED, state, text="no pose of the route within the window is free")
        ahead, entered = cut
        whole = PosePath(np.vstack((robot_pose, ahead.poses)), np.ones(len(ahead.poses) + 1))
        band = relax_band(whole, obstacles, self._band.cover, self._band_parameters)
        if band.path is None:
            return LocalPlan(Reason.PATH_BLOCKED, LocalPlannerState(route=route), text="the band is broken")
        state = replace(state, band=band.path.part(1, len(band.path.poses)), entered=entered)
        poses = oriented(band.path.poses)
        path = self._joined(poses, obstacles)
        behind = abs(poses[0, 2] - poses[1, 2]) > math.pi / 2
        if path is None or behind:
            return self._emergency(state, obstacles, poses)
        goal = ahead_only.poses[-1]
        return LocalPlan(Reason.OK, replace(state, turning=()), path, state.final and ends_at(path, goal))

    def _pruned(self, band: PosePath | None, obstacles: DistanceField, robot_pose: Array) -> PosePath | None:
        """Return the band, starting at its furthest bubble that touches the truck's bubble."""
        if band is None:
            return None
        field, cover = obstacles.data(), self._band.cover
        own = 0.5 * elastic_band.clearance(field, cover, *robot_pose)
        radii = [0.5 * elastic_band.clearance(field, cover, *pose) for pose in band.poses]
        reach = self._band_parameters.overlap * (
            np.minimum(radii, self._band_parameters.largest) + min(own, self._band_parameters.largest)
        )
        touching = np.flatnonzero(np.hypot(*(band.poses[:, :2] - robot_pose[:2]).T) < reach)
        return band.part(int(touching[-1]) if len(touching) else 0, len(band.poses))

    def _join(self, obstacles: DistanceField, robot_pose: Array, goal: Array) -> MotionPath | None:
        path = self._reeds_shepp.path(robot_pose, goal)
        if len(path.segments) and self._states.free(obstacles, path):
            return path
        end = PosePath(goal[None], np.ones(1))
        return self._states.search(obstacles, robot_pose, end, 0, final=True)[0]

    def _joined(self, poses: Array, obstacles: DistanceField) -> MotionPath | None:
        """Return the path of the configured strategy."""
        strategy, last = self.config.strategy, len(poses) - 1
        if strategy == "start_to_end":
            return self._join(obstacles, poses[0], poses[last])
        if strategy == "start_to_next":
            travelled = PosePath(poses, np.ones(len(poses))).travelled
            near = min(int(np.searchsorted(travelled, self.config.sub_goal)), last)
            return self._join(obstacles, poses[0], poses[near])
        if strategy == "start_to_receding_end":
            tries = (self._join(obstacles, poses[0], poses[i]) for i in range(last, 0, -1))
            return next((path for path in tries if path is not None), None)
        legs: list[MotionPath] = []
        for pose in poses[1:]:
            leg = self._join(obstacles, legs[-1].end if legs else poses[0], pose)
            if leg is not None:
                legs.append(leg)
            if (leg is None) != (strategy == "skip_failures"):
                break
        return joined(legs) if legs else None

    def _emergency(self, state: LocalPlannerState, obstacles: DistanceField, poses: Array) -> LocalPlan:
        """Execute an emergency turn: back to its start, turned a step further towards the wanted heading."""
        text = "no Reeds-Shepp motion found"
        if self.config.emergency:
            turning = state.turning or (*poses[0].tolist(), float(poses[1, 2]))
            state = replace(state, turning=turning)
            x, y, yaw, wanted = turning
            sign = 1.0 if wanted > yaw else -1.0
            steps = math.floor(abs(poses[0, 2] - yaw) / TURN_STEP) + 1
            goal = np.array([x, y, yaw + sign * (steps * TURN_STEP + TURN_MORE)])
            path = self._join(obstacles, poses[0], goal)
            if path is not None:
                return LocalPlan(Reason.OK, state, path, statistics={"emergency": 1.0})
            text += ", nor an emergency turn"
        return LocalPlan(Reason.PATH_BLOCKED, state, text=text)


def oriented(poses: Array) -> Array:
    """Return headings by the published rule: towards the next pose; the last one is kept unless it is exactly 0."""
    result = poses.copy()
    steps = np.diff(poses[:, :2], axis=0)
    course = np.arctan2(steps[:, 1], steps[:, 0])
    result[1:-1, 2] = course[1:]
    if result[-1, 2] == 0.0:
        result[-1, 2] = result[-2, 2]
    return result
