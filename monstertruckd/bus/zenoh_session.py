"""Bridge between the in-process bus and Zenoh: state out, requests in, remote calls, liveliness.

Zenoh calls back on its own threads; everything that touches the daemon is first passed to the event loop. Opening and
closing block, so they run in a thread.
"""

import asyncio
import logging
import re
import socket
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import zenoh
from zenoh import ext

from monstertruck_runtime import wire
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.endpoints import UNIX, announce, make_private
from monstertruck_runtime.errors import BusyError, ConfigError
from monstertruck_runtime.ports import Ready
from monstertruck_runtime.threads import ThreadHop, in_thread
from monstertruck_schemas.base import Message
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.roles import AccessRole, ServiceName
from monstertruck_schemas.topics import (
    CAMERA,
    ESTOP_WAY,
    KEY_ROOT,
    MAP,
    MAP_TILES,
    REQ_CONTROL,
    STAND_POSE,
    TOPICS,
    Topic,
    Writer,
    alive_key,
    estop_key,
    rpc_key,
    sender_in,
)
from monstertruckd.bus.access import ANONYMOUS, OBSERVING, Sender, in_groups
from monstertruckd.bus.call_limits import CALLS, ESTOP, ORDERS, TOO_MANY, CallLimits, may_be_served
from monstertruckd.bus.intake import Intake, Refusals, StandIntake
from monstertruckd.bus.local import Bus
from monstertruckd.bus.port_holder import holder_of
from monstertruckd.bus.replies import Replies, Reply
from monstertruckd.bus.rpc import Rpc, failure, topic_rows
from monstertruckd.bus.zenoh_config import Listener, ZenohConfig, listeners, session_config

log = logging.getLogger(__name__)

BULKY = frozenset({CAMERA.name, MAP.name, MAP_TILES.name})
"""Topics of large messages: on a slow link all others, and answers, go first."""
MAX_CALL = 16_384
"""Bytes of the largest payload of a call."""
Put = Callable[[bytes], None]
Call = tuple[zenoh.Query, Listener]
"""A query with its session."""

_SCHEMA_PREFIX = "schema/"
_SOURCE_PLACE = re.compile(r" at /\S+:\d+\.?")
_SCHEMA_MEDIA = {
    "jsonschema": "application/schema+json",
    "protobuf": "application/protobuf;google.protobuf.FileDescriptorSet",
}


