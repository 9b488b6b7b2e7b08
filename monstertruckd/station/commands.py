"""Commands of a browser to the station: one JSON object per message."""

import math
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import first_mistake
from monstertruck_schemas.points import PointName, PointOrder
from monstertruck_schemas.req import UNCONDITIONAL, BehaviourOrder, ExploreOrder, GoalOrder, MissionOrder, Order, Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.zones import LONGEST_OFF, OFF_FOR, ZoneArea, ZoneOrder

LONGEST_MESSAGE: Final = 262_144
"""Maximum size of a command (bytes): enough for the file of a raceline of a few kilometres."""

DeviceFault = Literal["none", "unplugged", "deaf", "noise"]
"""Fault of an emulated device: none, cable unplugged, receives nothing, one wrong bit in 50 bytes."""
Number = Annotated[float, Field(allow_inf_nan=False)]
Heading = Annotated[float, Field(ge=-math.tau, le=math.tau)]
"""Heading (rad), at most one turn."""
Place = Annotated[tuple[Number, ...], Field(min_length=2, max_length=3)]
"""x, y (m) and optionally yaw (rad)."""
Id = Annotated[int, Field(ge=0, lt=2**53)]
Name = Annotated[str, Field(max_length=64)]
Stamp = Annotated[int, Field(ge=0, lt=2**63)]
"""Time of the robot's clock (ns)."""


