"""ROS 2 interface of the bridge: publishers, subscriptions and services of one node, for any middleware."""

from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from monstertruckd.ros2.cdr import RosMessage
from monstertruckd.ros2.rmw import RELIABLE, RosQos

Publish = Callable[[Mapping[str, Any]], None]
"""Publishes one message; call it on the event loop."""


@dataclass(frozen=True, slots=True)
class RosSender:
    """A node that sends messages or calls services."""

    node: str
    """Qualified name, such as ``/teleop``."""
    key: str
    """Distinguishes nodes of the same name."""


@dataclass(frozen=True, slots=True)
class RosArrival:
    """Message of another node."""

    message: RosMessage
    sender: RosSender | None
    """Sender; None if the graph has no publisher of this topic that could have sent it."""
    publisher: bytes
    """Identity of the publisher."""
    sequence: int
    """Sequence number, which increases with every message of the publisher."""
    stamp: int
    """Send time by the sender's clock (ns since 1970)."""


Take = Callable[[RosArrival], None]
Answer = Callable[[RosMessage, RosSender | None], Awaitable[Mapping[str, Any]]]
"""Answers a service request."""


class RosNode(Protocol):
    """One node of the ROS 2 graph. All callbacks are called on the event loop."""

    distributions: Sequence[str]
    """Members of ``interfaces.DISTRIBUTIONS`` whose nodes it can talk to."""

    def publisher(self, topic: str, interface: str, qos: RosQos) -> Publish:
        """Advertise a topic; ``topic`` is absolute, or relative to the node's namespace."""

    def subscribe(self, topic: str, interface: str, take: Take, qos: RosQos = RELIABLE) -> None:
        """Receive a topic: the latest message of every publisher, also an earlier one if ``qos`` is latched."""

    def serve(self, service: str, interface: str, answer: Answer) -> None:
        """Advertise a service; requests are answered in parallel."""

    def qualified(self, name: str) -> str:
        """Return the full name of a topic or service: absolute, relative to the namespace, or to the node by ``~/``."""

    @property
    def malformed(self) -> int:
        """Number of malformed messages and requests so far."""

    def present(self, sender: RosSender) -> bool:
        """Return whether the graph still has this node."""


def sole_publisher(
    found: Iterable[tuple[str, str, bytes]], namespace: str, own: Collection[str]
) -> tuple[RosSender | None, bytes]:
    """Return a topic's publisher and its identity if exactly one publisher belongs to another program, else None.

    Args:
        found: namespace, name of the node and identity of all publishers.
        namespace: namespace of this program's nodes.
        own: names of this program's nodes.
    """
    others = [row for row in found if row[0] != namespace or row[1] not in own]
    undiscovered = "_NODE_NAME_UNKNOWN_"  # name in rmw while the publisher is known, but not its node
    if len(others) != 1 or others[0][1] == undiscovered:
        return None, b""
    ((space, name, identity),) = others
    node = f"{space.rstrip('/')}/{name}"
    return RosSender(node, node), identity
