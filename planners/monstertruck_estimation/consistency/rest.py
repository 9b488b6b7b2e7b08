"""Detects motion of the body by scans while the wheels show standstill.

The newest scan is compared with the first one since the wheels stopped, or one ``OVER`` earlier. Scan odometry alone
proves nothing where people walk by: the claim that the body stands must leave points unexplained that its motion
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
"""Maximum time between the two scans that are compared, ns."""
ASKED: Final = 2.0
"""Motion beyond this many standard deviations of the registration is judged by points."""


class RestWatch:
    """Compares the newest scan with an earlier one since the wheels stopped.

    Args:
        track: motion by the scans.
    """

    def __init__(self, track: MotionTrack) -> None:
        self._track = track
        self._rest: deque[int] = deque()
        """Stamps of the scans since the wheels stopped, ns."""
        self._deviations = 1.0, 1.0
        self._asked: int | None = None
        """Stamp of the earlier scan of the open claim, ns."""
        self.motion: UnshownMotion | None = None
        """Motion of the body that the newest scan proves, or None."""

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
        """Return the claim that the body stands, if scan odometry shows otherwise."""
        motion = self._track.motion(self._rest[0], self._rest[-1]) if len(self._rest) > 1 else None
        if motion is None:
            return None
        least = [ASKED * deviation for deviation in self._deviations]
        if math.hypot(motion[0], motion[1]) <= least[0] and abs(motion[2]) <= least[1]:
            return None
        self._asked = self._rest[0]
        return Claim(self._asked, (0.0, 0.0), 0.0, (0.0, 0.0))
