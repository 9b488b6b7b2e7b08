"""Scans of a log, and the common input of all readers: geometry, clocks, odometry at a scan."""

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, between, interpolate
from monstertruck_runtime.clock import SECOND

BEGIN: Final = SECOND
"""Stamp of the first scan in a log whose times have another origin (ns)."""
SHORTEST_RANGE: Final = 0.02
"""Default minimum range of a return (m)."""
LONGEST_RANGE: Final = 80.0
"""Ranges at or above this mean no return in the lasers of CARMEN logs (m)."""


@dataclass(frozen=True, slots=True)
class LogGeometry:
    """Geometry of the scans of a log that lacks it; None for the log's value or a default."""

    start_angle: float | None = None
    """Angle of the first beam (rad), counter-clockwise from straight ahead."""
    angle_increment: float | None = None
    """Angle between neighbouring beams (rad)."""
    range_min: float | None = None
    """Minimum range of a return (m)."""
    range_max: float | None = None
    """Range without a return (m)."""
    time_increment: float | None = None
    """Time between neighbouring beams (s)."""
    mount: Pose2 | None = None
    """Planar pose of the sensor in base (m, rad)."""

    @property
    def known(self) -> dict[str, Any]:
        """Fields that are not None."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True, slots=True)
class ScanLog:
    """Scans of a log, in order."""

    make: str
    scans: list[ScanInput]
    begin: float = 0.0
    """Time of the log's clock at stamp 0 (s)."""
    assumed: tuple[str, ...] = field(default=())
    """Parts of the geometry that neither the log nor the caller gave."""
    fault: str | None = None
    """Damage of the file, such as a missing end."""
    sources: dict[str, str] = field(default_factory=dict)
    """Sources of scans, odometry and mount in the log, if there was a choice."""


def vector(values: Any) -> Pose2:
    """Convert a pose to three floats."""
    x, y, yaw = (float(value) for value in values)
    return x, y, yaw


def missing(known: dict[str, Any]) -> tuple[str, ...]:
    """Return the fields of ``LogGeometry`` that are not ``known``."""
    return tuple(item.name for item in fields(LogGeometry) if item.name not in known)


def no_return(ranges: Array) -> float:
    """Return the range that means no return: a recurring maximum, or infinity.

    Args:
        ranges: ranges of any shape, at least one of them finite (m).
    """
    finite = ranges[np.isfinite(ranges)]
    greatest = float(finite.max())
    no_return_share = 0.001  # minimum fraction of beams at a log's maximum range for that range to mean no return
    recurs = np.count_nonzero(finite == greatest) >= max(no_return_share * finite.size, 3)
    return min(greatest if recurs else math.inf, LONGEST_RANGE)


def half_turn(stamp: int, ranges: Array, odom: Pose2 | None, geometry: dict[str, Any]) -> ScanInput:
    """Return a scan with this ``geometry``; by default 180 degrees ahead in n beams, or n + 1 with both ends."""
    count = len(ranges)
    assumed = {
        "start_angle": -math.pi / 2,
        "angle_increment": math.pi / max(count - count % 2, 1),
        "range_min": SHORTEST_RANGE,
    }
    return ScanInput(stamp=stamp, ranges=ranges, odom=odom, **(assumed | geometry))


def steady_clock(*clocks: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
    """Select the clock that best separates a log's scans.

    This is the first clock whose smallest step is shorter than the mean time between scans, otherwise the one with the
    most distinct times. Scans with the same time are then spread evenly up to the next.

    Args:
        clocks: times of the scans by each clock, shape (n,) (ns).

    Returns:
        Number of the clock, and times by it.

    Raises:
        ValueError: there are several scans, all with the same time on every clock.
    """
    for number, times in enumerate(clocks):
        if not _coarse(times):
            return number, times
    number = max(range(len(clocks)), key=lambda i: len(np.unique(clocks[i])))
    times = clocks[number]
    starts = np.flatnonzero(np.diff(times, prepend=times[0] - 1))
    if len(starts) < 2:
        raise ValueError(f"all {len(times)} scans have the same time")
    last = times[starts[-1]] + (times[starts[-1]] - times[0]) * (len(times) - starts[-1]) // starts[-1]
    return number, np.interp(
        np.arange(len(times)), [*starts, len(times)], [*(times[starts] - times[0]), last - times[0]]
    ).astype(np.int64) + times[0]


def _coarse(times: NDArray[np.int64]) -> bool:
    steps = np.diff(times)
    rising = steps[steps > 0]
    if len(rising) == len(steps):
        return False
    return not len(rising) or bool(rising.min() >= (times.max() - times.min()) / len(steps))


@dataclass(frozen=True, slots=True)
class OdometryLog:
    """Odometry of a log, interpolated at its scans."""

    stamps: NDArray[np.int64]
    """Stamps, shape (n,), increasing (ns)."""
    poses: Array
    """Poses of base in odom, shape (n, 3)."""

    def attached(self, scan: ScanInput) -> ScanInput:
        """Return the scan with pose and velocity of base from odometry; unchanged outside its time range."""
        if not len(self.stamps) or not self.stamps[0] <= scan.stamp <= self.stamps[-1]:
            return scan
        duration = scan.time_increment * len(scan.ranges)
        times = (np.array((scan.stamp, scan.stamp + duration * SECOND)) - self.stamps[0]).astype(np.float64)
        first, last = interpolate((self.stamps - self.stamps[0]).astype(np.float64), self.poses, times)
        twist = between(first, last) / max(duration, 1e-3)
        return replace(scan, odom=vector(first), twist=vector(twist))
