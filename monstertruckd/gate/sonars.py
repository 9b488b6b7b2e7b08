"""Sonar obstacle check for robots without a lidar: the swept footprint against arcs.

An echo comes from an unknown point on the arc across the sonar's cone at the measured range. Rules for the bearing:

- A sonar whose axis is within ``ALIGNED`` of the direction of travel: the whole arc is an obstacle.
- Any other sonar: only the part within ``gate.sonar.core`` of its axis is an obstacle. The whole arc would block a
  robot that drives along a wall; an obstacle in the rest of the arc enters the cone of the sonar ahead before the
  robot reaches it.
- The latest two rounds of pings are used, because a single echo may be reflected away.

A sonar that does not answer leaves its cone unknown. A silent sonar in the direction of travel stops the robot. Any
other silent sonar slows it, as does a direction of travel without a sonar.
"""

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import Footprint, UnitTwist, free_distance
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import SonarRanges
from monstertruck_schemas.topics import SONAR, Topic
from monstertruckd.gate.approach import Approach, comfortable_speed, reach
from monstertruckd.gate.checks import Check, GateView, PaceLimit, Tick
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.motion import Course

ALIGNED: Final = 0.3
"""Maximum angle between the direction of travel and the axis of a sonar that looks ahead, rad."""
TURNING: Final = 0.3
"""Travel of the base per metre of pace below which a motion is a turn on the spot: no sonar looks ahead."""

Place = tuple[float, float, float]


class SonarView(NamedTuple):
    """Result of the sonars for a motion."""

    free: float
    """Distance the footprint can travel, m; +inf without an obstacle within reach."""
    dead: tuple[str, ...]
    """Silent sonars in the direction of travel."""
    unknown: bool
    """Whether another sonar is silent, or no sonar faces the direction of travel."""


class SonarGuard:
    """Sweeps the footprint along a motion against the echoes.

    Args:
        limits: limits in force.
        footprint: the body's outline.
        mounts: pose (x, y, yaw) of every sonar in base by name, m, m, rad.
    """

    def __init__(self, limits: InForce, footprint: Footprint, mounts: Mapping[str, Place]) -> None:
        self._limits = limits
        self._footprint = footprint
        self._mounts = mounts
        self._rounds: deque[SonarRanges] = deque(maxlen=2)
        self._answered: dict[str, int] = {}
        """Time of the last answer of every sonar, ns."""
        self.view = SonarView(math.inf, (), False)
        """View of the latest checked motion."""

    def observe(self, ranges: SonarRanges) -> None:
        """Take a round of pings; ignore a late round."""
        if is_late(ranges, self._limits.config):
            return
        self._rounds.append(ranges)
        self._answered |= {sonar.name: ranges.received for sonar in ranges.sonars if sonar.answered}

    def fresh(self, now: int) -> bool:
        """Return whether the latest round exists and is fresh."""
        return bool(self._rounds) and now - self._rounds[-1].received <= self._limits.config.sonar.stale_after * SECOND

    def look(self, twist: UnitTwist, reach: float, now: int) -> SonarView:
        """Sweep a motion.

        Args:
            twist: twist of the base.
            reach: distance swept (m).
            now: current time (ns).
        """
        ahead = self._ahead(twist)
        oldest = now - round(self._limits.config.sonar.stale_after * SECOND)
        silent = [name for name in self._mounts if self._answered.get(name, -1) < oldest]
        points = self._points(ahead, now)
        step = 0.02  # distance between the poses of a sweep, m
        free = free_distance(self._footprint, twist, points, reach, step, self._limits.config.obstacle.side_clearance)
        dead = tuple(name for name in silent if name in ahead)
        unknown = len(silent) > len(dead) or (not ahead and math.hypot(twist[0], twist[1]) >= TURNING)
        self.view = SonarView(free, dead, unknown)
        return self.view

    def delay(self, now: int) -> float:
        """Age of the latest round, s; 0 without a round."""
        return max(now - self._rounds[-1].stamp, 0) / SECOND if self._rounds else 0.0

    def _ahead(self, twist: UnitTwist) -> frozenset[str]:
        """Sonars that face the direction of travel."""
        if math.hypot(twist[0], twist[1]) < TURNING:
            return frozenset()
        travel = math.atan2(twist[1], twist[0])
        return frozenset(
            name for name, (_, _, yaw) in self._mounts.items() if abs(math.remainder(yaw - travel, math.tau)) <= ALIGNED
        )

    def _points(self, ahead: frozenset[str], now: int) -> Array:
        """Points of all arcs in base, shape (n, 2), m."""
        arcs = [np.empty((0, 2))]
        for ranges in self._rounds:
            if now - ranges.received > self._limits.config.sonar.stale_after * SECOND:
                continue
            for sonar in ranges.sonars:
                if sonar.range is not None and sonar.answered and sonar.name in self._mounts:
                    half = ranges.field_of_view / 2
                    half = half if sonar.name in ahead else min(half, self._limits.config.sonar.core)
                    arcs.append(arc(self._mounts[sonar.name], sonar.range, half))
        return np.concatenate(arcs)


