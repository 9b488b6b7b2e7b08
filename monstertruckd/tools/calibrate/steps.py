"""Steps of a wizard: questions to the operator, moves of the truck, and the readings recorded during a move."""

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
    """Readings from one move, including the rests at its start and end."""

    drive: list[DriveFeedback] = field(default_factory=list)
    steering: list[SteeringFeedback] = field(default_factory=list)
    steering_commands: list[SteeringCommand] = field(default_factory=list)
    """Commands from the gate to the servos"""
    drive_commands: list[DriveCommand] = field(default_factory=list)
    """Commands to the drive"""
    attitude: list[Attitude] = field(default_factory=list)
    others: dict[str, list[Any]] = field(default_factory=dict)
    """Messages of the additional topics (``MoveStep.also``), by topic name"""
    left: int = 0
    """Latest robot stamp at the command to start (ns)"""
    arrived: int = 0
    """Time of rest after the move (ns, robot's clock)"""

    # Time series

    def of(self, topic: Topic[M]) -> list[M]:
        """Return the messages of an additional topic, in order."""
        return list(self.others.get(topic.name, ()))

    def at_rest(self, topic: Topic[M]) -> tuple[list[M], list[M]]:
        """Return the topic's messages from before the start and from after the arrival."""
        found = self.of(topic)
        return [m for m in found if m.stamp < self.left], [m for m in found if m.stamp > self.arrived]

    def distance(self, drivetrain: DriveTrain) -> float:
        """Distance rolled by the wheels, computed from the drive's position (m); negative when reversing."""
        if len(self.drive) < 2:
            return 0.0
        return float(drivetrain.distance(self.drive[-1].position - self.drive[0].position))

    @property
    def turns(self) -> float:
        """Motor turns between the two rests, forward positive."""
        return (self.drive[-1].position - self.drive[0].position) / (2 * math.pi)

    def headings(self) -> Array:
        """Unwrapped headings, clockwise (rad), shape (n,)."""
        return np.unwrap([reading.heading for reading in self.attitude])

    def turned(self) -> float:
        """Heading change since the first reading (rad), left positive."""
        return float(-(self.headings()[[0, -1]] @ (-1, 1))) if len(self.attitude) > 1 else 0.0

    def turn(self) -> tuple[float, float]:
        """Turn between the rests (rad, left positive), and its standard error due to noise alone.

        Raises:
            InputError: there are too few headings at rest.
        """
        headings = self.headings()
        stamps = np.array([reading.stamp for reading in self.attitude])
        before, after = headings[stamps < self.left], headings[stamps > self.arrived]
        if min(before.size, after.size) < 5:
            raise InputError(
                f"only {before.size} and {after.size} compass headings at rest: expected 5 at each end; "
                "`monstertruckd status` shows whether the compass is silent"
            )
        noise = math.hypot(*(float(rest.std(ddof=1)) / math.sqrt(rest.size) for rest in (before, after)))
        return float(before.mean() - after.mean()), noise

    def currents_at(self, stamps: Array) -> Array:
        """Motor current (A) at the given times (ns), shape (n,); 0 if no reading is within half a second."""
        known = [(reading.stamp, reading.current) for reading in self.drive if reading.current is not None]
        if not known:
            return np.zeros(stamps.shape)
        times, values = np.array(known, dtype=np.float64).T
        nearest = np.abs(times[:, None] - stamps[None, :]).min(axis=0)
        # 0.5: validity of a motor current (s): not every feedback contains one
        return np.where(nearest < 0.5 * SECOND, np.interp(stamps, times, values), 0.0)

    def steps(self) -> tuple[Array, Array, Array]:
        """Motor rotation between readings (rad), and both servo angles at the time of each reading (rad); (n,) each."""
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
    """A value that the operator reads from a tape or a meter."""

    name: str
    """Short name, for answers given in advance"""
    question: str
    """The question, with the expected unit"""
    low: float
    high: float
    """Upper bound. The wizard asks again for a value out of bounds, or refuses it if it was given in advance"""


