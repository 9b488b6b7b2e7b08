"""Where the truck went."""

import math
from dataclasses import dataclass, field
from typing import Final

_STEP: Final = 0.02
"""Metres between two positions that count; nearer ones are noise of standing still."""
_REMEMBERED: Final = 1500


@dataclass(slots=True)
class Way:
    """Positions, thinned out to a bounded number, and the distance along all of them."""

    points: list[tuple[int, float, float]] = field(default_factory=list)
    """Time, ns; x, y, m."""
    distance: float = 0.0
    _last: tuple[float, float] | None = None
    _spacing: float = _STEP

    def take(self, time: int, x: float, y: float) -> None:
        """The truck's position."""
        if self._last is None:
            self._last = x, y
            self.points.append((time, x, y))
            return
        step = math.dist(self._last, (x, y))
        if step < _STEP:
            return
        self.distance += step
        self._last = x, y
        if math.dist(self.points[-1][1:], (x, y)) >= self._spacing:
            self.points.append((time, x, y))
            if len(self.points) > _REMEMBERED:
                self.points = self.points[::2]
                self._spacing *= 2