class SonarCheck(Check):
    """Keeps the swept footprint clear of sonar echoes on a robot without a lidar.

    Args:
        view: read access to the gate's state.
        mounts: pose (x, y, yaw) of every sonar in base by name, m, m, rad.
    """

    reasons = (
        Reason.OBSTACLE_STOP,
        Reason.OBSTACLE_SLOW,
        Reason.SONAR_STALE,
        Reason.SONAR_BLIND,
        Reason.SONAR_SLOW,
    )
    reads = (SONAR,)

    def __init__(self, view: GateView, mounts: Mapping[str, Place]) -> None:
        super().__init__(view)
        self.guard = SonarGuard(view.limits, view.footprint, mounts)
        self._approach = Approach(view)

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Take rounds of pings."""
        if isinstance(seen, SonarRanges):
            self.guard.observe(seen)

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Sweep along the motions."""
        if courses is None:
            self._approach.forget()
        elif courses and self.guard.fresh(now):
            yield from self._along(now, courses)
        elif courses:
            yield PaceLimit(Reason.SONAR_STALE, 0.0)

    def _along(self, now: int, courses: Sequence[Course]) -> Iterator[PaceLimit]:
        config = self.view.config
        delay = self.guard.delay(now) + config.reaction
        views = [self.guard.look(twist, reach(config, delay), now) for twist, _ in courses]
        free = min(view.free for view in views)
        allowed = comfortable_speed(free - config.obstacle.ahead, delay, config.obstacle.deceleration)
        yield from self._approach.limits(free, allowed, max(pace for _, pace in courses))
        if any(view.dead for view in views):
            yield PaceLimit(Reason.SONAR_BLIND, 0.0)
        elif any(view.unknown for view in views):
            yield PaceLimit(Reason.SONAR_SLOW, config.sonar.unseen_speed)

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Free distance."""
        if reason in (Reason.OBSTACLE_STOP, Reason.SONAR_BLIND):
            yield self._approach.free_distance(None)


def is_late(ranges: SonarRanges, config: GateConfig) -> bool:
    """Return whether a round of pings arrived too late to be used."""
    return abs(ranges.received - ranges.stamp) > config.max_latency * SECOND


def arc(place: Place, distance: float, half: float) -> Array:
    """Points at ``distance`` (m) within ``half`` (rad) of a sonar's axis, in base, shape (n, 2), m."""
    x, y, yaw = place
    count = max(3, math.ceil(2 * half * distance / 0.02) + 1)  # distance between the points of an arc, m
    angles = yaw + np.linspace(-half, half, count)
    return np.column_stack((x + distance * np.cos(angles), y + distance * np.sin(angles)))
