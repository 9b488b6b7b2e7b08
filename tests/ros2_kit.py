"""A robot's bus with a face on it, and clients of ROS 2 over Zenoh with tokens in the graph, for tests of the face."""

import asyncio
import json
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial

import zenoh
from zenoh import ext

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics as t
from monstertruck_schemas.plan import GoalPhase, GoalState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.state import ClockOffset
from monstertruckd.ros2.cdr import decode, encode
from monstertruckd.ros2.face import FaceOptions, RosFace
from monstertruckd.ros2.facts import RobotFacts
from monstertruckd.ros2.interfaces import type_hash
from monstertruckd.ros2.operators import Operators
from monstertruckd.ros2.rmw import Attachment, EntityKind, RosEntity, data_key, dds_name, gid_of, token_key
from monstertruckd.ros2.zenoh_node import ZenohNode, session_settings
from tests.bus_kit import free_endpoint, gate_state, running_robot

OFFSET = 1_000_000 * SECOND


class ServiceClient:
    """Asks services as ``rmw_zenoh`` does; without a name it has no tokens."""

    def __init__(self, endpoint: str, name: str | None = "asker"):
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(endpoint, ""))))
        self.name = name
        self._clients = {}
        self._sequence = 0
        self._tokens = []
        if name is not None:
            self._token((0, 0), RosEntity(EntityKind.NODE, "/", name))

    def _token(self, numbers, entity, types=("", "")):
        key = token_key(0, str(self.session.zid()), numbers, entity, types)
        self._tokens.append(self.session.liveliness().declare_token(key))
        return gid_of(key)

    async def ask(self, service, interface, request=None, timeout=60.0):
        if service not in self._clients:
            gid = bytes(range(16))
            if self.name is not None:
                entity = RosEntity(EntityKind.CLIENT, "/", self.name, service, dds_name(interface))
                gid = self._token((0, len(self._clients) + 1), entity, (type_hash(interface), "::,10:,:,:,,"))
            self._clients[service] = gid
            await asyncio.sleep(0.3)  # until the graph has it
        self._sequence += 1
        clock = WallClock()
        attachment = Attachment(self._sequence, clock.now() + clock.real_offset(), self._clients[service])

        def get():
            return list(
                self.session.get(
                    data_key(0, service, interface),
                    payload=encode(f"{interface}_Request", request or {}),
                    attachment=attachment.packed(),
                    target=zenoh.QueryTarget.ALL_COMPLETE,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    timeout=timeout,
                )
            )

        (reply,) = await asyncio.to_thread(get)
        sent = Attachment.parse(reply.ok.attachment.to_bytes())
        assert (sent.sequence, sent.gid) == (attachment.sequence, attachment.gid)
        return decode(f"{interface}_Response", reply.ok.payload.to_bytes())

    def close(self):
        self.session.close()


@dataclass
class Scene:
    robot: object
    ros: str
    """Endpoint of the face's router."""
    requests: object
    operators: Operators
    texts: list[str] = field(default_factory=list)

    async def until(self, condition, seconds=5.0):
        async with asyncio.timeout(seconds):
            while not condition():
                await asyncio.sleep(0.01)

    @asynccontextmanager
    async def node(self, name="teleop"):
        async with ZenohNode((name, "/"), 0, session_settings(self.ros, ""), WallClock()) as node:
            yield node


FACTS = RobotFacts(0.4, 0.3, description='<robot><link name="base" /></robot>')


