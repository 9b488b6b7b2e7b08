"""A client of Foxglove's WebSocket protocol before a robot: topics, parameters, services, teleop."""

import asyncio
import json
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

import aiohttp
import pytest

from monstertruck_runtime import wire
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import BusyError, InputError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas.req import Order
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import BATTERY, GATE, POSE, REQ_CONTROL, REQ_DRIVE, TOPICS, Writer
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.foxglove import LAYOUT, TELEOP, FoxgloveServer, twist
from tests.bus_kit import Robot, gate_state, odometry, running_robot

CONFIG = {"robot": "truck", "gate": {"speed": 0.2, "leases": {"station": 0.3}}, "peers": ["ann"], "stand": None}


async def answer(value: dict[str, Any], _: dict[str, Any]) -> dict[str, Any]:
    return value


@asynccontextmanager
async def before(
    robot: Robot, **options: bool
) -> AsyncIterator[tuple[FoxgloveServer, aiohttp.ClientWebSocketResponse]]:
    """A connected client of the protocol."""
    server = FoxgloveServer(RobotAddress("truck", robot.endpoint), WallClock(), 0, **options)
    ready = asyncio.Event()
    running = asyncio.create_task(server.run(ready.set))
    try:
        await ready.wait()
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"ws://127.0.0.1:{server.port}", protocols=("foxglove.sdk.v1",)) as socket,
        ):
            assert socket.protocol == "foxglove.sdk.v1"
            yield server, socket
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def received(socket: aiohttp.ClientWebSocketResponse, op: str | int, wanted=lambda _: True) -> Any:
    """The next message of this operation: an object, or the bytes behind a binary one's number."""
    async with asyncio.timeout(10):
        while True:
            data = (await socket.receive()).data
            if isinstance(data, bytes):
                if data[0] == op and wanted(data[1:]):
                    return data[1:]
            elif (message := json.loads(data))["op"] == op and wanted(message):
                return message


async def call(socket: aiohttp.ClientWebSocketResponse, service: int) -> dict[str, Any]:
    """Call a service with an empty object (binary operation 2; answered by 3)."""
    await socket.send_bytes(struct.pack("<BIII", 2, service, 7, 4) + b"json" + b"{}")
    reply = await received(socket, 3)
    length = struct.unpack_from("<I", reply, 8)[0]
    return json.loads(reply[12 + length :])


async def test_topics_travel_as_the_robot_publishes_them_and_only_while_somebody_looks():
    async with running_robot() as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        robot.rpc.register("config", partial(answer, CONFIG), AccessRole.OBSERVER)
        poses = robot.bus.publisher(POSE, Writer.ESTIMATION)
        async with before(robot) as (server, socket):
            info = await received(socket, "serverInfo")
            assert "clientPublish" not in info["capabilities"], "who may drive has to be switched on"
            channels = {}
            outward = {f"/{topic.name}" for topic in TOPICS if not topic.inward}
            while channels.keys() != outward:
                channels |= {row["topic"]: row for row in (await received(socket, "advertise"))["channels"]}
            assert channels["/state/pose"]["schemaName"] == "foxglove.PoseInFrame"
            assert channels["/state/gate"]["encoding"] == "json"
            ids = {"/state/pose": 1, "/state/gate": 2}
            rows = [{"id": number, "channelId": channels[name]["id"]} for name, number in ids.items()]
            await socket.send_json({"op": "subscribe", "subscriptions": rows})
            seen = {}
            async with asyncio.timeout(10):
                while len(seen) < 2:
                    poses.put(odometry(4, x=1.5))
                    data = await received(socket, 1)
                    seen[struct.unpack_from("<I", data)[0]] = data[12:]
            assert wire.decode(POSE, seen[1]) == odometry(4, x=1.5)
            assert wire.decode(GATE, seen[2]) == gate_state(1), "the newest of a retained topic"
            assert set(server._taps) == {"/state/pose", "/state/gate"}
            await socket.send_json({"op": "unsubscribe", "subscriptionIds": [1]})
            async with asyncio.timeout(10):
                while set(server._taps) != {"/state/gate"}:
                    await asyncio.sleep(0.01)

            values = {}
            async with asyncio.timeout(10):
                while not values:
                    await socket.send_json({"op": "getParameters", "parameterNames": [], "id": "a"})
                    reply = await received(socket, "parameterValues")
                    values = {row["name"]: row["value"] for row in reply["parameters"]}
            assert values == {
                "robot": "truck",
                "gate.speed": 0.2,
                "gate.leases.station": 0.3,
                "peers": '["ann"]',
            }
            await socket.send_json(
                {"op": "setParameters", "parameters": [{"name": "gate.speed", "value": 9.0}], "id": "b"}
            )
            reply = await received(socket, "parameterValues", lambda m: m.get("id") == "b")
            assert reply["parameters"][0]["value"] == 0.2, "what a viewer sets does not count"


