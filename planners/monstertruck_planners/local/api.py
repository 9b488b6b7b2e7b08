"""Interface of the local planners: state and result. Loads numba.

Poses belong to the vehicle's reference point, as in the route planners: the rear axle's middle with front steering.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import DistanceField
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.motion import MotionPath
from monstertruck_schemas.reasons import Reason

CUSP_REACHED = 0.1
"""Nearer than this to a cusp of its band the truck continues with what follows (m)."""


@dataclass(frozen=True, slots=True)
class LocalPlannerState:
    """State of a local planner between two cycles."""

    route: PosePath | None = None
    """Route of the last cycle; a different route resets the state."""
    band: PosePath | None = None
    """Band of the last cycle."""
    entered: int = 0
    """Number of route poses in the band or behind the truck."""
    path: MotionPath | None = None
    """Result of the last cycle."""
    failed: int = 0
    """Number of successive local searches without a result; after some, another heading is tried at the goal."""
    turning: tuple[float, ...] = ()
    """Emergency turn: initial x, y, yaw, and wanted yaw."""

    @property
    def final(self) -> bool:
        """Whether the band ends at the end of the route."""
        return self.route is not None and self.entered == len(self.route.poses)


@dataclass(frozen=True)
class LocalPlan:
    """Drivable path around the obstacles, or the reason for its absence."""

    reason: Reason
    """OK; PATH_PARTIAL: ``path`` is the free part; otherwise there is no path."""
    state: LocalPlannerState
    """State for the next cycle."""
    path: MotionPath | None = None
    """Path from the truck to the end of the route or to an earlier pose."""
    complete: bool = False
    """Whether the path ends at the end of the route."""
    text: str = ""
    """Details of the reason."""
    statistics: dict[str, float] = field(default_factory=dict)


class LocalPlanner(Protocol):
    """Local planner; equal arguments give equal results."""

    vehicle: Vehicle

    def plan(self, route: PosePath, obstacles: DistanceField, pose: ArrayLike, state: LocalPlannerState) -> LocalPlan:
        """Plan a drivable path along a route, around the obstacles on it.

        Args:
            route: poses of the reference point.
            obstacles: obstacles in a window around the truck.
            pose: x, y, yaw of the reference point, in the frame of both.
            state: state of the cycle before, ``LocalPlannerState()`` at first.

        Raises:
            InputError: the pose is not finite or has a wrong shape.
        """


def pose_distance(a: Array, b: Array, reach: float = 0.3) -> Array:
    """Return the distance of poses (..., 3): metres plus ``reach`` times the angle between them."""
    away: Array = np.hypot(a[..., 0] - b[..., 0], a[..., 1] - b[..., 1])
    turned = np.abs(np.remainder(a[..., 2] - b[..., 2] + math.pi, math.tau) - math.pi)
    return np.asarray(away + reach * turned)


def nearest_pose(band: PosePath, pose: Array) -> int:
    """Return the band's pose nearest to the truck, not beyond a cusp that the truck has not reached."""
    for begin, end in direction_runs(band.directions):
        at = begin + int(np.argmin(pose_distance(band.poses[begin:end], pose)))
        last = band.poses[end - 1]
        if end == len(band.poses) or math.hypot(last[0] - pose[0], last[1] - pose[1]) > CUSP_REACHED:
            return at
    return 0


def direction_runs(directions: Array) -> Iterator[tuple[int, int]]:
    """Index ranges of one direction; the pose at a cusp, which ends one, also begins the next one."""
    cuts = [*np.flatnonzero(np.diff(directions)).tolist(), len(directions) - 1]
    begin = 0
    for cut in cuts:
        yield begin, cut + 1
        begin = cut
