"""Detection of compass headings that turn against the robot.

A heading of the wrong sign is not an outlier: it is right near the heading where north was found, and while the robot
turns slowly it pulls the yaw along within any outlier gate. Only its turns reveal the fault: they oppose the turns by
the wheels or an inertial measurement unit.
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
    """Compass turn opposite to the robot's turn."""

    robot: float
    """Turn of the robot (rad)."""
    headings: float
    """Turn by the headings (rad)."""
    distance: float
    """Distance travelled during the turn (m)."""
    correction: float
    """Correction of the yaw by these headings (rad)."""

    @property
    def text(self) -> str:
        """Description for the log."""
        return (
            f"the compass turned {self.headings:+.2f} rad while the robot turned {self.robot:+.2f}: check the "
            "compass's sign"
        )


class HeadingTurns:
    """Compare the turns of headings with the robot's turns."""

    def __init__(self) -> None:
        self._rows: deque[_Row] = deque()
        self._turn = self._distance = self._heading = self._correction = 0.0
        self._last: float | None = None
        self.contrary: ContraryTurn | None = None
        """Evidence of opposite turns; None while the headings turn with the robot."""

    def moved(self, turn: float, distance: float) -> None:
        """Add a turn of the robot without the compass (rad), over ``distance`` (m)."""
        self._turn += turn
        self._distance += distance

    def corrected(self, by: float) -> None:
        """Add a correction of the yaw by a heading (rad)."""
        self._correction += by

    def forget(self) -> None:
        """Start the comparison again after a disturbance of the field or the wheels."""
        self._rows.clear()

    def observe(self, yaw: float) -> bool:
        """Add a counter-clockwise heading (rad); return whether it changed ``contrary``."""
        if self._last is not None:
            self._heading += wrap_angle(yaw - self._last)
        self._last = yaw
        rows = self._rows
        rows.append(_Row(self._turn, self._distance, self._heading, self._correction))
        # minimum turn of the robot for a comparison, rad: several times the error caused by iron nearby
        proof = 0.25
        # Within 3 m: over a longer distance the wheels' drift dominates.
        while self._distance - rows[0].distance > 3.0 or (len(rows) > 2 and abs(self._turn - rows[1].turn) >= proof):
            rows.popleft()
        first, before = rows[0], self.contrary
        turn, heading = self._turn - first.turn, self._heading - first.heading
        if abs(turn) < proof:
            return False
        share = heading / turn
        # minimum share of the turn, with equal or opposite sign, in the headings for a decision
        alike = 0.5
        if share <= -alike:
            self.contrary = before or ContraryTurn(
                turn, heading, self._distance - first.distance, self._correction - first.correction
            )
        elif share >= alike:
            self.contrary = None
        return (self.contrary is None) is not (before is None)
