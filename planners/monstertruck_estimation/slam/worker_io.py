"""Inputs and outputs of the SLAM worker; without numba, so that the daemon can import them."""

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2
from monstertruck_schemas.health import LocalisationStatus, OdometryUse
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM, LaserScan

UNKNOWN: Final = -1
"""Value of an unknown cell."""


@dataclass(frozen=True, slots=True)
class GridPatch:
    """Rectangle of a grid."""

    cells: NDArray[np.int8]
    """Shape (rows, columns), row 0 at the lowest y: -1 unknown, 0 free .. 100 occupied."""
    origin: tuple[float, float]
    """Outer corner of cell (0, 0) in map (m)."""
    resolution: float
    """Edge of a cell (m)."""


@dataclass(frozen=True, slots=True)
class ScanInput:
    """One scan with odometry, tilt and mount."""

    stamp: int
    """Stamp of the first beam (ns)."""
    ranges: Array
    """Ranges, shape (n,) (m); +inf without a return within the sensor's range, NaN if unknown."""
    start_angle: float
    angle_increment: float
    range_min: float
    range_max: float
    time_increment: float = 0.0
    """Time between neighbouring beams (s)."""
    mount: Pose2 = (0.0, 0.0, 0.0)
    """Planar pose of the sensor in base (m, rad)."""
    odom: Pose2 | None = None
    """Base in odom at ``stamp``; None without odometry."""
    twist: Twist2 = (0.0, 0.0, 0.0)
    """Velocity of base during the scan (m/s, rad/s)."""
    slopes: tuple[float, float] | None = None
    """Rise per metre along the sensor's x and y axis; None if unknown, which is treated as level."""
    height: float | None = None
    """Height of the sensor above the ground (m); None if unknown: hits of the ground are then kept."""
    ceiling: float | None = None
    """Height of the ceiling above the ground (m)."""
    range_noise: float | None = None
    """Standard deviation of a short range (m); None if unknown."""

    @classmethod
    def of(cls, scan: LaserScan, mount: Pose2) -> Self:
        """Return the input built from the message's data."""
        return cls(
            stamp=scan.stamp,
            ranges=np.where((scan.codes == VALID_BEAM) | (scan.codes <= NO_ECHO), scan.ranges, np.nan),
            start_angle=scan.start_angle,
            angle_increment=scan.angle_increment,
            range_min=scan.range_min,
            range_max=scan.range_max,
            time_increment=scan.time_increment,
            mount=mount,
            range_noise=scan.range_noise,
        )


@dataclass(frozen=True, slots=True)
class Start:
    """Configuration of a new worker."""

    config: SlamConfig
    pose: Pose2 = (0.0, 0.0, 0.0)
    """Base in map at the first scan."""
    body: tuple[float, float] | None = None
    """Length and width of the robot (m): the ground under it is free; None if unknown."""
    run: str = ""
    """Run that makes the map, for its saves; an empty name makes every save a separate run."""


@dataclass(frozen=True, slots=True)
class WorkerInput:
    """Tasks of one step; None and False for parts not requested."""

    start: Start | None = None
    scan: ScanInput | None = None
    other: ScanInput | None = None
    """Scan of the second lidar, drawn but not matched."""
    tiles: bool = False
    """Whether to return the changed tiles."""
    whole: bool = False
    """Whether to return the whole grid."""
    save: Path | None = None
    """Folder for saving the map."""
    finish: bool = False
    """Whether to optimise all keyframes jointly first (seconds of work)."""
    trajectory: bool = False
    """Whether to return the poses of all scans."""
    instants: tuple[int, ...] = ()
    """Stamps for which to return the pose of base (ns)."""


@dataclass(frozen=True, slots=True)
class ScanIncrement:
    """Motion of base between two accepted matches, by the scans alone."""

    since: int
    """Stamp of the earlier scan (ns)."""
    motion: Pose2
    """Base at the later match in base at the earlier one."""
    covariance: tuple[float, ...]
    """Covariance of the later scan's pose in the map, in base's axes, row-major (3, 3); the earlier one came before."""


@dataclass(frozen=True, slots=True)
class SlamEstimate:
    """Pose and quality of match of one scan."""

    stamp: int
    pose: Pose2
    """Base in map at ``stamp``."""
    covariance: tuple[float, ...]
    """Covariance of the pose, row-major (3, 3)."""
    map_from_odom: Pose2 | None
    """Odom in map; None without odometry."""
    status: LocalisationStatus
    overlap: float
    residual: float
    degeneracy: float
    direction: float
    verdict: str
    events: tuple[str, ...] = ()
    offset: float | None = None
    """Lead of odometry over the scans (s); None if not found."""
    mount_fault: str | None = None
    """Fault of the lidar's mount; None without a certain fault."""
    moved: ScanIncrement | None = None
    """Motion since the last match; None for the first scan, and after rejected matches."""
    odometry: OdometryUse = OdometryUse.NONE


class ScanLeftOut(StrEnum):
    """Reason why a scan was not used."""

    GEOMETRY = "another geometry"
    ORDER = "stamp not later than the previous scan's"
    EMPTY = "too few returns"


@dataclass(frozen=True, slots=True)
class WorkerOutput:
    """Result of one step."""

    estimate: SlamEstimate | None = None
    refused: str | None = None
    """Reason why the scan was left out, with its figures."""
    left_out: ScanLeftOut | None = None
    """The same reason without figures."""
    tiles: tuple[GridPatch, ...] = ()
    whole: GridPatch | None = None
    counts: dict[str, int] = field(default_factory=dict)
    """Numbers of scans, keyframes, closures and rejected matches since the start."""
    saved: str | None = None
    error: str | None = None
    """Reason why the map could not be saved."""
    trajectory: tuple[NDArray[np.int64], Array] | None = None
    """Stamps (n,) (ns) and poses (n, 3) of base in map at the first beam of every scan; None for a saved map."""
    on_map: NDArray[np.bool_] | None = None
    """Whether each scan of ``trajectory`` belongs to the map, not to a submap that is not joined to it, shape (n,)."""
    bases: Array | None = None
    """Base in map at the requested stamps, shape (n, 3); NaN where unknown; None for a saved map."""
    joint: bool | None = None
    """After ``finish``: whether the joint registration was kept because it agreed better than the graph."""
    remarks: tuple[str, ...] = ()
    """Remarks on the saved map loaded in this step."""
    unreadable: str | None = None
    """Reason why the saved map cannot be loaded; the step then did no other work."""
