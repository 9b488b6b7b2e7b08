"""ROS 2 node over Zenoh, compatible with ``rmw_zenoh``; needs no ROS installation."""

import asyncio
import json
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final, Self

import zenoh
from zenoh import ext

from monstertruck_runtime.client import in_network_thread
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.endpoints import endpoint_of, host_of, port_of, protocol_of
from monstertruck_runtime.errors import BusyError, InputError, NotFoundError
from monstertruck_runtime.threads import ThreadHop, in_daemon_thread, in_thread
from monstertruckd.ros2.cdr import decode, encode
from monstertruckd.ros2.interfaces import DISTRIBUTIONS, type_hash
from monstertruckd.ros2.node import Answer, Publish, RosArrival, RosSender, Take
from monstertruckd.ros2.rmw import (
    LIVELINESS,
    NO_HASH,
    RELIABLE,
    Attachment,
    EntityKind,
    RosEntity,
    RosQos,
    data_key,
    dds_name,
    gid_of,
    mangled,
    parsed_token,
    token_key,
)

PUBLISHERS: Final = 64
"""Maximum number of publishers of a topic with a waiting message; messages of further ones are lost."""


def session_settings(connect: str | None, listen: str) -> dict[str, Any]:
    """Return the configuration of the node's Zenoh session.

    Args:
        connect: endpoint of a running Zenoh router such as ``rmw_zenohd``; None: the node is the router itself.
        listen: endpoint of that router.
    """
    settings: dict[str, Any] = {
        "scouting": {"delay": 0, "multicast": {"enabled": False}},
        "timestamping": {"enabled": True},
        "transport": {"shared_memory": {"enabled": False}},
    }
    if connect is None:
        return settings | {"mode": "router", "listen": {"endpoints": [listen]}}
    reach = {"endpoints": [connect], "timeout_ms": 2500, "exit_on_failure": True}
    return settings | {"mode": "client", "connect": reach}


def free_endpoint(listen: str) -> str:
    """Return the endpoint, or the same with the next free port: ``rmw_zenohd`` and the daemon share a default port.

    Raises:
        BusyError: none of the next ports is free.
    """
    protocol, host, first = protocol_of(listen), host_of(listen), port_of(listen) or 0
    ports = 10  # number of ports tried
    for port in range(first, first + ports):
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError:
                continue
            return endpoint_of(protocol, host, probe.getsockname()[1])
    raise BusyError(f"ports {first} to {first + ports - 1} of {host} are taken: choose a free one (--listen)")


