"""One robot for the Foxglove app: its topics, configuration and orders over Foxglove's WebSocket protocol.

The server forwards each topic's bytes unchanged, with its schema, and subscribes to the robot only while a client is
subscribed. Unlike the page's WebSocket, this server cannot see which site's page opened a connection, so any page open
in a browser on this machine may use it. Driving, and orders other than the emergency stop, must therefore be enabled
explicitly.
"""

import asyncio
import json
import logging
import math
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import foxglove
from foxglove import Channel, Context, MessageSchema, Parameter, Schema, Service, ServiceRequest, ServiceSchema
from foxglove.websocket import Capability, ChannelView, Client, ClientChannel, ServerListener, StatusLevel

from monstertruck_runtime import wire
from monstertruck_runtime.client import ORDER_TIMEOUT, TruckClient
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import BusyError, InputError, RequestRefusedError, TruckError
from monstertruck_schemas.req import Order
from monstertruck_schemas.topics import TOPICS, Topic
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.remarks import Remarks

log = logging.getLogger(__name__)

PORT: Final = 8765
"""Default port of Foxglove."""
LAYOUT: Final = Path(__file__).parent / "foxglove_layout.json"
TELEOP: Final = "/teleop"
"""Topic of the layout's teleop panel."""
ROBOT_RETRY: Final = 1.0
"""Interval between connection attempts to the robot, and timeout of each (s)."""


def twist(data: bytes) -> tuple[float, float, float]:
    """Return the forward and left velocity (m/s) and the turn rate (rad/s) in a JSON ``geometry_msgs/Twist``.

    Raises:
        InputError: ``data`` is not a twist, or not finite.
    """
    try:
        if len(data) > 4096:  # maximum size of a twist (bytes)
            raise ValueError(f"{len(data)} bytes")
        given = json.loads(data)
        found = given["linear"]["x"], given["linear"]["y"], given["angular"]["z"]
        vx, vy, wz = (float(value) for value in found)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"expected a geometry_msgs/Twist as JSON: {error}") from None
    if not math.isfinite(vx + vy + wz):
        raise InputError("expected a geometry_msgs/Twist of finite numbers")
    return vx, vy, wz


def parameters(config: dict[str, Any], prefix: str = "") -> list[Parameter]:
    """Flatten a configuration to parameters with dotted names; lists become JSON text, as viewers show them."""
    found: list[Parameter] = []
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            found += parameters(value, f"{name}.")
        elif value is not None:
            found.append(Parameter(name, value=json.dumps(value) if isinstance(value, list) else value))
    return found