class ZenohBridge:
    """Service that connects one robot's bus to Zenoh.

    Args:
        robot: name in the keys ``mt/<robot>/...``.
        bus: the robot's bus; requests come in, all other messages go out.
        config: endpoints and access.
        clock: time source.
        rpc: handlers for ``rpc/<name>``; ``rpc/topics`` is added.
        stand: whether to accept poses of the robot from a test stand.
    """

    name = ServiceName.ZENOH.value

    def __init__(
        self, robot: str, bus: Bus, config: ZenohConfig, clock: Clock, rpc: Rpc, *, stand: bool = False
    ) -> None:
        self._stand = stand
        self._robot = robot
        self._bus = bus
        self._config = config
        self._clock = clock
        self._rpc = rpc
        self._sessions: list[tuple[Listener, zenoh.Session]] = []
        self._announced: socket.socket | None = None
        rpc.register("topics", self._topics, AccessRole.OBSERVER, recorded=False)

    async def open(self) -> None:
        """Open the sessions and claim the robot's name. ``run`` does this too; a daemon calls it earlier to fail early.

        Raises:
            BusyError: an endpoint is in use, or another daemon already runs this robot.
            ConfigError: Zenoh refuses the configuration.
        """
        if not self._sessions:
            await in_thread(self._open)

    async def close(self) -> None:
        """Close the sessions; ``run`` does this too."""
        await in_thread(self._close)

    async def run(self, ready: Ready) -> None:
        """Serve until cancelled.

        Raises:
            BusyError: see ``open``.
            ConfigError: see ``open``.
        """
        replies, limits = Replies(), CallLimits(self._clock)
        try:
            await self.open()
            failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            guard = partial(_guarded, failed)
            publishers = await in_thread(self._declare_publishers)
            tap = self._bus.tap(
                partial(self._send, publishers, failed),
                (topic for topic in TOPICS if not topic.inward),
            )
            try:
                async with asyncio.TaskGroup() as calls:
                    with ExitStack() as inputs:
                        intakes = {
                            topic.name: inputs.enter_context(
                                closing(Intake(topic, self._bus, self._clock, guard, self.name))
                            )
                            for topic in TOPICS
                            if topic.writer is Writer.OUTSIDE
                        }
                        estops = inputs.enter_context(
                            closing(Intake(REQ_CONTROL, self._bus, self._clock, guard, self.name, only=Order.ESTOP))
                        )
                        refusals = inputs.enter_context(closing(Refusals(self._bus, self._clock, self.name)))
                        stand_intake = inputs.enter_context(
                            closing(StandIntake(self._bus, self._clock, guard, refusals))
                        )
                        active: set[asyncio.Task[Reply]] = set()
                        queries: ThreadHop[Call] = inputs.enter_context(
                            closing(
                                ThreadHop(
                                    lambda call: guard(partial(self._serve, *call, replies, limits, calls, active)),
                                    4 * CALLS.waiting,  # emergency stops included
                                    self._bus.add_drops,
                                    discard=lambda call: self._discard(*call, replies, limits),
                                )
                            )
                        )
                        inward = partial(
                            self._declare_inputs, intakes, estops, refusals, queries, replies, limits, stand_intake
                        )
                        for token in await in_thread(inward):
                            inputs.enter_context(token)
                        ready()
                        await failed
            finally:
                tap.close()
        finally:
            await self.close()
            await in_thread(replies.close)

    def _open(self) -> None:
        try:
            for listener in listeners(self._config):
                self._sessions.append((listener, self._open_listener(listener)))
                if listener.connect and self._runs_elsewhere(listener):
                    msg = f"another daemon already runs robot {self._robot!r} behind {', '.join(listener.connect)}"
                    raise BusyError(msg)
            self._announced = announce(self._robot, self._config.listen)
        except BaseException:
            self._close()
            raise

    def _close(self) -> None:
        while self._sessions:
            _, session = self._sessions.pop()
            session.close()  # type: ignore[no-untyped-call]
        if self._announced is not None:
            self._announced.close()
            self._announced = None

    def _open_listener(self, listener: Listener) -> zenoh.Session:
        where = ", ".join(listener.listen)
        sockets = [Path(endpoint.removeprefix(UNIX)) for endpoint in listener.listen if endpoint.startswith(UNIX)]
        try:
            for path in sockets:
                make_private(path.parent)
            session = zenoh.open(zenoh.Config.from_json5(session_config(self._robot, self._config, listener)))
            for path in sockets:
                path.chmod(0o660)
        except zenoh.ZError as error:
            text = _SOURCE_PLACE.sub("", str(error))
            if "in use" in text or "EAGAIN" in text:
                holder = holder_of(listener.listen)
                raise BusyError(f"{where} is in use by {holder}; give a second robot another zenoh.listen") from error
            msg = f"zenoh cannot open {where}: {text}"
            raise ConfigError(msg) from error
        except OSError as error:
            msg = f"zenoh cannot open {where}: {error}"
            raise ConfigError(msg) from error
        return session

    def _runs_elsewhere(self, listener: Listener) -> bool:
        """Ask the fleet's routers as a client: a client's link is complete once it is open, a router's link is not."""
        config = session_config(self._robot, self._config, listener, probe=True)
        try:
            with zenoh.open(zenoh.Config.from_json5(config)) as probe:
                return any(reply.ok for reply in probe.liveliness().get(alive_key(self._robot), timeout=1.0))
        except zenoh.ZError:  # none of them is up
            return False

    def _declare_publishers(self) -> dict[str, tuple[Put, ...]]:
        """Return the functions that publish to all sessions, by topic name."""
        return {
            topic.name: tuple(_publisher(session, topic, topic.key(self._robot)) for _, session in self._sessions)
            for topic in TOPICS
            if not topic.inward
        }

    def _declare_inputs(
        self,
        intakes: Mapping[str, Intake],
        estops: Intake,
        refusals: Refusals,
        queries: ThreadHop[Call],
        replies: Replies,
        limits: CallLimits,
        stand_intake: StandIntake,
    ) -> list[zenoh.LivelinessToken]:
        """Declare subscribers and queryables, then the liveliness tokens; each lives as long as its object."""
        remote = zenoh.Locality.REMOTE
        tokens = []
        for listener, session in self._sessions:
            for group in in_groups():
                # One for all requests, so that a put to many keys comes once.
                session.declare_subscriber(
                    f"{KEY_ROOT}/{self._robot}/{group}/**",
                    partial(self._on_request, listener, intakes, estops, refusals),
                    allowed_origin=remote,
                )
            # Zenoh has a thread for each subscriber: a blocked one does not delay an emergency stop.
            session.declare_subscriber(
                estop_key(self._robot), partial(self._on_estop, listener, estops), allowed_origin=remote
            )
            if self._stand:
                session.declare_subscriber(
                    STAND_POSE.key(self._robot), partial(_on_stand_pose, stand_intake), allowed_origin=remote
                )
            for topic in TOPICS:
                key = topic.key(self._robot)
                if topic.retained:
                    session.declare_queryable(key, partial(self._on_get, topic, key, replies), allowed_origin=remote)
            session.declare_queryable(
                rpc_key(self._robot, "**"),
                partial(self._on_call, listener, queries, replies, limits),
                allowed_origin=remote,
            )
            tokens.append(session.liveliness().declare_token(alive_key(self._robot)))
        return tokens

    def _on_request(
        self,
        listener: Listener,
        intakes: Mapping[str, Intake],
        estops: Intake,
        refusals: Refusals,
        sample: zenoh.Sample,
    ) -> None:
        key, payload = str(sample.key_expr), sample.payload
        found = sender_in(self._robot, key)
        name, source = found if found is not None else ("", None)
        if name == ESTOP_WAY:
            if source is None:  # else the subscriber to emergency stops has it
                self._on_estop(listener, estops, sample)
            return
        if name in intakes:
            intakes[name].take(_sender(listener, source), len(payload), payload.to_bytes)
            return
        source = (*key.split("/")[3:4], "")[0]
        for intake in intakes.values():
            if sample.key_expr.intersects(intake.topic.key(self._robot)):
                intake.charge(source)
        text = f"{key}: expected {KEY_ROOT}/{self._robot}/req/<source>/ and one of {', '.join(map(_last, intakes))}"
        refusals.add(Reason.BAD_INPUT, source, text)

    def _on_estop(self, listener: Listener, estops: Intake, sample: zenoh.Sample) -> None:
        found = sender_in(self._robot, str(sample.key_expr))
        if found is not None:  # else a key with wildcards, which the subscriber to all requests reports
            estops.take(_sender(listener, found[1]), len(sample.payload), sample.payload.to_bytes)

    def _send(
        self,
        publishers: dict[str, tuple[Put, ...]],
        failed: "asyncio.Future[None]",
        topic: Topic[Any],
        _message: Message,
        data: bytes,
        _at: int,
    ) -> None:
        try:
            for put in publishers[topic.name]:
                put(data)
        except Exception as bug:  # noqa: BLE001  # handed to the service's own coroutine
            if not failed.done():
                failed.set_exception(bug)

    # Queries

    def _on_get(self, topic: Topic[Any], key: str, replies: Replies, query: zenoh.Query) -> None:
        replies.wait_for_room()
        newest = self._bus.newest(topic)
        replies.end(query, None if newest is None else partial(_reply_message, topic, key, newest))

    def _called(self, query: zenoh.Query) -> tuple[str, str | None]:
        """Return the name and the source of a call."""
        key = str(query.key_expr)
        return sender_in(self._robot, key) or (key.removeprefix(rpc_key(self._robot, "")), None)

    def _on_call(
        self, listener: Listener, queries: ThreadHop[Call], replies: Replies, limits: CallLimits, query: zenoh.Query
    ) -> None:
        replies.wait_for_room()
        size = 0 if query.payload is None else len(query.payload)
        name, source = self._called(query)
        if size > MAX_CALL:
            text = f"payload of {size} bytes, at most {MAX_CALL} are accepted"
            replies.end(query, _error(failure(Reason.BAD_INPUT, text)), source)
        elif text := limits.refusal(name, source, queries.waiting):
            replies.end(query, _error(failure(Reason.BUSY, text)), source)
        elif not self._rpc.serves(name) and (described := self._described(query)):
            replies.end(query, partial(_reply_schemas, described), source)
        else:
            queries.put((query, listener))

    def _discard(self, query: zenoh.Query, _: Listener, replies: Replies, limits: CallLimits) -> None:
        name, source = self._called(query)
        limits.ended(name, source)
        replies.end(query, source=source)

    def _serve(
        self,
        query: zenoh.Query,
        listener: Listener,
        replies: Replies,
        limits: CallLimits,
        calls: asyncio.TaskGroup,
        active: set[asyncio.Task[Reply]],
    ) -> None:
        name, source = self._called(query)
        if not may_be_served(name, len(active)):
            replies.end(query, _error(failure(Reason.BUSY, TOO_MANY)), source)
            return
        task = calls.create_task(self._answer(query, name, _sender(listener, source)))
        if name != ESTOP:
            active.add(task)

        def end(_: asyncio.Task[Reply]) -> None:
            active.discard(task)
            limits.ended(name, source)
            replies.end(query, None if task.cancelled() else task.result(), source, order=name in ORDERS)

        task.add_done_callback(end)

    async def _answer(self, query: zenoh.Query, name: str, sender: Sender) -> Reply:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        success, data = await self._rpc.answer(sender, name, payload)
        return partial(_reply_success, str(query.key_expr), data) if success else _error(data)

    def _described(self, query: zenoh.Query) -> list[tuple[str, Topic[Any]]]:
        """Return the topics whose schema the query's key expression covers, each with the schema's key."""
        keys = [(rpc_key(self._robot, _SCHEMA_PREFIX + topic.name), topic) for topic in TOPICS]
        return [(key, topic) for key, topic in keys if query.key_expr.intersects(key)]

    async def _topics(self, _payload: dict[str, Any]) -> dict[str, Any]:
        return {"topics": topic_rows(self._robot)}


