"""Messages of the ``plan`` group: paths, tracker progress, and the planners' drive requests."""

from enum import StrEnum
from typing import Annotated, Final, Literal, Protocol

import numpy as np
from pydantic import Field

from monstertruck_schemas.base import Float64Array, Message, Pose2D, Schema
from monstertruck_schemas.reasons import Reason

Steering = Literal["front", "rear", "counter", "crab", "hybrid"]
"""Steering mode: one axle alone, both with opposite or equal angles, or both freely."""


MAX_POSES: Final = 5000
"""Maximum number of poses of a path."""
MAX_COORDINATE: Final = 10_000.0
"""Maximum magnitude of x and y (m) and of yaw (rad) in paths and goals."""
MAX_RUNS: Final = 64
"""Maximum number of runs of a path: parts between two stops, where the direction changes, or crab starts or ends."""


class Path(Message):
    """Poses to drive in order, in ``frame``."""

    poses: Float64Array
    """Shape (3 n,), row-major (x, y, yaw) rows: m, m, rad."""
    directions: Float64Array
    """Shape (n,): +1 where the truck arrives forward, -1 backward; empty: all forward."""
    steering: tuple[Steering, ...] = ()
    """Steering mode on arrival at each of the n poses; empty for the tracker's setting. The poses' yaw is used only in
    the modes crab and hybrid; otherwise it follows from the path."""
    clearance: Float64Array = Field(default_factory=lambda: np.zeros(0))
    """Shape (n,): distance from the footprint to the nearest obstacle at each pose (m), up to the search radius; empty
    if unknown."""
    speeds: Float64Array = Field(default_factory=lambda: np.zeros(0))
    """Shape (n,): maximum speed at each pose (m/s, >= 0); empty for none. The tracker's speed and the limits of curves,
    ground and obstacles hold as well."""
    closed: bool = False
    """A closed path is a lap: it ends where it began."""
    halts: bool = False
    """Whether it only brings the robot to rest and is not resumed after disarming."""
    name: str = ""
    """Name of the path; empty if it has none."""


class AxleResponse(Schema):
    """Response of the axles to requests: assumed by a tracker, and estimated from the truck's turns."""

    dead_time: Annotated[float, Field(ge=0)]
    """Assumed dead time from a request to the first movement of the wheels, s."""
    lag: Annotated[float, Field(ge=0)]
    """Assumed time constant of the axles after the dead time (s)."""
    delay: Annotated[float, Field(ge=0)]
    """Estimated dead time plus lag, s."""
    deviation: Annotated[float, Field(ge=0)]
    """Standard deviation of the estimate, s."""
    samples: Annotated[int, Field(ge=0)]
    """Number of measured turns behind the estimate."""


class AxleDeviation(Schema):
    """Deviation of one axle's steering from its calibration, learnt by a tracker."""

    axle: Literal["front", "rear"]
    """Axle that the values describe."""
    gain: float
    """Ratio of actual to requested angle."""
    gain_deviation: Annotated[float, Field(ge=0)]
    """Standard deviation of the ratio."""
    trim: float
    """Angle when straight ahead is requested, rad, left positive."""
    trim_deviation: Annotated[float, Field(ge=0)]
    """Standard deviation of that angle, rad."""
    slip: float
    """Angle lost per lateral acceleration, rad s^2/m."""
    slip_deviation: Annotated[float, Field(ge=0)]
    """Standard deviation of that loss, rad s^2/m."""
    samples: Annotated[int, Field(ge=0)]
    """Number of compared pieces of motion."""
    servo_differs: bool
    """Whether gain or trim differs significantly from the calibration."""


class TrackerState(Message):
    """How well the tracker follows its path."""

    path: str = ""
    """Name of the path."""
    cross_track: float
    """Signed distance from the path, left positive, m."""
    heading_error: float
    """Heading error, rad."""
    along: Annotated[float, Field(ge=0)]
    """Distance travelled along the path, m."""
    length: Annotated[float, Field(ge=0)]
    """Length of the whole path, m."""
    outcome: Reason
    """DRIVING, GOAL_REACHED, PATH_LOST ..."""
    axles: AxleResponse | None = None
    steering: tuple[AxleDeviation, ...] = ()
    """Front and rear axle; empty without steering."""
    steering_differs: str = ""
    """Difference from the calibration, as a sentence; empty if none is known."""


