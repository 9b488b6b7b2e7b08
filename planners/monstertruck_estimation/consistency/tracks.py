"""Motion by one measure between any two instants of the last seconds."""

from bisect import bisect_left
from math import cos, sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.clock import SECOND

KEPT: Final = 9 * SECOND
"""Minimum time for which motion is kept (ns); the maximum is 1.5 times as long."""
STILL: Final = 0.02, 0.02
"""Maximum speed (m/s) and turn rate (rad/s) of a standing robot."""


def between(origin: Pose2, target: Pose2) -> Pose2:
    """Return pose ``target`` in the frame of ``origin``; the yaw is not wrapped."""
    c, s = cos(origin[2]), sin(origin[2])
    dx, dy = target[0] - origin[0], target[1] - origin[1]
    return c * dx + s * dy, c * dy - s * dx, target[2] - origin[2]


class MotionTrack:
    """Gapless poses by one measure in a separate frame."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._poses: list[Pose2] = []

    def begin(self, stamp: int) -> None:
        """Start a new track after a gap: forget everything before ``stamp`` (ns)."""
        self._stamps, self._poses = [stamp], [(0.0, 0.0, 0.0)]

    def clear(self) -> None:
        """Forget all poses."""
        self._stamps, self._poses = [], []

    def add(self, stamp: int, motion: Pose2) -> None:
        """Take the motion since the latest sample, in its base frame; ignore it unless it is later."""
        if not self._stamps:
            self.begin(stamp)
        if stamp <= self._stamps[-1]:
            return
        x, y, yaw = self._poses[-1]
        c, s = cos(yaw), sin(yaw)
        self._stamps.append(stamp)
        self._poses.append((x + c * motion[0] - s * motion[1], y + s * motion[0] + c * motion[1], yaw + motion[2]))
        if stamp - self._stamps[0] > 3 * KEPT // 2:
            old = bisect_left(self._stamps, stamp - KEPT)
            del self._stamps[:old], self._poses[:old]

    @property
    def newest(self) -> int | None:
        """Stamp of the latest sample (ns)."""
        return self._stamps[-1] if self._stamps else None

    def covers(self, since: int, stamp: int) -> bool:
        """Whether the motion between two instants (ns) is known."""
        stamps = self._stamps
        # maximum time (ns) beyond the latest sample for reading a motion; the robot is assumed to keep moving
        ahead = SECOND // 10
        return len(stamps) > 1 and stamps[0] <= since and stamp <= stamps[-1] + ahead

    def motion(self, since: int, stamp: int) -> Pose2 | None:
        """Return the pose of base at ``stamp`` in base at ``since``, both in ns; None if unknown."""
        return between(self._at(since), self._at(stamp)) if self.covers(since, stamp) else None

    def motions(self, since: NDArray[np.int64], stamps: NDArray[np.int64]) -> Array:
        """Return the motions between many pairs of covered instants (ns) of any shape, with a last axis of 3 added."""
        known, zero = np.array(self._stamps), self._stamps[0]
        poses = np.array(self._poses)
        begin, end = (
            np.stack([np.interp(at - zero, known - zero, column) for column in poses.T], axis=-1)
            for at in (since, stamps)
        )
        c, s = np.cos(begin[..., 2]), np.sin(begin[..., 2])
        dx, dy, turn = np.moveaxis(end - begin, -1, 0)
        return np.stack((c * dx + s * dy, c * dy - s * dx, turn), axis=-1)

    def pace(self, at: int) -> tuple[float, float]:
        """Return speed (m/s) and turn rate (rad/s), neither negative, before the instant ``at`` (ns); 0 if unknown."""
        if not self._stamps:
            return 0.0, 0.0
        pace = SECOND // 4  # time over which the speed is averaged, ns
        since = max(at - pace, self._stamps[0])
        motion = self.motion(since, at)
        if motion is None or at <= since:
            return 0.0, 0.0
        seconds = (at - since) / SECOND
        return (motion[0] ** 2 + motion[1] ** 2) ** 0.5 / seconds, abs(motion[2]) / seconds

    def rests(self, at: int) -> bool:
        """Whether the samples on both sides of the instant ``at`` (ns), or the latest two, show no motion."""
        if len(self._stamps) < 2 or not self.covers(at, at):
            return False
        after = min(max(bisect_left(self._stamps, at), 1), len(self._stamps) - 1)
        seconds = (self._stamps[after] - self._stamps[after - 1]) / SECOND
        x, y, turn = between(self._poses[after - 1], self._poses[after])
        return (x**2 + y**2) ** 0.5 < STILL[0] * seconds and abs(turn) < STILL[1] * seconds

    def _at(self, stamp: int) -> Pose2:
        stamps, poses = self._stamps, self._poses
        after = min(max(bisect_left(stamps, stamp), 1), len(stamps) - 1)
        begin, end = stamps[after - 1], stamps[after]
        (x, y, yaw), (x1, y1, yaw1) = poses[after - 1], poses[after]
        share = (stamp - begin) / (end - begin)
        return x + share * (x1 - x), y + share * (y1 - y), yaw + share * (yaw1 - yaw)
