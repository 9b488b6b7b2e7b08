"""The bridge against real Zenoh sessions: state out, requests in, calls, refusals, clean ends."""

import asyncio
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import numpy as np
import pytest
import zenoh

from monstertruck_runtime import client, wire
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import BusyError, ConfigError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, DriveRequest, GoalRequest, Order, Role
from monstertruck_schemas.sensor import StandPose
from monstertruck_schemas.state import Grid
from monstertruck_schemas.topics import (
    GATE,
    MAP,
    POSE,
    REQ_CONTROL,
    REQ_DRIVE,
    REQ_GOAL,
    STAND_POSE,
    TOPICS,
    Writer,
    estop_key,
)
from monstertruckd.bus.access import ANONYMOUS, Sender
from monstertruckd.bus.call_limits import CALLS
from monstertruckd.bus.intake import Intake
from monstertruckd.bus.local import Bus
from monstertruckd.bus.rpc import Rpc
from monstertruckd.bus.zenoh_config import ZenohConfig, listeners, session_config
from monstertruckd.bus.zenoh_session import MAX_CALL, ZenohBridge
from monstertruckd.early_estop import estop_payload
from tests.bus_kit import free_endpoint, gate_state, odometry, running_robot


def raw_session(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


GRID = Grid(
    stamp=0,
    received=0,
    seq=0,
    frame="map",
    resolution=0.05,
    width=400,
    height=400,
    origin=Pose2D(x=0.0, y=0.0, yaw=0.0),
    cells=np.zeros(160_000, dtype=np.int8),
)


def put(station: zenoh.Session, key: str, payload: bytes) -> None:
    """Put without loss, however busy the machine is."""
    station.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)


def drive_request(seq: int) -> DriveRequest:
    return DriveRequest(
        stamp=1, received=1, seq=seq, source="a", role=Role.STATION, lease=0.5, nonce="n", speed=1.0, front=0.0
    )


HEADER = {"stamp", "received", "seq", "source", "role", "lease", "nonce"}


async def eventually(condition, seconds: float = 3.0) -> None:
    async with asyncio.timeout(seconds):
        while not condition():
            await asyncio.sleep(0.005)


async def test_state_leaves_with_the_recorders_bytes_and_its_encoding():
    async with running_robot() as robot:
        recorded: list[bytes] = []
        robot.bus.tap(lambda _t, _m, data, _: recorded.append(data), [POSE])
        got: list[tuple[bytes, str]] = []
        with raw_session(robot.endpoint) as station:
            station.declare_subscriber(
                "mt/truck/state/pose", lambda s: got.append((s.payload.to_bytes(), str(s.encoding)))
            )
            await asyncio.sleep(0.1)
            publisher = robot.bus.publisher(POSE, Writer.ESTIMATION)
            for seq in range(200):
                publisher.put(odometry(seq))
            await eventually(lambda: len(got) == 200)
    assert [data for data, _ in got] == recorded
    assert {encoding for _, encoding in got} == {wire.encoding(POSE)}
    assert wire.decode(POSE, got[7][0]) == odometry(7)


async def test_large_messages_take_no_shared_memory():
    def shared() -> set[str]:
        lines = Path("/proc/self/maps").read_text().splitlines()
        return {line.split()[-1] for line in lines if "/dev/shm/" in line}

    before, got = shared(), []
    async with running_robot() as robot:
        dial = json.dumps(client.session_config(robot.endpoint, 3.0, None))
        with zenoh.open(zenoh.Config.from_json5(dial)) as reader:
            reader.declare_subscriber("mt/truck/state/map", got.append)
            await asyncio.sleep(0.1)
            robot.bus.publisher(MAP, Writer.ESTIMATION).put(GRID)
            await eventually(lambda: got)
            assert shared() == before


