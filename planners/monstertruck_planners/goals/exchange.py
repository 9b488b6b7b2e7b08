"""Inputs and outputs of the planning step and the deforming step; light, as the daemon's loop imports them."""

from dataclasses import dataclass
from typing import Literal

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.pose_path import PosePath
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_schemas.health import PLACELESS, SlamHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Grid, Ground, Odometry

Place = tuple[float, float, float | None]
"""x, y (m), and yaw (rad) if it matters."""


@dataclass(frozen=True, slots=True)
class Setup:
    """What planning and deforming are made for; comes first, and again after every restart."""

    config: PlannerConfig
    geometry: FourWheelSteering
    footprint: Footprint
    lidar: Pose2 = (0.0, 0.0, 0.0)
    """Pose of the lidar in base."""
    cusp_clearance: float = 0.0
    """Clearance that the gate demands at a cusp, m."""
    seen_for: float | None = None
    """Age up to which seen ground counts as seen by the gate, s; None = it lets the robot reverse anywhere."""
    timed: bool = False
    """Whether the route planner works for its time or for its effort: only the latter is reproducible."""


@dataclass(frozen=True, slots=True)
class SeenScan:
    """A scan taken on the way, in the map's frame."""

    points: Array
    """Shape (n, 2): its returns, m."""
    sensor: Array
    """Shape (2,): where it was taken, m."""


@dataclass(frozen=True, slots=True)
class SeenGround:
    """Ground that the gate remembers as seen."""

    grid: Grid
    """See ``topics.SEEN``."""
    pose: Pose2
    """Of the grid's frame in the map's frame."""
    field: tuple[float, float]
    """Least and greatest bearing that the lidar measures, rad."""
    reach: float
    """Its range, m."""


@dataclass(frozen=True, slots=True)
class PlanTask:
    """One thing to plan."""

    what: Literal["route", "escape"]
    pose: Pose2
    """Of the base, in the map's frame."""
    goal: Pose2
    """Of the base."""
    points: Array
    """Shape (n, 2): returns of the newest scan in the map's frame, m."""
    setup: Setup | None = None
    grid: Grid | None = None
    """A newer map than before."""
    ground: Ground | None = None
    """Newer tilt and roughness of the ground than before."""
    clear: bool = False
    """Forget obstacles of older scans, but for those near the truck, and the route so far."""
    afresh: bool = False
    """Forget the route so far."""
    via: tuple[Place, ...] = ()
    """Places of the base to be passed before the goal."""
    deviation: float = 0.0
    """Standard deviation of the position, m."""
    seen: tuple[SeenScan, ...] = ()
    """Scans taken since the task before, oldest first."""
    ground_seen: SeenGround | None = None
    """None = not known: routes may reverse anywhere."""


@dataclass(frozen=True, slots=True)
class RouteAnswer:
    """A path to drive, or the reason why there is none."""

    reason: Reason
    text: str = ""
    path: PosePath | None = None
    """Path of the base, or None."""
    length: float = 0.0
    """Metres."""
    cost: float = 0.0
    """Metres, with all prices."""
    kept: bool = False
    """Whether it is the rest of the previous route."""
    drivable: bool = True
    """Whether the truck can drive it; else its poses only show where to go."""
    complete: bool = True
    """Whether it leads to the goal; else it is the beginning of a route too long for one path."""


@dataclass(frozen=True, slots=True)
class DeformTask:
    """One scan, with what is newer than at the scan before."""

    scan: LaserScan
    pose: Pose2
    """Of the base, in the map's frame."""
    setup: Setup | None = None
    grid: Grid | None = None
    route: PosePath | None = None
    """Route of the base to deform."""
    number: int = 0
    """Number of this route."""
    drivable: bool = True
    """Whether the truck can drive it; else a local path along it is always driven."""
    deviation: float = 0.0
    """Standard deviation of the position, m."""
    stamp: int = 0
    """Of the pose, ns."""
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Vx, vy, wz of the base since the scan, m/s and rad/s."""


Finding = Literal["idle", "free", "kept", "new", "blocked"]
"""No route yet; the route is free; the deformed path is kept; here is a new one; there is none."""


@dataclass(frozen=True, slots=True)
class DeformAnswer:
    """What becomes of the route."""

    number: int
    """The route's."""
    finding: Finding
    reason: Reason = Reason.OK
    """Of a new path PATH_PARTIAL if only its beginning is free; of none why."""
    text: str = ""
    place: int = 0
    """Index of the route's pose that the truck has come to."""
    complete: bool = False
    """The path leads to the route's end."""
    path: PosePath | None = None
    """The new path, of the base."""


def level(scan: LaserScan, config: PlannerConfig) -> bool:
    """Whether the plane of a scan was level enough to show obstacles; true where its tilt is not known."""
    return scan.tilt is None or scan.tilt <= config.max_tilt


def placeless(slam: SlamHealth | None) -> str:
    """Why the pose in map means nothing, by the newest state of the mapping; empty if it does, or there is none."""
    if slam is None or slam.standing not in PLACELESS:
        return ""
    return f"its place on the saved map is not known ({slam.standing})"


def require_place(slam: SlamHealth | None) -> None:
    """Whether the pose in map means something, by the newest state of the mapping; None = there is none.

    Raises:
        RequestRefusedError: it does not: the robot has not found its place on its saved map.
    """
    if why := placeless(slam):
        hint = "`monstertruckd drive` it a metre or two there, by which it finds itself"
        raise RequestRefusedError(Reason.POSE_LOST, f"{why}: {hint}")


def explained_within(config: PlannerConfig, deviation: float) -> float:
    """Distance from the map's obstacles at which returns are taken for those, m, at a deviation of the position."""
    return config.scan_tolerance + min(2.0 * deviation, config.scan_tolerance)


def pose_of(odometry: Odometry) -> Pose2:
    """x, y (m), yaw (rad)."""
    return odometry.pose.x, odometry.pose.y, odometry.pose.yaw


def twist_of(odometry: Odometry) -> tuple[float, float, float]:
    """Vx, vy (m/s), wz (rad/s)."""
    return odometry.twist.vx, odometry.twist.vy, odometry.twist.wz
