"""What a behaviour is: a pure step from inputs to a requested motion, which its service runs at a fixed rate."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, TypeVar

from pydantic import Field

from monstertruck_kinematics.chassis import Chassis
from monstertruck_schemas.base import Message, Schema
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import Topic

M = TypeVar("M", bound=Message)


class BehaviourConfig(Schema):
    """Settings that all behaviours have; each adds its ``kind``."""

    kind: str
    rate: Annotated[float, Field(gt=0, le=50)] = 10.0
    """Steps a second"""


class RequestedMotion(NamedTuple):
    """A requested twist of base."""

    vx: float = 0.0
    """Forward, m/s."""
    wz: float = 0.0
    """Yaw rate, rad/s, left positive."""
    vy: float = 0.0
    """To the left, m/s."""


@dataclass(frozen=True, slots=True)
class BehaviourStep:
    """Result of one step.

    Attributes:
        motion: the requested one; None = standstill.
        state: for the next step.
        phase: what it is doing.
        outcome: DRIVING, or why it has ended; it is not stepped again then.
        text: of the outcome; empty = the reason's own.
        values: for ``plan/behaviour``.
    """

    motion: RequestedMotion | None
    state: Any
    phase: str = ""
    outcome: Reason = Reason.DRIVING
    text: str = ""
    values: Mapping[str, float] = field(default_factory=dict)


class BehaviourBody(NamedTuple):
    """The robot that a behaviour moves."""

    chassis: Chassis
    max_angle: float
    """Greatest angle of its axles, rad: that of the gate."""


class Inputs:
    """The newest message of every topic that a behaviour reads; all of them are fresh.

    Args:
        messages: by the topic's name.
    """

    def __init__(self, messages: Mapping[str, Message]) -> None:
        self._messages = messages

    def of(self, topic: Topic[M]) -> M:
        """The newest message of a topic."""
        message = self._messages[topic.name]
        assert isinstance(message, topic.model)
        return message


class Behaviour(Protocol):
    """Made from its settings; keeps nothing between steps but what they return.

    A class with a class method ``fit(settings, body)`` is made by this instead, from a ``BehaviourBody`` as well, at
    every start; a ``ValueError`` of it says why the body cannot do that, or what is wrong with the settings.
    """

    reads: ClassVar[tuple[Topic[Any], ...]]
    """Topics without which it cannot run: when one has no fresh message, it is stopped with ``INPUT_STALE``."""

    def begin(self) -> Any:
        """State before the first step."""

    def step(self, inputs: Inputs, state: Any, t: float) -> BehaviourStep:
        """One step.

        Args:
            inputs: newest messages.
            state: of the step before.
            t: s since the behaviour was started.
        """