class TaskState(Protocol):
    """Common fields of the reports on tasks: goals, explorations, missions and behaviours."""

    @property
    def number(self) -> int:
        """Number of the task of its kind since the start of the daemon."""

    @property
    def source(self) -> str:
        """Source of the request."""

    @property
    def running(self) -> bool:
        """Whether it is still running."""

    @property
    def activity(self) -> str:
        """Description of the running task."""

    @property
    def outcome(self) -> Reason:
        """DRIVING while it runs, then the reason of its end."""

    @property
    def text(self) -> str:
        """The outcome in words."""

    @property
    def elapsed(self) -> float:
        """Seconds since its start."""


class GoalPhase(StrEnum):
    """State of a goal."""

    IDLE = "idle"
    """No goal, or the last one has ended with ``outcome``."""
    PLANNING = "planning"
    DRIVING = "driving"
    BACKING_OUT = "backing_out"
    WAITING = "waiting"
    PAUSED = "paused"


class GoalState(Message):
    """Progress towards a goal, in ``frame``."""

    number: Annotated[int, Field(ge=0)] = 0
    """Number of the goal since the start."""
    source: str = ""
    """Source of the goal."""
    goal: Pose2D | None = None
    phase: GoalPhase = GoalPhase.IDLE
    """Current phase."""
    outcome: Reason = Reason.OK
    """DRIVING while it runs, then GOAL_REACHED, CANCELLED, or the reason for giving up."""
    text: str = ""
    """The outcome in words."""
    waypoints: Annotated[int, Field(ge=0)] = 0
    """Remaining waypoints."""
    remaining: Annotated[float, Field(ge=0)] = 0.0
    """Remaining length of the current path (m)."""
    elapsed: Annotated[float, Field(ge=0)] = 0.0
    """Time spent on it, excluding pauses, s."""
    routes: Annotated[int, Field(ge=0)] = 0
    """Number of routes so far, including the current one."""
    recoveries: Annotated[int, Field(ge=0)] = 0
    """Number of recovery behaviours so far."""

    @property
    def running(self) -> bool:
        """Whether it is still running."""
        return self.phase is not GoalPhase.IDLE

    @property
    def activity(self) -> str:
        """Description of the running task."""
        return f"goal {self.number} of {self.source} is pursued"


DOCK: Final = "dock"
"""Kind of the docking behaviour: while it runs, every image is searched for tags."""


class DockTarget(Schema):
    """Dock that a behaviour approaches or leaves."""

    name: str
    """Name of the dock in the configuration"""
    pose: Pose2D
    """Pose of base at the dock, turned to face it, in the ``frame`` of odometry"""


class BehaviourState(Message):
    """Progress of a behaviour, in the ``frame`` of odometry."""

    number: Annotated[int, Field(ge=0)] = 0
    """Number of the behaviour run since the start of the daemon."""
    behaviour: str = ""
    """Name of the behaviour in the configuration."""
    kind: str = ""
    """Kind of the behaviour."""
    source: str = ""
    """Source that started it."""
    running: bool = False
    """Whether it runs now."""
    phase: str = ""
    """Current phase; each kind has its own names."""
    outcome: Reason = Reason.OK
    """DRIVING while it runs, then BEHAVIOUR_DONE, CANCELLED, or the reason why it stopped."""
    text: str = ""
    """The outcome in words."""
    elapsed: Annotated[float, Field(ge=0)] = 0.0
    """Seconds since it was started."""
    travelled: Annotated[float, Field(ge=0)] = 0.0
    """Distance travelled by odometry since its start, m."""
    values: dict[str, float] = Field(default_factory=dict)
    """Measurements of this kind of behaviour, such as the distance from a wall, m."""
    dock: DockTarget | None = None
    """Dock near which the gate lets the robot drive during the behaviour."""

    @property
    def activity(self) -> str:
        """Description of the running task."""
        return f"the behaviour {self.behaviour} of {self.source} is running"


class ExplorationPhase(StrEnum):
    """State of an exploration."""

    IDLE = "idle"
    """No exploration, or the last one has ended with ``outcome``."""
    LOOKING = "looking"
    """The robot stands and selects the next target."""
    DRIVING = "driving"
    LOST = "lost"
    """The robot stands because its pose in the map is unknown."""
    RETURNING = "returning"
    SAVING = "saving"
    """The robot waits until the map is saved."""


