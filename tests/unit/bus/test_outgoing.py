import asyncio

import pytest

from monstertruck_runtime.clock import run_virtual
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import EVENT, HEALTH, ODOMETRY, POSE, Writer
from monstertruckd.bus.local import Bus
from monstertruckd.bus.outgoing import ROW, Outgoing
from tests.bus_kit import odometry


def delivered(scenario, seconds=0.02):
    """Topics and milliseconds: when they were sent, when delivered."""
    found = []

    async def main(clock):
        begin = clock.now()
        outgoing = Outgoing(
            seconds,
            lambda topic, _, at: found.append(
                (topic.name, round((at - begin) / 10**6), round((clock.now() - begin) / 10**6))
            ),
        )
        await scenario(lambda topic: outgoing.send(topic, None, clock.now()), outgoing, clock)

    run_virtual(main)
    return found


def test_frequent_messages_wait_for_each_other():
    async def scenario(send, _, clock):
        send(ODOMETRY)
        await clock.sleep(0.005)
        send(POSE)
        await clock.sleep(0.03)
        send(ODOMETRY)
        await clock.sleep(0.1)

    assert delivered(scenario) == [("state/odometry", 0, 20), ("state/pose", 5, 20), ("state/odometry", 35, 55)]


@pytest.mark.parametrize("rare", [HEALTH, EVENT])
def test_a_rare_message_leaves_at_once_behind_what_waits(rare):
    async def scenario(send, _, clock):
        send(ODOMETRY)
        await clock.sleep(0.005)
        send(rare)
        send(POSE)
        await clock.sleep(0.1)

    assert delivered(scenario) == [("state/odometry", 0, 5), (rare.name, 5, 5), ("state/pose", 5, 20)]


def test_a_long_row_leaves_in_several_turns_of_the_loop():
    found = []

    async def main(clock):
        outgoing = Outgoing(0.02, lambda *message: found.append(message))
        for number in range(2 * ROW + 1):
            outgoing.send(ODOMETRY, None, number)
        counts = []
        await clock.sleep(0.02)
        for _ in range(3):
            counts.append(len(found))
            await asyncio.sleep(0)
        assert counts == [ROW, 2 * ROW, 2 * ROW + 1]

    run_virtual(main)
    assert [at for _, _, at in found] == list(range(2 * ROW + 1))


def test_nothing_waits_if_it_is_told_so():
    async def scenario(send, _, clock):
        send(ODOMETRY)
        await clock.sleep(0.1)

    assert delivered(scenario, seconds=0.0) == [("state/odometry", 0, 0)]


def test_a_failure_loses_only_its_own_message():
    found = []

    def deliver(topic, _, __):
        if topic is ODOMETRY:
            raise OSError("full")
        found.append(topic.name)

    async def main(clock):
        outgoing = Outgoing(0.02, deliver)
        outgoing.send(ODOMETRY, None, 0)
        outgoing.send(POSE, None, 0)
        with pytest.raises(OSError, match="full"):
            outgoing.flush()
        asyncio.get_running_loop().set_exception_handler(lambda *_: None)
        outgoing.send(ODOMETRY, None, 0)
        outgoing.send(POSE, None, 0)
        await clock.sleep(0.1)

    run_virtual(main)
    assert found == ["state/pose", "state/pose"]


def test_readers_get_a_message_at_once_and_taps_in_rows():
    async def main(clock):
        bus = Bus(clock, 0.02)
        got, read = [], []
        out = bus.publisher(ODOMETRY, Writer.ESTIMATION)
        bus.listen(ODOMETRY, lambda message: read.append(message.seq))
        bus.tap(lambda topic, message, _, at: got.append((topic.name, message.seq, at)), [ODOMETRY, EVENT])
        first = clock.now()
        out.put(odometry(0))
        await clock.sleep(0.001)
        second = clock.now()
        out.put(odometry(1))
        assert (read, got) == ([0, 1], [])
        await clock.sleep(0.03)
        assert got == [("state/odometry", 0, first), ("state/odometry", 1, second)]

    run_virtual(main)


def test_a_tap_gets_what_was_published_before_its_end_and_nothing_from_before_its_begin():
    async def main(clock):
        bus = Bus(clock, 0.02)
        out = bus.publisher(ODOMETRY, Writer.ESTIMATION)
        early, late = [], []
        tap = bus.tap(lambda _t, message, *_: early.append(message.seq), [ODOMETRY])
        out.put(odometry(0))
        bus.tap(lambda _t, message, *_: late.append(message.seq), [ODOMETRY])
        out.put(odometry(1))
        tap.close()
        out.put(odometry(2))
        await clock.sleep(0.1)
        assert (early, late) == ([0, 1], [1, 2])

    run_virtual(main)


def test_an_event_is_not_held_back():
    async def main(clock):
        bus = Bus(clock, 0.02)
        got = []
        bus.tap(lambda _t, message, *_: got.append(type(message)), [EVENT])
        bus.event_sink()(Reason.DISARMED, Severity.INFO, "gate")
        assert got == [Event]

    run_virtual(main)


def test_who_is_told_may_have_all_that_waits_delivered():
    found = []

    def deliver(_, __, at):
        found.append(at)
        outgoing[0].flush()

    outgoing = []

    async def main(clock):
        asyncio.get_running_loop().set_exception_handler(lambda _, context: found.append(context))
        outgoing.append(Outgoing(0.02, deliver))
        for number in range(3):
            outgoing[0].send(POSE, None, number)
        await clock.sleep(0.1)

    run_virtual(main)
    assert found == [0, 1, 2]