async def test_retained_topics_reach_late_joiners_and_plain_get():
    async with running_robot() as robot:
        publisher = robot.bus.publisher(GATE, Writer.GATE)
        publisher.put(gate_state(0))
        publisher.put(gate_state(1))
        async with TruckClient(endpoint=robot.endpoint) as client:
            box = client.subscribe(GATE, fifo(9))
            async with asyncio.timeout(2):
                assert (await box.next()).seq == 1
            publisher.put(gate_state(2))
            async with asyncio.timeout(2):
                assert (await box.next()).seq == 2
        with raw_session(robot.endpoint) as station:
            (reply,) = await asyncio.to_thread(lambda: list(station.get("mt/truck/state/gate", timeout=1.0)))
            assert reply.ok is not None
            assert wire.decode(GATE, reply.ok.payload.to_bytes()) == gate_state(2)


async def test_what_was_retained_before_the_bridge_ran_is_out_as_well():
    endpoint = free_endpoint()
    clock = WallClock()
    bus, rpc = Bus(clock), Rpc(clock)
    bus.publisher(GATE, Writer.GATE).put(gate_state(5))
    bridge = ZenohBridge("truck", bus, ZenohConfig(listen=(endpoint,)), clock, rpc)
    for _ in range(2):  # and again after a restart of the bridge
        ready = asyncio.Event()
        task = asyncio.create_task(bridge.run(ready.set))
        await ready.wait()
        async with TruckClient(endpoint=endpoint) as client:
            state = await client.get_retained(GATE)
            assert state == gate_state(5)
        task.cancel()
        await asyncio.wait([task])


async def test_requests_come_in_typed_and_stamped_by_the_robot():
    async with running_robot() as robot:
        box = robot.bus.subscribe(REQ_DRIVE, fifo(1000))
        with raw_session(robot.endpoint) as station:
            for seq in range(60):
                put(station, "mt/truck/req/ann/drive", wire.encode(REQ_DRIVE, drive_request(seq)))
            async with asyncio.timeout(3):
                got = [await box.next() for _ in range(60)]
    assert [request.seq for request in got] == list(range(60))
    assert all(request.received > 1 and request.stamp == 1 for request in got)


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (b"\xff\x00garbage", "req/drive"),
        (b"{}", "req/drive: stamp"),
        (b"x" * 2049, "request of 2049 bytes, at most 2048"),
        (wire.encode(REQ_DRIVE, drive_request(0)).replace(b'"station"', b'"king"'), "req/drive: role"),
    ],
    ids=["garbage", "empty", "huge", "role"],
)
async def test_bad_requests_become_one_event_a_second(payload: bytes, text: str):
    async with running_robot() as robot:
        box = robot.bus.subscribe(REQ_DRIVE, fifo(10))
        with raw_session(robot.endpoint) as station:
            for _ in range(20):
                put(station, "mt/truck/req/ann/drive", payload)
            put(station, "mt/truck/req/ann/drive", wire.encode(REQ_DRIVE, drive_request(1)))
            async with asyncio.timeout(3):
                await box.next()
            async with asyncio.timeout(3):
                event = await robot.events.next()
    assert event.reason is Reason.BAD_INPUT
    assert event.source == "zenoh"
    assert text in event.text
    assert event.seq == 0
    assert event.values == {"by": "ann", "count": 1}
    assert robot.events.latest is not None
    assert robot.events.latest.seq <= 2  # not 20


async def test_state_put_by_others_never_enters_the_bus():
    async with running_robot() as robot:
        box = robot.bus.subscribe(POSE, fifo(10))
        with raw_session(robot.endpoint) as station:
            put(station, "mt/truck/state/pose", wire.encode(POSE, odometry(1)))
            put(station, "mt/truck/req/ann/drive", wire.encode(REQ_DRIVE, drive_request(1)))
            async with asyncio.timeout(3):
                await robot.bus.subscribe(REQ_DRIVE, fifo(1)).next()
    assert box.latest is None
    assert robot.events.latest is None


