"""Whether the headings of a compass turn with the robot or against it.

A heading of the wrong sign is not an outlier: it is right near the heading where north was found, and while the robot
turns slowly it pulls the yaw with it, within any outlier gate. Only its turns show the fault: they oppose the turns of
the wheels or of an inertial measurement unit.
"""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from monstertruck_estimation.transforms import wrap_angle


class _Row(NamedTuple):
    turn: float
    distance: float
    heading: float
    correction: float


@dataclass(frozen=True, slots=True)
class ContraryTurn:
    """Headings that turned against the robot."""

    robot: float
    """Turn of the robot, rad."""
    headings: float
    """Turn by the headings, rad."""
    distance: float
    """Distance travelled meanwhile, m."""
    correction: float
    """Correction of the yaw by these headings, rad."""

    @property
    def text(self) -> str:
        """Text for the log."""
        return (
            f"the compass turned {self.headings:+.2f} rad while the robot turned {self.robot:+.2f}: check the "
            "compass's sign"
        )


class HeadingTurns:
    """Compares the turns of headings with the robot's turns."""

    def __init__(self) -> None:
        self._rows: deque[_Row] = deque()
        self._turn = self._distance = self._heading = self._correction = 0.0
        self._last: float | None = None
        self.contrary: ContraryTurn | None = None
        """The turn that showed it; None while headings turn with the robot."""

    def moved(self, turn: float, distance: float) -> None:
        """The robot turned by ``turn``, rad, without the compass, over ``distance``, m."""
        self._turn += turn
        self._distance += distance

    def corrected(self, by: float) -> None:
        """A heading corrected the yaw by so much, rad."""
        self._correction += by

    def forget(self) -> None:
        """Start a new comparison: the field or the wheels were disturbed."""
        self._rows.clear()

    def observe(self, yaw: float) -> bool:
        """Take a heading, rad, counter-clockwise; whether it changed ``contrary``."""
        if self._last is not None:
            self._heading += wrap_angle(yaw - self._last)
        self._last = yaw
        rows = self._rows
        rows.append(_Row(self._turn, self._distance, self._heading, self._correction))
        # turn of the robot over which the headings are compared, rad: several times the error that iron nearby causes
        proof = 0.25
        # Within 3 m: a drift of the wheels over a long distance does not count.
        while self._distance - rows[0].distance > 3.0 or (len(rows) > 2 and abs(self._turn - rows[1].turn) >= proof):
            rows.popleft()
        first, before = rows[0], self.contrary
        turn, heading = self._turn - first.turn, self._heading - first.heading
        if abs(turn) < proof:
            return False
        share = heading / turn
        # least share of the turn that the headings must show, with the same or the opposite sign, for a decision
        alike = 0.5
        if share <= -alike:
            self.contrary = before or ContraryTurn(
                turn, heading, self._distance - first.distance, self._correction - first.correction
            )
        elif share >= alike:
            self.contrary = None
        return (self.contrary is None) is not (before is None)
