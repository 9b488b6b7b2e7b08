"""The station's client against a real bridge."""

import asyncio
import json
import re
import subprocess
import sys
import time
from typing import Any

import pytest
import zenoh

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.errors import InputError, NoAnswerError, NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, GoalRequest, Order, Role
from monstertruck_schemas.topics import GATE, MAP, POSE, REQ_CONTROL, REQ_DRIVE, REQ_PATH, Writer
from monstertruckd.bus.zenoh_session import ZenohBridge
from tests.bus_kit import Robot, free_endpoint, gate_state, odometry, running_robot


async def test_a_stream_arrives_whole_and_in_order():
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint) as client:
        box = client.subscribe(POSE, fifo(1000))
        await asyncio.sleep(0.1)
        publisher = robot.bus.publisher(POSE, Writer.ESTIMATION)
        for seq in range(641):
            publisher.put(odometry(seq))
            if seq % 20 == 0:
                await asyncio.sleep(0)
        async with asyncio.timeout(5):
            got = [await box.next() for _ in range(641)]
    assert got == [odometry(seq) for seq in range(641)]
    assert box.drops == 0


async def test_closing_the_client_ends_its_subscriptions():
    async with running_robot() as robot:
        async with TruckClient(endpoint=robot.endpoint) as client:
            box = client.subscribe(POSE, latest())
            client.subscribe(POSE, latest()).close()
            reading = asyncio.create_task(_all(box))
            await asyncio.sleep(0)
        assert await reading == []
    with pytest.raises(RuntimeError, match="async with"):
        client.subscribe(POSE, latest())


async def _all(box):
    return [message async for message in box]


async def test_messages_that_cannot_be_decoded_are_logged_and_skipped(caplog: pytest.LogCaptureFixture):
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint) as client:
        box = client.subscribe(GATE, fifo(10))
        async with TruckClient(endpoint=robot.endpoint) as other:
            await asyncio.sleep(0.1)
            other._open_session().put("mt/truck/state/gate", b"garbage")
            await asyncio.sleep(0.1)
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(4))
        async with asyncio.timeout(3):
            assert (await box.next()).seq == 4
    assert "state/gate" in caplog.text


async def test_retained_topics_by_query():
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint, timeout=0.5) as client:
        assert await client.get_retained(MAP) is None
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        assert await client.get_retained(GATE) == gate_state(1)
        async with TruckClient("rover", robot.endpoint, timeout=0.5) as lost:
            with pytest.raises(NotFoundError, match="no robot 'rover' at tcp/127"):
                await lost.get_retained(GATE)
            assert not await lost.alive()


async def test_calls_answer_or_raise_what_happened():
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint) as client:

        async def double(payload):
            if "x" not in payload:
                msg = "x is missing"
                raise InputError(msg)
            return {"x": 2 * payload["x"]}

        async def refuse(_):
            raise RequestRefusedError(Reason.ESTOPPED)

        async def hang(_):
            await asyncio.sleep(60)
            return {}

        for handler in (double, refuse, hang):
            robot.rpc.register(handler.__name__, handler)

        assert await client.call("double", {"x": 21}) == {"x": 42}
        with pytest.raises(InputError, match="x is missing"):
            await client.call("double")
        with pytest.raises(NotFoundError, match="no rpc 'nope'; there are double, hang, refuse, topics"):
            await client.call("nope")
        with pytest.raises(RequestRefusedError) as refused:
            await client.call("refuse")
        assert refused.value.refusal is Reason.ESTOPPED
        with pytest.raises(NoAnswerError, match="hang did not end"):
            await client.call("hang")
        async with TruckClient("rover", robot.endpoint) as lost:
            with pytest.raises(NotFoundError, match="no robot 'rover'"):
                await lost.call("topics")


async def test_a_robot_that_never_answers_times_out():
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint, timeout=0.1) as client:
        robot.rpc.register("hang", lambda _: asyncio.sleep(60))
        with pytest.raises(NoAnswerError, match="no answer in time"):
            await client.call("hang")
        with pytest.raises(NoAnswerError, match="does not publish its gate state"):
            await client.drive(0.0, 0.0)


def called(robot: Robot, *names: str) -> asyncio.Queue[tuple[str, dict[str, Any]]]:
    """Payloads of calls, which are answered with a state of the gate."""
    payloads: asyncio.Queue[tuple[str, dict[str, Any]]] = asyncio.Queue()

    def register(name: str) -> None:
        async def take(payload: dict[str, Any]) -> dict[str, Any]:
            payloads.put_nowait((name, payload))
            return gate_state(5).model_dump(mode="json") | {"of a later version": 1}

        robot.rpc.register(name, take)

    for name in names:
        register(name)
    return payloads