@pytest.mark.parametrize(
    "key",
    ["req/ann/unknown", "req/ann", "req/**", "req/ann/**", "req/*/drive", "**", "req/ann/drive/x"],
)
async def test_a_put_to_a_wildcard_or_an_unknown_key_is_reported_and_taken_by_nobody(key: str):
    async with running_robot() as robot:
        box = robot.bus.subscribe(REQ_DRIVE, fifo(1))
        with raw_session(robot.endpoint) as station:
            put(station, f"mt/truck/{key}", wire.encode(REQ_DRIVE, drive_request(1)))
            async with asyncio.timeout(3):
                event = await robot.events.next()
    assert box.latest is None
    assert event.reason is Reason.BAD_INPUT
    assert event.text.startswith(f"mt/truck/{key}: expected mt/truck/req/<source>/ and one of drive, control,")
    assert event.values["by"] == (*key.split("/")[1:2], "")[0]


async def test_an_emergency_stop_waits_for_no_other_request(monkeypatch: pytest.MonkeyPatch):
    held, release = threading.Event(), threading.Event()
    take = Intake.take

    def slowly(intake: Intake, sender: Sender, *request: Any) -> None:
        if sender.source == "eve":
            held.set()
            release.wait(5)
        take(intake, sender, *request)

    monkeypatch.setattr(Intake, "take", slowly)
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint, source="ann") as client:
        got: list[ControlRequest] = []
        robot.bus.listen(REQ_CONTROL, got.append)
        try:
            with raw_session(robot.endpoint) as eve:
                put(eve, "mt/truck/req/eve/control", b"x")
                assert await asyncio.to_thread(held.wait, 3)
                for source in ("*", "**"):
                    put(eve, estop_key("truck", source), b"x")
                client.order(Order.ESTOP).close()
                await eventually(lambda: got)
                release.set()
                put(eve, "mt/truck/req/estop", estop_payload("eve"))
                await eventually(lambda: len(got) == 2)
        finally:
            release.set()
    assert [(request.order, request.source) for request in got] == [(Order.ESTOP, "ann"), (Order.ESTOP, ANONYMOUS)]


async def test_wildcard_puts_use_up_what_their_sender_may_send():
    async with running_robot() as robot:
        got: list[str] = []
        robot.bus.listen(REQ_GOAL, lambda request: got.append(request.source))
        with raw_session(robot.endpoint) as station:
            for _ in range(20):
                put(station, "mt/truck/req/ann/**", b"x")
            for source in ("ann", "bob"):
                goal = GoalRequest(**drive_request(1).model_dump(include=HEADER), goal=Pose2D(x=0.0, y=0.0, yaw=0.0))
                put(station, f"mt/truck/req/{source}/goal", wire.encode(REQ_GOAL, goal))
            await eventually(lambda: got)
    assert got == ["bob"]


async def test_schemas_are_served_in_their_own_encoding():
    async with running_robot() as robot:
        with raw_session(robot.endpoint) as station:
            replies = await asyncio.to_thread(lambda: list(station.get("mt/truck/rpc/schema/**", timeout=2.0)))
    served = {str(reply.ok.key_expr): reply.ok for reply in replies if reply.ok}
    assert set(served) == {f"mt/truck/rpc/schema/{topic.name}" for topic in TOPICS}
    pose = served["mt/truck/rpc/schema/state/pose"]
    assert pose.payload.to_bytes() == wire.schema(POSE).data
    assert str(pose.encoding) == "application/protobuf;google.protobuf.FileDescriptorSet"
    assert json.loads(served["mt/truck/rpc/schema/state/gate"].payload.to_bytes())["type"] == "object"


async def test_a_slow_call_does_not_hold_up_others_and_too_many_are_refused():
    async with running_robot() as robot:
        release = asyncio.Event()

        async def wait(_):
            await release.wait()
            return {}

        robot.rpc.register("wait", wait)

        def ask(name: str) -> str:
            (reply,) = list(station.get(f"mt/truck/rpc/{name}/ann", timeout=2.0))
            return "ok" if reply.ok else json.loads(reply.err.payload.to_bytes())["reason"]

        with raw_session(robot.endpoint) as station:
            waiting = [station.get("mt/truck/rpc/wait/ann", timeout=2.0) for _ in range(16)]
            refused = await asyncio.to_thread(ask, "topics")
            release.set()
            assert await asyncio.to_thread(lambda: [bool(next(iter(w)).ok) for w in waiting]) == [True] * 16
            accepted = await asyncio.to_thread(ask, "topics")
    assert (refused, accepted) == ("busy", "ok")


