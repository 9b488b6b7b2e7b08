"""Messages of the ``req`` group, the only input of the robot.

The key of every request names its source. A request has a role, carries the robot's nonce (published in ``state/gate``,
new at every start, so that a recorded request cannot move another run), a sequence number that must increase for each
source, and a lease: its validity without a newer request. No clock has to be trusted.
"""

import math
from enum import StrEnum
from typing import Annotated, ClassVar, Final, Self

from pydantic import ConfigDict, Field, model_validator

from monstertruck_schemas.base import Message, Nanoseconds, Pose2D, Schema
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.plan import Path


class Role(StrEnum):
    """Role of the sender; priority decreases in this order."""

    ESTOP = "estop"
    HAND = "hand"
    """Operator with a radio control next to the robot, through its receiver; no external sender has this role."""
    GAMEPAD = "gamepad"
    KEYBOARD = "keyboard"
    STATION = "station"
    TRACKER = "tracker"


class Request(Message):
    """Header of every request."""

    source: Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.@:-]+$")]
    """Name of the requesting program or person, visible to everyone; the daemon replaces it by the name in the key."""
    role: Role
    """Role of the sender, which gives its priority."""
    lease: Annotated[float, Field(gt=0, le=2.0)]
    """Lease, s; the gate limits it by the maximum for the role."""
    nonce: Annotated[str, Field(max_length=64)]
    """The robot's nonce from ``state/gate``."""
    gate_stamp: Nanoseconds | None = None
    """Stamp of the latest ``state/gate`` known to the sender, on the robot's clock. A request for motion must carry a
    recent one, so that a delayed request moves nothing.
    """
    instance: Annotated[str, Field(max_length=32)] | None = None
    """Random name of this run of the sender's program: during its lease no other program can take over its source."""

    @property
    def program(self) -> tuple[str, str | None]:
        """Source and instance: one run of one program."""
        return self.source, self.instance


AnyNumber = Annotated[float, Field(allow_inf_nan=True)]


class DriveForm(StrEnum):
    """Form of a drive request; each body accepts some of them."""

    AXLES = "axles"
    """Speed and both axle angles."""
    TWIST = "twist"
    """Velocity of the base: forward, sideways and turning."""
    SHAFTS = "shafts"
    """Rate of every driven shaft's wheels, open loop; for engineers."""


class RequestedTwist(Schema):
    """Requested velocity of the base in its own frame."""

    vx: AnyNumber = 0.0
    """Forward, m/s."""
    vy: AnyNumber = 0.0
    """Velocity to the left (m/s)."""
    wz: AnyNumber = 0.0
    """Yaw rate, rad/s, counter-clockwise positive."""


class DriveRequest(Request):
    """A requested motion in one form: speed and axle angles, ``twist``, or ``shafts``.

    Non-finite numbers are sent to the gate, which refuses them by name. A reader that does not know the form interprets
    it as a request for standstill.
    """

    speed: AnyNumber
    """Speed of the base point along its direction of travel, m/s; negative = reverse."""
    front: AnyNumber
    """Front axle angle of the equivalent bicycle, rad, left positive."""
    rear: AnyNumber = 0.0
    """Rear axle angle of the equivalent bicycle, rad, left positive (counter-steer: opposite to front)."""
    twist: RequestedTwist | None = None
    """Velocity of the base; speed and angles are then 0."""
    # 8: maximum number of rates in a request; a robot has at most four driven shafts, and refuses any other number than
    # its own
    shafts: Annotated[tuple[AnyNumber, ...], Field(min_length=1, max_length=8)] | None = None
    """Wheel rate of every driven shaft in the body's order, rad/s, forward positive; speed and angles are then 0."""
    unseen: bool = False
    """Whether the operator holds a second control to drive into ground that no sensor has seen; planners cannot."""

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        other = "a twist" if self.twist is not None else "shafts"
        if (self.twist is not None or self.shafts is not None) and (self.speed, self.front, self.rear) != (0.0,) * 3:
            raise ValueError(f"a request has one form: expected speed, front and rear of 0 with {other}")
        if self.twist is not None and self.shafts is not None:
            raise ValueError("a request has one form: expected either a twist or shafts")
        return self

    @property
    def form(self) -> DriveForm:
        """Form of the motion."""
        if self.shafts is not None:
            return DriveForm.SHAFTS
        return DriveForm.AXLES if self.twist is None else DriveForm.TWIST

    @property
    def numbers(self) -> dict[str, float]:
        """The numbers of its form, by name."""
        if self.shafts is not None:
            return {f"shafts[{i}]": rate for i, rate in enumerate(self.shafts)}
        if self.twist is None:
            return {"speed": self.speed, "front": self.front, "rear": self.rear}
        return self.twist.model_dump()

    @property
    def pace(self) -> float:
        """Speed of the base, m/s, negative: reverse; 0 when turning on the spot, and for shafts."""
        if self.twist is None:
            return self.speed
        return math.copysign(math.hypot(self.twist.vx, self.twist.vy), self.twist.vx)

    @property
    def neutral(self) -> bool:
        """Whether it requests standstill."""
        if self.shafts is not None:
            speeds = self.shafts
        else:
            speeds = (self.speed,) if self.twist is None else (self.twist.vx, self.twist.vy, self.twist.wz)
        # 1e-3: a request below this in all its speeds, m/s and rad/s, means standstill
        return all(abs(speed) < 1e-3 for speed in speeds)


class Order(StrEnum):
    """Control requests to the gate; each is also a remote call."""

    ARM = "arm"
    DISARM = "disarm"
    ESTOP = "estop"
    RESET = "reset"
    STOP = "stop"
    ASK = "ask"
    """Request control from the driving operator; has no other effect."""
    HAND_OVER = "hand_over"
    """The driving operator hands over to an operator who has requested control."""


