"""Motion of the body while the wheels show standstill, by the scans: a second source beside the drives.

A robot at rest is compared with the scans from when it began to rest, or of the newest seconds. The scans' odometry
alone proves nothing where people walk by: the claim that the body stands must leave points unexplained that its motion
explains, see ``ScanVerdict``.
"""

import math
from collections import deque
from typing import Final

from monstertruck_estimation.consistency.exchange import Claim, StepOutput
from monstertruck_estimation.consistency.tracks import MotionTrack
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.state import UnshownMotion

OVER: Final = 4 * SECOND
"""Time over which motion is looked for, ns."""
ASKED: Final = 2.0
"""Standard deviations of the registration from which on motion is judged by points."""


class RestWatch:
    """Compares the newest scan with one of the same rest.

    Args:
        track: motion by the scans.
    """

    def __init__(self, track: MotionTrack) -> None:
        self._track = track
        self._rest: deque[int] = deque()
        """Stamps of the scans since the wheels stand, ns."""
        self._deviations = 1.0, 1.0
        self._asked: int | None = None
        """Stamp of the earlier scan of the open claim, ns."""
        self.motion: UnshownMotion | None = None
        """Of the body, proven by the newest scan; None = none, or the points do not prove it."""

    def observe(self, output: StepOutput, *, still: bool) -> None:
        """Take the motion between two scans, and what the points say of the claim; ``still``: the wheels stand."""
        asked, self._asked = self._asked, None
        self.motion = None
        if not still or output.since is None:
            self._rest.clear()
        if not still:
            return
        self._rest.append(output.stamp)
        while output.stamp - self._rest[0] > OVER:
            self._rest.popleft()
        self._deviations = output.errors
        if asked is None or output.rest is None or not output.rest.refuted:
            return
        motion = self._track.motion(asked, output.stamp)
        if motion is not None:
            distance = math.hypot(motion[0], motion[1])
            self.motion = UnshownMotion(since=asked, stamp=output.stamp, distance=distance, turn=motion[2])
            self._rest = deque([output.stamp])  # what is proven next is new motion

    def claim(self) -> Claim | None:
        """That the body has stood since it rests, where the scans show otherwise."""
        motion = self._track.motion(self._rest[0], self._rest[-1]) if len(self._rest) > 1 else None
        if motion is None:
            return None
        least = [ASKED * deviation for deviation in self._deviations]
        if math.hypot(motion[0], motion[1]) <= least[0] and abs(motion[2]) <= least[1]:
            return None
        self._asked = self._rest[0]
        return Claim(self._asked, (0.0, 0.0), 0.0, (0.0, 0.0))