@dataclass(frozen=True, slots=True)
class Confirm:
    """Confirmation by the operator of a completed action or of an observation."""

    name: str
    question: str
    fact: bool = False
    """Whether the answer decides the measurement, so that ``--yes`` does not give it; otherwise any answer but yes ends
    the wizard
    """


@dataclass(frozen=True, slots=True)
class MoveStep:
    """A drive from rest to rest, with fixed or weaving steering; the truck is disarmed before and after.

    The wheels steer while the truck stands. The truck rests briefly at both ends so that readings can be averaged.
    """

    name: str
    """Purpose, in one or two words"""
    speed: float
    """Speed (m/s), negative backwards"""
    front: float = 0.0
    rear: float = 0.0
    """Axle angles (rad), left positive"""
    metres: float = 1.0
    """Maximum distance, by the drive's position (m)"""
    rest: float = 1.0
    """Standstill at each end (s)"""
    approach: float = 0.0
    """Axle angle set before the final angle (rad), because servos stop short of their set-point"""
    weave: tuple[float, ...] = ()
    """Times between sign changes of the axle angles during the drive, repeated cyclically (s); empty: no changes"""
    done: Callable[[MoveRecord], bool] | None = None
    """Condition that ends the move early"""
    also: tuple[Topic[Any], ...] = ()
    """Additional topics to record"""
    marked: bool = False
    """Whether the operator measures from the start, so that the move cannot be repeated once the truck has moved"""

    def back(self, distance: float) -> "MoveStep":
        """Return the reverse of the move over ``distance`` (m); for a weaving move, straight back."""
        back = replace(self, name=f"{self.name}, back", speed=-self.speed, metres=distance, done=None, also=())
        return replace(back, front=0.0, rear=0.0, weave=()) if self.weave else back

    def side(self, seconds: float) -> int:
        """Sign of the axle angles ``seconds`` after the start."""
        if not self.weave:
            return 1
        ends = list(itertools.accumulate(self.weave))
        rounds, left = divmod(seconds, ends[-1])
        changes = int(rounds) * len(ends) + sum(end <= left for end in ends)
        return -1 if changes % 2 else 1


@dataclass(frozen=True, slots=True)
class Collect(Generic[M]):
    """Collects ``count`` messages of a topic while the truck is at rest."""

    name: str
    topic: Topic[M]
    count: int
    timeout: float = 10.0
    """Time limit for all messages (s)"""


@dataclass(frozen=True, slots=True)
class WatchStep(Generic[M]):
    """Follows the messages of a topic while the operator acts, until there is enough data.

    If several messages arrive while one is processed, only the latest is used.
    """

    name: str
    topic: Topic[M]
    take: Callable[[M, dict[str, list[Any]]], tuple[float, float]]
    """Called with a message and the messages of ``also`` since the last call, by topic; returns progress and total"""
    also: tuple[Topic[Any], ...] = ()
    timeout: float = 10.0
    """Timeout without a message (s)"""


@dataclass(frozen=True, slots=True)
class Plot:
    """Measurements from a wizard, and the fit to them."""

    name: str
    x: str
    """Label of the horizontal axis, with its unit"""
    y: str
    """Label of the vertical axis, with its unit"""
    points: Array
    """Measurements, shape (n, 2)"""
    curve: Array | None = None
    """The fit, shape (m, 2); None before it"""


class Panel(Protocol):
    """Operator interface of a wizard: a terminal, a script, or a simulated operator."""

    def say(self, text: str) -> None:
        """Show a message."""

    def progress(self, name: str, done: float, total: float) -> None:
        """Show the progress of a step."""

    def plot(self, plot: Plot) -> None:
        """Show measurements in place of the previous plot."""

    async def number(self, step: Number) -> float:
        """Ask for a number.

        Raises:
            InputError: no answer is available.
        """

    async def confirm(self, step: Confirm) -> bool:
        """Ask for a confirmation. Raises the same errors as ``number``."""