async def test_a_flood_of_calls_is_refused_by_its_rate_and_keeps_off_neither_others_nor_orders():
    async with running_robot() as robot:
        robot.rpc.register("estop", AsyncMock(return_value={}))
        with raw_session(robot.endpoint) as station:

            def texts(key: str, count: int = 1) -> list[str]:
                asked = [station.get(f"mt/truck/rpc/{key}", payload=b"{}", timeout=10.0) for _ in range(count)]
                replies = [reply for answer in asked for reply in answer]
                return ["ok" if reply.ok else json.loads(reply.err.payload.to_bytes())["text"] for reply in replies]

            flood = asyncio.create_task(asyncio.to_thread(texts, "topics/eve", round(4 * CALLS.rate)))
            order = await asyncio.to_thread(texts, "estop/eve")
            answers = await flood
            other = await asyncio.to_thread(texts, "topics/ann")
    assert (order, other) == (["ok"], ["ok"])
    assert answers.count("more than 100 calls a second") > 2 * CALLS.rate


async def test_orders_have_room_where_too_many_calls_wait_and_the_others_are_refused():
    async with running_robot() as robot:
        robot.rpc.register("estop", AsyncMock(return_value={}))
        with raw_session(robot.endpoint) as station:
            (_,) = await asyncio.to_thread(lambda: list(station.get("mt/truck/rpc/topics/ann")))
            keys = [*["topics/eve"] * round(CALLS.rate), "estop/ann"]
            asked = [station.get(f"mt/truck/rpc/{key}", payload=b"{}", timeout=10.0) for key in keys]
            time.sleep(0.3)  # the loop takes none of them meanwhile
            answers = await asyncio.to_thread(lambda: [list(answer) for answer in asked])
    *others, order = ([bool(reply.ok) for reply in answer] for answer in answers)
    assert order == [True]
    assert others.count([False]) >= CALLS.rate - CALLS.waiting
    assert others.count([]) == 0, "all are answered"


async def test_an_emergency_stop_is_carried_out_while_slow_orders_fill_all_places_and_the_room_of_those_that_wait():
    async with running_robot(deadline=5.0) as robot:
        release, served = asyncio.Event(), []

        async def disarm(payload):
            await release.wait()
            return {}

        async def estop(payload):
            served.append(payload["source"])
            return {}

        robot.rpc.register("disarm", disarm)
        robot.rpc.register("estop", estop)
        with raw_session(robot.endpoint) as station:

            def ask(key: str) -> "zenoh.handlers.FifoChannel[zenoh.Reply]":
                return station.get(f"mt/truck/rpc/{key}", payload=b"{}", timeout=10.0)

            pressed = [ask("estop/ann")]
            others = [ask(f"disarm/eve{number % 40}") for number in range(200)]
            time.sleep(0.3)  # the loop takes none of them meanwhile
            pressed.append(ask("estop/bob"))
            answers = await asyncio.to_thread(lambda: [bool(next(iter(asked)).ok) for asked in pressed])
            release.set()
            await asyncio.to_thread(lambda: [list(asked) for asked in others])
    assert (answers, served) == ([True, True], ["ann", "bob"])


async def test_calls_with_huge_payloads_are_refused_before_anybody_parses_them():
    async with running_robot() as robot:
        with raw_session(robot.endpoint) as station:

            def ask(payload: bytes) -> tuple[str, str]:
                (reply,) = list(station.get("mt/truck/rpc/topics", payload=payload, timeout=2.0))
                answer = json.loads((reply.ok or reply.err).payload.to_bytes())
                return answer.get("reason", "ok"), answer.get("text", "")

            huge = await asyncio.to_thread(ask, b'{"x": "' + b"x" * 10_000_000 + b'"}')
            largest = await asyncio.to_thread(ask, b'{"x": "' + b"x" * (MAX_CALL - 9) + b'"}')
            nested = await asyncio.to_thread(ask, b"[" * MAX_CALL)
    assert huge == ("bad_input", f"payload of 10000009 bytes, at most {MAX_CALL} are accepted")
    assert largest[0] == "ok"
    assert nested[0] == "bad_input"


