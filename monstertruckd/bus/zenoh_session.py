"""Bridge between the in-process bus and Zenoh: state out, requests in, remote calls, liveliness.

Zenoh calls back on threads of its own; everything that touches the daemon hops onto the event loop first.
Opening and closing block, so a thread does them.
"""

import asyncio
import logging
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh
from zenoh import ext

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import BusyError, ConfigError, InputError
from monstertruck_runtime.ports import Ready
from monstertruck_runtime.threads import ThreadHop, in_thread
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import TOPICS, Topic, Writer, alive_key, rpc_key
from monstertruckd.bus.local import Bus
from monstertruckd.bus.rpc import Rpc, topic_rows
from monstertruckd.bus.zenoh_config import ZenohConfig, session_config

log = logging.getLogger(__name__)

MAX_REQUEST = 262_144
"""Bytes of the largest request; decoding more would stall the control tick."""
MAX_CALLS = 16
"""Remote calls served at once."""
_DEPTH = 64
_SCHEMA_PREFIX = "schema/"
_SOURCE_PLACE = re.compile(r" at /\S+:\d+\.?")
_SCHEMA_MEDIA = {
    "jsonschema": "application/schema+json",
    "protobuf": "application/protobuf;google.protobuf.FileDescriptorSet",
}


class ZenohBridge:
    """Service that carries one robot's bus over Zenoh.

    Args:
        robot: name in the keys ``mt/<robot>/...``.
        bus: the robot's bus; everything but requests goes out, requests come in.
        config: endpoints and access.
        clock: time.
        rpc: handlers behind ``rpc/<name>``; ``rpc/topics`` is added.
    """

    name = "zenoh"

    def __init__(self, robot: str, bus: Bus, config: ZenohConfig, clock: Clock, rpc: Rpc) -> None:
        self._robot = robot
        self._bus = bus
        self._config = config
        self._clock = clock
        self._rpc = rpc
        self._event = bus.event_sink()
        self._session: zenoh.Session | None = None
        self._held: dict[str, bytes] = {}
        self._refusals: dict[str, tuple[int, int]] = {}
        rpc.register("topics", self._topics)

    async def open(self) -> None:
        """Claim endpoints and name; ``run`` does it too, a daemon may do it first to fail early.

        Raises:
            BusyError: an endpoint is in use, or another daemon already runs this robot.
            ConfigError: Zenoh refuses the configuration.
        """
        if self._session is None:
            await in_thread(self._open)

    async def close(self) -> None:
        """Give endpoints and name back; ``run`` does it too."""
        session, self._session = self._session, None
        if session is not None:
            await in_thread(session.close)

    async def run(self, ready: Ready) -> None:
        """Serve until cancelled.

        Raises:
            BusyError: see ``open``.
            ConfigError: see ``open``.
        """
        try:
            await self.open()
            assert self._session is not None
            failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            hop = ThreadHop(partial(_guarded, failed), _DEPTH, self._bus.add_drops)
            publishers = await in_thread(partial(self._declare_publishers, self._session))
            tap = self._bus.tap(
                partial(self._send, publishers), (topic for topic in TOPICS if topic.writer is not Writer.OUTSIDE)
            )
            try:
                async with asyncio.TaskGroup() as calls:
                    try:
                        with await in_thread(partial(self._declare_inputs, self._session, hop, calls)):
                            ready()
                            await failed
                    finally:
                        hop.close()
            finally:
                tap.close()
        finally:
            await self.close()

    def _open(self) -> None:
        where = ", ".join(self._config.listen)
        try:
            session = zenoh.open(zenoh.Config.from_json5(session_config(self._robot, self._config)))
        except zenoh.ZError as error:
            text = _SOURCE_PLACE.sub("", str(error))
            if "in use" in text:
                msg = f"{where} is in use: another daemon is running here"
                raise BusyError(msg) from error
            msg = f"zenoh cannot open {where}: {text}"
            raise ConfigError(msg) from error
        if self._config.connect and self._runs_elsewhere():
            session.close()  # type: ignore[no-untyped-call]
            msg = f"another daemon already runs robot {self._robot!r} behind {', '.join(self._config.connect)}"
            raise BusyError(msg)
        self._session = session

    def _runs_elsewhere(self) -> bool:
        """Ask the fleet's routers as a client: its link is complete when it is open, a router's is not."""
        try:
            with zenoh.open(zenoh.Config.from_json5(session_config(self._robot, self._config, probe=True))) as probe:
                return any(reply.ok for reply in probe.liveliness().get(alive_key(self._robot), timeout=1.0))
        except zenoh.ZError:  # none of them is up
            return False

    def _declare_publishers(self, session: zenoh.Session) -> dict[str, Callable[[bytes], None]]:
        """Put functions by topic name."""
        return {
            topic.name: _publisher(session, topic, topic.key(self._robot))
            for topic in TOPICS
            if topic.writer is not Writer.OUTSIDE
        }

    def _declare_inputs(
        self, session: zenoh.Session, hop: ThreadHop[Callable[[], None]], calls: asyncio.TaskGroup
    ) -> zenoh.LivelinessToken:
        """Subscribers and queryables; last the token that says so, which lives as long as its object."""
        remote = zenoh.Locality.REMOTE
        active: set[asyncio.Task[None]] = set()
        for topic in TOPICS:
            key = topic.key(self._robot)
            if topic.writer is Writer.OUTSIDE:
                session.declare_subscriber(key, partial(self._on_request, hop, topic), allowed_origin=remote)
            elif topic.retained:
                session.declare_queryable(key, partial(self._on_get, topic, key), allowed_origin=remote)
        session.declare_queryable(
            rpc_key(self._robot, "**"),
            lambda query: hop.put(partial(self._serve, query, calls, active)),
            allowed_origin=remote,
        )
        return session.liveliness().declare_token(alive_key(self._robot))

    def _send(
        self, publishers: dict[str, Callable[[bytes], None]], topic: Topic[Any], _message: Message, data: bytes
    ) -> None:
        if topic.retained:
            self._held[topic.name] = data
        publishers[topic.name](data)

    # Requests: from Zenoh's threads onto the loop

    def _on_request(self, hop: ThreadHop[Callable[[], None]], topic: Topic[Any], sample: zenoh.Sample) -> None:
        size = len(sample.payload)
        data = sample.payload.to_bytes() if size <= MAX_REQUEST else None
        hop.put(partial(self._take, topic, data, size))

    def _take(self, topic: Topic[Any], data: bytes | None, size: int) -> None:
        if data is None:
            self._refuse(topic, f"{topic.name}: request of {size} bytes, at most {MAX_REQUEST} are taken")
            return
        try:
            message = wire.decode(topic, data)
        except InputError as error:
            self._refuse(topic, str(error))
        else:
            self._bus.inject(topic, message)

    def _refuse(self, topic: Topic[Any], text: str) -> None:
        """Report bad input, at most once a second per topic: a flood of garbage must not become one of events."""
        now = self._clock.now()
        reported, count = self._refusals.get(topic.name, (-SECOND, 0))
        count += 1
        if now - reported >= SECOND:
            self._event(Reason.BAD_INPUT, Severity.WARNING, self.name, text, count=count)
            reported, count = now, 0
        self._refusals[topic.name] = reported, count

    # Queries

    def _on_get(self, topic: Topic[Any], key: str, query: zenoh.Query) -> None:
        with query:
            if (data := self._held.get(topic.name)) is not None:
                query.reply(key, data, encoding=wire.encoding(topic))

    def _serve(self, query: zenoh.Query, calls: asyncio.TaskGroup, active: set[asyncio.Task[None]]) -> None:
        if len(active) >= MAX_CALLS:
            with query:
                query.reply_err(b'{"reason": "busy", "text": "too many calls at once"}', encoding="application/json")
            return
        task = calls.create_task(self._answer(query))
        active.add(task)
        task.add_done_callback(active.discard)

    async def _answer(self, query: zenoh.Query) -> None:
        with query:
            key = str(query.key_expr)
            name = key.removeprefix(rpc_key(self._robot, ""))
            if self._reply_schemas(query):
                return
            payload = b"" if query.payload is None else query.payload.to_bytes()
            success, data = await self._rpc.answer(name, payload)
            if success:
                query.reply(key, data, encoding="application/json")
            else:
                query.reply_err(data, encoding="application/json")

    def _reply_schemas(self, query: zenoh.Query) -> bool:
        """Reply with every schema the query's key expression covers; False if there is none."""
        found = False
        for topic in TOPICS:
            key = rpc_key(self._robot, _SCHEMA_PREFIX + topic.name)
            if query.key_expr.intersects(key):
                schema = wire.schema(topic)
                query.reply(key, schema.data, encoding=_SCHEMA_MEDIA[schema.encoding])
                found = True
        return found

    async def _topics(self, _payload: dict[str, Any]) -> dict[str, Any]:
        return {"topics": topic_rows(self._robot)}


def _publisher(session: zenoh.Session, topic: Topic[Any], key: str) -> Callable[[bytes], None]:
    """Put function of one topic; a full queue drops the message rather than stalling the loop."""
    if topic.retained:
        return ext.declare_advanced_publisher(
            session,
            key,
            encoding=wire.encoding(topic),
            congestion_control=zenoh.CongestionControl.DROP,
            cache=ext.CacheConfig(max_samples=1),
            publisher_detection=True,
        ).put
    return session.declare_publisher(
        key, encoding=wire.encoding(topic), congestion_control=zenoh.CongestionControl.DROP
    ).put


def _guarded(failed: "asyncio.Future[None]", job: Callable[[], None]) -> None:
    """Run ``job``; a bug in it ends the service instead of vanishing in the loop's exception handler."""
    try:
        job()
    except Exception as bug:  # noqa: BLE001  # handed to the service's own coroutine
        if not failed.done():
            failed.set_exception(bug)