async def test_orders_are_services_and_a_teleop_panel_is_a_deadman():
    async with running_robot() as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        robot.rpc.register("config", partial(answer, CONFIG), AccessRole.OBSERVER)
        done = gate_state(2).model_dump(mode="json")
        for order in ("arm", "estop"):
            robot.rpc.register(order, partial(answer, done), AccessRole.OBSERVER)
        orders = robot.bus.subscribe(REQ_CONTROL, latest())
        requests = robot.bus.subscribe(REQ_DRIVE, fifo(100))
        async with before(robot) as (_, socket):
            services = (await received(socket, "advertiseServices"))["services"]
            assert [row["name"] for row in services] == ["/estop"]
            async with asyncio.timeout(10):
                while not (await call(socket, services[0]["id"]))["ok"]:  # until it has the robot
                    pass
            assert orders.latest is not None
            assert orders.latest.order is Order.ESTOP
        async with before(robot, drives=True) as (_, socket):
            services = (await received(socket, "advertiseServices"))["services"]
            by_name = {row["name"]: row["id"] for row in services}
            assert by_name.keys() == {f"/{order.value}" for order in Order}
            async with asyncio.timeout(10):
                while not (await call(socket, by_name["/arm"]))["ok"]:
                    pass
            assert not (await call(socket, by_name["/reset"]))["ok"], "no such call here: the answer says so"
            await socket.send_json(
                {
                    "op": "advertise",
                    "channels": [
                        {"id": 5, "topic": TELEOP, "encoding": "json", "schemaName": "geometry_msgs/Twist"},
                        {"id": 6, "topic": "/other", "encoding": "json", "schemaName": "geometry_msgs/Twist"},
                    ],
                }
            )
            pushed = {"linear": {"x": 0.1, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0.3}}
            wrong = {"linear": {"x": 9.0, "y": 0, "z": 0}, "angular": {"z": 0}}
            await socket.send_bytes(struct.pack("<BI", 1, 6) + json.dumps(wrong).encode())
            await socket.send_bytes(struct.pack("<BI", 1, 5) + b'{"linear": {"x": NaN}}')
            await socket.send_bytes(struct.pack("<BI", 1, 5) + json.dumps(pushed).encode())
            async with asyncio.timeout(5):
                request = await requests.next()
            assert request.twist is not None
            assert (request.twist.vx, request.twist.wz, request.lease) == (0.1, 0.3, 0.25)
            await asyncio.sleep(0.2)
            assert requests.latest is request, "nothing repeats it"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b'{"linear": 1}',
        b'{"linear": {"x": "a", "y": 0}, "angular": {"z": 0}}',
        b'{"linear": {"x": Infinity, "y": 0}, "angular": {"z": 0}}',
        b"[" * 4000,
        b" " * 5000,
    ],
)
def test_what_is_no_twist_is_refused(data: bytes):
    with pytest.raises(InputError, match="expected a geometry_msgs/Twist"):
        twist(data)


async def test_a_taken_port_is_refused():
    async with running_robot() as robot, before(robot) as (server, _):
        with pytest.raises(BusyError, match=str(server.port)):
            await FoxgloveServer(RobotAddress("truck", robot.endpoint), WallClock(), server.port).run()


def test_the_layout_names_topics_and_services_that_there_are():
    layout = json.loads(LAYOUT.read_text(encoding="utf-8"))
    panels = layout["configById"]

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else [*leaves(node["first"]), *leaves(node["second"])]

    assert sorted(leaves(layout["layout"])) == sorted(panels)
    named = [
        *panels["3D!monstertruckd"]["topics"],
        panels["Image!monstertruckd"]["imageMode"]["imageTopic"],
        panels["RawMessages!gate"]["topicPath"],
        *(
            "/".join(row["value"].split(".")[:1])
            for key in panels
            if key.startswith("Plot")
            for row in panels[key]["paths"]
        ),
    ]
    assert set(named) <= {f"/{topic.name}" for topic in TOPICS}
    assert panels["Teleop!monstertruckd"]["topic"] == TELEOP
    assert panels["CallService!estop"]["serviceName"] == f"/{Order.ESTOP.value}"
    for path in (row["value"] for key in panels if key.startswith("Plot") for row in panels[key]["paths"]):
        name, _, field = path.partition(".")
        model = {f"/{topic.name}": topic.model for topic in (GATE, BATTERY)}[name]
        assert field.split(".")[0] in model.model_fields
