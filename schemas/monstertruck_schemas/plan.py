"""Messages of the ``plan`` group: paths, tracker progress, and the planners' drive requests."""

from enum import StrEnum
from typing import Annotated, Final, Literal, Protocol

import numpy as np
from pydantic import Field

from monstertruck_schemas.base import Float64Array, Message, Pose2D, Schema
from monstertruck_schemas.reasons import Reason

Steering = Literal["front", "rear", "counter", "crab", "hybrid"]
"""Which axles steer: one alone, both by opposite or by equal angles, or both freely."""


MAX_POSES: Final = 5000
"""Poses of a path that is driven."""
MAX_COORDINATE: Final = 10_000.0
"""Size of x and y, m, and of yaw, rad, in paths and goals."""
MAX_RUNS: Final = 64
"""Runs of a path that is driven: parts between two stops, where the direction changes, or crab begins or ends."""


class Path(Message):
    """Poses to be driven in order, expressed in ``frame``."""

    poses: Float64Array
    """Shape (3 n,), row-major (x, y, yaw) rows: m, m, rad."""
    directions: Float64Array
    """Shape (n,): +1 where the truck arrives forward, -1 backward; empty = all forward."""
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
    """It only brings the robot to rest; once that is disarmed nothing is left of it to be followed."""
    name: str = ""
    """Name of the path; empty if it has none."""


class AxleResponse(Schema):
    """Response of the axles to requests: assumed by a tracker, and estimated from the truck's turns."""

    dead_time: Annotated[float, Field(ge=0)]
    """Assumed, from a request to the first movement of the wheels, s."""
    lag: Annotated[float, Field(ge=0)]
    """Assumed time constant of the axles after the dead time (s)."""
    delay: Annotated[float, Field(ge=0)]
    """Estimated, dead time and lag together, s."""
    deviation: Annotated[float, Field(ge=0)]
    """Standard deviation of that, s."""
    samples: Annotated[int, Field(ge=0)]
    """Measured turns that the estimate rests on."""


class AxleDeviation(Schema):
    """How one axle steers against its calibration, as a tracker has learnt it."""

    axle: Literal["front", "rear"]
    """Axle that the values describe."""
    gain: float
    """Angle for each requested angle."""
    gain_deviation: Annotated[float, Field(ge=0)]
    """Standard deviation of that."""
    trim: float
    """Angle when straight ahead is requested, rad, left positive."""
    trim_deviation: Annotated[float, Field(ge=0)]
    """Standard deviation of that, rad."""
    slip: float
    """Angle lost for each m/s^2 of lateral acceleration, rad s^2/m."""
    slip_deviation: Annotated[float, Field(ge=0)]
    """Standard deviation of that, rad s^2/m."""
    samples: Annotated[int, Field(ge=0)]
    """Compared pieces of motion that this rests on."""
    servo_differs: bool
    """Whether gain or trim certainly differs from the calibration."""


class TrackerState(Message):
    """How well the tracker follows its path."""

    path: str = ""
    """Name of the path."""
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
    axles: AxleResponse | None = None
    steering: tuple[AxleDeviation, ...] = ()
    """Front and rear axle; empty where nothing is steered."""
    steering_differs: str = ""
    """Difference from the calibration, as a sentence; empty if none is known."""


class TaskState(Protocol):
    """Common fields of the reports on tasks: goals, explorations, missions and behaviours."""

    @property
    def number(self) -> int:
        """Number of tasks of its kind since the start of the daemon."""

    @property
    def source(self) -> str:
        """Who requested it."""

    @property
    def running(self) -> bool:
        """Whether it has not ended."""

    @property
    def activity(self) -> str:
        """Description of the running task."""

    @property
    def outcome(self) -> Reason:
        """DRIVING while it runs, then how it ended."""

    @property
    def text(self) -> str:
        """The outcome in words."""

    @property
    def elapsed(self) -> float:
        """Seconds since it was started."""


class GoalPhase(StrEnum):
    """State of a goal."""

    IDLE = "idle"
    """Nothing: there is none, or ``outcome`` says how the last one ended."""
    PLANNING = "planning"
    DRIVING = "driving"
    BACKING_OUT = "backing_out"
    WAITING = "waiting"
    PAUSED = "paused"


class GoalState(Message):
    """Progress towards a goal, in ``frame``."""

    number: Annotated[int, Field(ge=0)] = 0
    """Number of goals accepted since the start."""
    source: str = ""
    """Who requested it."""
    goal: Pose2D | None = None
    phase: GoalPhase = GoalPhase.IDLE
    """Current phase."""
    outcome: Reason = Reason.OK
    """DRIVING while it is pursued, then GOAL_REACHED, CANCELLED, or why it was given up."""
    text: str = ""
    """The outcome in words."""
    waypoints: Annotated[int, Field(ge=0)] = 0
    """Still to be passed."""
    remaining: Annotated[float, Field(ge=0)] = 0.0
    """Remaining length of the current path (m)."""
    elapsed: Annotated[float, Field(ge=0)] = 0.0
    """Seconds spent on it, excluding pauses."""
    routes: Annotated[int, Field(ge=0)] = 0
    """Number of routes so far, including the current one."""
    recoveries: Annotated[int, Field(ge=0)] = 0
    """Recovery behaviours run so far."""

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self.phase is not GoalPhase.IDLE

    @property
    def activity(self) -> str:
        """Description of the running task."""
        return f"goal {self.number} of {self.source} is pursued"


DOCK: Final = "dock"
"""Kind of the behaviour that docks: while it runs, every image is searched for tags."""


class DockTarget(Schema):
    """Dock that a behaviour drives to or away from."""

    name: str
    """Its name in the configuration"""
    pose: Pose2D
    """Pose of base at the dock, turned to face it, in the ``frame`` of odometry"""