def answering(robot, clock):
    """Remote calls of a robot that has a planner and one live setting; returns what was asked."""
    outcomes = []

    async def carry_out(order, payload):
        outcomes.append(payload | {"order": order})
        return json.loads(gate_state(1).model_dump_json())

    for order in Order:
        robot.rpc.register(order.value, partial(carry_out, order), AccessRole.OBSERVER)
    goals = robot.bus.publisher(t.GOAL, t.Writer.PLANNER)
    settings = {"gate.limits.speed": 0.25}

    def goal_state(**fields):
        now = clock.now()
        goals.put(GoalState(stamp=now, received=now, seq=goals.next_seq(), number=1, frame="map", **fields))

    async def goal(payload):
        outcomes.append(payload)
        if payload["goal"]["x"] > 100.0:
            raise RequestRefusedError(Reason.NO_MAP, "a wall is in the way")
        goal_state(phase=GoalPhase.DRIVING, outcome=Reason.DRIVING, remaining=2.5, recoveries=1)
        if payload["goal"]["x"] < 50.0:
            asyncio.get_running_loop().call_later(0.3, partial(goal_state, outcome=Reason.GOAL_REACHED))
        return {"number": 1}

    async def goal_control(payload):
        outcomes.append(payload)
        goal_state(outcome=Reason.CANCELLED, text="as asked")
        return {}

    async def list_settings(_):
        row = {"meaning": "Speed, m/s", "above": 0.0, "at_least": None, "below": None, "at_most": 0.3}
        return {"settings": [{"key": key, "value": value} | row for key, value in settings.items()]}

    async def set_settings(payload):
        outcomes.append(payload)
        if payload["values"].get("gate.limits.speed", 0.0) > 0.3:
            raise InputError("gate.limits.speed: expected at most 0.3")
        settings.update(payload["values"])
        return {}

    for name, serve in {
        "goal": goal,
        "goal_control": goal_control,
        "settings": list_settings,
        "set": set_settings,
    }.items():
        robot.rpc.register(name, serve, AccessRole.OBSERVER)
    return outcomes


@asynccontextmanager
async def scene(options=None, facts=FACTS):
    options = options or FaceOptions()
    async with running_robot() as robot:
        clock, ros = WallClock(), free_endpoint()
        outcomes = answering(robot, clock)
        gate = robot.bus.publisher(t.GATE, t.Writer.GATE)
        offset = robot.bus.publisher(t.CLOCK, t.Writer.DAEMON)

        async def live():
            while True:
                now = clock.now()
                gate.put(_gate(gate, now))
                offset.put(ClockOffset(stamp=now, received=now, seq=offset.next_seq(), offset=OFFSET))
                await asyncio.sleep(0.1)

        texts = []
        async with asyncio.TaskGroup() as tasks:
            running = [tasks.create_task(live())]
            async with (
                TruckClient("truck", robot.endpoint, source="face", clock=clock) as client,
                ZenohNode(("truck", "/"), 0, session_settings(None, ros), clock) as node,
            ):
                operators = Operators(
                    lambda source: TruckClient("truck", robot.endpoint, source=source, clock=clock),
                    None,
                    clock,
                    lambda _, text: texts.append(text),
                )
                ready = asyncio.Event()
                face = RosFace(client, node, operators, facts, options, clock)
                running.append(tasks.create_task(face.run(ready.set)))
                await asyncio.wait_for(ready.wait(), 10)
                requests = robot.bus.subscribe(t.REQ_DRIVE, fifo(1000))
                found = Scene(robot, ros, requests, operators, texts)
                found.outcomes = outcomes
                try:
                    yield found
                finally:
                    for task in running:
                        task.cancel()
                    await asyncio.wait(running)
                    await operators.close()


def _gate(gate, now):
    return gate_state(1).model_copy(update={"stamp": now, "received": now, "seq": gate.next_seq()})


class Reader:
    """Newest message of topics, by an AdvancedSubscriber with the options of rmw_zenoh."""

    def __init__(self, found):
        self.messages = {}
        self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(found.ros, ""))))
        self._kept = []

    def follow(self, topic, interface):
        def take(sample):
            self.messages[topic] = decode(interface, sample.payload.to_bytes())

        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        self._kept.append(
            ext.declare_advanced_subscriber(
                self._session, data_key(0, topic, interface), take, history=history, subscriber_detection=True
            )
        )

    def close(self):
        self._session.close()


def pose(x, frame="map"):
    header = {"frame_id": frame}
    return {"header": header, "pose": {"position": {"x": x}, "orientation": {"w": 1.0}}}


@asynccontextmanager
async def asking(found, name="nav"):
    client = ServiceClient(found.ros, name)
    try:
        yield client
    finally:
        await asyncio.to_thread(client.close)
