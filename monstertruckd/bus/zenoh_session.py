"""Bridge between the in-process bus and Zenoh: state out, requests in, remote calls, liveliness.

Zenoh calls back on threads of its own; everything that touches the daemon hops onto the event loop first.
Opening and closing block, so a thread does them.
"""

import asyncio
import logging
import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from functools import partial
from typing import Any

import zenoh
from zenoh import ext

from monstertruck_runtime import wire
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import BusyError, ConfigError
from monstertruck_runtime.ports import Ready
from monstertruck_runtime.threads import ThreadHop, in_thread
from monstertruck_schemas.base import Message
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.topics import CAMERA, MAP, MAP_TILES, TOPICS, Topic, Writer, alive_key, rpc_key
from monstertruckd.bus.intake import Intake
from monstertruckd.bus.local import Bus
from monstertruckd.bus.rpc import Rpc, failure, topic_rows
from monstertruckd.bus.zenoh_config import ZenohConfig, session_config

log = logging.getLogger(__name__)

BULKY = frozenset({CAMERA.name, MAP.name, MAP_TILES.name})
"""Topics of large messages: on a slow link all others, and answers, go first."""
ORDERS = frozenset(order.value for order in Order)
"""Calls that must get through when others fill the places."""
MAX_CALLS = 16
"""Remote calls served at once."""
MAX_WAITING_CALLS = 64
MAX_CALL = 16_384
"""Bytes of the largest payload of a call."""
Put = Callable[[bytes], None]

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
        self._session: zenoh.Session | None = None
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
            guard = partial(_guarded, failed)
            publishers = await in_thread(partial(self._declare_publishers, self._session))
            tap = self._bus.tap(
                partial(self._send, publishers, failed),
                (topic for topic in TOPICS if topic.writer is not Writer.OUTSIDE),
            )
            try:
                async with asyncio.TaskGroup() as calls:
                    with ExitStack() as inputs:
                        intakes = [
                            inputs.enter_context(closing(Intake(topic, self._bus, self._clock, guard, self.name)))
                            for topic in TOPICS
                            if topic.writer is Writer.OUTSIDE
                        ]
                        active: set[asyncio.Task[None]] = set()
                        queries: ThreadHop[zenoh.Query] = inputs.enter_context(
                            closing(
                                ThreadHop(
                                    lambda query: guard(partial(self._serve, query, calls, active)),
                                    MAX_WAITING_CALLS,
                                    self._bus.add_drops,
                                )
                            )
                        )
                        with await in_thread(partial(self._declare_inputs, self._session, intakes, queries)):
                            ready()
                            await failed
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

    def _declare_publishers(self, session: zenoh.Session) -> dict[str, Put]:
        """Put functions by topic name."""
        return {
            topic.name: _publisher(session, topic, topic.key(self._robot))
            for topic in TOPICS
            if topic.writer is not Writer.OUTSIDE
        }

    def _declare_inputs(
        self, session: zenoh.Session, intakes: Sequence[Intake], queries: ThreadHop[zenoh.Query]
    ) -> zenoh.LivelinessToken:
        """Subscribers and queryables; last the token that says so, which lives as long as its object."""
        remote = zenoh.Locality.REMOTE
        for intake in intakes:
            key = intake.topic.key(self._robot)
            session.declare_subscriber(key, partial(_on_request, intake), allowed_origin=remote)
        for topic in TOPICS:
            key = topic.key(self._robot)
            if topic.retained:
                session.declare_queryable(key, partial(self._on_get, topic, key), allowed_origin=remote)
        session.declare_queryable(rpc_key(self._robot, "**"), partial(_on_call, queries), allowed_origin=remote)
        return session.liveliness().declare_token(alive_key(self._robot))

    def _send(
        self,
        publishers: dict[str, Put],
        failed: "asyncio.Future[None]",
        topic: Topic[Any],
        _message: Message,
        data: bytes,
        _at: int,
    ) -> None:
        try:
            publishers[topic.name](data)
        except Exception as bug:  # noqa: BLE001  # handed to the service's own coroutine
            if not failed.done():
                failed.set_exception(bug)

    # Queries

    def _on_get(self, topic: Topic[Any], key: str, query: zenoh.Query) -> None:
        with query:
            if (newest := self._bus.newest(topic)) is not None:
                query.reply(key, wire.encode(topic, newest), encoding=wire.encoding(topic))

    def _serve(self, query: zenoh.Query, calls: asyncio.TaskGroup, active: set[asyncio.Task[None]]) -> None:
        name = str(query.key_expr).removeprefix(rpc_key(self._robot, ""))
        if len(active) >= (2 * MAX_CALLS if name in ORDERS else MAX_CALLS):
            _refuse(query, Reason.BUSY, "too many calls at once")
            return
        task = calls.create_task(self._answer(query))
        active.add(task)
        task.add_done_callback(active.discard)

    async def _answer(self, query: zenoh.Query) -> None:
        with query:
            key = str(query.key_expr)
            name = key.removeprefix(rpc_key(self._robot, ""))
            # A reply waits for room in the queue of a station that reads nothing: in a thread.
            if not self._rpc.serves(name) and await in_thread(partial(self._reply_schemas, query)):
                return
            payload = b"" if query.payload is None else query.payload.to_bytes()
            success, data = await self._rpc.answer(name, payload)
            if success:
                await in_thread(partial(query.reply, key, data, encoding="application/json"))
            else:
                await in_thread(partial(query.reply_err, data, encoding="application/json"))

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


def _on_request(intake: Intake, sample: zenoh.Sample) -> None:
    payload = sample.payload
    intake.take(len(payload), payload.to_bytes)


def _on_call(queries: ThreadHop[zenoh.Query], query: zenoh.Query) -> None:
    size = 0 if query.payload is None else len(query.payload)
    if size > MAX_CALL:
        _refuse(query, Reason.BAD_INPUT, f"payload of {size} bytes, at most {MAX_CALL} are taken")
    else:
        queries.put(query)


def _refuse(query: zenoh.Query, reason: Reason, text: str) -> None:
    with query:
        query.reply_err(failure(reason, text), encoding="application/json")


def _publisher(session: zenoh.Session, topic: Topic[Any], key: str) -> Put:
    """Put function of one topic; a full queue drops the message rather than stalling the loop.

    Each priority has a queue of its own: others send at Zenoh's ordinary one, and neither they nor answers delay ours.
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


def _guarded(failed: "asyncio.Future[None]", job: Callable[[], object]) -> None:
    """Run ``job``; a bug in it ends the service instead of vanishing in the loop's exception handler."""
    try:
        job()
    except Exception as bug:  # noqa: BLE001  # handed to the service's own coroutine
        if not failed.done():
            failed.set_exception(bug)
