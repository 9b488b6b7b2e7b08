"""Messages of the ``state`` group: estimates and state of the robot."""

from enum import StrEnum
from typing import Annotated, Final

from pydantic import Field

from monstertruck_schemas.base import (
    Covariance,
    FrameId,
    Int8Array,
    Message,
    Nanoseconds,
    Pose2D,
    Schema,
    Twist2D,
    UInt8Array,
    position_deviation,
)
from monstertruck_schemas.reasons import Reason, in_words
from monstertruck_schemas.req import DriveForm, Role


class Odometry(Message):
    """Pose of ``child`` in ``frame`` with velocity and covariance."""

    child: FrameId = "base"
    """Frame whose pose this is."""
    pose: Pose2D
    twist: Twist2D
    pose_covariance: Covariance
    """Shape (9,), row-major covariance of (x, y, yaw): m^2, m rad, rad^2."""
    twist_covariance: Covariance
    """Shape (9,), row-major covariance of (vx, vy, wz)."""
    age: Annotated[float, Field(ge=0)]
    """Age of the latest drive reading in this estimate (s); the time since is predicted."""
    sources: tuple[str, ...] = ()
    """Sensors used in this estimate, e.g. ("drive", "steering", "compass")."""
    degraded: bool = False
    """Whether it depends on an expired calibration."""

    @property
    def position_deviation(self) -> float:
        """Standard deviation of the position along the axis where it is largest, m."""
        return position_deviation(self.pose_covariance)


class Peer(Schema):
    """Report of another robot."""

    robot: str
    """Name of the robot."""
    pose: Pose2D
    """Pose in its map: robots that follow each other need one map, or starts measured in one frame."""
    twist: Twist2D
    """Twist in its base."""
    deviation: Annotated[float, Field(ge=0)] = 0.0
    """Standard deviation of its position along the axis where it is largest, by itself, m; 0 in older recordings."""
    heard: Nanoseconds
    """Time of receipt by this robot's clock: stamps of the other robot are meaningless here."""


class Peers(Message):
    """Latest pose of every other robot received since the start."""

    peers: tuple[Peer, ...] = ()


class ScanMotion(Message):
    """Motion of base between two scans, measured by the scans alone; ``stamp`` is the later stamp."""

    since: Nanoseconds
    """Stamp of the earlier scan."""
    motion: Pose2D
    """Base at ``stamp`` in base at ``since``."""
    covariance: Covariance
    """Shape (9,), row-major covariance of the later scan's place on the map, (x, y, yaw) in its own base's axes: m^2,
    m rad, rad^2; huge along a corridor. That of the earlier scan came with the motion before."""


class Transform(Schema):
    """Pose of ``child`` in ``parent``."""

    parent: FrameId
    """Frame in which the pose is given."""
    child: FrameId
    """Frame whose pose is given."""
    stamp: Nanoseconds
    """Time of the pose."""
    translation: tuple[float, float, float]
    """Metres."""
    rotation: tuple[float, float, float, float]
    """Unit quaternion x, y, z, w."""


class Transforms(Message):
    """The whole frame tree, including static mounts."""

    transforms: tuple[Transform, ...]


class Grid(Message):
    """Occupancy grid: row 0 is the lowest y, column 0 the lowest x."""

    resolution: Annotated[float, Field(gt=0)]
    """Metres per cell."""
    width: Annotated[int, Field(gt=0)]
    """Number of columns."""
    height: Annotated[int, Field(gt=0)]
    """Number of rows."""
    origin: Pose2D
    """Pose of the outer corner of cell (0, 0)."""
    cells: Int8Array
    """Shape (height * width,): -1 unknown, 0 free ... 100 occupied."""


TILT_STEP: Final = 0.005
"""Unit of ``Ground.tilt``, rad."""
ROUGHNESS_STEP: Final = 0.001
"""Unit of ``Ground.roughness``, m."""
GROUND_UNKNOWN: Final = 255
"""Value of a cell of ``Ground`` that was neither driven over nor seen."""


class Ground(Message):
    """Condition of the known ground: row 0 is the lowest y, column 0 the lowest x."""

    resolution: Annotated[float, Field(gt=0)]
    """Metres per cell."""
    width: Annotated[int, Field(gt=0)]
    """Number of columns."""
    height: Annotated[int, Field(gt=0)]
    """Number of rows."""
    origin: Pose2D
    """Pose of the outer corner of cell (0, 0)."""
    tilt: UInt8Array
    """Shape (height * width,): angle to the horizontal in units of ``TILT_STEP``; 255 unknown."""
    roughness: UInt8Array
    """Shape (height * width,): standard deviation of the height in units of ``ROUGHNESS_STEP``; 255 unknown."""


class ClockOffset(Message):
    """Real time = daemon time + offset."""

    offset: Nanoseconds
    """Real time minus daemon time."""
    stepped: Nanoseconds = 0
    """Size of the step since the message before; 0 when none."""


class DoubtKind(StrEnum):
    """Fault of a sensor."""

    MOTION = "motion"
    """It measures another motion than another sensor."""
    DELAY = "delay"
    """Its content is older than its stamps."""
    REPEATS = "repeats"
    """It repeats its values to the digit."""
    SCALE = "scale"
    """All its values have changed by one factor."""

    @property
    def lasting(self) -> bool:
        """Whether it lasts until the robot is armed again: a robot at rest provides no evidence about motion."""
        return self in {DoubtKind.MOTION, DoubtKind.DELAY}