class BehaviourState(Message):
    """Progress of a behaviour, in the ``frame`` of odometry."""

    number: Annotated[int, Field(ge=0)] = 0
    """Number of behaviours started since the start of the daemon."""
    behaviour: str = ""
    """Its name in the configuration."""
    kind: str = ""
    """Kind of the behaviour."""
    source: str = ""
    """Who started it."""
    running: bool = False
    """Whether it runs now."""
    phase: str = ""
    """Current phase; each kind has its own names."""
    outcome: Reason = Reason.OK
    """DRIVING while it runs, then BEHAVIOUR_DONE, CANCELLED, or why it stopped."""
    text: str = ""
    """The outcome in words."""
    elapsed: Annotated[float, Field(ge=0)] = 0.0
    """Seconds since it was started."""
    travelled: Annotated[float, Field(ge=0)] = 0.0
    """Metres by odometry since it was started."""
    values: dict[str, float] = Field(default_factory=dict)
    """Measurements of its kind, such as the distance from a wall, m."""
    dock: DockTarget | None = None
    """Dock near which the gate lets the robot drive, while it runs."""

    @property
    def activity(self) -> str:
        """Description of the running task."""
        return f"the behaviour {self.behaviour} of {self.source} is running"


class ExplorationPhase(StrEnum):
    """State of an exploration."""

    IDLE = "idle"
    """Nothing: there is none, or ``outcome`` says how the last one ended."""
    LOOKING = "looking"
    """It stands and decides where to look next."""
    DRIVING = "driving"
    LOST = "lost"
    """It stands, for its place in the map is not known."""
    RETURNING = "returning"
    SAVING = "saving"
    """It waits until the map is saved."""


class ExplorationState(Message):
    """Progress of an exploration, in ``frame``."""

    number: Annotated[int, Field(ge=0)] = 0
    """Number of explorations since the start of the daemon."""
    kind: str = ""
    """Kind of the explorer."""
    source: str = ""
    """Who requested it."""
    phase: ExplorationPhase = ExplorationPhase.IDLE
    """Current phase."""
    outcome: Reason = Reason.OK
    """DRIVING while it runs, then EXPLORED, BUDGET_SPENT, CHARGE_SPENT, CANCELLED, or why it was given up."""
    text: str = ""
    """Outcome in words; the awaited condition while it runs."""
    target: Pose2D | None = None
    """Current target."""
    frontiers: Annotated[int, Field(ge=0)] = 0
    """Frontiers that can be reached."""
    left_alone: Annotated[int, Field(ge=0)] = 0
    """Frontiers on the blacklist."""
    known: Annotated[float, Field(ge=0)] = 0.0
    """Area of the free ground in the map, m^2."""
    travelled: Annotated[float, Field(ge=0)] = 0.0
    """Metres since it was started."""
    elapsed: Annotated[float, Field(ge=0)] = 0.0
    """Seconds since it was started."""
    home: Annotated[float, Field(ge=0)] | None = None
    """Length of the path back to the start (m); None if unknown."""
    goals: Annotated[int, Field(ge=0)] = 0
    """Number of targets so far."""
    failures: Annotated[int, Field(ge=0)] = 0
    """Number of these whose place was not reached."""
    find: Annotated[int, Field(ge=1)] | None = None
    """Number of tags to find; None to explore only."""
    found: Annotated[int, Field(ge=0)] = 0
    """Tags in the map."""

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self.phase is not ExplorationPhase.IDLE

    @property
    def activity(self) -> str:
        """Description of the running task."""
        return f"the exploration of {self.source} is running"


class MissionLine(Schema):
    """A step in the list of a mission's steps."""

    number: str
    """Position, such as 2.1"""
    depth: Annotated[int, Field(ge=0)]
    """Number of steps that contain it"""
    text: str
    """Step in words."""
    active: bool = False
    """Whether the current step is this one or within it"""


class MissionState(Message):
    """Progress of a mission."""

    number: Annotated[int, Field(ge=0)] = 0
    """Number of missions since the start of the daemon."""
    name: str = ""
    """Name of the mission."""
    source: str = ""
    """Who requested it."""
    running: bool = False
    """Whether it runs now."""
    resumable: bool = False
    """Whether an interrupted mission can be resumed."""
    step: Annotated[int, Field(ge=0)] = 0
    """Number of the current step, from 1, nested steps not counted; 0 if none runs."""
    steps: Annotated[int, Field(ge=0)] = 0
    """Number of steps, nested steps not counted."""
    node: str = ""
    """Position of the current step among those within others, such as 2.1"""
    lines: tuple[MissionLine, ...] = ()
    """Steps around the current one"""
    doing: str = ""
    """Current step in words."""
    attempt: Annotated[int, Field(ge=0)] = 0
    """Attempt at the current step, counted from 1."""
    failures: Annotated[int, Field(ge=0)] = 0
    """Steps that have failed so far."""
    failed: str = ""
    """Why the last attempt at a step failed."""
    outcome: Reason = Reason.OK
    """DRIVING while it runs, then MISSION_DONE, CANCELLED, or why it ended."""
    text: str = ""
    """Outcome in words; the condition awaited by the current step while it runs."""
    elapsed: Annotated[float, Field(ge=0)] = 0.0
    """Seconds since it was started or resumed."""

    @property
    def activity(self) -> str:
        """Description of the running task."""
        return f"the mission of {self.source} is running"


class StabiliserCommand(Message):
    """Joint angles the lidar's mount has to take, see ``sensor.StabiliserFeedback`` for order and signs."""

    pitch: float
    """Rad, nose down positive."""
    roll: float
    """Rad, right side down positive."""