class _Command(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Asked(_Command):
    """Command whose outcome is reported to the browser."""

    id: Id


class Watch(_Command):
    """Watch a robot or a recording."""

    do: Literal["watch"]
    robot: Annotated[str, Field(max_length=200)]
    """Name of a robot or of a shown recording."""


class LookAtFleet(_Command):
    """Start or stop showing the whole fleet."""

    do: Literal["fleet"]
    on: bool


class EchoRequest(_Command):
    """Request an immediate answer, from which the browser measures the latency to the station."""

    do: Literal["ping"]
    at: Number
    """Browser's time (ms)."""


class Heartbeat(_Command):
    """One heartbeat from the stick, keys or gamepad, with the current input."""

    do: Literal["drive"]
    heard: Number
    """Station's time in the latest answer to a ``ping`` (ms)."""
    since: Number
    """Time from that answer to reading the input, by the browser's clock (ms)."""
    input: Literal["stick", "keys", "gamepad"]
    speed: Number = 0.0
    front: Number = 0.0
    rear: Number = 0.0
    twist: tuple[Number, Number, Number] | None = None
    unseen: bool = False

    @property
    def role(self) -> Role:
        """Priority of the input."""
        return {"stick": Role.STATION, "keys": Role.KEYBOARD, "gamepad": Role.GAMEPAD}[self.input]


class GiveOrder(Asked):
    """Arm, disarm, stop, emergency-stop or reset the emergency stop."""

    do: Literal["order"]
    order: Order
    hold: bool = False


class SetGoal(Asked):
    """Drive to a pose in the map frame, via intermediate poses."""

    do: Literal["goal"]
    goal: tuple[Number, Number, Heading]
    via: Annotated[
        tuple[Annotated[tuple[Number, ...], Field(min_length=2, max_length=3)], ...], Field(max_length=32)
    ] = ()


class ChangeGoal(Asked):
    """Pause, resume or cancel the goal."""

    do: Literal["goal_control"]
    order: GoalOrder


class Behave(Asked):
    """Start or stop a behaviour."""

    do: Literal["behave"]
    order: BehaviourOrder
    behaviour: Annotated[str, Field(max_length=64)] = ""


class Explore(Asked):
    """Start or end an exploration."""

    do: Literal["explore"]
    order: ExploreOrder


class DoMission(Asked):
    """Start, resume or end a mission."""

    do: Literal["mission"]
    order: MissionOrder
    text: Annotated[str, Field(max_length=LONGEST_MESSAGE)] = ""
    """Mission file (YAML), for a start."""
    moved: bool = False
    """Whether to resume although the robot is not where the mission was interrupted; its pose must be right."""


class Track(Asked):
    """Follow a path drawn on the map, in the map frame."""

    do: Literal["track"]
    points: Annotated[tuple[tuple[Number, Number], ...], Field(min_length=2, max_length=400)]


class TrackFile(Asked):
    """Follow the path in a file, in the map frame."""

    do: Literal["track_file"]
    name: Annotated[str, Field(max_length=128)]
    """Name of the file; its suffix selects table or YAML."""
    text: Annotated[str, Field(max_length=LONGEST_MESSAGE)]
    closed: bool = False
    """Whether the path is a lap."""


class StartPath(Asked):
    """Drive the configured path."""

    do: Literal["start_path"]
    path: Annotated[str, Field(max_length=128)]


class ChangeZone(Asked):
    """Add or remove a zone, or turn one off or on."""

    do: Literal["zone"]
    order: ZoneOrder
    name: Annotated[str, Field(max_length=32)]
    area: ZoneArea | None = None
    seconds: Annotated[float, Field(gt=0, le=LONGEST_OFF)] = OFF_FOR
    """Time for which the zone is off (s)."""


class ChangePoint(Asked):
    """Mark a place as a point of interest, or remove a point."""

    do: Literal["point"]
    order: PointOrder
    name: PointName
    place: tuple[Number, Number] | None = None
    """Position of the mark (m); None for the robot's position."""
    yaw: Heading | None = None
    """Heading of the mark (rad); None for the robot's heading."""


class AskToDrive(Asked):
    """Ask the current driver to hand over."""

    do: Literal["ask"]


class HandOver(Asked):
    """Hand over to a client that has asked to drive."""

    do: Literal["hand_over"]
    to: Annotated[str, Field(max_length=64)]


class Acknowledge(Asked):
    """Acknowledge a warning."""

    do: Literal["acknowledge"]
    text: Annotated[str, Field(max_length=200)]


class ListSettings(Asked):
    """List the settings that may be changed while the robot runs."""

    do: Literal["settings"]


class ChangeSetting(Asked):
    """Change a setting while the robot runs."""

    do: Literal["set"]
    key: Annotated[str, Field(max_length=100)]
    value: Number | bool | Annotated[str, Field(max_length=100)]
    save: bool = False


class ListRecordings(Asked):
    """List the recordings on the robot."""

    do: Literal["recordings"]


class DeleteRecording(Asked):
    """Delete a recording from the robot."""

    do: Literal["delete_recording"]
    name: Annotated[str, Field(max_length=128)]


class ReplayRecording(Asked):
    """Fetch a recording from the robot and show it."""

    do: Literal["replay"]
    name: Annotated[str, Field(max_length=128)]
    stamp: Stamp | None = None
    """Moment to begin with, and to stay at; None for the start."""


class InjectFault(Asked):
    """Start or end a fault in a device of an emulated robot."""

    do: Literal["fault"]
    device: Annotated[str, Field(max_length=64)]
    fault: DeviceFault


class PlaceObstacle(Asked):
    """Place an obstacle in the world of an emulated robot."""

    do: Literal["obstacle"]
    at: tuple[Number, Number] | None
    """Position (m); None removes all obstacles."""


class Calibrate(Asked):
    """List the calibration wizards, run one, answer its question, accept its result or discard it."""

    do: Literal["calibrate"]
    order: Literal["list", "start", "answer", "accept", "discard"]
    step: Annotated[str, Field(max_length=100)] = ""
    """Wizard to start."""
    options: Annotated[dict[Name, Number | bool | Name], Field(max_length=32)] = Field(default_factory=dict)
    """Options of the wizard that override the defaults."""
    value: Number | bool = False
    """Answer: a number, or True for yes."""


class ListNumbers(Asked):
    """List the numbers that can be plotted."""

    do: Literal["numbers"]


class PlotNumbers(Asked):
    """Send the values of these numbers instead of the previous selection."""

    do: Literal["plot"]
    set: Id
    """Number of this selection, which its values carry."""
    names: Annotated[tuple[Annotated[str, Field(max_length=100)], ...], Field(max_length=100)]


class ControlReplay(_Command):
    """Seek in the shown recording (s since its start), play or pause it, or change its rate."""

    do: Literal["seek"]
    at: Number | None = None
    stamp: Stamp | None = None
    """Moment to show."""
    playing: bool | None = None
    rate: Number | None = None


AnyCommand = (
    Watch
    | LookAtFleet
    | EchoRequest
    | Heartbeat
    | GiveOrder
    | SetGoal
    | ChangeGoal
    | Behave
    | Explore
    | DoMission
    | Track
    | TrackFile
    | StartPath
    | ChangeZone
    | ChangePoint
    | AskToDrive
    | HandOver
    | Acknowledge
    | ListSettings
    | ChangeSetting
    | ListRecordings
    | DeleteRecording
    | ReplayRecording
    | InjectFault
    | PlaceObstacle
    | Calibrate
    | ListNumbers
    | PlotNumbers
    | ControlReplay
)
Command = Annotated[AnyCommand, Field(discriminator="do")]

_COMMANDS: Final[TypeAdapter[AnyCommand]] = TypeAdapter(Command)


LOOKING: Final = Watch | LookAtFleet | EchoRequest | ControlReplay | ListNumbers | PlotNumbers
"""Commands that do not reach a robot."""


def needed(command: AnyCommand) -> AccessRole:
    """Return the role required for a command; every user may watch and stop."""
    if isinstance(command, GiveOrder) and command.order in UNCONDITIONAL:
        return AccessRole.OBSERVER
    if isinstance(command, LOOKING | ListSettings | ListRecordings):
        return AccessRole.OBSERVER
    return AccessRole.ENGINEER if isinstance(command, ChangeSetting | DeleteRecording | Calibrate) else AccessRole.PILOT


def parse(data: str) -> AnyCommand:
    """Parse the command in one message.

    Raises:
        InputError: the message is not a command; the text names the first wrong field.
    """
    try:
        return _COMMANDS.validate_json(data)
    except ValidationError as error:
        raise InputError(first_mistake(error, "message")) from None
