"""Which sonars a wall follower uses, and what shows that one of them does not measure."""

import math
from dataclasses import dataclass, field
from typing import Final

from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import SonarRanges

NAMES: Final = {"left": ("l", "fl", "f", "fr"), "right": ("r", "fr", "f", "fl")}
"""Side, diagonal, front and far diagonal sonar by the side where the wall is."""


@dataclass(frozen=True, slots=True)
class SonarMonitor:
    """Notices sonars that are silent, and ranges that do not change although the robot turns."""

    answered: dict[str, float] = field(default_factory=dict)
    """When each answered last, s."""
    echoes: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Newest range of each, m, and when it came, s."""
    changed: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Range of each when it changed last, m, and how far the robot had turned then, rad."""

    def observe(self, sonars: SonarRanges, names: tuple[str, ...], turned: float, t: float) -> "SonarMonitor":
        """After a message at t, with ``turned`` rad turned so far, left and right both counted."""
        answered, echoes, changed = dict(self.answered), dict(self.echoes), dict(self.changed)
        for name in names:
            echo = sonars.echo(name)
            answered.setdefault(name, t)
            if echo is None or not echo.answered:
                continue
            answered[name] = t
            if echo.range is not None:
                echoes[name] = (echo.range, t)
            measured = echo.range is not None and sonars.range_min < echo.range < sonars.range_max
            value = echo.range if measured and echo.range is not None else math.inf  # limits may repeat
            if name not in changed or changed[name][0] != value or not math.isfinite(value):
                changed[name] = (value, turned)
        return SonarMonitor(answered, echoes, changed)

    def fault(self, turned: float, t: float) -> tuple[Reason, str] | None:
        """What is wrong with the sonars at t."""
        for name, at in self.answered.items():
            if t - at >= 0.5:  # seconds without any answer of a sonar after which it counts as dead
                return Reason.INPUT_STALE, f"sonar {name} has not answered for {t - at:.1f} s"
        for name, (value, at) in self.changed.items():
            if turned - at > 0.6:  # angle, rad, over which a sonar's range cannot stay the same to the last digit
                degrees = math.degrees(turned - at)
                return (
                    Reason.INPUT_CONTRADICTORY,
                    f"sonar {name} measures {value:.3f} m although the robot turned by {degrees:.0f} degrees",
                )
        return None

    def range(self, name: str, hold: float, furthest: float, t: float) -> float:
        """The newest echo if it is not older than ``hold``, else the greatest range, m."""
        value, at = self.echoes.get(name, (furthest, -math.inf))
        return value if t - at <= hold else furthest
