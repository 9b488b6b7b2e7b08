"""Judge of a fault-family drill; its only inputs are the world's true state and the operator's orders.

No fault can deceive it. It reads no wires, so it can judge a robot with any devices.
"""

import math
from typing import Final

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_sim.world.world import World
from monstertruckd.tools.drill.observer import STANDING_SPEED, Violation

MAY_MOVE: Final = 1.0
"""Maximum time that a robot still moves once motion is not permitted (s)."""


class WorldJudge:
    """Judges one robot.

    Motion is permitted from the operator's arm order to the next disarm or stop order. Three things are unsafe: any
    contact, forbidden motion beyond 0.3 m or ``MAY_MOVE``, and a motor demand that outlasts a fault. Contacts that
    start while the operator confirms unseen ground are counted separately.

    Args:
        world: the simulated world.
        clock: source of time.
    """

    def __init__(self, world: World, clock: Clock) -> None:
        self.speed = 0.0
        """True speed (m/s), negative backwards."""
        self._world = world
        self._clock = clock
        self._began = clock.now()
        self._violations: dict[str, Violation] = {}
        self._forbidden: int | None = None
        self._stood: int | None = None
        """Time of standstill after motion was forbidden (ns)."""
        self._still_since: int | None = None
        self._travelled = 0.0
        self._place: tuple[float, float] | None = None
        self._confirmed: int | None = None
        """Latest confirmation by the operator (ns)."""
        self._touches = False
        self.confirmed_contacts = 0
        """Contacts since ``begin`` that started while the operator confirmed unseen ground."""

    async def run(self) -> None:
        """Check the world at 50 Hz until cancelled."""
        due = self._clock.now()
        while True:
            self.look()
            due += SECOND // 50
            await self._clock.sleep_until(due)

    # Operator actions

    def arm(self) -> None:
        """Permit motion: the operator arms."""
        self._forbidden = None

    def forbid(self) -> None:
        """Forbid motion: the operator disarms or stops."""
        if self._forbidden is None:
            self._forbidden, self._stood, self._travelled = self._clock.now(), None, 0.0

    def begin(self) -> None:
        """Start a trial."""
        self._began = self._clock.now()
        self._violations.clear()
        self.confirmed_contacts = 0

    def confirm(self) -> None:
        """Record that the operator holds the second control, to drive into ground that the robot has not seen."""
        self._confirmed = self._clock.now()

    # Results

    @property
    def violations(self) -> tuple[Violation, ...]:
        """Violations since ``begin``: the first of each kind."""
        return tuple(self._violations.values())

    @property
    def travelled(self) -> float:
        """Distance travelled since motion was forbidden (m)."""
        return self._travelled

    @property
    def place(self) -> tuple[float, float]:
        """True position of the robot at the latest check (m)."""
        return self._place or (0.0, 0.0)

    @property
    def standstill(self) -> float | None:
        """Time from forbidding motion to standstill (s); None while the robot moves or may move."""
        if self._stood is None or self._forbidden is None:
            return None
        return max(0, self._stood - self._forbidden) / SECOND

    def look(self) -> None:
        """Compare the robot's true motion with the permission."""
        now = self._clock.now()
        truth = self._world.truth(now)
        moved = 0.0 if self._place is None else math.dist(self._place, (truth.x, truth.y))
        self._place, self.speed = (truth.x, truth.y), truth.v
        twist = self._world.plant.twist
        moves = math.hypot(*twist[:2]) > STANDING_SPEED or abs(twist[2]) > 10 * STANDING_SPEED
        self._still_since = None if moves else self._still_since or now
        if truth.stuck and not self._touches:
            self._touch(now, f"ran into something at ({truth.x:.2f}, {truth.y:.2f}) m")
        self._touches = truth.stuck
        if self._forbidden is None:
            return
        if self._stood is None and self._still_since is not None:
            # 0.2: time without motion that is standstill (s): a braked robot rocks on its tyres
            if now - self._still_since >= 0.2 * SECOND:
                self._stood = self._still_since
        elif self._stood is not None and moves:
            self._stood = None
        self._travelled += moved
        since = (now - self._forbidden) / SECOND
        if self._travelled > 0.3:  # maximum distance while motion is forbidden (m)
            self._blame("motion", f"travelled {self._travelled:.2f} m after motion was forbidden {since:.2f} s ago")
        if moves and since > MAY_MOVE:
            self._blame("motion", f"{truth.v:.3f} m/s though motion was forbidden {since:.2f} s ago")

    def check_left(self) -> None:
        """Check that no motor has a demand once a fault is over and motion is forbidden."""
        for shaft, motor in enumerate(self._world.motors):
            demand = motor.reading(self._clock.now()).demand_rpm
            if demand != 0.0:
                self._blame("left behind", f"motor {shaft + 1} is still asked for {demand:.0f} rpm")

    def _touch(self, now: int, text: str) -> None:
        # 0.5: validity of the operator's confirmation (s): the robot has stopped by then
        if self._confirmed is not None and now - self._confirmed <= 0.5 * SECOND:
            self.confirmed_contacts += 1
        else:
            self._blame("contact", text)

    def _blame(self, rule: str, text: str) -> None:
        self._violations.setdefault(rule, Violation((self._clock.now() - self._began) / SECOND, rule, text))
