"""Requests from threads of others: nothing they send may cost the loop its time or an emergency stop."""

import asyncio
import json
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas.base import Message, Pose2D
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, DriveRequest, GoalRequest, Order, PathRequest, Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.state import GateMode
from monstertruck_schemas.topics import ESTOP_WAY, EVENT, REQ_CONTROL, REQ_DRIVE, REQ_GOAL, REQ_PATH, Topic
from monstertruckd.bus.access import EVERYTHING, OBSERVING, Grant, Sender
from monstertruckd.bus.intake import LIMITS, ORDER_RATE, REQUEST_QUEUE, Intake, Refusals
from monstertruckd.bus.local import Bus
from tests.unit.gate.rig import make_gate

MAX_REPEATS = 8
REPEAT = 0.02

STOP_RATE = 50.0
MAX_OWNERS = 64

HEADER: dict[str, Any] = {
    "stamp": 1,
    "received": 1,
    "source": "a",
    "role": Role.STATION,
    "lease": 0.5,
    "nonce": "run-1",
    "gate_stamp": 1,
}


def order(what: Order, seq: int = 1, **more: Any) -> bytes:
    return wire.encode(REQ_CONTROL, ControlRequest(**{**HEADER, "seq": seq, "order": what, **more}))


def drive(seq: int) -> bytes:
    return wire.encode(REQ_DRIVE, DriveRequest(**HEADER, seq=seq, speed=0.1, front=0.0))


def path(poses: int, seq: int = 1) -> bytes:
    rng = np.random.default_rng(1)
    route = Path(
        stamp=1,
        received=1,
        seq=1,
        frame="odom",
        poses=rng.uniform(-9999, 9999, 3 * poses),
        directions=rng.choice([-1.0, 1.0], poses),
        name="route",
    )
    return wire.encode(REQ_PATH, PathRequest(**HEADER, seq=seq, path=route))


ANN = Sender("ann", EVERYTHING)


class FixedClock(WallClock):
    """Time that passes when a test says so: no rate is regained because a computer is busy."""

    stamp = SECOND

    def now(self) -> int:
        return self.stamp


class Entrance:
    """A bus with the intakes of all topics, used from a thread while the loop is busy elsewhere."""

    def __init__(self) -> None:
        clock = FixedClock()
        self.clock = clock
        self.bus = Bus(clock)
        self.events = self.bus.subscribe(EVENT, fifo(100))
        self.intakes = {
            topic.name: Intake(topic, self.bus, clock, _call, "zenoh")
            for topic in (REQ_CONTROL, REQ_DRIVE, REQ_GOAL, REQ_PATH)
        }
        self.intakes[ESTOP_WAY] = Intake(REQ_CONTROL, self.bus, clock, _call, "zenoh", only=Order.ESTOP)

    def send(self, *requests: tuple[Topic[Any], bytes], sender: Sender = ANN) -> None:
        """All of them arrive before the loop gets a turn."""

        def run() -> None:
            for topic, data in requests:
                self.intakes[topic.name].take(sender, len(data), lambda data=data: data)

        thread = threading.Thread(target=run)
        thread.start()
        thread.join()

    def stop_by_its_own_way(self, data: bytes) -> None:
        self.intakes[ESTOP_WAY].take(ANN, len(data), lambda: data)

    async def settle(self) -> None:
        for _ in range(3 * REQUEST_QUEUE):
            await asyncio.sleep(0)


def _call(job: Callable[[], None]) -> None:
    job()


