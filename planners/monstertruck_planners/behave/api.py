"""Interface of behaviours: a pure step from inputs to a requested motion, run by the service at a fixed rate."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, TypeVar

from pydantic import Field

from monstertruck_kinematics.chassis import Chassis
from monstertruck_schemas.base import Message, Schema
from monstertruck_schemas.plan import DockTarget
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import Topic

M = TypeVar("M", bound=Message)


class BehaviourConfig(Schema):
    """Settings shared by all behaviours; each adds its ``kind``."""

    kind: str
    rate: Annotated[float, Field(gt=0, le=50)] = 10.0
    """Steps per second"""


class RequestedMotion(NamedTuple):
    """Requested twist of base."""

    vx: float = 0.0
    """Forward speed (m/s)."""
    wz: float = 0.0
    """Yaw rate (rad/s), left positive."""
    vy: float = 0.0
    """Lateral speed (m/s), left positive."""


@dataclass(frozen=True, slots=True)
class BehaviourStep:
    """Result of one step.

    Attributes:
        motion: requested motion; None for standstill.
        state: state for the next step.
        phase: current phase.
        outcome: DRIVING, or the reason why the behaviour ended; an ended behaviour is not stepped again.
        text: message for the outcome; empty for the default message of the reason.
        values: values for ``plan/behaviour``.
        dock: dock near which the gate is to let the robot drive.
    """

    motion: RequestedMotion | None
    state: Any
    phase: str = ""
    outcome: Reason = Reason.DRIVING
    text: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    dock: DockTarget | None = None


class BehaviourBody(NamedTuple):
    """Body of the robot that a behaviour moves."""

    chassis: Chassis
    max_angle: float
    """Maximum axle angle (rad): the gate's limit."""


class Inputs:
    """Latest fresh messages of the topics that a behaviour reads and may read.

    Args:
        messages: messages by topic name.
    """

    def __init__(self, messages: Mapping[str, Message]) -> None:
        self._messages = messages

    def of(self, topic: Topic[M]) -> M:
        """Return the latest message of a topic that the behaviour requires."""
        message = self.if_fresh(topic)
        assert message is not None
        return message

    def if_fresh(self, topic: Topic[M]) -> M | None:
        """Return the latest message of a topic; None if it is not fresh."""
        message = self._messages.get(topic.name)
        assert message is None or isinstance(message, topic.model)
        return message


class Behaviour(Protocol):
    """Behaviour constructed from its settings; the state returned by a step is all it keeps between steps.

    A class may list more topics in an attribute ``may_read``; it then receives their fresh messages, too.

    If a class has a class method ``fit(settings, body)``, this method constructs the behaviour at every start, with a
    ``BehaviourBody``. It raises a ``ValueError`` if the body cannot execute the behaviour or the settings are wrong.
    """

    reads: ClassVar[tuple[Topic[Any], ...]]
    """Required topics: if one has no fresh message, the behaviour is stopped with ``INPUT_STALE``."""

    def begin(self) -> Any:
        """Return the state before the first step."""

    def step(self, inputs: Inputs, state: Any, t: float) -> BehaviourStep:
        """Run one step.

        Args:
            inputs: latest messages.
            state: state returned by the previous step.
            t: time since the start of the behaviour (s).
        """
