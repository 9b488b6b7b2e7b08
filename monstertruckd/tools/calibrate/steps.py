"""What a wizard may ask for: typed steps, and the faces that answer them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import Topic
from monstertruckd.tools.calibrate.track import Track

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class Number:
    """The operator reads something off a tape or a meter."""

    name: str
    """Short, for answers given beforehand"""
    question: str
    """With the unit that is expected"""
    low: float
    high: float
    """Anything outside is asked again, or refused when it was given beforehand"""


@dataclass(frozen=True, slots=True)
class Confirm:
    """The operator does something, or says what happened."""

    name: str
    question: str
    fact: bool = False
    """The answer decides what is measured, so ``--yes`` is none; otherwise anything but yes ends the wizard"""


@dataclass(frozen=True, slots=True)
class Move:
    """The truck drives with fixed steering, from rest to rest; it is disarmed before and after.

    The wheels are turned while it stands, and it rests for a moment at both ends so that what is measured there can be
    averaged.
    """

    name: str
    """What for, in a word or two"""
    speed: float
    """m/s, negative backwards"""
    front: float = 0.0
    rear: float = 0.0
    """Axle angles, rad, left positive"""
    metres: float = 1.0
    """Way by the drive's own count, at most"""
    rest: float = 1.0
    """Seconds of standing still at each end"""
    approach: float = 0.0
    """Axle angle from which straight wheels are turned to where they shall be, rad: servos stop short of their goal"""
    done: Callable[[Track], bool] | None = None
    """Ends the way earlier"""


@dataclass(frozen=True, slots=True)
class Collect(Generic[M]):
    """So many messages of a topic, while the truck stands."""

    name: str
    topic: Topic[M]
    count: int
    timeout: float = 10.0
    """Seconds in which they must have come"""


Step = Number | Confirm | Move | Collect[Any]


class Panel(Protocol):
    """The operator's side of a wizard: a terminal, a script, or a simulated operator."""

    def say(self, text: str) -> None:
        """Show a sentence."""
        ...

    def progress(self, name: str, done: float, total: float) -> None:
        """Show how far a step has come."""
        ...

    async def number(self, step: Number) -> float:
        """Ask.

        Raises:
            InputError: there is no answer.
        """
        ...

    async def confirm(self, step: Confirm) -> bool:
        """Ask. Raises as ``number`` does."""
        ...
