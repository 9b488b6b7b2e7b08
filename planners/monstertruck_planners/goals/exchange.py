"""Inputs and outputs of the planning and deforming steps; lightweight, as the daemon's loop imports them."""

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
from monstertruck_schemas.zones import Zones

Place = tuple[float, float, float | None]
"""x, y (m), and yaw (rad), or None for any yaw."""


@dataclass(frozen=True, slots=True)
class Setup:
    """Settings and robot data for planning and deforming; sent first, and again after every restart."""

    config: PlannerConfig
    geometry: FourWheelSteering
    footprint: Footprint
    lidar: Pose2 = (0.0, 0.0, 0.0)
    """Pose of the lidar in base."""
    cusp_clearance: float = 0.0
    """Clearance required by the gate at a cusp (m)."""
    zone_margin: float = 0.0
    """Clearance from keepout zones required by the gate (m)."""
    seen_for: float | None = None
    """Maximum age of seen ground in the gate (s); None if the gate lets the robot reverse anywhere."""
    timed: bool = False
    """Whether the time budget limits the route planner, or else its effort budget; only the latter is reproducible."""
    speed: float = 0.18
    """Speed of the tracker on a straight path (m/s)."""


@dataclass(frozen=True, slots=True)
class SeenScan:
    """Scan taken while driving, in the map frame."""

    points: Array
    """Returns of the scan (m), shape (n, 2)."""
    sensor: Array
    """Position of the sensor (m), shape (2,)."""


@dataclass(frozen=True, slots=True)
class SeenGround:
    """Ground that the gate remembers as seen."""

    grid: Grid
    """See ``topics.SEEN``."""
    pose: Pose2
    """Pose of the grid frame in the map frame."""
    field: tuple[float, float]
    """Minimum and maximum bearing of the lidar (rad)."""
    reach: float
    """Range of the lidar (m)."""


@dataclass(frozen=True, slots=True)
class PlanTask:
    """Planning request."""

    what: Literal["route", "escape"]
    pose: Pose2
    """Pose of the base in the map frame."""
    goal: Pose2
    """Goal pose of the base."""
    points: Array
    """Returns of the latest scan in the map frame (m), shape (n, 2)."""
    setup: Setup | None = None
    grid: Grid | None = None
    """Map, if newer than in the previous task."""
    ground: Ground | None = None
    """Tilt and roughness of the ground, if newer than in the previous task."""
    clear: bool = False
    """Discard obstacles of older scans, except those near the truck, and the current route."""
    afresh: bool = False
    """Discard the current route."""
    via: tuple[Place, ...] = ()
    """Waypoints of the base before the goal."""
    deviation: float = 0.0
    """Standard deviation of the position (m)."""
    seen: tuple[SeenScan, ...] = ()
    """Scans since the previous task, oldest first."""
    ground_seen: SeenGround | None = None
    """Seen ground; None if unknown: routes may reverse anywhere."""
    zones: Zones | None = None
    """Zones of the map, if newer than in the previous task."""
    start: Pose2 | None = None
    """Pose of the base where the path begins, as the truck is braking and comes to rest there; None for ``pose``."""


@dataclass(frozen=True, slots=True)
class RouteAnswer:
    """Path to drive, or the reason why there is none."""

    reason: Reason
    text: str = ""
    path: PosePath | None = None
    """Path of the base, or None."""
    length: float = 0.0
    """Length of the path (m)."""
    cost: float = 0.0
    """Cost of the path including all penalties (m)."""
    kept: bool = False
    """Whether the path is the rest of the previous route."""
    drivable: bool = True
    """Whether the truck can drive the path; otherwise its poses are only a guide."""
    complete: bool = True
    """Whether the path leads to the goal; otherwise it is the first part of a route too long for one path."""


@dataclass(frozen=True, slots=True)
class DeformTask:
    """A scan, and data newer than the previous scan."""

    scan: LaserScan
    pose: Pose2
    """Pose of the base in the map frame."""
    setup: Setup | None = None
    grid: Grid | None = None
    route: PosePath | None = None
    """Base route to deform."""
    number: int = 0
    """Number of the route."""
    drivable: bool = True
    """Whether the truck can drive the route; otherwise it always drives a local path along it."""
    deviation: float = 0.0
    """Standard deviation of the position (m)."""
    stamp: int = 0
    """Time stamp of the pose (ns)."""
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Vx, vy (m/s), wz (rad/s) of the base since the scan."""
    zones: Zones | None = None
    """Zones of the map, if newer than with the previous scan."""
    odometry: Pose2 | None = None
    """Pose of the base in the odometry frame at ``stamp``; None if ``pose`` is in that frame."""


Finding = Literal["idle", "free", "kept", "new", "blocked", "yields"]
"""State of the route: none yet; free; deformed path kept; new deformed path; no path found; letting a person pass."""


@dataclass(frozen=True, slots=True)
class DeformAnswer:
    """Result of deforming the route."""

    number: int
    """Number of the route."""
    finding: Finding
    reason: Reason = Reason.OK
    """PATH_PARTIAL if only the beginning of a new path is free; without a path, the cause."""
    text: str = ""
    place: int = 0
    """Index of the route pose that the truck has reached."""
    complete: bool = False
    """Whether the path leads to the end of the route."""
    path: PosePath | None = None
    """New path of the base."""


def level(scan: LaserScan, config: PlannerConfig) -> bool:
    """Whether the plane of a scan was level enough to show obstacles; true if its tilt is unknown."""
    return scan.tilt is None or scan.tilt <= config.max_tilt


def placeless(slam: SlamHealth | None) -> str:
    """Return why the pose in map is invalid, from the latest slam health; empty if it is valid or without slam."""
    if slam is None or slam.standing not in PLACELESS:
        return ""
    return f"its pose on the saved map is unknown ({slam.standing})"


def require_place(slam: SlamHealth | None) -> None:
    """Require a valid pose in map, from the latest slam health (None without slam).

    Raises:
        RequestRefusedError: the robot has not found its place on its saved map.
    """
    if why := placeless(slam):
        hint = "drive it a metre or two there with `monstertruckd drive`, so that it can localise"
        raise RequestRefusedError(Reason.POSE_LOST, f"{why}: {hint}")


def explained_within(config: PlannerConfig, deviation: float) -> float:
    """Maximum distance of a return from a map obstacle that explains it (m), for a position deviation (m)."""
    return config.scan_tolerance + min(2.0 * deviation, config.scan_tolerance)


def pose_of(odometry: Odometry) -> Pose2:
    """Return the pose: x, y (m), yaw (rad)."""
    return odometry.pose.x, odometry.pose.y, odometry.pose.yaw


def twist_of(odometry: Odometry) -> tuple[float, float, float]:
    """Return the twist: vx, vy (m/s), wz (rad/s)."""
    return odometry.twist.vx, odometry.twist.vy, odometry.twist.wz
