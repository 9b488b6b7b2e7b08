"""The topic table: one row per key. Bus, recorder, health, access rules and docs are derived from it.

Other distributions add topics through entry points that name a ``Topic``::

    [project.entry-points."monstertruck.topics"]
    "sensor/radar" = "my_package.topics:RADAR"
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any, Final, Generic, TypeVar

from monstertruck_schemas.base import Message
from monstertruck_schemas.cmd import DriveCommand, SteeringCommand
from monstertruck_schemas.entry_points import ExtensibleTable
from monstertruck_schemas.event import Call, Event, LogRecord, Stop
from monstertruck_schemas.health import (
    CalibrationHealth,
    HealthTable,
    HostHealth,
    LinkHealth,
    LoopHealth,
    OdometryHealth,
    RecorderHealth,
    SlamHealth,
)
from monstertruck_schemas.plan import (
    BehaviourState,
    ExplorationState,
    GoalState,
    MissionState,
    Path,
    StabiliserCommand,
    TrackerState,
)
from monstertruck_schemas.points import PointsOfInterest, TagPoses
from monstertruck_schemas.req import (
    ControlRequest,
    DriveRequest,
    GoalControl,
    GoalRequest,
    LocalisationRequest,
    MapRequest,
    PathRequest,
)
from monstertruck_schemas.sensor import (
    Attitude,
    Battery,
    CompressedImage,
    DriveFeedback,
    HandControls,
    Imu,
    LaserScan,
    SonarRanges,
    StabiliserFeedback,
    StandPose,
    SteeringFeedback,
    WheelEncoders,
)
from monstertruck_schemas.state import (
    ClockOffset,
    Consistency,
    GateState,
    Grid,
    Ground,
    Odometry,
    Peers,
    ScanMotion,
    Transforms,
)
from monstertruck_schemas.usb import UsbTree
from monstertruck_schemas.zones import Zones

M = TypeVar("M", bound=Message)

KEY_ROOT: Final = "mt"

SOURCE_NAME: Final = re.compile(r"[A-Za-z0-9_.:-][A-Za-z0-9_.@:-]{0,63}")
"""Names that are one chunk of a key: a first @ would hide it from wildcards."""


class Writer(StrEnum):
    """Permitted publisher of a topic; the bus refuses all others."""

    DRIVER = "driver"
    ESTIMATION = "estimation"
    PLANNER = "planner"
    GATE = "gate"
    DAEMON = "daemon"
    OUTSIDE = "outside"
    STAND = "stand"
    """A test stand, or the simulator: observes the robot; nothing in the robot reads its messages."""


@dataclass(frozen=True, slots=True)
class Topic(Generic[M]):
    """One row: message model of ``mt/<robot>/<name>``, rate, writer and retention."""

    name: str
    model: type[M]
    writer: Writer
    doc: str
    rate: float | None = None
    """Nominal rate in Hz; None: on change."""
    stale_after: float | None = None
    """Age after which the latest message is stale, s, for every reader in the robot. Requests are limited by their
    lease and commands by ``command_timeout`` of the drivers: their limits here are for display only."""
    logged: bool = True
    retained: bool = False
    """Late joiners get the latest message at once."""
    foxglove: str | None = None
    """Well-known protobuf schema on the wire; None for JSON with JSON Schema."""
    place: str | None = None
    """Key below ``mt/`` with ``{robot}``, for messages about a robot from elsewhere; None if below its own name."""

    @property
    def group(self) -> str:
        """First part of the name: sensor, state, plan, cmd, health, event or req."""
        return self.name.partition("/")[0]

    @property
    def schema_name(self) -> str:
        """Name of the wire schema."""
        return self.foxglove or f"monstertruck.{self.model.__name__}"

    def key(self, robot: str, source: str = "*") -> str:
        """Zenoh key expression of this topic on ``robot``; for a request, of one source or of all.

        A request ``req/drive`` of ``ann`` travels on ``mt/<robot>/req/ann/drive``.
        """
        if self.place is not None:
            return f"{KEY_ROOT}/{self.place.format(robot=robot)}"
        group, _, name = self.name.partition("/")
        parts = (group, source, name) if self.writer is Writer.OUTSIDE else (group, name)
        return "/".join((KEY_ROOT, robot, *parts))

    @property
    def inward(self) -> bool:
        """Whether the robot receives it from clients."""
        return self.writer in (Writer.OUTSIDE, Writer.STAND)

    def fresh_for(self) -> float:
        """Validity of a message (s); +inf for topics without a limit."""
        return math.inf if self.stale_after is None else self.stale_after


W = Writer

DRIVE_STALE: Final = 0.2
"""``stale_after`` of every driven shaft, s."""
POSE_STALE: Final = 0.2
"""``stale_after`` of dead reckoning and of the pose in the map (s): a tracker reads either."""

SCAN: Final = Topic(
    "sensor/scan", LaserScan, W.DRIVER, "Lidar revolution", 10, stale_after=0.25, foxglove="foxglove.LaserScan"
)
SCAN_2: Final = Topic(
    "sensor/scan_2",
    LaserScan,
    W.DRIVER,
    "Revolution of the second lidar, where there is one",
    10,
    stale_after=0.25,
    foxglove="foxglove.LaserScan",
)
COMPASS: Final = Topic("sensor/compass", Attitude, W.DRIVER, "Heading and tilt", 20, stale_after=0.25)
DRIVE: Final = Topic("sensor/drive", DriveFeedback, W.DRIVER, "Drive motor feedback", 20, stale_after=DRIVE_STALE)
DRIVE_2: Final = Topic(
    "sensor/drive_2", DriveFeedback, W.DRIVER, "Second driven shaft, where there is one", 20, stale_after=DRIVE_STALE
)
DRIVE_3: Final = Topic("sensor/drive_3", DriveFeedback, W.DRIVER, "Third driven shaft", 20, stale_after=DRIVE_STALE)
DRIVE_4: Final = Topic("sensor/drive_4", DriveFeedback, W.DRIVER, "Fourth driven shaft", 20, stale_after=DRIVE_STALE)
STEERING: Final = Topic("sensor/steering", SteeringFeedback, W.DRIVER, "Servo pulses being sent", 20, stale_after=0.25)
BATTERY: Final = Topic("sensor/battery", Battery, W.DRIVER, "Pack voltage and level", 10, stale_after=2.0)
CAMERA: Final = Topic(
    "sensor/camera",
    CompressedImage,
    W.DRIVER,
    "Pictures of the supervision camera",
    15,
    stale_after=2.0,
    foxglove="foxglove.CompressedImage",
)
STABILISER: Final = Topic(
    "sensor/stabiliser", StabiliserFeedback, W.DRIVER, "Joints of the lidar's mount", 25, stale_after=0.2
)
SONAR: Final = Topic(
    "sensor/sonar", SonarRanges, W.DRIVER, "Nearest echo of each sonar of the robot", 10, stale_after=0.3
)
IMU: Final = Topic("sensor/imu", Imu, W.DRIVER, "Angular velocity and specific force", 50, stale_after=0.2)
ENCODERS: Final = Topic(
    "sensor/encoders", WheelEncoders, W.DRIVER, "Rear wheels of a tricycle, by their encoders", 25, stale_after=0.2
)
HAND: Final = Topic(
    "sensor/hand", HandControls, W.DRIVER, "Radio control of the operator next to the robot", 50, stale_after=0.25
)

ODOMETRY: Final = Topic(
    "state/odometry",
    Odometry,
    W.ESTIMATION,
    "Dead-reckoned pose in odom",
    50,
    stale_after=POSE_STALE,
    foxglove="foxglove.PoseInFrame",
)
POSE: Final = Topic(
    "state/pose", Odometry, W.ESTIMATION, "Pose in map", 50, stale_after=POSE_STALE, foxglove="foxglove.PoseInFrame"
)
SCAN_MOTION: Final = Topic(
    "state/scan_motion", ScanMotion, W.ESTIMATION, "Motion of base between two scans, by the scans alone", 10
)
TRANSFORMS: Final = Topic(
    "state/transforms",
    Transforms,
    W.ESTIMATION,
    "Frame tree, static mounts included",
    10,
    retained=True,
    foxglove="foxglove.FrameTransforms",
)
MAP: Final = Topic("state/map", Grid, W.ESTIMATION, "Occupancy grid", 0.5, retained=True, foxglove="foxglove.Grid")
MAP_TILES: Final = Topic(
    "state/map_tiles",
    Grid,
    W.ESTIMATION,
    "Tiles of the occupancy grid that have changed since the message of the whole grid, one each",
    foxglove="foxglove.Grid",
)
GROUND: Final = Topic(
    "state/ground",
    Ground,
    W.ESTIMATION,
    "Tilt and roughness of the ground that was driven over or seen",
    retained=True,
    foxglove="foxglove.Grid",
)
POINTS: Final = Topic(
    "state/points",
    PointsOfInterest,
    W.ESTIMATION,
    "Points of interest in map: tags that the camera found, places that were marked",
    retained=True,
)
TAGS: Final = Topic(
    "state/tags", TagPoses, W.ESTIMATION, "Poses of the tags in an image, in base; of every image that was read", 5,
    stale_after=1.0,
)  # fmt: skip
ZONES: Final = Topic(
    "state/zones",
    Zones,
    W.PLANNER,
    "Keepout and speed zones of the map, those that are off, and those that the robot is in",
    retained=True,
)
PEERS: Final = Topic(
    "state/peers", Peers, W.ESTIMATION, "Poses published by other robots, with the time of their receipt", 10,
    stale_after=0.5,
)  # fmt: skip
CONSISTENCY: Final = Topic(
    "state/consistency",
    Consistency,
    W.ESTIMATION,
    "Comparison of the sensors' measures of motion: which are in use, and which sensor cannot be right",
    1,
    stale_after=3.0,
    retained=True,
)
GATE: Final = Topic(
    "state/gate", GateState, W.GATE, "Safety gate: mode, holder, limits, reasons", 10, stale_after=0.5, retained=True
)
SEEN: Final = Topic(
    "state/seen",
    Grid,
    W.GATE,
    "Ground around the robot that it may reverse onto: -1 not seen, else the age of the latest view in percent of "
    "gate.obstacle.memory_time; its frame is base at the stamp",
    1,
    retained=True,
    foxglove="foxglove.Grid",
)
CLOCK: Final = Topic("state/clock", ClockOffset, W.DAEMON, "Real time minus daemon time", 1, retained=True)

PATH: Final = Topic("plan/path", Path, W.PLANNER, "Path being tracked", retained=True, foxglove="foxglove.PosesInFrame")
TRACKER: Final = Topic("plan/tracker", TrackerState, W.PLANNER, "Tracking error and progress", 20, stale_after=0.5)
GOAL: Final = Topic("plan/goal", GoalState, W.PLANNER, "Progress towards the goal", 2, retained=True)
BEHAVIOUR: Final = Topic(
    "plan/behaviour", BehaviourState, W.PLANNER, "Progress of the running behaviour, or how the last one ended", 5,
    retained=True,
)  # fmt: skip
EXPLORE: Final = Topic(
    "plan/explore", ExplorationState, W.PLANNER, "Progress of the exploration, or how the last one ended", 2,
    retained=True,
)  # fmt: skip
MISSION: Final = Topic(
    "plan/mission", MissionState, W.PLANNER, "Progress of the mission, or how the last one ended", 2, retained=True
)
PLAN_DRIVE: Final = Topic(
    "plan/drive", DriveRequest, W.PLANNER, "The planners' drive requests to the gate", 20, stale_after=0.3
)
PLAN_STABILISER: Final = Topic(
    "plan/stabiliser",
    StabiliserCommand,
    W.PLANNER,
    "Joint goals of the lidar's mount; they move no wheel, so they pass no gate",
    25,
    stale_after=0.5,
)

CMD_DRIVE: Final = Topic("cmd/drive", DriveCommand, W.GATE, "Command sent to the drive controller", 50, stale_after=0.1)
CMD_DRIVE_2: Final = Topic(
    "cmd/drive_2", DriveCommand, W.GATE, "The same to the second driven shaft", 50, stale_after=0.1
)
CMD_DRIVE_3: Final = Topic(
    "cmd/drive_3", DriveCommand, W.GATE, "The same to the third driven shaft", 50, stale_after=0.1
)
CMD_DRIVE_4: Final = Topic(
    "cmd/drive_4", DriveCommand, W.GATE, "The same to the fourth driven shaft", 50, stale_after=0.1
)
CMD_STEERING: Final = Topic("cmd/steering", SteeringCommand, W.GATE, "Command sent to the servos", 50, stale_after=0.1)

HEALTH: Final = Topic(
    "health/services", HealthTable, W.DAEMON, "Every service's state", 1, stale_after=3.0, retained=True
)
CALIBRATION: Final = Topic(
    "health/calibration",
    CalibrationHealth,
    W.DAEMON,
    "Calibrations with quality and expiry; total distance driven",
    retained=True,
)
LOOP: Final = Topic("health/loop", LoopHealth, W.DAEMON, "Lateness of the control tick", 1, stale_after=3.0)
RECORDER: Final = Topic("health/recorder", RecorderHealth, W.DAEMON, "Recorder", 1, stale_after=3.0, retained=True)
LINK: Final = Topic("health/link", LinkHealth, W.DRIVER, "Wi-Fi or Ethernet link of the robot", 1, stale_after=3.0)
HOST: Final = Topic(
    "health/host", HostHealth, W.DRIVER, "Load, temperature, memory and disk of the computer", 1, stale_after=3.0
)
SLAM: Final = Topic("health/slam", SlamHealth, W.ESTIMATION, "How well the scans fit the map", 10, stale_after=3.0)
FUSION: Final = Topic(
    "health/odometry", OdometryHealth, W.ESTIMATION, "Slip, and a disturbed compass", 1, stale_after=3.0
)
USB: Final = Topic("health/usb", UsbTree, W.DAEMON, "USB hubs, ports and devices", 1, stale_after=3.0, retained=True)

EVENT: Final = Topic("event/event", Event, W.DAEMON, "Decisions, faults and recoveries")
STOP: Final = Topic("event/stop", Stop, W.GATE, "Why the robot was stopped, with the chain of causes", retained=True)
CALL: Final = Topic("event/call", Call, W.DAEMON, "Remote calls that change something: who, what, answer")
LOG: Final = Topic("event/log", LogRecord, W.DAEMON, "The daemon's journal", foxglove="foxglove.Log")

REQ_DRIVE: Final = Topic(
    "req/drive",
    DriveRequest,
    W.OUTSIDE,
    "Drive by speed and axle angles, by twist, or by shaft speeds",
    20,
    stale_after=0.3,
)
REQ_CONTROL: Final = Topic("req/control", ControlRequest, W.OUTSIDE, "Arm, disarm, e-stop, reset, stop")
REQ_GOAL: Final = Topic("req/goal", GoalRequest, W.OUTSIDE, "A pose to drive to")
REQ_GOAL_CONTROL: Final = Topic("req/goal_control", GoalControl, W.OUTSIDE, "Pause, resume or cancel the goal")
REQ_PATH: Final = Topic("req/path", PathRequest, W.OUTSIDE, "A path computed off board")
REQ_LOCALISATION: Final = Topic(
    "req/localisation", LocalisationRequest, W.OUTSIDE, "Pose of odom in map, by a localisation off board"
)
REQ_MAP: Final = Topic("req/map", MapRequest, W.OUTSIDE, "Map made off board")

STAND_POSE: Final = Topic(
    "stand/pose",
    StandPose,
    W.STAND,
    "Pose of the robot as a test stand sees it; recorded with the robot's topics, used only by its consistency check",
    20,
    place="stand/sensor/pose_{robot}",
)

SCANS: Final = (SCAN, SCAN_2)
"""Scans of the lidars in their order; most robots have the first one only."""
DRIVES: Final = (DRIVE, DRIVE_2, DRIVE_3, DRIVE_4)
"""Feedback of the driven shafts in their order; most robots have the first one only."""
CMD_DRIVES: Final = (CMD_DRIVE, CMD_DRIVE_2, CMD_DRIVE_3, CMD_DRIVE_4)
"""Their commands."""

OPEN_GROUPS: Final = {
    "sensor": (W.DRIVER,),
    "state": (W.ESTIMATION,),
    "plan": (W.PLANNER,),
    "health": (W.DRIVER, W.ESTIMATION, W.PLANNER),
}
"""Groups that other distributions may extend, and who may write them."""


class TopicTable(ExtensibleTable[Topic[Message]]):
    """Topics by name: built-in ones, then those of other distributions."""

    def fault(self, row: Any) -> str | None:
        """Return an error in a topic of another distribution, or None."""
        if not isinstance(row, Topic):
            return f"expected a Topic, found {type(row).__name__}"
        if row.group not in OPEN_GROUPS or not re.fullmatch(r"[a-z]+/[a-z][a-z0-9_]*", row.name):
            return f"expected a name like sensor/radar, in one of the groups {', '.join(OPEN_GROUPS)}"
        if row.writer not in OPEN_GROUPS[row.group]:
            return f"written by {row.writer}: expected {' or '.join(OPEN_GROUPS[row.group])}"
        model: Any = row.model
        if not (isinstance(model, type) and issubclass(model, Message)):
            return "model: expected a subclass of Message"
        if row.foxglove is not None:
            return "foxglove: only this repository's messages travel as Foxglove schemas"
        numbers: dict[str, Any] = {"rate": row.rate, "stale_after": row.stale_after}
        for name, value in numbers.items():
            if value is not None and not (isinstance(value, int | float) and value > 0):
                return f"{name}: expected a positive number, found {value!r}"
        model.model_json_schema()  # raises where the recorder would
        if self._models.setdefault(row.schema_name, model) is not model:
            return f"another message is called {row.schema_name}"
        return None

    @cached_property
    def _models(self) -> dict[str, type[Message]]:
        """Accepted messages by schema name."""
        return {known.schema_name: known.model for known in self.ours.values()}


BY_NAME: Final = TopicTable(
    "monstertruck.topics", [value for value in list(globals().values()) if isinstance(value, Topic)]
)
TOPICS: Final = BY_NAME.values()
"""All topics, in the order of the table."""


def topics_of(group: str) -> Iterator[Topic[Message]]:
    """Yield all rows of one group."""
    return (topic for topic in TOPICS if topic.group == group)


def rpc_key(robot: str, name: str, source: str | None = None) -> str:
    """Return the key of a remote call by ``source``; None for a call without a caller."""
    key = f"{KEY_ROOT}/{robot}/rpc/{name}"
    return key if source is None else f"{key}/{source}"


ESTOP_WAY: Final = "req/estop"
"""Name of the emergency stop's own key; inside the robot it is an order on ``req/control`` like any other."""


def estop_key(robot: str, source: str = "*") -> str:
    """Key of emergency stops, separate so that they wait behind no other request."""
    return f"{KEY_ROOT}/{robot}/req/{source}/estop"


def sender_in(robot: str, key: str) -> tuple[str, str | None] | None:
    """Return request and source of a ``key``: the inverse of ``Topic.key`` and ``rpc_key``.

    Returns:
        Name of the topic or call, and the source, None if the key has none. None for keys with wildcards and for
        invalid names.
    """
    head, parts = key.split("/")[:2], key.split("/")[2:]
    if head != [KEY_ROOT, robot] or not all(map(SOURCE_NAME.fullmatch, parts)):
        return None
    match parts:
        case ["req", source, name]:
            return f"req/{name}", source
        case ["req", name]:
            return f"req/{name}", None
        case ["rpc", name, source]:
            return name, source
        case ["rpc", name]:
            return name, None
    return None


def owner_of(source: str) -> str:
    """Name on the certificate of a source; one owner's programs are named ``owner:suffix``."""
    return source.partition(":")[0]


def alive_key(robot: str) -> str:
    """Key of the robot's liveliness token."""
    return f"{KEY_ROOT}/{robot}/alive"
