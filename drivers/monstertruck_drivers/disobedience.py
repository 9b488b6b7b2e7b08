"""Emulated motor controllers that disobey: how they deviate from their commanded targets."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Self


class Disobedience(StrEnum):
    """Kind of deviation from the commanded target."""

    IGNORE = "ignore"
    """Lower and opposite targets are ignored: the motor keeps its speed."""
    CREEP = "creep"
    """The motor never turns slower than a given speed."""
    RUN = "run"
    """The motor runs at a given speed, whatever is commanded."""
    REVERSE = "reverse"
    """Targets are applied with the opposite sign."""


class StoppedBy(StrEnum):
    """Weakest stop that still stops the motor; the stronger stops, listed after it, also work."""

    STAGE = "stage"
    """Power stage off."""
    LINE = "line"
    """A hardware input for a quick stop."""
    SUPPLY = "supply"
    """Only the loss of the controller's supply."""


WITH_SPEED = frozenset({Disobedience.CREEP, Disobedience.RUN})
USAGE = "ignore|reverse|creep RPM|run RPM [stage|line|supply], or off"


@dataclass(frozen=True, slots=True)
class DisobedientMotor:
    """Current disobedience of a controller.

    Args:
        kind: how it disobeys.
        rpm: motor speed for CREEP and RUN (rpm), with the controller's sign.
        stopped_by: weakest stop that still works.
    """

    kind: Disobedience
    rpm: float = 0.0
    stopped_by: StoppedBy = StoppedBy.STAGE

    @classmethod
    def parse(cls, *words: str) -> Self | None:
        """Parse the words of a fault command; return None for ``off``.

        Raises:
            ValueError: the words do not match ``USAGE``.
        """
        if words == ("off",):
            return None
        kind, *rest = words
        disobedience = Disobedience(kind)
        rpm = float(rest.pop(0)) if disobedience in WITH_SPEED and rest else 0.0
        if (disobedience in WITH_SPEED and rpm == 0.0) or len(rest) > 1:
            raise ValueError(words)
        return cls(disobedience, rpm, StoppedBy(rest[0]) if rest else StoppedBy.STAGE)

    def target(self, asked: float | None, present: float, *, line: bool = False) -> float | None:
        """Return the speed that the controller drives the motor to.

        Args:
            asked: commanded speed (rpm); None if the power stage is off.
            present: motor speed (rpm).
            line: whether the hardware input requests a quick stop.

        Returns:
            Speed (rpm); None if the power stage is off.
        """
        if asked is None and self.stopped_by is StoppedBy.STAGE:
            return None
        if line and self.stopped_by is not StoppedBy.SUPPLY:
            return asked
        wanted = asked or 0.0
        match self.kind:
            case Disobedience.IGNORE:
                return wanted if abs(wanted) >= abs(present) and wanted * present >= 0 else present
            case Disobedience.CREEP:
                return wanted if abs(wanted) >= abs(self.rpm) else self.rpm
            case Disobedience.RUN:
                return self.rpm
            case Disobedience.REVERSE:
                return -wanted