async def test_requests_carry_the_nonce_and_a_growing_sequence():
    async with running_robot() as robot:
        gate = robot.bus.publisher(GATE, Writer.GATE)
        gate.put(gate_state(17, nonce="first"))
        boxes = [robot.bus.subscribe(topic, fifo(9)) for topic in (REQ_DRIVE, REQ_PATH)]
        calls = called(robot, "arm", "goal")
        seqs = []
        for _run in range(2):
            async with (
                TruckClient(endpoint=robot.endpoint, source="ann@laptop", role=Role.KEYBOARD) as client,
                asyncio.timeout(5),
            ):
                await client.drive(0.5, 0.1, -0.1, lease=0.2)
                drive = await boxes[0].next()
                assert await client.arm() == gate_state(5)
                order = ControlRequest.model_validate_json(json.dumps({**(await calls.get())[1], "order": "arm"}))
                await client.goal((1.0, 2.0, 0.0))
                goal = GoalRequest.model_validate_json(json.dumps((await calls.get())[1]))
                await client.path(Path(stamp=0, received=0, seq=0, frame="odom", poses=[0.0, 0.0, 0.0], directions=[]))
                path = await boxes[1].next()
                seqs += [drive.seq, order.seq, goal.seq, path.seq]
        assert (drive.speed, drive.front, drive.rear, drive.lease) == (0.5, 0.1, -0.1, 0.2)
        assert (drive.source, drive.role, drive.nonce) == ("ann@laptop", Role.KEYBOARD, "first")
        assert {request.gate_stamp for request in (drive, order, goal, path)} == {17}
        assert (goal.frame, goal.goal.y) == ("map", 2.0)
        assert (path.frame, path.path.poses.tolist()) == ("odom", [0.0, 0.0, 0.0])
        assert seqs == sorted(set(seqs))


@pytest.mark.parametrize("order", [Order.ESTOP, Order.STOP])
async def test_an_emergency_stop_is_published_before_anything_is_awaited(order: Order):
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint, timeout=60.0) as client:
        orders = robot.bus.subscribe(REQ_CONTROL, fifo(4))
        calls = called(robot, order.value)
        async with asyncio.timeout(3):
            answer = await client.order(order)
            stop = await orders.next()
            name, payload = await calls.get()
    assert (stop.order, stop.nonce) == (order, "")
    assert (name, payload["nonce"], payload["seq"]) == (order.value, "", stop.seq + 1)
    assert answer == gate_state(5)


async def test_other_orders_are_calls_only():
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint) as client:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        orders = robot.bus.subscribe(REQ_CONTROL, fifo(4))
        called(robot, "arm", "disarm", "reset")
        async with asyncio.timeout(3):
            for give in (client.arm, client.disarm, client.reset):
                await give()
    assert orders.drain() == []


async def test_a_refused_order_carries_its_reason():
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint) as client:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))

        async def refuse(_: dict[str, Any]) -> dict[str, Any]:
            raise RequestRefusedError(Reason.SCAN_STALE, "no fresh lidar scan (age 1.0 s)")

        robot.rpc.register("arm", refuse)
        with pytest.raises(RequestRefusedError, match=r"no fresh lidar scan \(age 1.0 s\)") as refused:
            await client.arm()
    assert refused.value.refusal is Reason.SCAN_STALE


async def test_orders_of_a_robot_that_is_not_there():
    async with running_robot() as robot, TruckClient("rover", robot.endpoint, timeout=0.1) as client:
        with pytest.raises(NoAnswerError, match="does not publish its gate state"):
            await client.arm()
        with pytest.raises(NotFoundError, match="no robot 'rover'"):
            await client.estop()


async def test_tasks_that_ask_at_once_share_one_wait():
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint) as client:
        calls = called(robot, "arm", "disarm")
        asking = asyncio.gather(client.arm(), client.disarm())
        await asyncio.sleep(0.2)
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        async with asyncio.timeout(3):
            await asking
            seqs = {name: payload["seq"] for name, payload in (await calls.get(), await calls.get())}
    assert seqs["disarm"] == seqs["arm"] + 1


async def test_a_source_the_robot_knows_goes_on_counting_above_it():
    async with running_robot() as robot:
        known = 2**62
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(0, holder="ann", role=Role.STATION, last_seq=known))
        box = robot.bus.subscribe(REQ_DRIVE, fifo(9))
        async with TruckClient(endpoint=robot.endpoint, source="ann") as client, asyncio.timeout(3):
            await client.drive(0.0, 0.0)
            assert (await box.next()).seq == known + 1


