"""Elastic band, then Reeds-Shepp motions of the truck's own turning radius that join its poses. Compiled.

The five strategies are those of the published planner: one motion to the band's end, to the next sub-goal, from pose to
pose until one fails, the same leaving out poses that fail, and to the furthest pose that can be reached. What they
cannot reach, a small search does; a path is kept while it is free.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DistanceField
from monstertruck_planners.local.api import DeformResult, Guide, Memory, apart
from monstertruck_planners.local.config import RsbandConfig
from monstertruck_planners.local.core import CUSP_REACHED, RUN_ENDED, Local, Surveyor, costs_of, rest_of, runs
from monstertruck_planners.local.elastic_band import rules_of, stretch
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.motion import MotionPath, joined
from monstertruck_schemas.reasons import Reason

FURTHER = (1.0, 1.5, 2.0, 3.0)
"""Sub-goals tried, as factors on their distance."""

CRUMB = 0.05
"""What is left of a path to a cusp when it is replaced, m."""

ROUNDABOUT = 1.6
"""A motion between two band poses longer than this factor on their distance is none: it turns round."""


@dataclass(frozen=True)
class Motion:
    """A motion found by a strategy."""

    path: MotionPath
    last: int
    """Index of the band's pose at which it ends."""


class Rsband:
    """The deformer of kind ``rsband``.

    Args:
        vehicle: what is driven.
        config: strategy and limits.
    """

    def __init__(self, vehicle: Vehicle, config: RsbandConfig | None = None) -> None:
        self.vehicle = vehicle
        self.config = config or RsbandConfig()
        costs = costs_of(self.config)
        self._steer = vehicle.reeds_shepp(costs)
        self._surveyor = Surveyor(vehicle, self.config, costs)
        self._rules = rules_of(self.config.band, self._surveyor.cover)
        self._strategy: Callable[[Guide, DistanceField, Array], Motion | None] = getattr(
            self, f"_{self.config.strategy}"
        )

    def deform(self, guide: Guide, surroundings: DistanceField, pose: ArrayLike, memory: Memory) -> DeformResult:
        """One cycle, see ``api.Deformer``.

        Raises:
            InputError: a pose that is none.
        """
        cycle = self._surveyor.begin(guide, surroundings, pose, memory)
        if isinstance(cycle, DeformResult):
            return cycle
        here, local, memory = cycle.here, cycle.local, cycle.memory
        rest, far = rest_of(memory.path, here) if memory.path is not None else (None, 0.0)
        ended_there = rest is not None and ends_at(rest, guide.poses[-1])
        if (
            rest is not None
            and self._good(rest, far, to_end=ended_there, to_cusp=to_cusp(rest, local.band))
            and self._surveyor.free(surroundings, rest)
        ):
            kept = replace(memory, path=rest)
            return DeformResult(Reason.OK, kept, rest, ended_there, statistics={"kept": 1.0})
        return self._fresh(local, surroundings, here, memory, rest)

    def _good(self, rest: MotionPath, far: float, *, to_end: bool, to_cusp: bool) -> bool:
        if far > self.config.off_path or not len(rest.segments):
            return False
        if to_end or to_cusp:
            return rest.length > (RUN_ENDED if to_end else CRUMB)
        return rest.length > self.config.renew * self.config.sub_goal

    def _fresh(
        self, local: Local, surroundings: DistanceField, here: Array, memory: Memory, rest: MotionPath | None
    ) -> DeformResult:
        """Deform the band and join it, else search."""
        whole = with_robot(local.band, here)
        band = stretch(whole, surroundings, self._surveyor.cover, self._rules)
        statistics = {
            "kept": 0.0,
            "bubbles": float(len(band.radii)),
            "searched": 0.0,
            "broken": float(band.guide is None),
        }
        if band.guide is not None:
            motion = self._strategy(band.guide, surroundings, here)
            if motion is not None:
                after = replace(memory, band=band.guide.part(1, len(band.guide.poses)), path=motion.path, failed=0)
                done = ends_at(motion.path, memory.guide.poses[-1])  # type: ignore[union-attr]
                return DeformResult(Reason.OK, after, motion.path, done, statistics=statistics)
        statistics["searched"] = 1.0
        path, band_of_path, why = self._surveyor.search(surroundings, here, local, memory.failed)
        if path is None:
            result = self._surveyor.partial(memory, surroundings, here, rest, why)
            return replace(result, statistics=statistics)
        after = replace(memory, band=band_of_path, path=path, failed=0)
        done = ends_at(path, memory.guide.poses[-1])  # type: ignore[union-attr]
        return DeformResult(Reason.OK, after, path, done, statistics=statistics)

    def _join(self, surroundings: DistanceField, here: Array, goal: Array) -> MotionPath | None:
        """Best motion between two poses if it is free."""
        path = self._steer.path(here, goal)
        return path if len(path.segments) and self._surveyor.free(surroundings, path) else None

    def _start_to_end(self, band: Guide, surroundings: DistanceField, here: Array) -> Motion | None:
        last = len(band.poses) - 1
        path = self._join(surroundings, here, band.poses[last])
        return Motion(path, last) if path is not None else None

    def _start_to_next(self, band: Guide, surroundings: DistanceField, here: Array) -> Motion | None:
        """To the first pose at the sub-goal's distance, or further if that needs no change of direction."""
        travelled = band.travelled
        end = next(
            end for _, end in runs(band.directions) if travelled[end - 1] > CUSP_REACHED or end == len(travelled)
        )
        found = None
        tried = -1
        for factor in FURTHER:
            last = min(int(np.searchsorted(travelled, factor * self.config.sub_goal)), end - 1)
            if last == tried:
                break
            tried = last
            path = self._join(surroundings, here, band.poses[last])
            if path is None:
                continue
            if path.cusps == 0:
                return Motion(path, last)
            if found is None or path.length + self.config.sub_goal * factor < found.path.length:
                found = Motion(path, last)
        return found

    def _start_to_receding_end(self, band: Guide, surroundings: DistanceField, here: Array) -> Motion | None:
        for last in reversed(list(self._posts(band))):
            path = self._join(surroundings, here, band.poses[last])
            if path is not None:
                return Motion(path, last)
        return None

    def _point_to_point(self, band: Guide, surroundings: DistanceField, here: Array) -> Motion | None:
        return self._chain(band, surroundings, here, skip=False)

    def _skip_failures(self, band: Guide, surroundings: DistanceField, here: Array) -> Motion | None:
        return self._chain(band, surroundings, here, skip=True)

    def _chain(self, band: Guide, surroundings: DistanceField, here: Array, *, skip: bool) -> Motion | None:
        legs: list[MotionPath] = []
        at, reached = here, 0
        for last in self._posts(band):
            path = self._join(surroundings, at, band.poses[last])
            backs = legs and path is not None and (path.segments[:, 0] * band.directions[last] < 0).any()
            if path is None or backs or self._roundabout(path, at):
                if not skip:
                    break
                continue
            legs.append(path)
            at, reached = path.end, last
        return Motion(joined(legs), reached) if legs else None

    @staticmethod
    def _roundabout(path: MotionPath, at: Array) -> bool:
        return path.length > ROUNDABOUT * float(apart(path.end, at))

    def _posts(self, band: Guide) -> Iterator[int]:
        """Indices of the poses to be joined: one every ``spacing`` metres, cusps and the last one among them."""
        travelled = band.travelled
        begin = 0.0
        cusps = {end - 1 for _, end in runs(band.directions)}
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


def with_robot(band: Guide, here: Array) -> Guide:
    """A band that begins at the truck; its first pose gives way if it lies behind or at the truck."""
    first = band.poses[0]
    if len(band.poses) > 1:
        step = band.poses[1, :2] - first[:2]
        behind = float((first[:2] - here[:2]) @ step) <= 0.02 * float(np.hypot(*step))
        if behind and band.directions[0] == band.directions[1]:
            band = band.part(1, len(band.poses))
    return Guide(here[None], band.directions[:1]).then(band)


def to_cusp(path: MotionPath, band: Guide) -> bool:
    """Whether a path leads to where its band changes direction, or the band has done so already."""
    if not len(path.segments):
        return False
    if path.segments[-1, 0] * band.directions[0] < 0:
        return True
    cusps = band.poses[np.flatnonzero(np.diff(band.directions))]
    return bool((apart(cusps, path.end) < 0.05).any())


def ends_at(path: MotionPath, goal: Array) -> bool:
    """Whether a path leads to a pose, within 5 cm and 0.09 rad."""
    away = path.end - goal
    turned = abs(float(np.remainder(away[2] + np.pi, 2 * np.pi) - np.pi))
    return float(np.hypot(away[0], away[1])) < 0.05 and turned < 0.09
