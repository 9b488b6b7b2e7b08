"""Estimate of the lidar's mount from the map: compares motions by the wheels with motions by the scans.

Wheels measure motion in the robot's axes, scans in the axes of the lidar. If the lidar is rotated against its
configured mount, every motion by the scans is rotated the other way, while the map stays consistent; if it hangs upside
down, every turn is reversed. With the lidar's pose X in its configured mount, A X = X B for motions A of the wheels and
B of the scans (Tsai and Lenz 1989): linear in its yaw, in the scale of the wheels, and in its displacement.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.motion import ClockOffsetEstimator
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, wrap
from monstertruck_schemas.health import OdometryUse

LEAST_YAW: Final = math.radians(1.5)
"""Accuracy of a lidar mounted by hand: in recorded logs (Intel, ACES, CSAIL) it is off by 0.4 to 1.2 degrees."""


@dataclass(frozen=True, slots=True)
class MountEstimate:
    """Deviation of the lidar's mount from its configuration."""

    yaw: float
    """Yaw of the lidar relative to its mount (rad)."""
    deviation: float
    """Standard deviation of ``yaw`` (rad)."""
    mirrored: bool
    """Whether the scans turn against odometry."""

    @property
    def fault(self) -> str | None:
        """Return the fault of the mount and its remedy; None without a certain fault."""
        if self.mirrored:
            return "scans turn against odometry: the lidar hangs upside down, or its beams run the other way"
        sure = 3.0  # standard deviations
        if abs(self.yaw) < LEAST_YAW + sure * self.deviation:
            return None
        text = f"{math.degrees(self.yaw):+.1f} degrees (standard deviation {math.degrees(self.deviation):.1f})"
        return (
            f"odometry and scans differ by {text} in direction. Either the lidar is turned relative to its mount: add "
            "that to its yaw, or run `calibrate lidar`. Or both axles steer to one side: run `calibrate steering`"
        )


class MountEstimator:
    """Estimate the mount from stretches of the path.

    Args:
        most: maximum number of stretches used, the latest ones; None for all.
    """

    def __init__(self, most: int | None = None) -> None:
        self._stretches: deque[tuple[Array, Array]] = deque(maxlen=most)
        self._begin: tuple[Array, Array] | None = None
        self._estimate: MountEstimate | None = None

    def add(self, odom: Array | None, pose: Array) -> None:
        """Add base in odom and in map at a scan, shape (3,) each; non-finite odometry ends the stretch."""
        if odom is None or not np.isfinite(odom).all():
            self.interrupt()
        elif self._begin is None:
            self._begin = odom, pose
        else:
            moved = between(self._begin[0], odom)
            stretch = 0.3  # distance by odometry for a comparison of both motions, m: a match is accurate to 1 or 2 cm
            if math.hypot(moved[0], moved[1]) >= stretch:
                self._stretches.append((moved, between(self._begin[1], pose)))
                self._begin, self._estimate = (odom, pose), None

    def interrupt(self) -> None:
        """Begin a new stretch after poses were corrected or unknown."""
        self._begin = None

    @property
    def estimate(self) -> MountEstimate | None:
        """Return the latest estimate; None with too few stretches."""
        if self._estimate is None and len(self._stretches) >= 10:  # minimum number of stretches
            by_wheels, by_scans = (np.array(motions) for motions in zip(*self._stretches, strict=True))
            self._estimate = estimated(by_wheels, by_scans)
        return self._estimate


class LidarCheck:
    """Compare scans with odometry: the offset of their clocks, and the lidar's mount."""

    def __init__(self) -> None:
        self._clocks = ClockOffsetEstimator()
        self._mount = MountEstimator(300)  # stretches: 90 m

    @property
    def offset(self) -> float | None:
        """Lead of odometry over the scans (s); None if unknown or zero."""
        return self._clocks.offset

    @property
    def mount_fault(self) -> str | None:
        """Fault of the lidar's mount and its remedy; None without a certain fault."""
        found = self._mount.estimate
        return None if found is None else found.fault

    def add(self, stamp: int, pose: Array, odom: Array | None, use: OdometryUse) -> None:
        """Add base in map by the scan at ``stamp`` (ns) and in odom, shape (3,) each, and the use of odometry.

        A wrong mount contradicts odometry, too.
        """
        self._mount.add(odom, pose)
        if odom is not None and use is OdometryUse.USED:
            self._clocks.add(stamp, float(pose[2]), float(odom[2]))

    def interrupt(self) -> None:
        """Begin a new stretch after a corrected or unmeasured pose."""
        self._mount.interrupt()


def estimated(by_wheels: Array, by_scans: Array) -> MountEstimate:
    """Return the estimate from the motions over stretches by odometry and by the scans, shape (n, 3) each."""
    mirrored = bool(np.sum(by_wheels[:, 2] * by_scans[:, 2]) < -np.sum(by_wheels[:, 2] ** 2) / 2)
    if mirrored:
        by_scans = by_scans * (1.0, -1.0, -1.0)
    seen = by_scans[:, 0] + 1j * by_scans[:, 1]
    # The turn is taken from the scans, which measure it best; half of it turns the chord of a stretch.
    driven = (by_wheels[:, 0] + 1j * by_wheels[:, 1]) * np.exp(0.5j * wrap(by_scans[:, 2] - by_wheels[:, 2]))
    levers = np.column_stack((driven, np.exp(1j * by_scans[:, 2]) - 1.0))
    displaced = 0.05  # standard deviation of the lidar's displacement from its mount, m
    weights, found, normal = np.ones(len(seen)), np.zeros(2, complex), np.eye(2, dtype=complex)
    errors, noise = seen, 0.01  # standard deviation of a stretch's motion before it is estimated, m
    for _ in range(5):  # iterations of the reweighting: slip and wrong matches are outliers
        normal = (levers.conj().T * weights) @ levers + np.diag((0.0, (noise / displaced) ** 2))
        found = np.linalg.solve(normal, (levers.conj().T * weights) @ seen)
        errors = seen - levers @ found
        noise = max(1.48 * float(np.median(np.abs(errors))) / math.sqrt(2.0), 1e-6)  # 1.48: of a normal distribution
        weights = 1.0 / (1.0 + np.square(np.abs(errors) / (2.0 * noise)))
    # Neighbouring stretches have correlated errors, blocks of them do not.
    scores = (levers.conj() * (weights * errors)[:, None]) @ np.linalg.inv(normal)[0]
    blocks = np.add.reduceat(scores, np.arange(0, len(scores), 5)) / found[0]
    yaw = -float(np.angle(found[0])) * (-1.0 if mirrored else 1.0)
    return MountEstimate(yaw, float(np.linalg.norm(blocks.imag)), mirrored)


def mount_of(scans: Sequence[ScanInput], trajectory: tuple[NDArray[np.int64], Array]) -> MountEstimate | None:
    """Estimate the mount from a whole log.

    Args:
        scans: scans of the log, with odometry if available.
        trajectory: stamps (n,) (ns) and poses (n, 3) by the scans.

    Returns:
        None with too few stretches of odometry.
    """
    odometry = {scan.stamp: scan.odom for scan in scans}
    estimator = MountEstimator()
    for stamp, pose in zip(trajectory[0].tolist(), trajectory[1], strict=True):
        odom = odometry.get(stamp)
        estimator.add(None if odom is None else np.array(odom), pose)
    return estimator.estimate
