"""Doubt about the travelled distance: the driven shafts turn by their measurements otherwise than commanded."""

import math
from collections import deque
from collections.abc import Sequence

from monstertruck_kinematics.chassis import Speeds
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import DriveFeedback, DriveMode
from monstertruckd.gate.config import InForce


class TravelDoubt:
    """Difference between the distances commanded and measured since the start (m).

    A drive that follows its commands turns its shaft at a speed commanded within its reaction time, once it has
    accelerated. Any other measured speed leaves two possible distances, and nothing in the gate tells which is true.
    Readings that are too slow and readings that are too fast cancel, as those of a constant offset do back and forth.

    Args:
        limits: limits in force.
        shafts: number of driven shafts.
    """

    def __init__(self, limits: InForce, shafts: int) -> None:
        self._limits = limits
        self._commands: deque[tuple[int, Speeds]] = deque()
        self._attained = [0.0] * shafts
        """Speed that each shaft has had the time to reach, m/s."""
        self.distance = 0.0
        """Commanded minus measured distance along the commands, of the shaft that differs most at each time, m."""

    def observe(
        self, now: int, dt: float, commanded: Speeds, measured: Speeds, drives: Sequence[DriveFeedback | None]
    ) -> None:
        """Take the speeds of all shafts at a tick.

        Args:
            now: current time (ns).
            dt: time since the previous tick (s).
            commanded: commanded speed of every shaft since then (m/s).
            measured: latest measured speeds, m/s; empty if unknown.
            drives: latest feedback of every shaft.
        """
        config, known = self._limits.config, self._commands
        known.append((now, commanded))
        heard = now - round((config.reaction + config.drive.stale_after) * SECOND)
        while len(known) > 1 and known[1][0] <= heard:
            known.popleft()
        differences = [0.0]
        for shaft, drive in enumerate(drives):
            speeds = [command[shaft] for _, command in known]
            low, high = min(speeds), max(speeds)
            if not measured or low * high <= 0.0 or drive is None or drive.mode is not DriveMode.ENABLED:
                self._attained[shaft] = 0.0
                continue
            speed = measured[shaft] * math.copysign(1.0, high)
            low, high = sorted((abs(low), abs(high)))
            self._attained[shaft] = low = min(low, self._attained[shaft] + config.acceleration * dt)
            differences.append(max(low - speed, 0.0) + min(high - speed, 0.0))
        self.distance += max(differences, key=abs) * dt
