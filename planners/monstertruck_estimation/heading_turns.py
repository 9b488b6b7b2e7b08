"""Whether the headings of a compass turn with the robot or against it.

A heading of the wrong sign is no outlier: near the heading at which north was found it is right, and a gate by its
error lets it draw the yaw along as the robot turns slowly. Its turns tell: they are opposite to those of the wheels or
of an inertial measurement unit.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple

from monstertruck_estimation.transforms import wrap_angle

PROOF: Final = 0.25
"""Turn of the robot over which the headings are compared, rad: several times what iron near by makes of it."""
LONGEST: Final = 3.0
"""Way within which it has to turn so far, m: a drift of the wheels over a long way is no turn."""
ALIKE: Final = 0.5
"""Share of the turn that the headings have to show, with its sign or with the other, to prove anything."""


class _Row(NamedTuple):
    turn: float
    way: float
    heading: float
    correction: float


@dataclass(frozen=True, slots=True)
class ContraryTurn:
    """Headings that turned against the robot."""

    robot: float
    """Turn of the robot, rad."""
    headings: float
    """Turn by the headings, rad."""
    way: float
    """In which, m."""
    correction: float
    """By how much they have drawn the yaw along meanwhile, rad."""

    @property
    def text(self) -> str:
        """What is seen, in words."""
        return f"the compass turned {self.headings:+.2f} rad while the robot turned {self.robot:+.2f}: a wrong sign?"


class HeadingTurns:
    """Compares the turns of headings with those of the robot."""

    def __init__(self) -> None:
        self._rows: deque[_Row] = deque()
        self._turn = self._way = self._heading = self._correction = 0.0
        self._last: float | None = None
        self.contrary: ContraryTurn | None = None
        """What showed that they turn against it; None while they do not."""

    def moved(self, turn: float, way: float) -> None:
        """The robot turned by ``turn``, rad, by something else than the compass, on ``way``, m."""
        self._turn += turn
        self._way += way

    def corrected(self, by: float) -> None:
        """A heading corrected the yaw by so much, rad."""
        self._correction += by

    def forget(self) -> None:
        """What comes next is not to be compared with what was: the field or the wheels are disturbed."""
        self._rows.clear()

    def observe(self, yaw: float) -> bool:
        """Take a heading, rad, counter-clockwise; whether it changed ``contrary``."""
        if self._last is not None:
            self._heading += wrap_angle(yaw - self._last)
        self._last = yaw
        rows = self._rows
        rows.append(_Row(self._turn, self._way, self._heading, self._correction))
        while self._way - rows[0].way > LONGEST or (len(rows) > 2 and abs(self._turn - rows[1].turn) >= PROOF):
            rows.popleft()
        first, before = rows[0], self.contrary
        turn, heading = self._turn - first.turn, self._heading - first.heading
        if abs(turn) < PROOF:
            return False
        share = heading / turn
        if share <= -ALIKE:
            self.contrary = before or ContraryTurn(
                turn, heading, self._way - first.way, self._correction - first.correction
            )
        elif share >= ALIKE:
            self.contrary = None
        return (self.contrary is None) is not (before is None)