class _Discovery:
    """Holds messages that arrive before the token of their publisher, because latched messages are sent only once.

    Args:
        loop: event loop.
        sender_of: returns the publisher with a GID; None if the graph has none.
        deliver: called with the message, after at most a second.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, sender_of: Callable[[bytes], RosSender | None], deliver: Take
    ) -> None:
        self._loop, self._sender_of, self._deliver = loop, sender_of, deliver
        self._early: dict[bytes, RosArrival] = {}
        """Waiting messages by publisher."""

    def take(self, arrival: RosArrival) -> None:
        """Deliver a message now or later; a newer message of its publisher replaces a waiting one."""
        self._early.pop(arrival.publisher, None)
        if arrival.sender is None and len(self._early) < PUBLISHERS:
            self._early[arrival.publisher] = arrival
            self._loop.call_later(1.0, self._discovered, arrival)
        else:
            self._deliver(arrival)

    def _discovered(self, arrival: RosArrival) -> None:
        if self._early.get(arrival.publisher) is arrival:
            del self._early[arrival.publisher]
            self._deliver(replace(arrival, sender=self._sender_of(arrival.publisher)))


class ZenohNode:
    """One node; an async context manager.

    Args:
        name: name of the node, and its namespace, ``/`` or ``/truck1``.
        domain: ``ROS_DOMAIN_ID``.
        settings: result of ``session_settings``.
        clock: time.
        hashed: False for Humble.
    """

    def __init__(
        self, name: tuple[str, str], domain: int, settings: Mapping[str, Any], clock: Clock, *, hashed: bool = True
    ) -> None:
        self._name, self._namespace = name
        self._domain = domain
        self._settings = settings
        self._clock = clock
        self._hashed = hashed
        self.distributions: Sequence[str] = DISTRIBUTIONS[1:] if hashed else DISTRIBUTIONS[:1]
        self._entities = 0
        self._graph: dict[str, RosEntity] = {}
        """Entities by their token."""
        self._gids: dict[bytes, str] = {}
        """Tokens by GID."""
        self._kept: list[Any] = []
        """Zenoh declarations, which end when they are dropped."""
        self._answering: set[asyncio.Task[None]] = set()
        self.malformed = 0

    async def __aenter__(self) -> Self:
        """Join the graph.

        Raises:
            BusyError: the graph already has a node with this name.
            NotFoundError: no router answers, or the endpoint is not available.
        """
        self._loop = asyncio.get_running_loop()
        text = json.dumps(self._settings)
        try:
            self._session = await in_thread(lambda: zenoh.open(zenoh.Config.from_json5(text)))
        except zenoh.ZError as error:
            places = self._settings.get("connect", self._settings.get("listen", {})).get("endpoints")
            raise NotFoundError(f"no Zenoh session for ROS 2 at {', '.join(places or ())}: {error}") from None
        graph = 100_000  # maximum number of pending graph changes
        hop: ThreadHop[tuple[str, bool]] = ThreadHop(self._seen, graph, lambda _: None)
        try:
            await in_thread(partial(self._join, hop))
        except BusyError:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """Leave the graph."""
        for task in self._answering:
            task.cancel()
        await in_daemon_thread(self._session.close)

    def _join(self, hop: ThreadHop[tuple[str, bool]]) -> None:
        own = f"*/*/*/{EntityKind.NODE}/*/{mangled('' if self._namespace == '/' else self._namespace)}/{self._name}"
        key = f"{LIVELINESS}/{self._domain}/{own}"
        found = [reply for reply in self._session.liveliness().get(key, timeout=0.5) if reply.ok is not None]
        if found:
            node = f"{self._namespace.rstrip('/')}/{self._name}"
            raise BusyError(
                f"domain {self._domain} already has a node {node}: expected one ROS 2 bridge for each robot"
            )

        def follow(sample: zenoh.Sample) -> None:
            hop.put((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

        graph = f"{LIVELINESS}/{self._domain}/**"
        self._kept.append(self._session.liveliness().declare_subscriber(graph, follow, history=True))
        self._token(EntityKind.NODE)

    # Graph

    def _seen(self, news: tuple[str, bool]) -> None:
        key, here = news
        if not here:
            self._graph.pop(key, None)
            self._gids.pop(gid_of(key), None)
            return
        try:
            self._graph[key] = parsed_token(key)
        except InputError:
            self.malformed += 1
            return
        self._gids[gid_of(key)] = key

    def _sender(self, gid: bytes, topic: str, interface: str, kind: EntityKind) -> RosSender | None:
        entity = self._graph.get(self._gids.get(gid, ""))
        if entity is None or (entity.kind, entity.topic, entity.interface) != (kind, topic, dds_name(interface)):
            return None
        return RosSender(entity.qualified_node, entity.owner)

    def present(self, sender: RosSender) -> bool:
        """Return whether the graph still has this node."""
        return any(entity.owner == sender.key for entity in self._graph.values())

    def qualified(self, name: str) -> str:
        """Return the full name of a topic or service; see ``RosNode``."""
        name = name.replace("~", self._name, 1) if name.startswith("~/") else name
        return name if name.startswith("/") else f"{self._namespace.rstrip('/')}/{name}"

    def _token(self, kind: EntityKind, topic: str = "", interface: str = "", qos: RosQos = RELIABLE) -> bytes:
        """Declare an entity; return its GID."""
        own = self._entities
        self._entities += 1
        described = dds_name(interface) if interface else ""
        entity = RosEntity(kind, self._namespace, self._name, topic, described)
        types = "" if not interface else type_hash(interface) if self._hashed else NO_HASH
        key = token_key(self._domain, str(self._session.zid()), (0, own), entity, (types, qos.text))
        self._kept.append(self._session.liveliness().declare_token(key))
        return gid_of(key)

    def _key(self, name: str, interface: str) -> str:
        return data_key(self._domain, name, interface, hashed=self._hashed)

    def _real_time(self) -> int:
        return self._clock.now() + self._clock.real_offset()

    # Topics

    def publisher(self, topic: str, interface: str, qos: RosQos) -> Publish:
        """Advertise a topic; see ``RosNode``."""
        name = self.qualified(topic)
        more: dict[str, Any] = {}
        if qos.latched:
            more = {"cache": ext.CacheConfig(qos.depth), "publisher_detection": True}
            if qos.reliable:
                # 0.5: interval between two heartbeats (s), as in rmw_zenoh
                more["sample_miss_detection"] = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)
        publisher = ext.declare_advanced_publisher(
            self._session, self._key(name, interface), congestion_control=zenoh.CongestionControl.DROP, **more
        )
        self._kept.append(publisher)
        gid = self._token(EntityKind.PUBLISHER, name, interface, qos)
        sequence = 0

        def publish(message: Mapping[str, Any]) -> None:
            nonlocal sequence
            sequence += 1
            attachment = Attachment(sequence, self._real_time(), gid).packed()
            publisher.put(encode(interface, message), attachment=attachment)

        return publish

    def subscribe(self, topic: str, interface: str, take: Take, qos: RosQos = RELIABLE) -> None:
        """Receive a topic; see ``RosNode``."""
        name = self.qualified(topic)
        newest: dict[bytes, tuple[Attachment, bytes]] = {}
        """Latest message by publisher; the network thread fills it, the event loop empties it."""
        lock = threading.Lock()
        sender_of = partial(self._sender, topic=name, interface=interface, kind=EntityKind.PUBLISHER)
        if qos.latched:
            take = _Discovery(self._loop, sender_of, take).take

        def receive(sample: zenoh.Sample) -> None:
            try:
                attachment = Attachment.parse(None if sample.attachment is None else sample.attachment.to_bytes())
            except InputError:
                self.malformed += 1
                return
            with lock:
                scheduled = bool(newest)
                waiting = newest.get(attachment.gid)
                if waiting is None and len(newest) >= PUBLISHERS:
                    self.malformed += 1
                elif waiting is None or attachment.sequence > waiting[0].sequence:
                    newest[attachment.gid] = attachment, sample.payload.to_bytes()
                    if not scheduled:
                        self._loop.call_soon_threadsafe(deliver)

        def deliver() -> None:
            with lock:
                arrived = list(newest.values())
                newest.clear()
            for attachment, data in arrived:
                try:
                    message = decode(interface, data)
                except InputError:
                    self.malformed += 1
                    continue
                sender = sender_of(attachment.gid)
                take(RosArrival(message, sender, attachment.gid, attachment.sequence, attachment.stamp))

        self._token(EntityKind.SUBSCRIPTION, name, interface, qos)
        key, handler = self._key(name, interface), in_network_thread(receive)
        if qos.latched:
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth)
            subscriber = ext.declare_advanced_subscriber(
                self._session, key, handler, history=history, subscriber_detection=True
            )
            self._kept.append(subscriber)
            return
        others = zenoh.Locality.REMOTE  # not this node's own messages
        self._kept.append(self._session.declare_subscriber(key, handler, allowed_origin=others))

    # Services

    def serve(self, service: str, interface: str, answer: Answer) -> None:
        """Advertise a service; see ``RosNode``."""
        name = self.qualified(service)
        key = self._key(name, interface)
        requests = 64  # maximum number of pending requests of a service; the oldest is dropped
        hop: ThreadHop[zenoh.Query] = ThreadHop(
            partial(self._request, key, name, interface, answer), requests, lambda _: None
        )
        # Clients query with target ALL_COMPLETE.
        self._kept.append(self._session.declare_queryable(key, hop.put, complete=True))
        self._token(EntityKind.SERVICE, name, interface)

    def _request(self, key: str, name: str, interface: str, answer: Answer, query: zenoh.Query) -> None:
        task = self._loop.create_task(self._answer(key, name, interface, answer, query))
        self._answering.add(task)
        task.add_done_callback(self._answering.discard)

    async def _answer(self, key: str, name: str, interface: str, answer: Answer, query: zenoh.Query) -> None:
        with query:
            try:
                asked = Attachment.parse(None if query.attachment is None else query.attachment.to_bytes())
                data = b"" if query.payload is None else query.payload.to_bytes()
                message = decode(f"{interface}_Request", data)
            except InputError as error:
                self.malformed += 1
                query.reply_err(str(error).encode())
                return
            reply = await answer(message, self._sender(asked.gid, name, interface, EntityKind.CLIENT))
            attachment = Attachment(asked.sequence, self._real_time(), asked.gid)
            query.reply(key, encode(f"{interface}_Response", reply), attachment=attachment.packed())
