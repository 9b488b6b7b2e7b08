"""What goes to the planning step and what comes back; picklable, and light."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.manage.config import PlannerConfig
from monstertruck_schemas.plan import Steering
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Grid

Array = NDArray[np.float64]
Pose = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Setup:
    """What the step is made for; comes first, and again after every restart."""

    config: PlannerConfig
    geometry: FourWheelSteering
    footprint: Footprint
    timed: bool
    """Whether the route planner works for its time or for its effort: only the latter is reproducible."""


@dataclass(frozen=True, slots=True)
class PlanTask:
    """One thing to plan."""

    what: Literal["route", "escape"]
    pose: Pose
    """Of the base, in the map's frame."""
    goal: Pose
    """Of the base."""
    points: Array
    """Shape (n, 2): returns of the newest scan in the map's frame, m."""
    setup: Setup | None = None
    grid: Grid | None = None
    """A newer map than before."""
    clear: bool = False
    """Forget the obstacles of older scans, and the route so far."""


@dataclass(frozen=True, slots=True)
class PlanAnswer:
    """A way to drive, or why there is none."""

    reason: Reason
    text: str = ""
    poses: Array | None = None
    """Shape (n, 3): of the base along the way."""
    directions: Array | None = None
    """Shape (n,): +1 or -1."""
    steering: tuple[Steering, ...] = ()
    """n of them."""
    length: float = 0.0
    """Metres."""
    cost: float = 0.0
    """Metres, with all prices."""
    kept: bool = False
    """It is the rest of the route before."""

    @property
    def ok(self) -> bool:
        """Whether there is something to drive."""
        return self.reason is Reason.OK and self.poses is not None