class FoxgloveServer:
    """Serves one robot; waits while the robot is absent.

    Args:
        address: address of the robot.
        clock: clock of the station.
        port: port on the loopback interface; 0 selects a free port.
        drives: whether clients may drive and give all orders; the emergency stop is always allowed.
    """

    def __init__(self, address: RobotAddress, clock: Clock, port: int = PORT, *, drives: bool = False) -> None:
        self.port = port
        """Listening port, once the server runs."""
        self._address = address
        self._clock = clock
        self._drives = drives
        self._client: TruckClient | None = None
        self._parameters: list[Parameter] = []
        context = Context()
        self._context = context
        self._channels = {f"/{t.name}": (t, _channel(t, context)) for t in TOPICS if not t.inward}
        self._looks: Counter[str] = Counter()
        self._taps: dict[str, Any] = {}
        self._driving: asyncio.Task[None] | None = None
        self._remarks = Remarks(log)

    async def run(self, ready: Callable[[], object] = lambda: None) -> None:
        """Serve until cancelled; call ``ready`` as soon as clients can connect.

        Raises:
            BusyError: the port is in use.
        """
        loop = asyncio.get_running_loop()
        publish = [Capability.ClientPublish] if self._drives else []
        try:
            server = foxglove.start_server(
                name=f"monstertruckd {self._address.name}",
                host="127.0.0.1",
                port=self.port,
                capabilities=[Capability.Parameters, Capability.Services, *publish],
                server_listener=_Listener(self, loop),
                supported_encodings=["json"],
                services=[self._service(order, loop) for order in (Order if self._drives else (Order.ESTOP,))],
                context=self._context,
            )
        except (OSError, RuntimeError) as error:
            raise BusyError(f"port {self.port} cannot be served to Foxglove: {error}") from None
        self.port = server.port
        self._server = server
        try:
            ready()
            while True:
                with suppress(TruckError):  # the page shows the error
                    async with self._address.session("foxglove", self._clock, ROBOT_RETRY) as client:
                        await self._follow(client)
                await self._clock.sleep(ROBOT_RETRY)
        finally:
            self._client = None
            self._remarks.tell()
            await asyncio.to_thread(server.stop)

    async def _follow(self, client: TruckClient) -> None:
        self._client = client
        try:
            for topic in self._looks:
                self._tap(topic)
            while True:  # until the robot returns its configuration
                with suppress(TruckError):
                    self._parameters = parameters(await client.call("config"))
                    self._server.publish_parameter_values(self._parameters)
                    break
                await self._clock.sleep(ROBOT_RETRY)
            await asyncio.Event().wait()
        finally:
            self._client = None
            while self._taps:
                self._taps.popitem()[1].undeclare()

    # Subscriptions of clients

    def look(self, topic: str) -> None:
        """Count a client's subscription, and forward the topic."""
        self._looks[topic] += 1
        self._tap(topic)

    def leave(self, topic: str) -> None:
        """Drop a client's subscription; after the last one, the topic is no longer forwarded."""
        self._looks[topic] -= 1
        if self._looks[topic] <= 0:
            del self._looks[topic]
            if topic in self._taps:
                self._taps.pop(topic).undeclare()

    def _tap(self, name: str) -> None:
        if self._client is not None and name not in self._taps and name in self._channels:
            topic, channel = self._channels[name]
            self._taps[name] = self._client.tap(topic, channel.log)

    # Requests of clients

    def known_parameters(self, names: list[str]) -> list[Parameter]:
        """Return the parameters with these names; all if ``names`` is empty."""
        return [each for each in self._parameters if not names or each.name in names]

    def drive(self, data: bytes) -> None:
        """Convert one message from a teleop panel to one request with a short lease; nothing repeats the request."""
        try:
            motion = twist(data)
        except InputError as error:
            self.refuse(f"message of a Foxglove client refused: {error}")
            self._server.publish_status(str(error), StatusLevel.Warning, TELEOP)
            return
        if self._client is not None and (self._driving is None or self._driving.done()):
            self._driving = asyncio.create_task(self._request(self._client, motion))

    def refuse(self, text: str) -> None:
        """Log a refused client request."""
        self._remarks.add("Foxglove", text)

    async def _request(self, client: TruckClient, motion: tuple[float, float, float]) -> None:
        with suppress(TruckError):  # the robot publishes the reason on its topics
            await client.drive_twist(*motion, lease=0.25)  # validity of a teleop panel's message (s)

    def _service(self, order: Order, loop: asyncio.AbstractEventLoop) -> Service:
        empty = MessageSchema(encoding="json", schema=Schema(name="none", encoding="jsonschema", data=b"{}"))
        answer = MessageSchema(encoding="json", schema=Schema(name="outcome", encoding="jsonschema", data=_OUTCOME))

        def handle(_: ServiceRequest) -> bytes:
            return asyncio.run_coroutine_threadsafe(self._order(order), loop).result(ORDER_TIMEOUT + ROBOT_RETRY)

        schema = ServiceSchema(name="monstertruckd/order", request=empty, response=answer)
        return Service(f"/{order.value}", schema=schema, handler=handle)

    async def _order(self, order: Order) -> bytes:
        outcome: dict[str, Any] = {"ok": False, "reason": "not_found", "text": "no link to the robot"}
        if self._client is not None:
            try:
                await self._client.order(order)
                outcome = {"ok": True, "reason": "ok", "text": ""}
            except TruckError as error:
                reason = error.refusal if isinstance(error, RequestRefusedError) else error.reason
                outcome = {"ok": False, "reason": reason.value, "text": str(error)}
        return json.dumps(outcome).encode()


_OUTCOME: Final = json.dumps(
    {
        "type": "object",
        "properties": {"ok": {"type": "boolean"}, "reason": {"type": "string"}, "text": {"type": "string"}},
    }
).encode()


class _Listener(ServerListener):
    """Moves clients' messages from the server's threads to the event loop."""

    def __init__(self, server: FoxgloveServer, loop: asyncio.AbstractEventLoop) -> None:
        self._server = server
        self._loop = loop
        self._teleop: set[tuple[int, int]] = set()
        """Channels for twists from clients."""

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._loop.call_soon_threadsafe(self._server.look, channel.topic)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        self._loop.call_soon_threadsafe(self._server.leave, channel.topic)

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        if channel.topic == TELEOP and channel.encoding == "json":
            self._teleop.add((client.id, channel.id))
        else:
            text = f"Foxglove client {client.id}: {channel.topic} as {channel.encoding} refused"
            self._loop.call_soon_threadsafe(self._server.refuse, text)

    def on_client_unadvertise(self, client: Client, client_channel_id: int) -> None:
        self._teleop.discard((client.id, client_channel_id))

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        if (client.id, client_channel_id) in self._teleop:
            self._loop.call_soon_threadsafe(self._server.drive, data)

    def on_get_parameters(
        self, client: Client, param_names: list[str], request_id: str | None = None
    ) -> list[Parameter]:
        return self._server.known_parameters(param_names)

    def on_set_parameters(
        self, client: Client, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        return self._server.known_parameters([each.name for each in parameters])


def _channel(topic: Topic[Any], context: Context) -> Channel:
    schema = wire.schema(topic)
    described = Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
    return Channel(f"/{topic.name}", schema=described, message_encoding=schema.message_encoding, context=context)
