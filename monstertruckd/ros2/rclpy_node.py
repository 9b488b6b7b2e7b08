"""ROS 2 node based on ``rclpy``, for every ROS 2 middleware; requires a ROS 2 installation.

Messages are passed as bytes, which the bridge encodes and decodes itself. Interfaces whose package is not installed are
omitted. ``rclpy`` reports neither the publisher of a message nor the client of a request:

- A message is attributed to the publisher of its topic if there is exactly one besides this node, and to an unknown
  publisher otherwise.
- All service clients count as one sender.
"""

import asyncio
import os
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final, Self

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

from monstertruck_runtime.errors import BusyError, InputError
from monstertruck_runtime.threads import in_daemon_thread, in_thread
from monstertruckd.ros2.cdr import decode, encode
from monstertruckd.ros2.interfaces import DISTRIBUTIONS, installed_interface, wire_name
from monstertruckd.ros2.node import Answer, Publish, RosArrival, RosSender, Take, sole_publisher
from monstertruckd.ros2.rmw import RELIABLE, RosQos

CLIENTS: Final = RosSender("/service_clients", "clients")
"""Sender that stands for all service clients."""
ANSWER_TIMEOUT: Final = 3600.0
"""Maximum time for answering a request (s): the result of an action is available only at its end."""
THREADS: Final = 64
"""Maximum number of requests answered in parallel, plus one thread for messages; the result request of an action
occupies one until the action ends.
"""


def distribution_here() -> str:
    """Return the entry of ``interfaces.DISTRIBUTIONS`` that is installed, according to ``ROS_DISTRO``."""
    named = os.environ.get("ROS_DISTRO", "jazzy")
    others = {"iron": "jazzy"}
    return named if named in DISTRIBUTIONS else others.get(named, DISTRIBUTIONS[-1])


def _profile(qos: RosQos) -> QoSProfile:
    return QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy.RELIABLE if qos.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else DurabilityPolicy.VOLATILE,
    )


@dataclass(slots=True)
class Participant:
    """An ``rclpy`` context with one node."""

    context: Context
    node: Node
    executor: MultiThreadedExecutor
    interfaces: dict[str, str] = field(default_factory=dict)
    """Interface names by topic."""

    def leave(self) -> None:
        """Leave the graph."""
        self.executor.shutdown(1.0)
        self.node.destroy_node()
        self.context.try_shutdown()


def _spin(executor: MultiThreadedExecutor) -> None:
    try:
        executor.spin()
    except ExternalShutdownException:
        return