STARTING: Final = frozenset({Order.ARM, Order.RESET})
"""Orders that permit motion: they must carry a recent gate stamp."""

UNCONDITIONAL: Final = frozenset({Order.ESTOP, Order.STOP})
"""Orders that the gate always accepts, whatever their header: stopping is always safe. They are sent by topic, ahead of
all calls.
"""


class ControlRequest(Request):
    """Arm, disarm, emergency stop, its reset, stop, request control, or hand over."""

    order: Order
    """Requested action."""
    hold: bool = False
    """With an order to arm: planners do not drive until the truck is armed without it."""
    calibrates: bool = False
    """With an order to arm: sensors are calibrated on ground that an operator keeps clear. Until the robot is disarmed,
    contradicting motion measurements and ground that no sensor has seen slow it instead of stopping it.
    """
    to: Annotated[str, Field(max_length=64)] | None = None
    """Source that may drive after a hand-over."""


class Verb(StrEnum):
    """Order to a task server; the orders of all kinds of task are mapped to these."""

    START = "start"
    RESUME = "resume"
    """Continue after a pause."""
    PAUSE = "pause"
    STOP = "stop"

    @property
    def moves(self) -> bool:
        """Whether the order may start a motion of the robot."""
        return self in (Verb.START, Verb.RESUME)


class Waypoint(Schema):
    """A waypoint on the way to a goal."""

    x: float
    """Position x, m."""
    y: float
    """Position y, m."""
    yaw: float | None = None
    """Yaw (rad); None to follow the path."""


class GoalRequest(Request):
    """A pose to drive to, in ``frame``."""

    goal: Pose2D
    waypoints: Annotated[tuple[Waypoint, ...], Field(max_length=32)] = ()
    """Waypoints, passed in this order."""

    @property
    def verb(self) -> Verb:
        """Order to the task server."""
        return Verb.START

    @property
    def own(self) -> bool:
        """Whether it applies only to a task of the same program."""
        return False


class GoalOrder(StrEnum):
    """Order about the current goal."""

    PAUSE = "pause"
    RESUME = "resume"
    CANCEL = "cancel"


class GoalControl(Request):
    """Interrupt, resume or cancel the current goal."""

    order: GoalOrder
    """Requested action."""
    own: bool = False
    """Only a goal that the same program sent."""

    @property
    def verb(self) -> Verb:
        """Order to the task server."""
        return Verb.STOP if self.order is GoalOrder.CANCEL else Verb(self.order)


class BehaviourOrder(StrEnum):
    """Orders about behaviours."""

    START = "start"
    STOP = "stop"


class BehaviourRequest(Request):
    """Start a configured behaviour, or stop the running one."""

    order: BehaviourOrder
    behaviour: Annotated[str, Field(max_length=64)] = ""
    """Name of the behaviour to start; with a stop: only this behaviour, empty for any."""
    settings: Annotated[dict[str, float | str | bool | None], Field(max_length=32)] = Field(default_factory=dict)
    """For a start: settings that replace the configured ones for this run."""
    own: bool = False
    """Whether a stop applies only to a behaviour that the same program started."""

    @property
    def verb(self) -> Verb:
        """Order to the task server."""
        return Verb(self.order)


class ExploreOrder(StrEnum):
    """Orders about explorations."""

    START = "start"
    STOP = "stop"


class ExploreRequest(Request):
    """Start or stop an exploration."""

    order: ExploreOrder
    home: bool | None = None
    """Drive back to the start at the end; None for the configured value."""
    budget: Annotated[float, Field(gt=0)] | None = None
    """Time budget (s); None for the configured value."""
    find: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Look for tags on walls, and end when the map has so many of them; None: explore only."""
    own: bool = False
    """Whether a stop applies only to an exploration that the same program started."""

    @property
    def verb(self) -> Verb:
        """Order to the task server."""
        return Verb(self.order)


class MissionOrder(StrEnum):
    """Orders about missions."""

    START = "start"
    RESUME = "resume"
    STOP = "stop"


class MissionRequest(Request):
    """Start a mission, resume an interrupted one, or stop the running one."""

    order: MissionOrder
    mission: Mission | None = None
    """For a start."""
    moved: bool = False
    """For a resume: the robot is not where the mission was interrupted, and its pose is right."""
    own: bool = False
    """Whether a stop applies only to a running mission that the same program started."""

    @property
    def verb(self) -> Verb:
        """Order to the task server; resuming a mission is a start, from its current step."""
        return Verb.STOP if self.order is MissionOrder.STOP else Verb.START


class PathRequest(Request):
    """A path computed by a client, to be tracked."""

    path: Path


class LocalisationRequest(Request):
    """Pose of odom in map, estimated by a client; valid for the lease."""

    correction: Pose2D


class MapRequest(Request):
    """Occupancy grid in map, made by a client."""

    model_config: ClassVar[ConfigDict] = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")

    resolution: Annotated[float, Field(gt=0)]
    """Metres per cell."""
    width: Annotated[int, Field(gt=0, le=2048)]
    """Number of columns."""
    height: Annotated[int, Field(gt=0, le=2048)]
    """Number of rows."""
    origin: Pose2D
    """Pose of the outer corner of cell (0, 0); its yaw is 0."""
    packed: bytes
    """Cells as ``Grid.cells``, a signed byte each, compressed by zlib."""


class PathStart(Request):
    """Drive the configured path once, until its end or until the robot is disarmed."""

    path: Annotated[str, Field(min_length=1, max_length=128)]
    """Name of the file without its extension."""