def _sender(listener: Listener, source: str | None) -> Sender:
    return Sender(ANONYMOUS, OBSERVING) if source is None else Sender(source, listener.grant(source))


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _reply_success(key: str, data: bytes, query: zenoh.Query) -> None:
    query.reply(key, data, encoding="application/json")


def _error(data: bytes) -> Reply:
    return lambda query: query.reply_err(data, encoding="application/json")


def _reply_message(topic: Topic[Any], key: str, message: Message, query: zenoh.Query) -> None:
    query.reply(key, wire.encode(topic, message), encoding=wire.encoding(topic))


def _reply_schemas(described: list[tuple[str, Topic[Any]]], query: zenoh.Query) -> None:
    for key, topic in described:
        schema = wire.schema(topic)
        query.reply(key, schema.data, encoding=_SCHEMA_MEDIA[schema.encoding])


def _publisher(session: zenoh.Session, topic: Topic[Any], key: str) -> Put:
    """Return the put function for one topic; if the queue is full, it drops the message instead of blocking the loop.

    Each priority has its own queue: other programs use Zenoh's default priority, so neither they nor answers delay the
    topics.
    """
    priority = zenoh.Priority.DATA_LOW if topic.name in BULKY else zenoh.Priority.DATA_HIGH
    if topic.retained:
        return ext.declare_advanced_publisher(
            session,
            key,
            encoding=wire.encoding(topic),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=priority,
            cache=ext.CacheConfig(max_samples=1),
            publisher_detection=True,
        ).put
    return session.declare_publisher(
        key, encoding=wire.encoding(topic), congestion_control=zenoh.CongestionControl.DROP, priority=priority
    ).put


def _on_stand_pose(stand_intake: StandIntake, sample: zenoh.Sample) -> None:
    stand_intake.take(len(sample.payload), sample.payload.to_bytes)


def _guarded(failed: "asyncio.Future[None]", job: Callable[[], object]) -> None:
    """Run ``job``; a bug in it ends the service instead of only reaching the loop's exception handler."""
    try:
        job()
    except Exception as bug:  # noqa: BLE001  # handed to the service's own coroutine
        if not failed.done():
            failed.set_exception(bug)
