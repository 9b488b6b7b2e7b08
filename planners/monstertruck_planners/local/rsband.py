"""Elastic band, then Reeds-Shepp motions of the truck's own turning radius that join its poses. Loads numba.

The five strategies of the published planner: one motion to the band's end, to the next sub-goal, from pose to pose
until one fails, the same without the poses that fail, and to the furthest reachable pose. If they fail, a local search
replaces them; a path is kept while it is free.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DistanceField
from monstertruck_planners.local.api import LocalPlan, LocalPlannerState
from monstertruck_planners.local.config import RsbandConfig
from monstertruck_planners.local.core import (
    PATH_CUSP_REACHED,
    LocalPlannerCore,
    costs_of,
    ends_at,
    remaining_path,
    starting_at,
)
from monstertruck_planners.local.elastic_band import band_parameters, relax_band
from monstertruck_planners.pose_path import CUSP_REACHED, PosePath, direction_runs, pose_distance
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.motion import MotionPath, joined
from monstertruck_schemas.reasons import Reason


class RsbandPlanner:
    """Local planner of kind ``rsband``.

    Args:
        vehicle: body and its limits.
        config: strategy and limits.
    """

    def __init__(self, vehicle: Vehicle, config: RsbandConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or RsbandConfig()
        costs = costs_of(self.config)
        self._reeds_shepp = vehicle.reeds_shepp(costs)
        self._core = LocalPlannerCore(vehicle, self.config, costs)
        self._band_parameters = band_parameters(self.config.band, self._core.cover)
        strategy: Callable[[PosePath, DistanceField, Array], MotionPath | None] = getattr(
            self, f"_{self.config.strategy}"
        )
        self._strategy = strategy

    def plan(self, route: PosePath, obstacles: DistanceField, pose: ArrayLike, state: LocalPlannerState) -> LocalPlan:
        """Execute one cycle, see ``LocalPlanner``."""
        cycle = self._core.begin(route, obstacles, pose, state)
        if isinstance(cycle, LocalPlan):
            return cycle
        robot_pose, band, state = cycle.robot_pose, cycle.band, cycle.state
        rest, far = remaining_path(state.path, robot_pose) if state.path is not None else (None, 0.0)
        ended_there = rest is not None and ends_at(rest, route.poses[-1])
        if (
            rest is not None
            and self._worth_keeping(rest, far, to_end=ended_there, to_cusp=ends_at_cusp(rest, band))
            and self._core.free(obstacles, rest)
        ):
            kept = replace(state, path=rest)
            return LocalPlan(Reason.OK, kept, rest, ended_there, statistics={"kept": 1.0})
        return self._new_path(band, obstacles, robot_pose, state, rest)

    def _worth_keeping(self, rest: MotionPath, far: float, *, to_end: bool, to_cusp: bool) -> bool:
        if far > self.config.off_path or not len(rest.segments):
            return False
        if to_end or to_cusp:
            # 0.05: remaining length at which a path to a cusp is replaced, m
            return rest.length > (PATH_CUSP_REACHED if to_end else 0.05)
        return rest.length > self.config.renew * self.config.sub_goal

    def _new_path(
        self,
        ahead: PosePath,
        obstacles: DistanceField,
        robot_pose: Array,
        state: LocalPlannerState,
        rest: MotionPath | None,
    ) -> LocalPlan:
        """Relax the band and join its poses; search if that fails."""
        whole = starting_at(ahead, robot_pose)
        band = relax_band(whole, obstacles, self._core.cover, self._band_parameters)
        statistics = {
            "kept": 0.0,
            "bubbles": float(len(band.radii)),
            "searched": 0.0,
            "broken": float(band.path is None),
        }
        if band.path is not None:
            path = self._strategy(band.path, obstacles, robot_pose)
            if path is not None:
                after = replace(state, band=band.path.part(1, len(band.path.poses)), path=path, failed=0)
                done = ends_at(path, state.route.poses[-1])  # type: ignore[union-attr]
                return LocalPlan(Reason.OK, after, path, done, statistics=statistics)
        statistics["searched"] = 1.0
        path, band_of_path, why = self._core.search(obstacles, robot_pose, ahead, state.failed, final=state.final)
        if path is None:
            result = self._core.partial(state, obstacles, robot_pose, rest, why)
            return replace(result, statistics=statistics)
        after = replace(state, band=band_of_path, path=path, failed=0)
        done = ends_at(path, state.route.poses[-1])  # type: ignore[union-attr]
        return LocalPlan(Reason.OK, after, path, done, statistics=statistics)

    def _join(self, obstacles: DistanceField, robot_pose: Array, goal: Array) -> MotionPath | None:
        """Return the best motion between two poses if it is free."""
        path = self._reeds_shepp.path(robot_pose, goal)
        return path if len(path.segments) and self._core.free(obstacles, path) else None

    def _start_to_end(self, band: PosePath, obstacles: DistanceField, robot_pose: Array) -> MotionPath | None:
        return self._join(obstacles, robot_pose, band.poses[-1])

    def _start_to_next(self, band: PosePath, obstacles: DistanceField, robot_pose: Array) -> MotionPath | None:
        """Return a motion to the first pose at the sub-goal's distance, or further without a change of direction."""
        travelled = band.travelled
        end = next(
            end
            for _, end in direction_runs(band.directions)
            if travelled[end - 1] > CUSP_REACHED or end == len(travelled)
        )
        found = None
        tried = -1
        for factor in (1.0, 1.5, 2.0, 3.0):  # sub-goals tried, as factors on their distance
            last = min(int(np.searchsorted(travelled, factor * self.config.sub_goal)), end - 1)
            if last == tried:
                break
            tried = last
            path = self._join(obstacles, robot_pose, band.poses[last])
            if path is None:
                continue
            if path.cusps == 0:
                return path
            if found is None or path.length + self.config.sub_goal * factor < found.length:
                found = path
        return found

    def _start_to_receding_end(self, band: PosePath, obstacles: DistanceField, robot_pose: Array) -> MotionPath | None:
        for last in reversed(list(self._via_indices(band))):
            path = self._join(obstacles, robot_pose, band.poses[last])
            if path is not None:
                return path
        return None

    def _point_to_point(self, band: PosePath, obstacles: DistanceField, robot_pose: Array) -> MotionPath | None:
        return self._chain(band, obstacles, robot_pose, skip=False)

    def _skip_failures(self, band: PosePath, obstacles: DistanceField, robot_pose: Array) -> MotionPath | None:
        return self._chain(band, obstacles, robot_pose, skip=True)

    def _chain(self, band: PosePath, obstacles: DistanceField, robot_pose: Array, *, skip: bool) -> MotionPath | None:
        legs: list[MotionPath] = []
        at = robot_pose
        for last in self._via_indices(band):
            path = self._join(obstacles, at, band.poses[last])
            backs = legs and path is not None and (path.segments[:, 0] * band.directions[last] < 0).any()
            if path is None or backs or self._is_detour(path, at):
                if not skip:
                    break
                continue
            legs.append(path)
            at = path.end
        return joined(legs) if legs else None

    @staticmethod
    def _is_detour(path: MotionPath, at: Array) -> bool:
        # 1.6: ratio of motion length to distance above which a motion between two band poses is a detour
        return path.length > 1.6 * float(pose_distance(path.end, at))

    def _via_indices(self, band: PosePath) -> Iterator[int]:
        """Yield the indices of the poses to join: one every ``spacing`` metres, all cusps, and the last one."""
        travelled = band.travelled
        begin = 0.0
        cusps = {end - 1 for _, end in direction_runs(band.directions)}
        for i in range(1, len(travelled)):
            if i in cusps:
                if travelled[i] > CUSP_REACHED or i == len(travelled) - 1:
                    yield i
                begin = travelled[i]
            elif travelled[i] - begin >= self.config.spacing and all(
                travelled[c] - travelled[i] >= 0.5 * self.config.spacing for c in cusps if c > i
            ):
                yield i
                begin = travelled[i]


def ends_at_cusp(path: MotionPath, band: PosePath) -> bool:
    """Whether a path ends at a cusp of its band, or the band has already passed that cusp."""
    if not len(path.segments):
        return False
    if path.segments[-1, 0] * band.directions[0] < 0:
        return True
    cusps = band.poses[np.flatnonzero(np.diff(band.directions))]
    return bool((pose_distance(cusps, path.end) < 0.05).any())
