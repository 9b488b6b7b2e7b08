"""What a browser may ask of the station: one JSON object a message."""

import math
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import first_mistake
from monstertruck_schemas.req import UNCONDITIONAL, BehaviourOrder, ExploreOrder, GoalOrder, MissionOrder, Order, Role
from monstertruck_schemas.roles import AccessRole

LONGEST_MESSAGE: Final = 262_144
"""Bytes of a command at most: the file of a raceline of some kilometres."""

DeviceFault = Literal["none", "unplugged", "deaf", "noise"]
"""Of an emulated device: works; its cable is unplugged; it hears nothing; one bit in 50 bytes is wrong."""
Number = Annotated[float, Field(allow_inf_nan=False)]
Heading = Annotated[float, Field(ge=-math.tau, le=math.tau)]
"""rad; at most one turn."""
Place = Annotated[tuple[Number, ...], Field(min_length=2, max_length=3)]
"""x, y (m) and optionally yaw (rad)."""
Id = Annotated[int, Field(ge=0, lt=2**53)]


class _Command(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Asked(_Command):
    """A command whose outcome is answered."""

    id: Id


class Watch(_Command):
    """Look at a robot."""

    do: Literal["watch"]
    robot: Annotated[str, Field(max_length=200)]
    """Name of a robot, or of a recording that is shown."""


class LookAtFleet(_Command):
    """Show where all robots are, or no longer."""

    do: Literal["fleet"]
    on: bool


class EchoRequest(_Command):
    """Answer at once: the browser measures the way to the station."""

    do: Literal["ping"]
    at: Number
    """The browser's time, ms."""


class Heartbeat(_Command):
    """One heartbeat of a hand on stick, keys or gamepad: what the input says at this moment."""

    do: Literal["drive"]
    heard: Number
    """The station's time in the newest answer to a ``ping``, ms."""
    since: Number
    """Time from that answer to reading the input, by the browser's clock, ms."""
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
    """Arm, disarm, stop, emergency stop or its reset."""

    do: Literal["order"]
    order: Order
    hold: bool = False


class SetGoal(Asked):
    """Drive to a pose in the frame of the map, by way of others."""

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
    """Start an exploration, or end it."""

    do: Literal["explore"]
    order: ExploreOrder


class DoMission(Asked):
    """Start a mission, resume one, or end it."""

    do: Literal["mission"]
    order: MissionOrder
    text: Annotated[str, Field(max_length=LONGEST_MESSAGE)] = ""
    """Of a start: the mission's file, YAML."""
    moved: bool = False
    """Of a resume: the robot is not where the mission was interrupted, and its pose is right."""


class Track(Asked):
    """Follow a path that was drawn on the map, in its frame."""

    do: Literal["track"]
    points: Annotated[tuple[tuple[Number, Number], ...], Field(min_length=2, max_length=400)]


class TrackFile(Asked):
    """Follow the path of a file, in the frame map."""

    do: Literal["track_file"]
    name: Annotated[str, Field(max_length=128)]
    """Of the file; its suffix says whether it is a table or YAML."""
    text: Annotated[str, Field(max_length=LONGEST_MESSAGE)]
    closed: bool = False
    """The path is a lap."""


class StartPath(Asked):
    """Drive the configured path."""

    do: Literal["start_path"]
    path: Annotated[str, Field(max_length=128)]


class AskToDrive(Asked):
    """Ask whoever drives to hand over."""

    do: Literal["ask"]


class HandOver(Asked):
    """Let somebody drive who has asked to."""

    do: Literal["hand_over"]
    to: Annotated[str, Field(max_length=64)]


class Acknowledge(Asked):
    """A warning was seen."""

    do: Literal["acknowledge"]
    text: Annotated[str, Field(max_length=200)]


class ListSettings(Asked):
    """What may be changed while the robot runs."""

    do: Literal["settings"]


class ChangeSetting(Asked):
    """Change a setting while the robot runs."""

    do: Literal["set"]
    key: Annotated[str, Field(max_length=100)]
    value: Number | bool | Annotated[str, Field(max_length=100)]
    save: bool = False


class ListRecordings(Asked):
    """The recordings on the robot."""

    do: Literal["recordings"]


class DeleteRecording(Asked):
    """Delete one of them."""

    do: Literal["delete_recording"]
    name: Annotated[str, Field(max_length=128)]


class ReplayRecording(Asked):
    """Fetch a recording from the robot, and show it."""

    do: Literal["replay"]
    name: Annotated[str, Field(max_length=128)]


class InjectFault(Asked):
    """Let a device of an emulated robot fail, or work again."""

    do: Literal["fault"]
    device: Annotated[str, Field(max_length=64)]
    fault: DeviceFault


class PlaceObstacle(Asked):
    """Put an obstacle into the world of an emulated robot."""

    do: Literal["obstacle"]
    at: tuple[Number, Number] | None
    """Place, m; None removes all obstacles."""


class ControlReplay(_Command):
    """Go to a time of the recording that is shown, s since its beginning; play or pause; play at another rate."""

    do: Literal["seek"]
    at: Number | None = None
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
    | ControlReplay
)
Command = Annotated[AnyCommand, Field(discriminator="do")]

_COMMANDS: Final[TypeAdapter[AnyCommand]] = TypeAdapter(Command)


def needed(command: AnyCommand) -> AccessRole:
    """What a user must be to ask for it: everybody may look, and stop."""
    if isinstance(command, GiveOrder) and command.order in UNCONDITIONAL:
        return AccessRole.OBSERVER
    if isinstance(command, Watch | LookAtFleet | EchoRequest | ControlReplay | ListSettings | ListRecordings):
        return AccessRole.OBSERVER
    return AccessRole.ENGINEER if isinstance(command, ChangeSetting | DeleteRecording) else AccessRole.PILOT


def parse(data: str) -> AnyCommand:
    """The command of one message.

    Raises:
        InputError: it is none; the text names the first wrong field.
    """
    try:
        return _COMMANDS.validate_json(data)
    except ValidationError as error:
        raise InputError(first_mistake(error, "message")) from None
