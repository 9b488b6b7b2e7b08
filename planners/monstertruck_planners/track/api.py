"""What goes into a tracker and what comes out."""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from monstertruck_planners.track.line import Line, Progress
from monstertruck_schemas.reasons import Reason


class TruckState(NamedTuple):
    """What a tracker knows of the truck."""

    pose: tuple[float, float, float]
    """x, y (m), yaw (rad) in the path's frame."""
    speed: float
    """Forward speed, m/s."""
    clearance: float = math.inf
    """Room around the footprint along the next part of the path, m."""
    tilt: float = 0.0
    """Angle between the truck's z axis and the vertical, rad."""
    roughness: float = 0.0
    """Standard deviation of the tilt over the last seconds, rad."""


@dataclass(slots=True)
class Command:
    """What to do now, and how the tracking goes."""

    speed: float
    """Of the base point along its direction of travel, m/s; negative backwards."""
    front: float
    rear: float
    progress: Progress
    cross_track: float
    """Distance of the base point from the path, m; positive left of it, seen in the direction of travel."""
    heading_error: float
    """Yaw less the path's, rad."""
    outcome: Reason
    """DRIVING, GOAL_REACHED, PATH_LOST or NOT_FINITE."""


class Tracker(Protocol):
    """Follows lines. It remembers its own requests only, to know what the wheels are still about to do."""

    def reset(self) -> None:
        """Forget: the requests were not obeyed."""
        ...

    def prepare(self, line: Line, progress: Progress) -> bool:
        """Compute what ``control`` needs of a line's present run, once; whether that had to be done."""
        ...

    def control(self, state: TruckState, line: Line, progress: Progress, t: float) -> Command:
        """One control step.

        Args:
            state: the truck at ``t``.
            line: the path.
            progress: place reached at the step before, ``line.start`` at first.
            t: s, growing.
        """
        ...
