"""Inputs and outputs of the exploring step; lightweight, as the daemon's loop imports them."""

from dataclasses import dataclass

from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.collision import Footprint
from monstertruck_planners.explore.catalog import AnyExplorer
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Grid
from monstertruck_schemas.zones import Zones

Point = tuple[float, float]
"""x, y (m)."""


@dataclass(frozen=True, slots=True)
class CameraView:
    """Camera data for the search for tags."""

    mount: Pose2 = (0.18, 0.0, 0.0)
    """Camera pose in base."""
    view: float = 0.95
    """Usable angle of view (rad)."""
    reach: float = 1.4
    """Maximum distance of a wall (m)."""
    nearest: float = 0.25
    """Minimum distance of a wall (m)."""
    oblique: float = 0.75
    """Maximum angle from the normal of a wall (rad)."""


@dataclass(frozen=True, slots=True)
class ExploreSetup:
    """Settings and robot data of the exploring step; sent first, and again after every restart."""

    config: AnyExplorer
    footprint: Footprint
    radius: float
    """Minimum turning radius (m)."""
    margin: float = 0.04
    """Clearance of routes from obstacles (m)."""
    lidar: Pose2 = (0.0, 0.0, 0.0)
    """Lidar pose in base."""
    camera: CameraView = CameraView()
    zone_margin: float = 0.0
    """Clearance from keepout zones required by the gate (m)."""


@dataclass(frozen=True, slots=True)
class ExploreTask:
    """Data newer than the previous task, and whether a decision is requested."""

    pose: Pose2
    """Pose of the base in the map frame."""
    whole: Grid | None = None
    """Whole map, which replaces the previous one."""
    tiles: tuple[Grid, ...] = ()
    """Tiles newer than the whole map."""
    setup: ExploreSetup | None = None
    choose: bool = False
    """Choose the next viewpoint."""
    current: "Viewpoint | None" = None
    """Viewpoint the robot is driving to."""
    pursued: float = 0.0
    """Time since the robot set course for ``current`` (s)."""
    banned: tuple[Point, ...] = ()
    """Places whose frontiers are skipped."""
    avoided: tuple[Point, ...] = ()
    """Unreachable places, where no viewpoints are placed."""
    home: Pose2 | None = None
    """Home pose, if the path to it is requested."""
    find: bool = False
    """Whether walls are viewed once no frontier is left."""
    zones: Zones | None = None
    """Zones of the map, if they have changed; then the map comes as a whole."""


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """Viewpoint and its frontier."""

    pose: Pose2
    """Pose of the base in the map frame."""
    frontier: Point
    """Centre of the viewed frontier or wall."""
    path_length: float = 0.0
    """Path length to the viewpoint (m)."""
    gain: float = 0.0
    """Expected new area (m^2)."""


@dataclass(frozen=True, slots=True)
class ExploreAnswer:
    """Decision and state of the map."""

    target: Viewpoint | None = None
    """Chosen viewpoint; None if no reachable one is left or none was requested."""
    kept: bool = False
    """Whether ``target`` is the current viewpoint."""
    frontiers: int = 0
    """Number of reachable frontiers."""
    banned: int = 0
    """Number of other frontiers that are skipped for now."""
    known: float = 0.0
    """Area of free ground in the map (m^2)."""
    home: float | None = None
    """Length of the path home (m); None if not requested or if no path is known."""
    failure: Reason | None = None
    """Why there is no decision, or None."""
    text: str = ""
    """Description of the failure."""
