"""People walking through the world between way-points, modelled as upright cylinders."""

from collections import deque
from collections.abc import Callable, Sequence
from math import atan2, cos, hypot, pi, sin

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_sim.world.config import PersonConfig
from monstertruck_sim.world.noise import PEOPLE, generator
from monstertruck_sim.world.obstacles import Disc

STEP_S = 0.02
"""Interval between checks of the path ahead (s)."""
SIDE = 0.25
"""Lateral clearance: a person walks past obstacles further than this from the swept path (m)."""

Free = Callable[[float, float, float], bool]
"""Return whether a disc (x, y, radius; m) is clear of the map."""
Round = tuple[float, float, float]
"""Circle around another body: x, y, radius (m)."""
Place = tuple[float, float]


class Person:
    """A walking person; all random values derive from the seed and the index.

    Args:
        name: name in contact reports.
        config: way-points and behaviour.
        seed: the world's seed.
        index: the person's index.
        free: free-space test of the map.
        bounds: area for random way-points: minimum and maximum x, then y (m).

    Raises:
        ValueError: a way-point or the leg between two way-points is not free, or no free place can be drawn.
    """

    def __init__(
        self,
        name: str,
        config: PersonConfig,
        seed: int,
        index: int,
        free: Free,
        bounds: tuple[float, float, float, float],
    ) -> None:
        self.name = name
        self.radius = config.radius
        self.speed = 0.0
        """Speed (m/s)."""
        self._config, self._free, self._bounds = config, free, bounds
        self._rng = generator(seed, PEOPLE, index)
        self._tries = 400  # draws of a free place, or of a free leg
        self._given: list[Place] = [(point.x, point.y) for point in config.waypoints]
        self._next = 0
        self._require_free()
        self.x, self.y = self._given[0] if self._given else self._drawn_place()
        self._before = (self.x, self.y)
        """Start of the current leg."""
        self._pace = config.speed
        self._pausing = float(self._rng.uniform(0.0, 2.0)) * config.pause
        self._waited = 0.0
        self._target = (self.x, self.y)
        self._choose()
        self._trail: deque[tuple[int, float, float]] = deque(maxlen=40)

    @property
    def pace(self) -> float:
        """Speed on the current leg (m/s)."""
        return self._pace

    @property
    def disc(self) -> Disc:
        """The person's footprint."""
        return Disc(self.x, self.y, self.radius)

    def step(self, now_ns: int, others: Sequence[Round], touched: Callable[[Disc], bool]) -> None:
        """Walk for ``STEP_S``, until ``now_ns``.

        Args:
            now_ns: elapsed time of the world.
            others: circles around robots and the other people.
            touched: returns whether a disc would overlap another body; called for each candidate position.
        """
        if not self._trail:
            self._trail.append((now_ns - 1, self.x, self.y))
        self.speed = 0.0
        if self._pausing > 0.0:
            self._pausing -= STEP_S
        else:
            self._walk(others, touched)
        self._trail.append((now_ns, self.x, self.y))

    def places(self, times_ns: Array) -> Array:
        """Return the centres (m) at elapsed times within the last 0.8 s, shape (2, n)."""
        if not self._trail:
            return np.repeat([[self.x], [self.y]], len(times_ns), axis=1)
        at, xs, ys = np.array(self._trail, dtype=float).T
        return np.array([np.interp(times_ns, at, xs), np.interp(times_ns, at, ys)])

    def _walk(self, others: Sequence[Round], touched: Callable[[Disc], bool]) -> None:
        dx, dy = self._target[0] - self.x, self._target[1] - self.y
        left = hypot(dx, dy)
        if left < 0.05:  # distance at which a way-point is reached, m
            self._pausing = float(self._rng.uniform(0.0, 2.0)) * self._config.pause
            self._choose()
            return
        heading = self._way_on(atan2(dy, dx), others)
        stride = min(self._pace * STEP_S, left)
        if heading is not None:
            x, y = self.x + stride * cos(heading), self.y + stride * sin(heading)
            if self._free(x, y, self.radius) and not touched(Disc(x, y, self.radius)):
                self.x, self.y, self.speed = x, y, stride / STEP_S
                self._waited = 0.0
                return
        self._waited += STEP_S
        if self._waited > 3.0:  # maximum wait for another body before a different way-point is chosen, s
            self._waited = 0.0
            self._turn_back()

    def _way_on(self, ahead: float, others: Sequence[Round]) -> float | None:
        """Return the walking direction (rad), or None to stand still."""
        if self._config.before == "walk_on" or not self._blocked(ahead, others):
            return ahead
        if self._config.before == "turn":
            reach = self.radius + SIDE
            turns = (pi / 6, -pi / 6, pi / 3, -pi / 3, pi / 2, -pi / 2)
            for turn in turns:
                x, y = self.x + reach * cos(ahead + turn), self.y + reach * sin(ahead + turn)
                if not self._blocked(ahead + turn, others) and self._free(x, y, self.radius):
                    return ahead + turn
        return None

    def _blocked(self, heading: float, others: Sequence[Round]) -> bool:
        c, s = cos(heading), sin(heading)
        for x, y, radius in others:
            along, across = c * (x - self.x) + s * (y - self.y), abs(c * (y - self.y) - s * (x - self.x))
            both = self.radius + radius
            if 0.0 < along < self._config.distance + both and across < both + SIDE:
                return True
        return False

    def _choose(self) -> None:
        """Choose the next way-point and the pace for the leg."""
        self._before = (self.x, self.y)
        self._pace = self._config.speed * float(self._rng.uniform(0.8, 1.2))
        if self._given:
            self._next = (self._next + 1) % len(self._given)
            self._target = self._given[self._next]
            return
        for _ in range(self._tries):
            # (1.0, 4.0): minimum and maximum length of a random leg, m
            length, heading = self._rng.uniform(1.0, 4.0), self._rng.uniform(-pi, pi)
            place = self.x + length * cos(heading), self.y + length * sin(heading)
            if self._clear((self.x, self.y), place):
                self._target = place
                return
        self._target = (self.x, self.y)

    def _turn_back(self) -> None:
        if self._given:
            self._target, self._before = self._before, (self.x, self.y)
            self._next = self._given.index(self._target) if self._target in self._given else self._next
        else:
            self._choose()

    def _drawn_place(self) -> Place:
        left, right, low, high = self._bounds
        for _ in range(self._tries):
            x, y = float(self._rng.uniform(left, right)), float(self._rng.uniform(low, high))
            if self._free(x, y, self.radius + SIDE):
                return x, y
        raise ValueError(f"no free place found for {self.name} on the map")

    def _require_free(self) -> None:
        for i, place in enumerate(self._given):
            end = self._given[(i + 1) % len(self._given)]
            if not self._clear(place, end):
                raise ValueError(f"the path from {place} to {end} touches occupied or unknown cells")

    def _clear(self, a: Place, b: Place) -> bool:
        count = max(1, round(hypot(b[0] - a[0], b[1] - a[1]) / (self.radius / 2)))
        return all(
            self._free(a[0] + (b[0] - a[0]) * i / count, a[1] + (b[1] - a[1]) * i / count, self.radius)
            for i in range(count + 1)
        )