@pytest.mark.parametrize("urgent", [Order.ESTOP, Order.STOP])
@pytest.mark.parametrize("place", ["first", "last", "middle"])
async def test_an_emergency_stop_reaches_the_gate_through_any_flood(urgent: Order, place: str):
    entrance = Entrance()
    gate = make_gate()
    taken: list[Order] = []

    def take(request: ControlRequest) -> None:
        taken.append(request.order)
        gate.control(request, 1)

    entrance.bus.listen(REQ_CONTROL, take)
    bogus = [(REQ_CONTROL, order(Order.ARM, seq, nonce="bogus")) for seq in range(4 * REQUEST_QUEUE)]
    position = {"first": 0, "last": len(bogus), "middle": len(bogus) // 2}[place]
    bogus.insert(position, (REQ_CONTROL, order(urgent)))
    entrance.send(*[(REQ_DRIVE, drive(seq)) for seq in range(4 * REQUEST_QUEUE)], *bogus, (REQ_PATH, path(2000)))
    await entrance.settle()
    assert urgent in taken
    assert len(taken) == ORDER_RATE + 1
    if urgent is Order.ESTOP:
        assert gate.mode is GateMode.ESTOPPED


async def test_an_emergency_stop_overtakes_the_orders_that_wait():
    entrance = Entrance()
    taken: list[Order] = []
    entrance.bus.listen(REQ_CONTROL, lambda request: taken.append(request.order))
    stops = [(REQ_CONTROL, order(Order.STOP))] * (2 * REQUEST_QUEUE)
    for name in ("eve", "bob"):
        entrance.send(*stops, sender=Sender(name, EVERYTHING))
    entrance.send((REQ_CONTROL, order(Order.ESTOP)))
    await entrance.settle()
    assert len(taken) == REQUEST_QUEUE + 1
    assert taken.index(Order.ESTOP) <= 1


@pytest.mark.parametrize("stopping", [Order.STOP, Order.ESTOP])
async def test_of_stops_that_repeat_all_the_time_the_loop_gets_few_and_always_the_last(stopping: Order):
    entrance = Entrance()
    taken: list[ControlRequest] = []
    entrance.bus.listen(REQ_CONTROL, taken.append)
    burst = round(STOP_RATE)
    entrance.send(*[(REQ_CONTROL, order(stopping, seq)) for seq in range(burst)])
    await entrance.settle()
    entrance.send(*[(REQ_CONTROL, order(stopping, seq)) for seq in range(burst, 20 * burst)])
    for number in range(3 * MAX_REPEATS):
        entrance.send(*[(REQ_CONTROL, order(stopping))] * (burst + 1), sender=Sender(f"eve{number}", EVERYTHING))
    await asyncio.sleep(2 * REPEAT)
    await entrance.settle()
    assert len(taken) < 6 * burst
    entrance.send(*[(REQ_CONTROL, order(stopping, seq)) for seq in range(20 * burst, 40 * burst)])
    await asyncio.sleep(2 * REPEAT)
    await entrance.settle()
    assert (taken[-1].source, taken[-1].seq) == ("ann", 40 * burst - 1)


async def test_stops_that_repeat_cost_those_of_others_no_time():
    entrance = Entrance()
    taken: list[ControlRequest] = []
    entrance.bus.listen(REQ_CONTROL, taken.append)
    entrance.send(*[(REQ_CONTROL, order(Order.STOP))] * 500, sender=Sender("eve", EVERYTHING))
    await entrance.settle()
    entrance.send((REQ_CONTROL, order(Order.STOP)))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert taken[-1].source == "ann"


async def test_an_emergency_stop_has_a_way_of_its_own_which_takes_nothing_else():
    entrance = Entrance()
    taken: list[Order] = []
    entrance.bus.listen(REQ_CONTROL, lambda request: taken.append(request.order))
    entrance.stop_by_its_own_way(order(Order.ESTOP))
    await entrance.settle()
    assert taken == [Order.ESTOP]
    for wrong, complaint in (
        (order(Order.STOP), "req/estop: expected the order estop, found stop"),
        (order(Order.ARM), "req/estop: expected the order estop, found arm"),
    ):
        entrance.stop_by_its_own_way(wrong)
        await entrance.settle()
        event = await entrance.events.next()
        assert (event.reason, event.text) == (Reason.BAD_INPUT, complaint)
        entrance.clock.stamp += SECOND
    assert taken == [Order.ESTOP]


async def test_orders_beyond_the_rate_are_refused_without_decoding_them_but_never_one_that_may_stop(monkeypatch):
    entrance = Entrance()
    taken: list[Order] = []
    decoded: list[bytes] = []
    decode = wire.decode
    monkeypatch.setattr(wire, "decode", lambda topic, data: decoded.append(data) or decode(topic, data))
    entrance.bus.listen(REQ_CONTROL, lambda request: taken.append(request.order))
    entrance.send(*[(REQ_CONTROL, order(Order.ARM))] * 100)
    assert len(decoded) == ORDER_RATE
    for spelling in (b'"stop"', rb'"\u0073top"', b'"estop"', rb'"e\u0073top"'):
        data = order(Order.STOP).replace(b'"stop"', spelling)
        assert spelling in data
        entrance.send((REQ_CONTROL, data))
    await entrance.settle()
    assert taken.count(Order.STOP) == 2
    assert taken.count(Order.ESTOP) == 2


async def test_what_one_may_not_order_costs_the_others_no_rate():
    entrance = Entrance()
    taken: list[str] = []
    entrance.bus.listen(REQ_CONTROL, lambda request: taken.append(request.source))
    for number in range(2 * MAX_OWNERS):
        entrance.send((REQ_CONTROL, order(Order.ARM)), sender=Sender(f"eve{number}", OBSERVING))
    entrance.send((REQ_CONTROL, order(Order.ARM)))
    await entrance.settle()
    assert taken == ["ann"]


@pytest.mark.parametrize("limited", [Order.ARM, Order.DISARM, Order.RESET])
async def test_orders_that_do_not_stop_have_a_rate(limited: Order):
    entrance = Entrance()
    taken: list[Order] = []
    entrance.bus.listen(REQ_CONTROL, lambda request: taken.append(request.order))
    entrance.send(*[(REQ_CONTROL, order(limited))] * 10, *[(REQ_CONTROL, order(Order.STOP))] * 10)
    await entrance.settle()
    assert taken.count(limited) == ORDER_RATE
    assert taken.count(Order.STOP) == 10
    event = await entrance.events.next()
    assert (event.reason, event.text) == (Reason.MESSAGES_DROPPED, "req/control: more than 5 orders a second")
    entrance.clock.stamp += SECOND
    entrance.send((REQ_CONTROL, order(limited)))
    await entrance.settle()
    assert taken[-1] is limited


async def test_a_flood_of_stops_does_not_push_out_an_emergency_stop():
    entrance = Entrance()
    taken: list[Order] = []
    entrance.bus.listen(REQ_CONTROL, lambda request: taken.append(request.order))
    entrance.send((REQ_CONTROL, order(Order.ESTOP)), *[(REQ_CONTROL, order(Order.STOP))] * (2 * REQUEST_QUEUE))
    await entrance.settle()
    assert Order.ESTOP in taken[:2]
    entrance.send(*[(REQ_CONTROL, order(Order.ESTOP))] * (2 * REQUEST_QUEUE))
    await entrance.settle()
    assert taken[-1] is Order.ESTOP


async def test_a_batch_is_taken_one_request_a_turn():
    entrance = Entrance()
    box = entrance.bus.subscribe(REQ_DRIVE, fifo(3))  # a reader that keeps up misses nothing
    seen: list[int] = []

    async def read() -> None:
        while len(seen) < REQUEST_QUEUE:
            seen.append((await box.next()).seq)

    reading = asyncio.create_task(read())
    await asyncio.sleep(0)
    entrance.send(*[(REQ_DRIVE, drive(seq)) for seq in range(REQUEST_QUEUE)])
    await asyncio.sleep(0)
    assert len(seen) <= 1
    await entrance.settle()
    await reading
    assert seen == list(range(REQUEST_QUEUE))


async def test_a_path_of_two_thousand_poses_fits():
    entrance = Entrance()
    box = entrance.bus.subscribe(REQ_PATH, fifo(1))
    entrance.send((REQ_PATH, path(2000)))
    await entrance.settle()
    assert len((await box.next()).path.directions) == 2000


SHAPES = {
    "lists": "[" + ",".join(["[]"] * 40_000) + "]",
    "ragged": "[" + ",".join(["[1]"] * 30_000) + ",[1,2]]",
    "objects": "[" + ",".join(["{}"] * 40_000) + "]",
    "strings": "[" + ",".join(['"1"'] * 30_000) + "]",
    "numbers": "[" + ",".join(["1"] * 60_000) + "]",
    "keys": "{" + ",".join(f'"{i}":1' for i in range(12_000)) + "}",
}


@pytest.mark.parametrize("shape", SHAPES)
async def test_wrong_shapes_are_refused_without_decoding_them(shape: str, monkeypatch: pytest.MonkeyPatch):
    text = json.loads(path(2))
    text["path"]["poses"] = "@"
    data = json.dumps(text).replace('"@"', SHAPES[shape]).encode()
    assert len(data) < LIMITS[REQ_PATH.name].size
    entrance = Entrance()
    monkeypatch.setattr(wire, "decode", lambda *_: pytest.fail("decoded"))
    entrance.send((REQ_PATH, data))
    await entrance.settle()
    event = await entrance.events.next()
    assert (event.reason, event.text) == (Reason.BAD_INPUT, "req/path: request in too many parts")


async def test_what_cannot_be_an_array_is_refused_like_any_bad_input():
    entrance = Entrance()
    text = json.loads(path(2))
    text["path"]["poses"] = [{}]
    entrance.send((REQ_PATH, json.dumps(text).encode()))
    await entrance.settle()
    event = await entrance.events.next()
    assert event.reason is Reason.BAD_INPUT
    assert "expected a list of numbers" in event.text


async def test_what_is_too_large_is_not_even_read():
    entrance = Entrance()
    for topic, size in ((REQ_DRIVE, 2049), (REQ_CONTROL, 2049), (REQ_GOAL, 2049), (REQ_PATH, 131_073)):
        entrance.intakes[topic.name].take(ANN, size, lambda: pytest.fail("read"))
        await entrance.settle()
        event = await entrance.events.next()
        assert event.reason is Reason.BAD_INPUT
        assert f"{topic.name}: request of {size} bytes" in event.text


def goal(seq: int) -> bytes:
    return wire.encode(REQ_GOAL, GoalRequest(**HEADER, seq=seq, goal=Pose2D(x=0.0, y=0.0, yaw=0.0)))


@pytest.mark.parametrize(("topic", "make", "burst"), [(REQ_GOAL, goal, 5), (REQ_PATH, lambda seq: path(2, seq), 5)])
async def test_more_than_a_few_a_second_are_dropped_and_reported_once(
    topic: Topic[Message], make: Callable[[int], bytes], burst: int
):
    entrance = Entrance()
    got: list[Message] = []
    entrance.bus.listen(topic, got.append)
    entrance.send(*[(topic, make(seq)) for seq in range(50)])
    await entrance.settle()
    assert len(got) == burst
    event = await entrance.events.next()
    assert event.reason is Reason.MESSAGES_DROPPED
    assert event.text == f"{topic.name}: more than 5 requests a second"
    entrance.clock.stamp += SECOND // 4
    entrance.send((topic, make(50)))
    await entrance.settle()
    assert len(got) == burst + 1


async def test_after_closing_nothing_comes_in():
    entrance = Entrance()
    got: list[Message] = []
    entrance.bus.listen(REQ_CONTROL, got.append)
    entrance.send((REQ_CONTROL, order(Order.ARM)))
    entrance.intakes[REQ_CONTROL.name].close()
    entrance.send((REQ_CONTROL, order(Order.ARM)))
    await entrance.settle()
    assert got == []


async def test_the_source_is_that_of_the_key_and_the_rank_that_of_the_grant():
    entrance = Entrance()
    got: list[DriveRequest] = []
    entrance.bus.listen(REQ_DRIVE, got.append)
    data = drive(1).replace(b'"station"', b'"gamepad"')
    for grant in (EVERYTHING, Grant(AccessRole.PILOT, Role.KEYBOARD)):
        entrance.send((REQ_DRIVE, data), sender=Sender("bob", grant))
        await entrance.settle()
    assert [(request.source, request.role) for request in got] == [("bob", Role.GAMEPAD), ("bob", Role.KEYBOARD)]


async def test_observers_order_an_emergency_stop_and_nothing_else():
    entrance = Entrance()
    got: list[Message] = []
    for topic in (REQ_CONTROL, REQ_DRIVE, REQ_GOAL):
        entrance.bus.listen(topic, got.append)
    bob = Sender("bob", OBSERVING)
    others = [(REQ_CONTROL, order(what)) for what in Order if what is not Order.ESTOP]
    entrance.send(*others, (REQ_DRIVE, drive(1)), (REQ_GOAL, goal(1)), sender=bob)
    await entrance.settle()
    assert got == []
    event = await entrance.events.next()
    assert event.reason is Reason.NOT_PERMITTED
    assert event.text == "req/control: bob has the role observer, but this needs pilot"
    entrance.send((REQ_CONTROL, order(Order.ESTOP)), sender=bob)
    await entrance.settle()
    assert [(request.order, request.source) for request in got] == [(Order.ESTOP, "bob")]


async def test_a_flood_of_one_source_costs_no_other_its_rate():
    entrance = Entrance()
    got: list[str] = []
    entrance.bus.listen(REQ_GOAL, lambda request: got.append(request.source))
    entrance.send(*[(REQ_GOAL, goal(seq)) for seq in range(50)], sender=Sender("eve", EVERYTHING))
    entrance.send((REQ_GOAL, goal(1)))
    await entrance.settle()
    assert got.count("ann") == 1
    assert got.count("eve") == 5


async def test_invented_names_are_bounded_together():
    entrance = Entrance()
    got: list[str] = []
    entrance.bus.listen(REQ_GOAL, lambda request: got.append(request.source))
    for number in range(3 * MAX_OWNERS):
        entrance.send((REQ_GOAL, goal(1)), sender=Sender(f"eve{number}", EVERYTHING))
    await entrance.settle()
    assert len(got) == 25


async def test_programs_of_one_owner_share_its_rate_and_cost_no_other_owner_anything():
    entrance = Entrance()
    got: list[str] = []
    entrance.bus.listen(REQ_GOAL, lambda request: got.append(request.source))
    eve = [Sender(f"eve:{number}", OBSERVING if number % 2 else EVERYTHING) for number in range(MAX_OWNERS)]
    for sender in eve:
        entrance.send((REQ_GOAL, goal(1)), sender=sender)
    entrance.send((REQ_GOAL, goal(1)))
    await entrance.settle()
    assert got == ["eve:0", "eve:2", "eve:4", "ann"]


def test_refusals_that_wait_for_a_busy_loop_become_one_event_with_the_newest_of_them():
    async def main(clock: VirtualClock) -> None:
        bus = Bus(clock)
        refusals = Refusals(bus, clock, "zenoh")
        with bus.subscribe(EVENT, fifo(8)) as events:
            refusals.add(Reason.BAD_INPUT, "ann", "first")
            clock.spend(1.5)
            refusals.add(Reason.BAD_INPUT, "bob", "second")
            await clock.sleep(0.1)
            assert [(event.text, event.values["count"]) for event in events.drain()] == [("second", 1)]
            for name in ("ann", "bob", "cy"):
                refusals.add(Reason.BAD_INPUT, name, name)
            await clock.sleep(1.0)
            refusals.add(Reason.BAD_INPUT, "ann", "later")
            await clock.sleep(0.1)
            assert [(event.text, event.values["count"]) for event in events.drain()] == [("later", 4)]
        refusals.close()

    run_virtual(main)


def test_the_first_refusal_is_reported_at_once_as_one():
    async def main(clock: VirtualClock) -> None:
        bus = Bus(clock)
        refusals = Refusals(bus, clock, "zenoh")
        with bus.subscribe(EVENT, fifo(8)) as events:
            refusals.add(Reason.BAD_INPUT, "ann", "first")
            await clock.sleep(0.1)
            assert [(event.text, event.values["count"]) for event in events.drain()] == [("first", 1)]
        refusals.close()

    run_virtual(main)