class RclpyNode:
    """One node; an async context manager.

    Args:
        name: name of the node, and its namespace, ``/`` or ``/truck1``.
        domain: ``ROS_DOMAIN_ID``.
    """

    def __init__(self, name: tuple[str, str], domain: int) -> None:
        self._name, self._namespace = name
        self._domain = domain
        self.malformed = 0
        self.distributions: Sequence[str] = (distribution_here(),)
        self.missing: set[str] = set()
        """Interfaces that are not installed."""
        self._undiscovered: dict[str, asyncio.TimerHandle] = {}
        """Timers of latched messages whose publisher is still unknown, by topic."""

    async def __aenter__(self) -> Self:
        """Join the graph.

        Raises:
            BusyError: the graph already has a node with this name.
        """
        self._loop = asyncio.get_running_loop()
        self._participants = [await in_thread(self._join)]
        own = self._name, self._namespace
        await asyncio.sleep(1.0)  # time to discover the running nodes (s)
        if self._node.get_node_names_and_namespaces().count(own) > 1:
            await self.__aexit__()
            where = f"{self._namespace.rstrip('/')}/{self._name}"
            raise BusyError(
                f"domain {self._domain} already has a node {where}: expected one ROS 2 bridge for each robot"
            )
        return self

    @property
    def _node(self) -> Any:
        """Identity of the first participant."""
        return self._participants[0].node

    def _join(self, number: int = 1) -> "Participant":
        context = Context()
        context.init(domain_id=self._domain)
        node = Node(
            self._name if number == 1 else f"{self._name}_{number}",
            namespace=self._namespace,
            context=context,
            start_parameter_services=False,
            enable_rosout=False,
        )
        executor = MultiThreadedExecutor(THREADS, context=context)
        executor.add_node(node)
        threading.Thread(target=_spin, args=(executor,), name="rclpy", daemon=True).start()
        return Participant(context, node, executor)

    async def __aexit__(self, *_: object) -> None:
        """Leave the graph."""
        for waiting in self._undiscovered.values():
            waiting.cancel()

        def leave() -> None:
            for participant in self._participants:
                participant.leave()

        await in_daemon_thread(leave)

    def _node_for(self, topic: str, interface: str) -> Any:
        """Return the node for a topic with an interface, because a DDS participant has a single interface per topic.

        A second interface, such as a stamped ``cmd_vel``, gets a separate participant and node.
        """
        for participant in self._participants:
            if participant.interfaces.setdefault(topic, interface) == interface:
                return participant.node
        self._participants.append(self._join(len(self._participants) + 1))
        return self._node_for(topic, interface)

    def qualified(self, name: str) -> str:
        """Return the full name of a topic or service; see ``RosNode``."""
        return str(self._node.resolve_topic_name(name))

    def present(self, sender: RosSender) -> bool:
        """Return whether the graph still has this node."""
        names = {f"{space.rstrip('/')}/{name}" for name, space in self._node.get_node_names_and_namespaces()}
        return sender is CLIENTS or sender.node in names

    def _interface(self, name: str) -> Any:
        found = installed_interface(name)
        if found is None:
            self.missing.add(wire_name(name))
        return found

    def publisher(self, topic: str, interface: str, qos: RosQos) -> Publish:
        """Advertise a topic; see ``RosNode``."""
        kind = self._interface(interface)
        if kind is None:
            return lambda _: None
        publisher = self._node_for(topic, interface).create_publisher(kind, topic, _profile(qos))
        return lambda message: publisher.publish(encode(interface, message))

    def subscribe(self, topic: str, interface: str, take: Take, qos: RosQos = RELIABLE) -> None:
        """Receive a topic; see ``RosNode``."""
        kind = self._interface(interface)
        if kind is None:
            return

        def receive(data: bytes, info: Mapping[str, Any]) -> None:
            try:
                message = decode(interface, data)
            except InputError:
                self.malformed += 1
                return
            sender, gid = self._publisher_of(topic)
            number, stamp = info["publication_sequence_number"], info["source_timestamp"]
            arrival = RosArrival(message, sender, gid, int(number or 0), int(stamp))
            self._loop.call_soon_threadsafe(arrive, arrival)

        def arrive(arrival: RosArrival) -> None:
            if (waiting := self._undiscovered.pop(topic, None)) is not None:
                waiting.cancel()
            if arrival.sender is None and qos.latched:  # sent once, possibly before the graph has its publisher
                self._undiscovered[topic] = self._loop.call_later(1.0, self._discovered, topic, take, arrival)
            else:
                take(arrival)

        # Queue length 1: only the latest waiting message is used.
        profile = _profile(RosQos(depth=1, reliable=qos.latched, latched=qos.latched))
        self._node_for(topic, interface).create_subscription(kind, topic, receive, profile, raw=True)

    def _discovered(self, topic: str, take: Take, arrival: RosArrival) -> None:
        del self._undiscovered[topic]
        sender, gid = self._publisher_of(topic)
        take(replace(arrival, sender=sender, publisher=gid))

    def _publisher_of(self, topic: str) -> tuple[RosSender | None, bytes]:
        """Return the publisher of a topic if it is the only one besides this node."""
        own = {participant.node.get_name() for participant in self._participants}
        rows = self._node.get_publishers_info_by_topic(self.qualified(topic))
        named = [(row.node_namespace, row.node_name, bytes(row.endpoint_gid)) for row in rows]
        return sole_publisher(named, self._namespace, own)

    def serve(self, service: str, interface: str, answer: Answer) -> None:
        """Advertise a service; see ``RosNode``."""
        kind = self._interface(interface)
        if kind is None:
            return

        def reply(request: Any, _: Any) -> Any:
            message = decode(f"{interface}_Request", serialize_message(request))
            work = partial(answer, message, CLIENTS)
            values = asyncio.run_coroutine_threadsafe(_awaited(work), self._loop).result(ANSWER_TIMEOUT)
            return deserialize_message(encode(f"{interface}_Response", values), kind.Response)

        self._node.create_service(kind, service, reply, callback_group=ReentrantCallbackGroup())


async def _awaited(work: Any) -> Any:
    return await work()
