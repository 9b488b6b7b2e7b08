"""What goes into the estimation worker and what comes out; light, so that the daemon can hold it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_schemas.health import Standing
from monstertruck_schemas.sensor import LaserScan

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

UNKNOWN: Final = -1
"""Value of a cell nothing is known of."""


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle of a grid."""

    cells: NDArray[np.int8]
    """Shape (rows, columns), row 0 at the lowest y: -1 unknown, 0 free .. 100 occupied."""
    origin: tuple[float, float]
    """Outer corner of cell (0, 0) in map, m."""
    resolution: float
    """Edge of a cell, m."""


@dataclass(frozen=True, slots=True)
class ScanInput:
    """One scan with everything known about it."""

    stamp: int
    """ns, of the first beam."""
    ranges: Array
    """Shape (n,), m; anything not finite is a no-return."""
    start_angle: float
    angle_increment: float
    range_min: float
    range_max: float
    time_increment: float = 0.0
    """Seconds between neighbouring beams."""
    mount: Vector = (0.0, 0.0, 0.0)
    """Planar pose of the sensor in base, m and rad."""
    odom: Vector | None = None
    """Base in odom at ``stamp``; None without odometry."""
    twist: Vector = (0.0, 0.0, 0.0)
    """The base's velocity during the scan, m/s and rad/s."""
    slopes: tuple[float, float] | None = None
    """Rise per metre along the sensor's x and y axis; None = not known, taken as level."""
    height: float | None = None
    """Of the sensor over the ground, m; None = not known, no ground is looked for."""
    ceiling: float | None = None
    """Of the ceiling over the ground, m."""

    @classmethod
    def of(cls, scan: LaserScan, mount: Vector) -> Self:
        """What the scan itself says."""
        return cls(
            stamp=scan.stamp,
            ranges=scan.ranges,
            start_angle=scan.start_angle,
            angle_increment=scan.angle_increment,
            range_min=scan.range_min,
            range_max=scan.range_max,
            time_increment=scan.time_increment,
            mount=mount,
        )


@dataclass(frozen=True, slots=True)
class Start:
    """How a worker begins."""

    config: SlamConfig
    pose: Vector = (0.0, 0.0, 0.0)
    """Base in map at the first scan."""


@dataclass(frozen=True, slots=True)
class WorkerInput:
    """One step's work; what is None or False is not asked for."""

    start: Start | None = None
    scan: ScanInput | None = None
    tiles: bool = False
    """Tell the changed tiles."""
    whole: bool = False
    """Tell the whole grid."""
    save: Path | None = None
    """Folder to save the map to."""
    finish: bool = False
    """First fit all key scans jointly (seconds of work)."""


@dataclass(frozen=True, slots=True)
class Moved:
    """How base moved between two scans that fitted, by the scans alone."""

    since: int
    """Stamp of the earlier scan, ns."""
    motion: Vector
    """Base at the later one in base at the earlier one."""
    covariance: tuple[float, ...]
    """Row-major (3, 3), of the later scan's place on the map, in base's axes: the earlier one's came with its own."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """What one scan told."""

    stamp: int
    pose: Vector
    """Base in map at ``stamp``."""
    covariance: tuple[float, ...]
    """Row-major (3, 3)."""
    map_from_odom: Vector | None
    """Odom in map; None without odometry."""
    standing: Standing
    overlap: float
    residual: float
    degeneracy: float
    direction: float
    verdict: str
    events: tuple[str, ...] = ()
    offset: float | None = None
    """Seconds by which odometry runs ahead of the scans, as far as that was found."""
    moved: Moved | None = None
    """None for the first scan, and those that do not fit."""


@dataclass(frozen=True, slots=True)
class WorkerOutput:
    """What one step gave."""

    estimate: Estimate | None = None
    refused: str | None = None
    """Why the scan was left out."""
    tiles: tuple[Patch, ...] = ()
    whole: Patch | None = None
    redrawn: bool = False
    """The grid was drawn anew since the last step: whoever holds tiles should take the whole."""
    counts: dict[str, int] = field(default_factory=dict)
    """Scans, key scans, closures, rejected matches since the start."""
    saved: str | None = None
    error: str | None = None
    """Why the map could not be saved."""
