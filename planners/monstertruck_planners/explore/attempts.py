"""Places that could not be reached, or from which nothing new was seen: left alone for a while, then tried again."""

import math
from dataclasses import dataclass, replace
from typing import Final

from monstertruck_planners.explore.exchange import Point

SAME: Final = 0.5
"""Places this near to each other are one, m."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """A place that was tried in vain."""

    place: Point
    count: int
    until: float
    """It is left alone until then, s; +inf: for good."""


@dataclass(frozen=True, slots=True)
class Attempts:
    """All of them.

    Args:
        period: seconds for which a place is left alone.
        most: attempts after which it is left alone for good.
    """

    period: float
    most: int
    places: tuple[Attempt, ...] = ()

    def failed(self, place: Point, now: float, *, ignore_first: bool = False) -> "Attempts":
        """With one more attempt in vain at a place; ``ignore_first``: the first has no effect yet."""
        before = next((attempt for attempt in self.places if math.dist(attempt.place, place) < SAME), None)
        count = 1 if before is None else before.count + 1
        until = math.inf if count >= self.most else now if ignore_first and count == 1 else now + self.period
        others = tuple(attempt for attempt in self.places if attempt is not before)
        return replace(self, places=(*others, Attempt(place, count, until)))

    def banned(self, now: float) -> tuple[Point, ...]:
        """Places that are left alone at an instant."""
        return tuple(attempt.place for attempt in self.places if now < attempt.until)

    def released(self, now: float) -> "Attempts | None":
        """Without a wait for the places that are left alone only for a while; None = there is none.

        For a robot that has nothing else to do.
        """
        if not any(now < attempt.until < math.inf for attempt in self.places):
            return None
        return replace(
            self, places=tuple(replace(a, until=min(a.until, now)) if a.until < math.inf else a for a in self.places)
        )
