"""Rear-facing sonars of a robot with a lidar: they observe the ground behind it.

An echo shows that the ground within the cone is free up to the measured range, and that an obstacle stands on the arc
at that range. A ping without an echo carries no information, because a surface may have reflected the sound elsewhere.
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import SonarEcho, SonarRanges
from monstertruckd.gate.config import InForce
from monstertruckd.gate.scan_memory import Beams
from monstertruckd.gate.sonars import ALIGNED, Place, arc, is_late


class MountedEcho(NamedTuple):
    """Echo measured by one sonar."""

    sonar: str
    mount: Place
    """Pose of the sonar in base, m, m, rad."""
    beams: Beams
    """Two beams, one for each half of the cone."""
    arc: Array
    """Possible origins of the echo in base, shape (n, 2), m."""


def rear(mounts: Mapping[str, Place]) -> dict[str, Place]:
    """Return the sonars of ``mounts`` (pose in the base frame by name; m, m, rad) that look backwards."""
    return {
        name: place for name, place in mounts.items() if abs(math.remainder(place[2] - math.pi, math.tau)) <= ALIGNED
    }


class RearSonars:
    """Splits rounds of pings by sonar and records which sonars are silent.

    Args:
        limits: limits in force.
        mounts: pose in the base frame (x and y in m, yaw in rad) of every sonar that looks backwards, by name.
    """

    def __init__(self, limits: InForce, mounts: Mapping[str, Place]) -> None:
        self._limits = limits
        self._mounts = mounts
        self._answered: dict[str, int] = {}
        """Time of the last answer of every sonar that is not silent, ns."""

    def pings(self, ranges: SonarRanges) -> Iterator[MountedEcho]:
        """Echoes in a round of pings; none if the round is late."""
        if is_late(ranges, self._limits.config):
            return
        for echo in ranges.sonars:
            if echo.answered and echo.name in self._mounts:
                self._answered[echo.name] = ranges.received
                yield _ping(ranges, echo, self._mounts[echo.name])

    def silenced(self, now: int) -> list[str]:
        """Return sonars that have become silent since the last call, at ``now`` (ns)."""
        oldest = now - round(self._limits.config.sonar.stale_after * SECOND)
        names = [name for name, answered in self._answered.items() if answered < oldest]
        for name in names:
            del self._answered[name]
        return names


def _ping(ranges: SonarRanges, echo: SonarEcho, mount: Place) -> MountedEcho:
    cone = ranges.field_of_view
    if echo.range is None:
        return MountedEcho(echo.name, mount, Beams.across(echo.stamp, cone, 0.0), np.empty((0, 2)))
    free = echo.range if echo.range > ranges.range_min else 0.0  # nearer echoes are reported as about range_min
    return MountedEcho(echo.name, mount, Beams.across(echo.stamp, cone, free), arc(mount, free, cone / 2))
