"""The published planner, for comparison: what it does, with the faults that its sources show. Compiled.

Faults that are kept: the turning radius is 1.0 m whatever the truck; bubbles know the inscribed circle only, and half
of the clearance; forces and distances without headings, the force before wrongly summed; the truck's centre has to stay
out of the inflation, so a truck that stands near a wall finds nothing; headings always ahead, a last heading of exactly
0 overwritten; ``skip_failures`` leaves a gap after its first motion, where the path ends here; nothing is kept from one
cycle to the next but the band; differences of the emergency turn are not wrapped. The sampling tree of its Reeds-Shepp
planner is our deterministic search, the better of the two.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DiscFootprint, DistanceField
from monstertruck_planners.local import elastic_band
from monstertruck_planners.local.api import DeformResult, Guide, Memory
from monstertruck_planners.local.config import BandConfig, PublishedConfig
from monstertruck_planners.local.core import Local, Surveyor, checked
from monstertruck_planners.local.elastic_band import rules_of, stretch
from monstertruck_planners.local.rsband import ends_at
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.motion import MotionPath, joined, moved
from monstertruck_schemas.reasons import Reason

INSCRIBED = 0.17
"""Half the truck's width, m."""

AUTHORS = BandConfig(overlap=0.3, significant=0.1, largest=0.276)
"""Parameters of the author's robot."""

TURN_STEP, TURN_MORE = math.radians(45.0), 0.5
"""Of an emergency turn, rad."""


class Published:
    """The deformer of kind ``rsband-as-published``.

    Args:
        vehicle: what is driven; results speak of the base, whatever its reference point.
        config: strategy.
    """

    def __init__(self, vehicle: Vehicle, config: PublishedConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or PublishedConfig()
        search = HybridConfig(
            improve=False, effort=self.config.effort, cusp_cost=0.0, swing_cost=0.0, clearance_cost=0.0
        )
        config = self.config.model_copy(update={"margin": 0.0})
        states = Vehicle(DiscFootprint((0.0,), self.config.inflation), self.config.radius, 0.0, vehicle.steering)
        self._states = Surveyor(states, config, search)
        self._steer = states.reeds_shepp()
        self._band = Surveyor(replace(states, footprint=DiscFootprint((0.0,), INSCRIBED)), config)
        self._rules = rules_of(AUTHORS, self._band.cover)._replace(
            scale=0.5, reach=0.0, spacing=math.inf, published=True
        )

    def deform(self, guide: Guide, surroundings: DistanceField, pose: ArrayLike, memory: Memory) -> DeformResult:
        """One cycle, see ``api.Deformer``.

        Raises:
            InputError: a pose that is none.
        """
        here = moved(checked(pose), -self.vehicle.reference)
        if memory.guide is not guide:
            memory = Memory(guide=guide)
        ahead_only = Guide(moved(guide.poses, -self.vehicle.reference), np.ones(len(guide.poses)))
        before = replace(memory, band=self._pruned(memory.band, surroundings, here))
        local = self._band.cut(ahead_only, surroundings, here, before)
        if local is None:
            return DeformResult(Reason.PATH_BLOCKED, memory, text="no pose of the route in the window is free")
        whole = Guide(np.vstack((here, local.band.poses)), np.ones(len(local.band.poses) + 1))
        band = stretch(whole, surroundings, self._band.cover, self._rules)
        if band.guide is None:
            return DeformResult(Reason.PATH_BLOCKED, Memory(guide=guide), text="the band is broken")
        memory = replace(memory, band=band.guide.part(1, len(band.guide.poses)), entered=local.entered)
        poses = oriented(band.guide.poses)
        path = self._joined(poses, surroundings)
        behind = abs(poses[0, 2] - poses[1, 2]) > math.pi / 2
        if path is None or behind:
            return self._emergency(memory, surroundings, poses)
        goal = ahead_only.poses[-1]
        return DeformResult(Reason.OK, replace(memory, turning=()), path, local.final and ends_at(path, goal))

    def _pruned(self, band: Guide | None, surroundings: DistanceField, here: Array) -> Guide | None:
        """The band from the furthest bubble on that touches the truck's."""
        if band is None:
            return None
        field, cover = surroundings.data(), self._band.cover
        own = 0.5 * elastic_band.clearance(field, cover, *here)
        radii = [0.5 * elastic_band.clearance(field, cover, *pose) for pose in band.poses]
        reach = self._rules.overlap * (np.minimum(radii, self._rules.largest) + min(own, self._rules.largest))
        touching = np.flatnonzero(np.hypot(*(band.poses[:, :2] - here[:2]).T) < reach)
        return band.part(int(touching[-1]) if len(touching) else 0, len(band.poses))

    def _join(self, surroundings: DistanceField, here: Array, goal: Array) -> MotionPath | None:
        path = self._steer.path(here, goal)
        if len(path.segments) and self._states.free(surroundings, path):
            return path
        end = Local(Guide(goal[None], np.ones(1)), 0, final=True)
        return self._states.search(surroundings, here, end, 0)[0]

    def _joined(self, poses: Array, surroundings: DistanceField) -> MotionPath | None:
        """The path of the strategy."""
        strategy, last = self.config.strategy, len(poses) - 1
        if strategy == "start_to_end":
            return self._join(surroundings, poses[0], poses[last])
        if strategy == "start_to_next":
            travelled = Guide(poses, np.ones(len(poses))).travelled
            near = min(int(np.searchsorted(travelled, self.config.sub_goal)), last)
            return self._join(surroundings, poses[0], poses[near])
        if strategy == "start_to_receding_end":
            tries = (self._join(surroundings, poses[0], poses[i]) for i in range(last, 0, -1))
            return next((path for path in tries if path is not None), None)
        legs: list[MotionPath] = []
        for pose in poses[1:]:
            leg = self._join(surroundings, legs[-1].end if legs else poses[0], pose)
            if leg is not None:
                legs.append(leg)
            if (leg is None) != (strategy == "skip_failures"):
                break
        return joined(legs) if legs else None

    def _emergency(self, memory: Memory, surroundings: DistanceField, poses: Array) -> DeformResult:
        """Back to where the turn began, turned a step further towards the wanted heading."""
        text = "no Reeds-Shepp motion found"
        if self.config.emergency:
            turning = memory.turning or (*poses[0].tolist(), float(poses[1, 2]))
            memory = replace(memory, turning=turning)
            x, y, yaw, wanted = turning
            sign = 1.0 if wanted > yaw else -1.0
            steps = math.floor(abs(poses[0, 2] - yaw) / TURN_STEP) + 1
            goal = np.array([x, y, yaw + sign * (steps * TURN_STEP + TURN_MORE)])
            path = self._join(surroundings, poses[0], goal)
            if path is not None:
                return DeformResult(Reason.OK, memory, path, statistics={"emergency": 1.0})
            text += ", nor an emergency turn"
        return DeformResult(Reason.PATH_BLOCKED, memory, text=text)


def oriented(poses: Array) -> Array:
    """Headings by the published rule: towards the next pose; the last one keeps its own unless that is exactly 0."""
    result = poses.copy()
    steps = np.diff(poses[:, :2], axis=0)
    course = np.arctan2(steps[:, 1], steps[:, 0])
    result[1:-1, 2] = course[1:]
    if result[-1, 2] == 0.0:
        result[-1, 2] = result[-2, 2]
    return result
