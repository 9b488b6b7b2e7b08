"""Messages of the ``plan`` group: paths, tracker progress, and the planners' wishes to the gate."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import Float64Array, Message
from monstertruck_schemas.reasons import Reason

Steering = Literal["front", "rear", "counter", "crab", "hybrid"]
"""Which axles steer: one alone, both by opposite or by equal angles, or both freely."""


class Path(Message):
    """Poses to be driven in order, expressed in ``frame``."""

    poses: Float64Array
    """Shape (3 n,), row-major (x, y, yaw) rows: m, m, rad."""
    directions: Float64Array
    """Shape (n,): +1 where the truck arrives forward, -1 backward; empty = all forward."""
    steering: tuple[Steering, ...] = ()
    """n of them: how the axles steer where the truck arrives; empty = as the tracker is configured. Only where it is
    crab or hybrid is the poses' yaw meant; else it follows from the path."""
    closed: bool = False
    """A closed path is a lap: it ends where it began."""
    name: str = ""


class TrackerState(Message):
    """How well the tracker follows its path."""

    path: str = ""
    cross_track: float
    """Signed distance from the path, left positive, m."""
    heading_error: float
    """Rad."""
    along: Annotated[float, Field(ge=0)]
    """Metres driven along the path."""
    length: Annotated[float, Field(ge=0)]
    """Metres of the whole path."""
    outcome: Reason
    """DRIVING, GOAL_REACHED, PATH_LOST ..."""


class StabiliserCommand(Message):
    """Joint angles the lidar's mount has to take, see ``sensor.StabiliserFeedback`` for order and signs."""

    pitch: float
    """Rad, nose down positive."""
    roll: float
    """Rad, right side down positive."""
