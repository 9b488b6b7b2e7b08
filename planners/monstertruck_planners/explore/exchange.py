"""Inputs and outputs of the exploring step; light, as the daemon's loop imports them."""

from dataclasses import dataclass

from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.collision import Footprint
from monstertruck_planners.explore.catalog import AnyExplorer
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Grid

Point = tuple[float, float]
"""x, y, m."""


@dataclass(frozen=True, slots=True)
class CameraView:
    """What the camera is good for where tags are looked for."""

    mount: Pose2 = (0.18, 0.0, 0.0)
    """In base."""
    view: float = 0.95
    """Angle of view that is counted on, rad."""
    reach: float = 1.4
    """Greatest distance, m."""
    nearest: float = 0.25
    """Distance of the nearest wall, m."""
    oblique: float = 0.75
    """Greatest angle from a wall's normal, rad."""


@dataclass(frozen=True, slots=True)
class ExploreSetup:
    """What exploring is made for; comes first, and again after every restart."""

    config: AnyExplorer
    footprint: Footprint
    radius: float
    """Least turning radius, m."""
    margin: float = 0.04
    """Kept to obstacles by the routes, m."""
    lidar: Pose2 = (0.0, 0.0, 0.0)
    """In base."""
    camera: CameraView = CameraView()


@dataclass(frozen=True, slots=True)
class ExploreTask:
    """What is newer than at the task before, and whether a decision is requested."""

    pose: Pose2
    """Of the base, in map."""
    whole: Grid | None = None
    """A whole map, which replaces the last one."""
    tiles: tuple[Grid, ...] = ()
    """Tiles that are newer than the whole map."""
    setup: ExploreSetup | None = None
    choose: bool = False
    """Say where to look next."""
    current: "Viewpoint | None" = None
    """Where the robot is going."""
    pursued: float = 0.0
    """Time for which it has been pursued, s."""
    banned: tuple[Point, ...] = ()
    """Frontiers here are skipped."""
    avoided: tuple[Point, ...] = ()
    """No viewpoints here: these places could not be reached."""
    home: Pose2 | None = None
    """The path there is wanted."""
    find: bool = False
    """Walls are looked at, too, once no frontier is left."""


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """A place to look from, and what for."""

    pose: Pose2
    """Of the base, in map."""
    frontier: Point
    """Centre of the frontier or wall that is viewed."""
    path_length: float = 0.0
    """Length of the path to a viewpoint, m."""
    gain: float = 0.0
    """New area that may be seen there, m^2."""


@dataclass(frozen=True, slots=True)
class ExploreAnswer:
    """What is known, and the decision."""

    target: Viewpoint | None = None
    """None = nothing is left that can be reached, or none was requested."""
    kept: bool = False
    """Whether it is the pursued one."""
    frontiers: int = 0
    """Frontiers that can be reached."""
    banned: int = 0
    """Others that are skipped for now."""
    known: float = 0.0
    """Area of the free ground in the map, m^2."""
    home: float | None = None
    """Metres of the path home; None = not requested, or none is known."""
    failure: Reason | None = None
    """Why there is no decision; None = there is one."""
    text: str = ""
    """The same in words."""