async def test_an_endpoint_in_use_is_refused_by_name():
    async with running_robot() as robot:
        by = rf"is in use by robot 'truck', process {os.getpid()} \(.*\); give a second robot another zenoh.listen"
        with pytest.raises(BusyError, match=f"{robot.endpoint}.* {by}"):
            async with running_robot(robot.endpoint):
                pass
    async with running_robot(robot.endpoint):  # free again
        pass


async def test_one_robot_name_is_run_once_on_a_network():
    async with running_robot() as robot:
        with pytest.raises(BusyError, match="already runs robot 'truck'"):
            async with running_robot(connect=(robot.endpoint,), mode="peer"):
                pass
        async with running_robot(connect=(robot.endpoint,), robot="rover"):
            pass


async def test_an_endpoint_that_cannot_be_opened_is_a_config_error():
    with pytest.raises(ConfigError, match=r"zenoh cannot open tcp/203\.0\.113\.1:7447") as caught:
        async with running_robot("tcp/203.0.113.1:7447", insecure=True):
            pass
    assert "cargo" not in str(caught.value)


async def test_opening_first_fails_early_and_run_goes_on_with_it():
    endpoint = free_endpoint()
    clock = WallClock()
    first = ZenohBridge("truck", Bus(clock), ZenohConfig(listen=(endpoint,)), clock, Rpc(clock))
    second = ZenohBridge("truck", Bus(clock), ZenohConfig(listen=(endpoint,)), clock, Rpc(clock))
    await first.open()
    await first.open()
    with pytest.raises(BusyError):
        await second.open()
    ready = asyncio.Event()
    task = asyncio.create_task(first.run(ready.set))
    await ready.wait()
    task.cancel()
    await asyncio.wait([task])
    await first.close()
    await second.open()
    await second.close()


@pytest.mark.parametrize("turns", [0, 1, 3, 10])
async def test_cancelling_at_any_moment_frees_the_endpoint(turns: int):
    endpoint = free_endpoint()
    clock = WallClock()
    bridge = ZenohBridge("truck", Bus(clock), ZenohConfig(listen=(endpoint,)), clock, Rpc(clock))
    task = asyncio.create_task(bridge.run(lambda: None))
    for _ in range(turns):
        await asyncio.sleep(0.0005)
    task.cancel()
    await asyncio.wait([task])
    assert task.cancelled()
    host, _, port = endpoint.removeprefix("tcp/").partition(":")
    with socket.socket() as probe:
        probe.bind((host, int(port)))


async def test_no_thread_of_zenoh_outlives_the_bridge():
    before = set(threading.enumerate())
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint) as client:
        assert await client.call("topics")
    loops = "uvloop"
    await eventually(lambda: not [t for t in set(threading.enumerate()) - before if not t.name.startswith(loops)])


async def test_a_bug_behind_the_bridge_ends_the_service(monkeypatch: pytest.MonkeyPatch):
    clock = WallClock()
    bus = Bus(clock)
    endpoint = free_endpoint()
    bridge = ZenohBridge("truck", bus, ZenohConfig(listen=(endpoint,)), clock, Rpc(clock))
    monkeypatch.setattr(bus, "inject", lambda *_: 1 / 0)
    ready = asyncio.Event()
    task = asyncio.create_task(bridge.run(ready.set))
    await ready.wait()
    with raw_session(endpoint) as station:
        put(station, "mt/truck/req/ann/drive", wire.encode(REQ_DRIVE, drive_request(1)))
        await asyncio.wait([task], timeout=3)
    with pytest.raises(ExceptionGroup) as caught:
        await task
    assert caught.group_contains(ZeroDivisionError)


