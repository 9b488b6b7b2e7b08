"""Sonars of a wall follower, and detection of a sonar that does not measure."""

import math
from dataclasses import dataclass, field
from typing import Final

from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import SonarRanges

NAMES: Final = {"left": ("l", "fl", "f", "fr"), "right": ("r", "fr", "f", "fl")}
"""Side, diagonal, front and far diagonal sonar, by side of the wall."""


@dataclass(frozen=True, slots=True)
class SonarMonitor:
    """Detector of silent sonars, and of ranges that do not change while the robot turns."""

    answered: dict[str, float] = field(default_factory=dict)
    """Time of each sonar's last answer (s)."""
    echoes: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Latest range of each sonar (m) and its time (s)."""
    changed: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Range of each sonar at its last change (m), and the robot's accumulated turn at that time (rad)."""

    def observe(self, sonars: SonarRanges, names: tuple[str, ...], turned: float, t: float) -> "SonarMonitor":
        """Return the monitor after a message at t; ``turned`` is the absolute turn so far (rad), left plus right."""
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
        """Return the fault of the sonars at t, or None."""
        for name, at in self.answered.items():
            if t - at >= 0.5:  # time without any answer after which a sonar is considered dead, s
                return Reason.INPUT_STALE, f"sonar {name} has not answered for {t - at:.1f} s"
        for name, (value, at) in self.changed.items():
            if turned - at > 0.6:  # turn during which a sonar's range cannot stay exactly constant, rad
                degrees = math.degrees(turned - at)
                return (
                    Reason.INPUT_CONTRADICTORY,
                    f"sonar {name} measures {value:.3f} m although the robot turned by {degrees:.0f} degrees",
                )
        return None

    def range(self, name: str, hold: float, furthest: float, t: float) -> float:
        """Return the latest echo if it is not older than ``hold``, else ``furthest`` (m)."""
        value, at = self.echoes.get(name, (furthest, -math.inf))
        return value if t - at <= hold else furthest
