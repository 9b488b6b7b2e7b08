"""In-process hand-over: who may write, who gets what, in which order, with which bytes."""

import asyncio
import subprocess
import sys

import pytest

from monstertruck_runtime import wire
from monstertruck_runtime.clock import VirtualClock, WallClock, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, Order, Role
from monstertruck_schemas.topics import CMD_DRIVE, EVENT, GATE, PATH, POSE, REQ_CONTROL, TOPICS, Writer
from monstertruckd.bus.local import Bus
from tests.bus_kit import gate_state, odometry


@pytest.fixture
def bus() -> Bus:
    return Bus(WallClock())


async def test_the_object_itself_reaches_every_reader(bus: Bus):
    boxes = [bus.subscribe(POSE, latest()), bus.subscribe(POSE, fifo(2))]
    pose = odometry(0)
    bus.publisher(POSE, Writer.ESTIMATION).put(pose)
    assert [await box.next() is pose for box in boxes] == [True, True]


def test_only_the_tables_writer_gets_the_write_end_and_only_once(bus: Bus):
    with pytest.raises(RuntimeError, match="written by estimation, not by planner"):
        bus.publisher(POSE, Writer.PLANNER)
    bus.publisher(POSE, Writer.ESTIMATION)
    with pytest.raises(RuntimeError, match="already has a writer"):
        bus.publisher(POSE, Writer.ESTIMATION)


@pytest.mark.parametrize("topic", [CMD_DRIVE, REQ_CONTROL, EVENT], ids=lambda t: t.name)
def test_commands_requests_and_events_have_no_plain_write_end(bus: Bus, topic):
    with pytest.raises(RuntimeError, match="cannot be written directly"):
        bus.publisher(topic, topic.writer)


def test_actuators_are_handed_out_exactly_once(bus: Bus):
    (drive, second), steering = bus.actuators(2)
    assert (drive.next_seq(), drive.next_seq(), second.next_seq(), steering.next_seq()) == (0, 1, 0, 0)
    with pytest.raises(RuntimeError, match="already has a writer"):
        bus.actuators()


async def test_late_readers_of_retained_topics_get_the_newest_at_once(bus: Bus):
    publisher = bus.publisher(GATE, Writer.GATE)
    assert bus.newest(GATE) is None
    publisher.put(gate_state(0))
    publisher.put(newest := gate_state(1))
    box = bus.subscribe(GATE, fifo(5))
    assert await box.next() is newest
    assert bus.newest(GATE) is newest


async def test_late_readers_of_other_topics_get_nothing(bus: Bus):
    bus.publisher(POSE, Writer.ESTIMATION).put(odometry(0))
    assert bus.subscribe(POSE, latest()).latest is None
    assert bus.newest(POSE) is None


def test_drops_are_summed_over_open_and_closed_readers(bus: Bus):
    publisher = bus.publisher(POSE, Writer.ESTIMATION)
    with bus.subscribe(POSE, fifo(1)):
        for seq in range(3):
            publisher.put(odometry(seq))
    still = bus.subscribe(POSE, fifo(1))
    bus.subscribe(POSE, latest())
    for seq in range(3):
        publisher.put(odometry(seq))
    bus.add_drops(10)
    assert still.drops == 2
    assert bus.drops == 2 + 2 + 10


def test_a_closed_reader_gets_nothing_more(bus: Bus):
    box = bus.subscribe(POSE, latest())
    box.close()
    bus.publisher(POSE, Writer.ESTIMATION).put(odometry(0))
    assert box.latest is None


def test_readers_wake_in_subscription_order_on_the_virtual_loop():
    async def main(clock: VirtualClock) -> list[int]:
        bus = Bus(clock)
        woken: list[int] = []
        boxes = [bus.subscribe(POSE, latest()) for _ in range(20)]

        async def read(number: int) -> None:
            async for _ in boxes[number]:
                woken.append(number)  # noqa: PERF401  # order of waking matters

        tasks = [asyncio.create_task(read(number)) for number in reversed(range(20))]
        publisher = bus.publisher(POSE, Writer.ESTIMATION)
        for seq in range(3):
            await clock.sleep(0.02)
            publisher.put(odometry(seq))
        await clock.sleep(0.02)
        for box in boxes:
            box.close()
        await asyncio.gather(*tasks)
        return woken

    assert run_virtual(main) == 3 * list(range(20))


def test_taps_share_one_encoding_and_untapped_topics_are_not_encoded(bus: Bus):
    got: list[tuple[str, str, int, bytes]] = []
    taps = [
        bus.tap(lambda topic, m, data, _, who=who: got.append((who, topic.name, m.seq, data)), [POSE, GATE])
        for who in ("recorder", "zenoh")
    ]
    pose = bus.publisher(POSE, Writer.ESTIMATION)
    pose.put(odometry(0))
    bus.publisher(PATH, Writer.PLANNER).put(Path(stamp=0, received=0, seq=0, poses=[1.0], directions=[]))
    assert [row[:3] for row in got] == [("recorder", "state/pose", 0), ("zenoh", "state/pose", 0)]
    assert got[0][3] is got[1][3]
    assert wire.decode(POSE, got[0][3]) == odometry(0)

    taps[0].close()
    taps[0].close()
    pose.put(odometry(1))
    assert [row[0] for row in got[2:]] == ["zenoh"]


def test_a_tap_starts_with_what_is_retained_of_its_topics(bus: Bus):
    bus.publisher(GATE, Writer.GATE).put(state := gate_state(3))
    got: list[tuple[str, int]] = []
    bus.tap(lambda topic, m, *_: got.append((topic.name, m.seq)), TOPICS)
    assert got == [("state/gate", 3)]
    bus.tap(lambda topic, m, *_: got.append((topic.name, m.seq)), [POSE])
    assert len(got) == 1
    assert list(bus.retained()) == [(GATE, state, wire.encode(GATE, state))]


def test_requests_come_in_from_outside_with_the_daemons_time_of_receipt():
    async def main(clock: VirtualClock) -> tuple[ControlRequest, int]:
        bus = Bus(clock)
        box = bus.subscribe(REQ_CONTROL, fifo(1))
        taps: list[int] = []
        bus.tap(lambda _t, m, *_: taps.append(m.received), [REQ_CONTROL])
        claim = ControlRequest(
            stamp=5, received=2**62, seq=1, source="a", role=Role.STATION, lease=0.5, nonce="", order=Order.ARM
        )
        bus.inject(REQ_CONTROL, claim)
        assert taps == [clock.now()]
        return await box.next(), clock.now()

    request, now = run_virtual(main)
    assert request.received == now
    assert (request.stamp, request.order) == (5, Order.ARM)


def test_nothing_else_can_be_injected(bus: Bus):
    with pytest.raises(RuntimeError, match="not from outside"):
        bus.inject(POSE, odometry(0))


def test_all_services_share_one_event_topic(bus: Bus):
    events = bus.subscribe(EVENT, fifo(5))
    first, second = bus.event_sink(), bus.event_sink()
    first(Reason.DEVICE_LOST, Severity.ERROR, "lidar", "gone", port=3)
    second(Reason.NOT_FINITE, Severity.WARNING, "gate", speed=float("nan"), front=float("-inf"), ok=True, none=None)
    newest = events.latest
    assert newest is not None
    assert newest.seq == 1
    assert newest.values == {"speed": "nan", "front": "-inf", "ok": True, "none": None}
    assert wire.decode(EVENT, wire.encode(EVENT, newest)) == newest


def test_the_local_bus_does_not_load_zenoh():
    code = "import sys, monstertruckd.bus.local; sys.exit('zenoh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
