"""Interfaces between services and the rest of the daemon: publish, subscribe, report."""

from collections.abc import Awaitable, Callable
from typing import Any, Protocol, TypeVar, runtime_checkable

from monstertruck_runtime.mailbox import Delivery, Mailbox
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import Topic, Writer

M = TypeVar("M", bound=Message)
M_co = TypeVar("M_co", bound=Message, covariant=True)
M_contra = TypeVar("M_contra", bound=Message, contravariant=True)

Value = float | int | str | bool | None


class Publisher(Protocol[M_contra]):
    """Write end of one topic."""

    def next_seq(self) -> int:
        """Sequence number for the next message of this topic."""

    def put(self, message: M_contra) -> None:
        """Deliver the message to all subscribers; never blocks."""


class Subscription(Protocol[M_co]):
    """Read end of one topic, with its own delivery (latest, or bounded FIFO)."""

    @property
    def latest(self) -> M_co | None:
        """Latest message, or None before the first; reading it does not consume it."""

    async def next(self) -> M_co:
        """Wait for a message not returned by ``next`` yet."""

    async def next_within(self, seconds: float, take: Callable[[M_co], bool] | None = None) -> M_co | None:
        """Wait as ``next`` does; return None if no message arrives within the timeout.

        Args:
            seconds: timeout, s.
            take: called immediately with a message that arrives during the wait, in its writer's callback; if it
                returns True the wait continues, and the message counts as read.
        """


class EventSink(Protocol):
    """Sink of a service's events."""

    def __call__(self, reason: Reason, severity: Severity, source: str, text: str = "", **values: Value) -> None:
        """Publish one event."""


class BusPort(Protocol):
    """The bus, for plug-ins that choose their topics themselves."""

    def publisher(self, topic: Topic[M], writer: Writer) -> Publisher[M]:
        """Return the only write end of ``topic``.

        Raises:
            RuntimeError: ``writer`` is not the topic's writer, or the write end is already in use.
        """

    def subscribe(self, topic: Topic[M], delivery: Delivery) -> Mailbox[M]:
        """Return a read end of ``topic``; for a retained topic it contains the latest message at once."""

    def event_sink(self) -> EventSink:
        """Return a sink of events."""


Ready = Callable[[], None]
"""Called by a service once its session works; resets the restart budget."""

Handler = Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]
"""Handler of a remote call: receives the caller's JSON object, returns the answer; refuses by raising
``TruckError``.
"""


class RpcRegistry(Protocol):
    """Registry of remote calls."""

    def register(
        self, name: str, handler: Handler, role: AccessRole = AccessRole.PILOT, *, recorded: bool = True
    ) -> None:
        """Serve ``name`` by ``handler`` for callers with ``role`` or a more powerful role.

        Calls that only read, or arrive many times a second, are not ``recorded``.
        """


@runtime_checkable
class ServesCalls(Protocol):
    """A service that serves remote calls."""

    def register(self, rpc: RpcRegistry) -> None:
        """Register its calls with ``rpc``."""
