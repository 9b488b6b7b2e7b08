"""Approach to obstacles: speed limits based on the free distance, with hysteresis, and the emergency stop criterion."""

import math
from collections.abc import Callable, Iterable, Iterator

from monstertruck_planners.collision import UnitTwist
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruckd.gate.checks import GateView, PaceLimit
from monstertruckd.gate.config import GateConfig


def comfortable_speed(room: float, delay: float, deceleration: float) -> float:
    """Maximum speed (m/s) of a body that brakes after ``delay`` s and stops within ``room`` metres."""
    return deceleration * (math.sqrt(delay**2 + 2 * max(room, 0.0) / deceleration) - delay)


def stopping(speed: float, delay: float, deceleration: float) -> float:
    """Stopping distance (m) of a body that brakes from ``speed`` (m/s) after ``delay`` s."""
    return speed * delay + speed**2 / (2 * deceleration)


def reach(config: GateConfig, delay: float) -> float:
    """Length of the sweep against obstacles that were seen ``delay`` s ago (m)."""
    return config.obstacle.ahead + stopping(config.speed, delay, config.obstacle.deceleration)


class Approach:
    """State of the approach to obstacles of one kind.

    Args:
        view: limits, samples and motion.
    """

    def __init__(self, view: GateView) -> None:
        self._view = view
        self.blocked = False
        """Whether an obstacle ahead allows no motion."""
        self.emergency = False
        """Whether an obstacle is so near that only the quick stop avoids contact."""
        self.free: float | None = None
        """Distance the footprint can travel, m; None without an obstacle within the checked distance."""

    def forget(self) -> None:
        """Reset the state while no source drives."""
        self.blocked = self.emergency = False
        self.free = None

    def limits(self, free: float, allowed: float, fastest: float) -> Iterator[PaceLimit]:
        """Limit for ``free`` metres ahead, given the allowed pace and the fastest motion (m/s)."""
        crawl = self._view.config.obstacle.crawl
        self.free = free if math.isfinite(free) else None
        self.blocked = allowed < (2 * crawl if self.blocked else crawl)
        if self.blocked:
            yield PaceLimit(Reason.OBSTACLE_STOP, 0.0)
        elif allowed < fastest:
            yield PaceLimit(Reason.OBSTACLE_SLOW, allowed)

    def judge(self, now: int, twists: Iterable[UnitTwist], too_near: Callable[[float], bool]) -> None:
        """Update ``emergency``.

        Args:
            now: current time (ns).
            twists: motions of the base per metre of pace.
            too_near: whether an ordinary stop from a pace (m/s) needs more than the free distance.
        """
        view = self._view
        measured = view.samples.shaft_speeds(now)
        speed = max(view.motion.progress(measured, twist) for twist in twists) if measured else 0.0
        approaching = speed > view.config.standstill
        self.emergency = approaching and (self.emergency or (self.blocked and too_near(speed)))

    def free_distance(self, age: float | None) -> Measurement:
        """Free distance as a measurement; ``age`` (s) is the age of the sample behind it."""
        return Measurement(
            name="free distance", value=self.free, unit="m", limit=self._view.config.obstacle.ahead, age=age
        )
