"""Interface of the local planners: state and result. Loads numba.

Poses belong to the vehicle's reference point, as in the route planners: the rear axle's middle with front steering.
"""

from dataclasses import dataclass, field
from typing import Protocol

from numpy.typing import ArrayLike

from monstertruck_planners.collision import DistanceField
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.motion import MotionPath
from monstertruck_schemas.reasons import Reason


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
    """Number of successive local searches without a result; after several, another heading at the goal is tried."""
    turning: tuple[float, ...] = ()
    """Emergency turn: initial x, y, yaw, and target yaw."""

    @property
    def final(self) -> bool:
        """Whether the band ends at the end of the route."""
        return self.route is not None and self.entered == len(self.route.poses)


@dataclass(frozen=True)
class LocalPlan:
    """Drivable path around the obstacles, or the reason for its absence."""

    reason: Reason
    """OK; PATH_PARTIAL if ``path`` is only the free part; with any other reason there is no path."""
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
            pose: x, y, yaw of the reference point, in the frame of route and obstacles.
            state: state of the previous cycle; initially ``LocalPlannerState()``.

        Raises:
            InputError: the pose is not finite or has a wrong shape.
        """
