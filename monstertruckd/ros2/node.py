"""Interface of a face to ROS 2: publishers, subscriptions and services of one node, by whatever middleware."""

from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from monstertruckd.ros2.cdr import RosMessage
from monstertruckd.ros2.rmw import RELIABLE, RosQos

Publish = Callable[[Mapping[str, Any]], None]
"""Publishes one message; to be called on the event loop."""


@dataclass(frozen=True, slots=True)
class RosSender:
    """A node that sends messages or calls services."""

    node: str
    """Qualified name, such as ``/teleop``."""
    key: str
    """Distinguishes nodes of the same name."""


@dataclass(frozen=True, slots=True)
class RosArrival:
    """A message of another node."""

    message: RosMessage
    sender: RosSender | None
    """None: the graph knows no publisher of this topic that could have sent it."""
    publisher: bytes
    """Identity of the publisher."""
    sequence: int
    """Grows with every message of the publisher."""
    stamp: int
    """When it was sent, by the sender's clock, ns since 1970."""


Take = Callable[[RosArrival], None]
Answer = Callable[[RosMessage, RosSender | None], Awaitable[Mapping[str, Any]]]
"""Answers a request of a service."""


class RosNode(Protocol):
    """One node of the ROS 2 graph. All callbacks are called on the event loop."""

    distributions: Sequence[str]
    """Members of ``interfaces.DISTRIBUTIONS`` whose nodes it meets."""

    def publisher(self, topic: str, interface: str, qos: RosQos) -> Publish:
        """Offer a topic; ``topic`` is absolute, or relative to the node's namespace."""

    def subscribe(self, topic: str, interface: str, take: Take, qos: RosQos = RELIABLE) -> None:
        """Receive a topic: the latest message of every publisher, also an earlier one if ``qos`` is latched."""

    def serve(self, service: str, interface: str, answer: Answer) -> None:
        """Offer a service; requests are answered in parallel."""

    def qualified(self, name: str) -> str:
        """Full name of a topic or service that is absolute, relative to the namespace, or to the node by ``~/``."""

    @property
    def malformed(self) -> int:
        """Messages and requests so far that were not as the wire has them."""

    def present(self, sender: RosSender) -> bool:
        """Whether the graph still has this node."""


def sole_publisher(
    found: Iterable[tuple[str, str, bytes]], namespace: str, own: Collection[str]
) -> tuple[RosSender | None, bytes]:
    """Return a topic's publisher and its identity if exactly one publisher belongs to another program, else None.

    Args:
        found: namespace, name of the node and identity of all publishers.
        namespace: of this program's nodes.
        own: their names.
    """
    others = [row for row in found if row[0] != namespace or row[1] not in own]
    undiscovered = "_NODE_NAME_UNKNOWN_"  # of rmw: the publisher is known before its node is
    if len(others) != 1 or others[0][1] == undiscovered:
        return None, b""
    ((space, name, identity),) = others
    node = f"{space.rstrip('/')}/{name}"
    return RosSender(node, node), identity
