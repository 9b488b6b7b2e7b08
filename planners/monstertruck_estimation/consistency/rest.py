"""Detect motion of the body by scans while the wheels show standstill.

The latest scan is compared with the first one since the wheels stopped, or with the one ``OVER`` earlier.
"""

import math
from collections import deque
from typing import Final

from monstertruck_estimation.consistency.exchange import Claim, StepOutput
from monstertruck_estimation.consistency.tracks import MotionTrack
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.state import UnshownMotion

OVER: Final = 4 * SECOND
"""Maximum time between the two compared scans (ns)."""


class RestWatch:
    """Compare the latest scan with an earlier one since the wheels stopped.

    Args:
        wheels: motion that the wheels show.
        slip: tolerated slip, as a fraction of that motion.
    """

    def __init__(self, wheels: MotionTrack, slip: float) -> None:
        self._wheels, self._slip = wheels, slip
        self._rest: deque[int] = deque()
        """Stamps of the scans since the wheels stopped (ns)."""
        self._asked: Claim | None = None
        self.motion: UnshownMotion | None = None
        """Motion of the body that the latest scan proves, or None."""

    def observe(self, output: StepOutput) -> None:
        """Take the latest scan and its evidence against the claim."""
        asked, self._asked = self._asked, None
        self.motion = None
        still = self._wheels.rests(output.stamp)
        if not still or output.since is None:
            self._rest.clear()
        if not still:
            return
        self._rest.append(output.stamp)
        while output.stamp - self._rest[0] > OVER:
            self._rest.popleft()
        if asked is None or asked.way is None or output.rest is None or not output.rest.proven:
            return
        x, y, turn = output.rest.motion
        distance = max(0.0, math.hypot(x, y) - self._slip * math.hypot(*asked.way))
        self.motion = UnshownMotion(since=asked.since, stamp=output.stamp, distance=distance, turn=turn)
        # the next proof is of new motion
        self._rest = deque([output.stamp])

    def claim(self, stamp: int, end: int) -> Claim | None:
        """Return the claim that the body moves no more than its wheels up to a scan.

        None if they turn before its last beam: a robot that starts moving distorts the scan.

        Args:
            stamp: stamp of its first beam (ns).
            end: stamp of its last beam (ns).
        """
        if not self._rest or not self._wheels.rests(stamp) or not self._wheels.rests(end):
            return None
        motion = self._wheels.motion(self._rest[0], stamp)
        self._asked = None if motion is None else Claim(self._rest[0], motion[:2], motion[2], (0.0, 0.0))
        return self._asked