class Doubt(Schema):
    """A wrong sensor, or one of two sensors that contradict each other."""

    sensor: str
    """Role of the device."""
    kind: DoubtKind
    """Kind of contradiction."""
    since: Nanoseconds
    """When it was found."""
    text: str
    """Which two disagree and by how much, in words."""
    against: str | None = None
    """Role of the other device."""
    difference: float = 0.0
    """m, rad, s, number of equal values or fraction of the values."""
    limit: float = 0.0
    """Tolerated difference, in the same unit."""


class UnshownMotion(Schema):
    """Motion of the body measured by the scans while its wheels report standstill; the scan points prove it.

    Successive measurements do not overlap: no motion is counted twice.
    """

    since: Nanoseconds
    """Stamp of the earlier scan."""
    stamp: Nanoseconds
    """Stamp of the latest scan."""
    distance: Annotated[float, Field(ge=0)]
    """Distance from where it was, m."""
    turn: float
    """Turn since then, rad."""


class StandingBody(Schema):
    """Evidence from the scans that the body stands although its wheels roll; a turn of 1 rad counts as 1 m."""

    since: Nanoseconds
    """Stamp of the latest scan before it stood."""
    stamp: Nanoseconds
    """Stamp of the latest scan."""
    rolled: Annotated[float, Field(ge=0)]
    """Distance by the wheels since then, m."""
    shown: float
    """Distance by the scans since then, in the direction of the wheels' motion, m."""


class Consistency(Message):
    """Comparison of the robot's independent measures of motion. Retained."""

    measures: tuple[str, ...]
    """Measures in use: wheels, scans, gyro, compass, encoders, stand."""
    distances: tuple[str, ...] | None = None
    """Measures of distances, not of turns alone; None if not reported."""
    doubts: tuple[Doubt, ...] = ()
    scans: str | None = None
    """Scan odometry in use: kiss or own; None if there is none."""
    unshown: UnshownMotion | None = None
    """Motion of the body that the wheels do not show, or None."""
    standing: StandingBody | None = None
    """Evidence that the body stands still although its wheels turn, or None."""


class GateMode(StrEnum):
    """States of the safety gate."""

    DISARMED = "disarmed"
    ARMED = "armed"
    DRIVING = "driving"
    STOPPING = "stopping"
    ESTOPPED = "estopped"

    @property
    def active(self) -> bool:
        """Whether the truck may move: it is armed, drives or is stopping."""
        return self in (GateMode.ARMED, GateMode.DRIVING, GateMode.STOPPING)

    @property
    def accepts_motion(self) -> bool:
        """Whether the gate carries out motion requests."""
        return self in (GateMode.ARMED, GateMode.DRIVING)

    @property
    def moving(self) -> bool:
        """Whether the truck drives or is stopping."""
        return self in (GateMode.DRIVING, GateMode.STOPPING)


class GateState(Message):
    """State of the safety gate: driver, limits and their reasons. Retained; also acknowledges requests."""

    mode: GateMode
    """State of the gate."""
    nonce: str
    """Changes at every start of the daemon; requests must carry it."""
    holder: str | None = None
    """Source that is driving."""
    role: Role | None = None
    """Role of the holder."""
    lease_left: float | None = None
    """Seconds until the holder's lease runs out."""
    last_seq: int | None = None
    """Latest accepted sequence number of the holder."""
    speed_limit: float
    """Speed allowed now, m/s."""
    reasons: tuple[Reason, ...] = ()
    """Everything that limits or stops the truck now, worst first."""
    stopping_distance: float = 0.0
    """Metres the truck would still travel if stopped now."""
    form: DriveForm | None = None
    """Form of the holder's latest request."""
    twist: Twist2D | None = None
    """Commanded velocity of the base, whatever the form of the request."""
    latched: bool = False
    """An emergency stop is on the disk: it outlasts a loss of power. Before that it outlasts the daemon only."""
    weakened: tuple[str, ...] = ()
    """Settings less safe than their defaults, each with its value and the default."""
    waiting: tuple[str, ...] = ()
    """Planners that request motion while no source drives: they start as soon as the truck is armed without
    ``hold``."""
    asking: tuple[str, ...] = ()
    """Operators who have asked the driving operator to hand over, latest last."""
    stopping: bool = False
    """The robot is to stand, and its standstill has not been measured since."""
    handed_to: str | None = None
    """Operator to whom the drive was handed over just now: others of that priority wait a moment."""

    @property
    def mode_text(self) -> str:
        """Mode in words; with ``stopping`` while standstill has not been measured."""
        still = self.stopping and self.mode is not GateMode.STOPPING
        return f"{self.mode.value}, stopping" if still else self.mode.value

    @property
    def worst(self) -> Reason:
        """Reason that limits the truck most; ``DISARMED`` if there is none."""
        return next(iter(self.reasons), Reason.DISARMED)

    @property
    def hindrances(self) -> tuple[Reason, ...]:
        """``reasons`` without ``DISARMED``, which only means that the truck is not armed."""
        return tuple(reason for reason in self.reasons if reason is not Reason.DISARMED)

    @property
    def why(self) -> str:
        """Why the truck stands or is slow, in words; without a reason, its mode."""
        return in_words(self.reasons) or f"the robot is {self.mode}"