class ExplorationState(Message):
    """Progress of an exploration, in ``frame``."""

    number: Annotated[int, Field(ge=0)] = 0
    """Number of the exploration since the start of the daemon."""
    kind: str = ""
    """Kind of the explorer."""
    source: str = ""
    """Source of the request."""
    phase: ExplorationPhase = ExplorationPhase.IDLE
    """Current phase."""
    outcome: Reason = Reason.OK
    """DRIVING while it runs, then EXPLORED, BUDGET_SPENT, CHARGE_SPENT, CANCELLED, or the reason for giving up."""
    text: str = ""
    """Outcome in words; the awaited condition while it runs."""
    target: Pose2D | None = None
    """Current target."""
    frontiers: Annotated[int, Field(ge=0)] = 0
    """Number of reachable frontiers."""
    left_alone: Annotated[int, Field(ge=0)] = 0
    """Number of frontiers on the blacklist."""
    known: Annotated[float, Field(ge=0)] = 0.0
    """Area of the free ground in the map, m^2."""
    travelled: Annotated[float, Field(ge=0)] = 0.0
    """Distance travelled since the start, m."""
    elapsed: Annotated[float, Field(ge=0)] = 0.0
    """Seconds since it was started."""
    home: Annotated[float, Field(ge=0)] | None = None
    """Length of the path back to the start (m); None if unknown."""
    goals: Annotated[int, Field(ge=0)] = 0
    """Number of targets so far."""
    failures: Annotated[int, Field(ge=0)] = 0
    """Number of targets that were not reached."""
    find: Annotated[int, Field(ge=1)] | None = None
    """Number of tags to find; None without tags."""
    found: Annotated[int, Field(ge=0)] = 0
    """Number of tags in the map."""

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self.phase is not ExplorationPhase.IDLE

    @property
    def activity(self) -> str:
        """Description of the running task."""
        return f"the exploration of {self.source} is running"


class MissionLine(Schema):
    """One line of a mission's list of steps."""

    number: str
    """Position, such as 2.1"""
    depth: Annotated[int, Field(ge=0)]
    """Number of steps that contain it"""
    text: str
    """Step in words."""
    active: bool = False
    """Whether it is, or contains, the current step"""


class MissionState(Message):
    """Progress of a mission."""

    number: Annotated[int, Field(ge=0)] = 0
    """Number of the mission since the start of the daemon."""
    name: str = ""
    """Name of the mission."""
    source: str = ""
    """Source of the request."""
    running: bool = False
    """Whether it runs now."""
    resumable: bool = False
    """Whether an interrupted mission can be resumed."""
    step: Annotated[int, Field(ge=0)] = 0
    """Number of the current step, from 1, nested steps not counted; 0 if none runs."""
    steps: Annotated[int, Field(ge=0)] = 0
    """Number of steps, nested steps not counted."""
    node: str = ""
    """Position of the current step within nested steps, such as 2.1"""
    lines: tuple[MissionLine, ...] = ()
    """Steps around the current one"""
    doing: str = ""
    """Description of the current step."""
    attempt: Annotated[int, Field(ge=0)] = 0
    """Attempt at the current step, counted from 1."""
    failures: Annotated[int, Field(ge=0)] = 0
    """Number of failed steps so far."""
    failed: str = ""
    """Failure of the last attempt at a step."""
    outcome: Reason = Reason.OK
    """DRIVING while it runs, then MISSION_DONE, CANCELLED, or the reason of its end."""
    text: str = ""
    """Outcome in words; the condition awaited by the current step while it runs."""
    elapsed: Annotated[float, Field(ge=0)] = 0.0
    """Seconds since it was started or resumed."""

    @property
    def activity(self) -> str:
        """Description of the running task."""
        return f"the mission of {self.source} is running"


class StabiliserCommand(Message):
    """Commanded joint angles of the lidar's mount; see ``sensor.StabiliserFeedback`` for order and signs."""

    pitch: float
    """Pitch, rad, nose down positive."""
    roll: float
    """Roll, rad, right side down positive."""
