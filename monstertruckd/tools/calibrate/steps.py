"""Steps of a wizard: what it may ask of the operator and the truck, and what the sensors measured during a move."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Message
from monstertruck_schemas.cmd import DriveCommand, SteeringCommand
from monstertruck_schemas.sensor import Attitude, DriveFeedback, SteeringFeedback
from monstertruck_schemas.topics import Topic

M = TypeVar("M", bound=Message)


@dataclass(slots=True)
class MoveRecord:
    """Readings of one move, rests at both ends included."""

    drive: list[DriveFeedback] = field(default_factory=list)
    steering: list[SteeringFeedback] = field(default_factory=list)
    steering_commands: list[SteeringCommand] = field(default_factory=list)
    """What the gate sent to the servos"""
    drive_commands: list[DriveCommand] = field(default_factory=list)
    """Commands to the drive"""
    attitude: list[Attitude] = field(default_factory=list)
    others: dict[str, list[Any]] = field(default_factory=dict)
    """What was requested in addition (``MoveStep.also``), by name of the topic"""
    left: int = 0
    """Newest stamp of the robot when the command to set off was given, ns"""
    arrived: int = 0
    """When it was at rest again, ns of the robot's clock"""

    # Time series

    def of(self, topic: Topic[M]) -> list[M]:
        """Messages of a topic that was requested in addition, in their order."""
        return list(self.others.get(topic.name, ()))

    def at_rest(self, topic: Topic[M]) -> tuple[list[M], list[M]]:
        """Those before it set off, and those after it had arrived."""
        found = self.of(topic)
        return [m for m in found if m.stamp < self.left], [m for m in found if m.stamp > self.arrived]

    def distance(self, drivetrain: DriveTrain) -> float:
        """Distance rolled by the wheels, m, by the drive's count; negative backwards."""
        if len(self.drive) < 2:
            return 0.0
        return float(drivetrain.distance(self.drive[-1].position - self.drive[0].position))

    @property
    def turns(self) -> float:
        """Turns of the motor between the two rests, forward positive."""
        return (self.drive[-1].position - self.drive[0].position) / (2 * math.pi)

    def headings(self) -> Array:
        """Headings, clockwise, rad, unwrapped; (n,)."""
        return np.unwrap([reading.heading for reading in self.attitude])

    def turned(self) -> float:
        """How far the heading has turned since the first reading, rad, left positive."""
        return float(-(self.headings()[[0, -1]] @ (-1, 1))) if len(self.attitude) > 1 else 0.0

    def turn(self) -> tuple[float, float]:
        """Turn between the rests, rad, left positive, and its standard error by the noise alone.

        Raises:
            InputError: too few headings at rest.
        """
        headings = self.headings()
        stamps = np.array([reading.stamp for reading in self.attitude])
        before, after = headings[stamps < self.left], headings[stamps > self.arrived]
        if min(before.size, after.size) < 5:
            raise InputError(
                f"only {before.size} and {after.size} headings of the compass at rest: expected 5 at each end; "
                "`monstertruckd status` says whether it is silent"
            )
        noise = math.hypot(*(float(rest.std(ddof=1)) / math.sqrt(rest.size) for rest in (before, after)))
        return float(before.mean() - after.mean()), noise

    def currents_at(self, stamps: Array) -> Array:
        """Motor current, A, at instants in ns; 0 where none was read for half a second; (n,)."""
        known = [(reading.stamp, reading.current) for reading in self.drive if reading.current is not None]
        if not known:
            return np.zeros(stamps.shape)
        times, values = np.array(known, dtype=np.float64).T
        nearest = np.abs(times[:, None] - stamps[None, :]).min(axis=0)
        # 0.5: seconds for which a motor current counts: not every feedback carries one
        return np.where(nearest < 0.5 * SECOND, np.interp(stamps, times, values), 0.0)

    def steps(self) -> tuple[Array, Array, Array]:
        """Motor turned between readings, rad, and both servo angles then, rad: (n,) each."""
        stamps = np.array([reading.stamp for reading in self.drive], dtype=np.float64)
        motor = np.diff([reading.position for reading in self.drive])
        middle = (stamps[1:] + stamps[:-1]) / 2
        times = np.array([reading.stamp for reading in self.steering], dtype=np.float64)
        front, rear = (
            np.interp(middle, times, [getattr(reading, axle) for reading in self.steering])
            for axle in ("front", "rear")
        )
        return motor, front, rear


@dataclass(frozen=True, slots=True)
class Number:
    """The operator reads something off a tape or a meter."""

    name: str
    """Short, for answers given beforehand"""
    question: str
    """The question, with the unit that is expected"""
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
class MoveStep:
    """The truck drives with fixed or weaving steering, from rest to rest; it is disarmed before and after.

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
    """Distance by the drive's own count, at most"""
    rest: float = 1.0
    """Seconds of standing still at each end"""
    approach: float = 0.0
    """Axle angle from which straight wheels are turned to where they shall be, rad: servos stop short of their goal"""
    weave: tuple[float, ...] = ()
    """Seconds after which the axle angles change their sign while it drives, in turn, again and again; none: never"""
    done: Callable[[MoveRecord], bool] | None = None
    """Ends the move earlier"""
    also: tuple[Topic[Any], ...] = ()
    """Topics that are recorded besides"""
    marked: bool = False
    """The operator measures from where it begins, so that it cannot start again once the truck has moved"""

    def back(self, distance: float) -> "MoveStep":
        """Back over the first ``distance`` of it, m; of a weaving move straight back."""
        back = replace(self, name=f"{self.name}, back", speed=-self.speed, metres=distance, done=None, also=())
        return replace(back, front=0.0, rear=0.0, weave=()) if self.weave else back

    def side(self, seconds: float) -> int:
        """Sign of the axle angles so long after the truck set off."""
        if not self.weave:
            return 1
        ends = list(itertools.accumulate(self.weave))
        rounds, left = divmod(seconds, ends[-1])
        changes = int(rounds) * len(ends) + sum(end <= left for end in ends)
        return -1 if changes % 2 else 1


@dataclass(frozen=True, slots=True)
class Collect(Generic[M]):
    """So many messages of a topic, while the truck stands."""

    name: str
    topic: Topic[M]
    count: int
    timeout: float = 10.0
    """Seconds in which they must have come"""


@dataclass(frozen=True, slots=True)
class WatchStep(Generic[M]):
    """Messages of a topic as they come, while the operator does something, until enough was seen.

    Of messages that come while one is looked at, the newest counts.
    """

    name: str
    topic: Topic[M]
    take: Callable[[M, dict[str, list[Any]]], tuple[float, float]]
    """Gets a message, and those of ``also`` since the last call, by topic; returns how much of how much is done"""
    also: tuple[Topic[Any], ...] = ()
    timeout: float = 10.0
    """Seconds without a message that end it"""


class Panel(Protocol):
    """The operator's side of a wizard: a terminal, a script, or a simulated operator."""

    def say(self, text: str) -> None:
        """Show a sentence."""

    def progress(self, name: str, done: float, total: float) -> None:
        """Show how far a step has come."""

    async def number(self, step: Number) -> float:
        """Ask.

        Raises:
            InputError: there is no answer.
        """

    async def confirm(self, step: Confirm) -> bool:
        """Ask. Raises as ``number`` does."""