async def test_access_control_stops_forgers_but_no_one_else():
    async with running_robot(access_control=True) as robot:
        publisher = robot.bus.publisher(GATE, Writer.GATE)
        publisher.put(gate_state(1))
        requests = robot.bus.subscribe(REQ_DRIVE, fifo(1))
        async with TruckClient(endpoint=robot.endpoint) as client, asyncio.timeout(5):
            gate = client.subscribe(GATE, fifo(9))
            pose = client.subscribe(POSE, fifo(9))
            assert (await gate.next()).seq == 1
            assert await client.get_retained(GATE) == gate_state(1)
            assert await client.alive()
            assert (await client.call("topics"))["topics"]
            await client.drive(0.5, 0.0)
            await requests.next()
            with raw_session(robot.endpoint) as forger:
                forger.put("mt/truck/state/pose", wire.encode(POSE, odometry(666)))
                forger.put("mt/truck/state/gate", wire.encode(GATE, gate_state(666)))
                await asyncio.sleep(0.1)
            publisher.put(gate_state(2))
            robot.bus.publisher(POSE, Writer.ESTIMATION).put(odometry(2))
            assert (await gate.next()).seq == 2
            assert (await pose.next()).seq == 2


def test_discovery_is_off_and_the_default_is_this_machine_only():
    config = json.loads(session_config("truck", ZenohConfig(), listeners(ZenohConfig())[0]))
    assert config["listen"]["endpoints"] == ["tcp/127.0.0.1:7447"]
    assert config["scouting"]["multicast"]["enabled"] is False
    assert config["scouting"]["gossip"]["enabled"] is False
    assert config["scouting"]["delay"] == 0
    assert "access_control" not in config


async def test_the_ten_lines_of_the_docs_print_the_pose(tmp_path: Path):
    text = (Path(__file__).parents[3] / "docs" / "zenoh.md").read_text()
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "import sys, zenoh" in block]
    assert len(code.strip().splitlines()) <= 10
    assert "monstertruck" not in code
    script = tmp_path / "pose.py"
    script.write_text(code)
    async with running_robot() as robot:
        publisher = robot.bus.publisher(POSE, Writer.ESTIMATION)
        process = await asyncio.create_subprocess_exec(
            sys.executable, str(script), robot.endpoint, stdout=subprocess.PIPE
        )
        assert process.stdout is not None
        line = asyncio.create_task(process.stdout.readline())
        async with asyncio.timeout(10):
            while not line.done():
                publisher.put(odometry(publisher.next_seq(), x=1.25))
                await asyncio.sleep(0.02)
        process.kill()
        await process.communicate()
    assert line.result() == b"x 1.250 m, y 2.000 m in map\n"


async def test_who_asks_right_after_an_answer_gets_what_it_says():
    async with running_robot(gather_seconds=0.1) as robot, TruckClient(endpoint=robot.endpoint) as client:
        gate = robot.bus.publisher(GATE, Writer.GATE)

        async def tell(_: dict[str, object]) -> dict[str, object]:
            gate.put(gate_state(seq=gate.next_seq()))
            return {}

        robot.rpc.register("tell", tell)
        for number in range(5):
            await client.call("tell")
            newest = await client.get_retained(GATE)
            assert newest is not None
            assert newest.seq == number


async def test_what_a_test_stand_sees_comes_in_for_the_recorder_where_it_is_asked_for_and_does_not_go_out():
    pose = StandPose(
        stamp=3,
        received=3,
        seq=1,
        frame="map",
        pose=Pose2D(x=0.1, y=0.2, yaw=0.3),
        observer="overhead",
        position_sigma=0.0,
        heading_sigma=0.0,
    )
    async with running_robot(stand=True) as robot, running_robot() as without:
        for bridge, heard in ((robot, True), (without, False)):
            seen: list[StandPose] = []
            bridge.bus.tap(lambda _t, message, _d, _a, seen=seen: seen.append(message), [STAND_POSE])
            async with (
                TruckClient("truck", bridge.endpoint) as stand,
                TruckClient("truck", bridge.endpoint) as station,
            ):
                echoes = station.subscribe(STAND_POSE, fifo(10))
                await asyncio.sleep(0.1)
                stand.publish_stand_pose(pose)
                await asyncio.sleep(0.3)
                assert [message.pose for message in seen] == [pose.pose] * heard
                assert len(echoes.drain()) <= 1  # the stand's own, never the robot's
