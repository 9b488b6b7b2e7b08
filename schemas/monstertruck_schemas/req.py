"""Messages of the ``req`` group, the only way into the robot.

Every request names its source and role, carries the robot's nonce (published in ``state/gate``, new at
every start, so that no recorded request can move another run), a sequence number that must grow for each
source, and a lease: the time for which the request stands without a newer one. Trust in clocks is not needed.
"""

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Message, Nanoseconds, Pose2D, Schema
from monstertruck_schemas.plan import Path


class Role(StrEnum):
    """Who asks; priority falls in this order."""

    ESTOP = "estop"
    GAMEPAD = "gamepad"
    KEYBOARD = "keyboard"
    STATION = "station"
    TRACKER = "tracker"


class Request(Message):
    """Header of every request."""

    source: Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.@:-]+$")]
    """Name of the asking program or person, shown to everybody."""
    role: Role
    lease: Annotated[float, Field(gt=0, le=2.0)]
    """Seconds this request stands; the gate caps it by its own limit for the role."""
    nonce: Annotated[str, Field(max_length=64)]
    """The robot's nonce from ``state/gate``."""
    gate_stamp: Nanoseconds | None = None
    """Stamp of the newest ``state/gate`` its sender had, on the robot's clock: what may set the truck in motion must
    carry a recent one, so that a request that was long on its way moves nothing."""


class DriveRequest(Request):
    """Speed and both axle angles asked for. Non-finite numbers reach the gate, which refuses them by name."""

    speed: Annotated[float, Field(allow_inf_nan=True)]
    """Speed of the base point along its direction of travel, m/s; negative = reverse."""
    front: Annotated[float, Field(allow_inf_nan=True)]
    """Front axle angle of the equivalent bicycle, rad, left positive."""
    rear: Annotated[float, Field(allow_inf_nan=True)] = 0.0
    """Rear axle angle of the equivalent bicycle, rad, left positive (counter-steer: opposite to front)."""


class Order(StrEnum):
    """What a control request can ask of the gate."""

    ARM = "arm"
    DISARM = "disarm"
    ESTOP = "estop"
    RESET = "reset"
    STOP = "stop"


class ControlRequest(Request):
    """Arm, disarm, emergency stop, its reset, or give up driving."""

    order: Order


class Waypoint(Schema):
    """A place to pass on the way to a goal."""

    x: float
    """M."""
    y: float
    """M."""
    yaw: float | None = None
    """Rad; None = that of the way there and on."""


class GoalRequest(Request):
    """A pose to drive to, in ``frame``."""

    goal: Pose2D
    waypoints: Annotated[tuple[Waypoint, ...], Field(max_length=32)] = ()
    """Passed in this order before it."""


class GoalOrder(StrEnum):
    """What can be asked about the present goal."""

    PAUSE = "pause"
    RESUME = "resume"
    CANCEL = "cancel"


class GoalControl(Request):
    """Interrupt, go on with or give up the present goal."""

    order: GoalOrder


class PathRequest(Request):
    """A path computed off board, to be tracked."""

    path: Path
