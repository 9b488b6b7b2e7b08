"""What the goal service reads and writes, and how it reports."""

from dataclasses import dataclass

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.exchange import Pose
from monstertruck_planners.goals.mission import Mission
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink, Publisher, Subscription
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.plan import GoalState, Path, TrackerState
from monstertruck_schemas.req import DriveRequest, GoalControl, GoalRequest
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import GateState, Grid, Odometry


@dataclass(frozen=True, slots=True)
class Inputs:
    """What the service reads."""

    goals: Mailbox[GoalRequest]
    controls: Mailbox[GoalControl]
    gate: Subscription[GateState]
    pose: Subscription[Odometry]
    """In the paths' frame."""
    tracker: Subscription[TrackerState]
    path: Subscription[Path]
    scan: Subscription[LaserScan] | None
    grid: Subscription[Grid] | None
    """None = the configured map."""


@dataclass(frozen=True, slots=True)
class Outputs:
    """What it writes."""

    path: Publisher[Path]
    planner_request: Publisher[DriveRequest]
    state: Publisher[GoalState]
    events: EventSink


@dataclass(frozen=True)
class Followed:
    """The path being driven."""

    message: Path
    poses: Array
    travelled: Array
    before: float = 0.0
    """Metres driven on the paths that it was deformed from."""

    def told(self, report: TrackerState | None) -> TrackerState | None:
        """What the tracker says of it; None while that speaks of another path."""
        return report if report is not None and report.path == self.message.name else None

    def along(self, report: TrackerState | None) -> float:
        """Metres driven on it."""
        told = self.told(report)
        return 0.0 if told is None else told.along


def level(scan: LaserScan, config: PlannerConfig) -> bool:
    """Whether a scan lay flat enough to tell of the way, as far as it is known."""
    return scan.tilt is None or scan.tilt <= config.max_tilt


def pose_of(odometry: Odometry) -> Pose:
    """x, y (m), yaw (rad)."""
    return odometry.pose.x, odometry.pose.y, odometry.pose.yaw


def goal_state(
    mission: Mission | None, now: int, followed: Followed | None, inputs: Inputs, left: float = 0.0
) -> GoalState:
    """The report on a goal, its sequence number still 0; ``left`` metres of the route are ahead at least."""
    odometry = inputs.pose.latest
    frame = "map" if odometry is None else odometry.frame
    if mission is None:
        return GoalState(stamp=now, received=now, seq=0, frame=frame)
    x, y, yaw = mission.goal
    remaining = 0.0
    if followed is not None and mission.active:
        remaining = max(float(followed.travelled[-1]) - followed.along(inputs.tracker.latest), left, 0.0)
    return GoalState(
        stamp=now,
        received=now,
        seq=0,
        frame=frame,
        number=mission.number,
        source=mission.source,
        goal=Pose2D(x=x, y=y, yaw=yaw),
        phase=mission.phase,
        outcome=mission.outcome,
        text=mission.text,
        waypoints=len(mission.via) if mission.active else 0,
        remaining=remaining,
        elapsed=mission.elapsed,
        routes=mission.routes,
        recoveries=mission.recoveries,
    )
