"""Mount of the lidar, checked against odometry over a whole log: the yaw, and whether the scans are mirrored.

Wheels measure motion in the robot's axes, scans in the axes of the lidar. A lidar that is turned by an angle against
its mount sees every motion turned by that angle the other way, and the map is none the worse for it; one that hangs
upside down sees every turn reversed.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, wrap

LEAST_YAW: Final = math.radians(1.5)
"""A lidar is fitted by hand to about this: in recorded logs (Intel, ACES, CSAIL) it is off by 0.4 to 1.2 degrees."""


@dataclass(frozen=True, slots=True)
class MountCheck:
    """Result of the check."""

    yaw: float
    """Yaw of the lidar relative to its mount, rad."""
    deviation: float
    """Standard deviation of ``yaw``, rad."""
    mirrored: bool
    """Whether the scans turn against odometry."""

    @classmethod
    def of(cls, scans: Sequence[ScanInput], trajectory: tuple[NDArray[np.int64], Array]) -> Self | None:
        """Compare the motions of a log's path.

        Args:
            scans: scans of the log, with odometry where it has any.
            trajectory: stamps (n,), ns, and poses (n, 3) by the scans.

        Returns:
            None if there are too few stretches of odometry.
        """
        pairs = list(_stretches(scans, trajectory))
        if len(pairs) < 10:  # minimum number of stretches for a report
            return None
        by_wheels, by_scans = (np.array(motions) for motions in zip(*pairs, strict=True))
        turns = float(np.sum(by_wheels[:, 2] * by_scans[:, 2]))
        mirrored = turns < -np.sum(by_wheels[:, 2] ** 2) / 2
        angles = np.arctan2(by_wheels[:, 1], by_wheels[:, 0]) - np.arctan2(by_scans[:, 1], by_scans[:, 0])
        angles = wrap(angles)
        yaw = float(np.median(angles))
        spread = float(np.median(np.abs(angles - yaw))) * 1.48  # of a normal distribution
        return cls(yaw, spread * math.sqrt(math.pi / 2 / len(angles)), bool(mirrored))

    @property
    def fault(self) -> str | None:
        """Fault of the mount, and the remedy; None if none is certain."""
        if self.mirrored:
            return "scans turn against odometry: the lidar hangs upside down, or its beams run the other way"
        sure = 3.0  # standard deviations
        if abs(self.yaw) < max(LEAST_YAW, sure * self.deviation):
            return None
        text = f"{math.degrees(self.yaw):+.1f} degrees (standard deviation {math.degrees(self.deviation):.1f})"
        return f"the lidar is turned by {text} against its mount: add that to its yaw, or run `calibrate lidar`"


def _stretches(
    scans: Sequence[ScanInput], trajectory: tuple[NDArray[np.int64], Array]
) -> Iterator[tuple[Array, Array]]:
    """Motions over successive stretches, by odometry and by the scans; shape (3,) each."""
    odometry = {scan.stamp: scan.odom for scan in scans}
    begin: tuple[Array, Array] | None = None
    for stamp, pose in zip(trajectory[0].tolist(), trajectory[1], strict=True):
        odom = odometry.get(stamp)
        if odom is None:
            begin = None
            continue
        at = np.array(odom)
        if begin is None:
            begin = at, pose
            continue
        moved = between(begin[0], at)
        stretch = 0.3  # distance by odometry over which both motions are compared, m: a match is known to 1 or 2 cm
        if math.hypot(moved[0], moved[1]) >= stretch:
            yield moved, between(begin[1], pose)
            begin = at, pose