async def test_a_restarted_robot_is_found_again_with_its_new_nonce():
    endpoint = free_endpoint()
    async with running_robot(endpoint) as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(0, nonce="first"))
        client = await TruckClient(endpoint=endpoint).__aenter__()
        gate = client.subscribe(GATE, latest())
        async with asyncio.timeout(3):
            assert (await gate.next()).nonce == "first"
        assert await client.alive()
    assert not await client.alive()
    async with running_robot(endpoint) as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(0, nonce="second"))
        async with asyncio.timeout(10):
            assert (await gate.next()).nonce == "second"
        calls = called(robot, "arm")
        await client.arm()
        assert calls.get_nowait()[1]["nonce"] == "second"
        await client.__aexit__(None, None, None)


async def test_nobody_at_the_endpoint():
    with pytest.raises(NotFoundError, match=r"no robot answers at tcp/127\.0\.0\.1:\d+ within \d\.\d s"):
        async with TruckClient(endpoint=free_endpoint(), timeout=0.2):
            pass


async def test_it_says_how_long_it_really_waited(monkeypatch):
    def open_slowly(_):
        time.sleep(0.3)
        raise zenoh.ZError

    monkeypatch.setattr(zenoh, "open", open_slowly)
    with pytest.raises(NotFoundError, match=r"within 0\.[3-9] s"):
        async with TruckClient(timeout=0.1):
            pass


async def test_who_asks_for_another_robot_learns_which_one_is_there():
    async with running_robot(robot="sonar") as robot, TruckClient("truck", robot.endpoint, timeout=0.5) as client:
        with pytest.raises(NotFoundError, match=r"no robot 'truck' at tcp/\S+; found: sonar \(--robot NAME\)$"):
            await client.call("config")


async def test_a_robot_that_is_there_and_gives_no_answer_is_not_said_to_be_absent(monkeypatch):
    monkeypatch.setattr(ZenohBridge, "_serve", lambda *_: None)  # as one that ends: the query is dropped
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint, timeout=0.5, source="ann") as client:
        with pytest.raises(NoAnswerError, match=r"^robot 'truck' at tcp/.* does not answer: it is starting or ending"):
            await client.call("config")


async def test_the_loop_runs_while_the_client_dials():
    beats = 0

    async def beat() -> None:
        nonlocal beats
        while True:
            await asyncio.sleep(0.01)
            beats += 1

    beating = asyncio.create_task(beat())
    with pytest.raises(NotFoundError):
        async with TruckClient(endpoint=free_endpoint(), timeout=0.3):
            pass
    beating.cancel()
    assert beats > 10


async def test_a_dial_that_is_cancelled_leaves_nothing_open():
    async with running_robot() as robot:
        client = TruckClient(endpoint=robot.endpoint)
        dialling = asyncio.create_task(client.__aenter__())
        await asyncio.sleep(0)
        dialling.cancel()
        with pytest.raises(asyncio.CancelledError):
            await dialling
        assert client._session is None


def test_the_default_source_is_acceptable():
    assert TruckClient().source.count(":") == 1
    assert re.fullmatch(r"[A-Za-z0-9_.@:-]{1,64}", TruckClient().source)


def test_a_station_needs_nothing_of_the_robot():
    code = (
        "import sys, monstertruck_runtime.client; "
        "sys.exit(bool({'monstertruckd', 'monstertruck_drivers', 'mcap', 'PIL', 'serial'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


async def test_a_stop_withdraws_an_order_that_still_waits_for_the_nonce(monkeypatch):
    client = TruckClient()
    known, called, put = asyncio.Event(), [], []

    async def answered(*_):
        await known.wait()
        return {}

    async def call(name, _header, _timeout):
        called.append(name)
        await asyncio.Event().wait()

    monkeypatch.setattr(client, "header", answered)
    monkeypatch.setattr(client, "_call", call)
    monkeypatch.setattr(client, "_put", lambda _topic, request, _key: put.append(request.order))
    monkeypatch.setattr(client, "_header", lambda _lease: header())
    reset = asyncio.create_task(client.order(Order.RESET))
    await asyncio.sleep(0)
    stop = asyncio.create_task(client.order(Order.ESTOP))
    await asyncio.sleep(0)
    known.set()
    with pytest.raises(RequestRefusedError) as refused:
        await reset
    assert refused.value.refusal is Reason.BAD_SEQUENCE
    assert (put, called) == ([Order.ESTOP], ["estop"])
    stop.cancel()
    await asyncio.wait([stop])


def header():
    return {"stamp": 1, "received": 1, "seq": 1, "source": "ann", "role": Role.STATION, "lease": 1.0, "nonce": ""}
