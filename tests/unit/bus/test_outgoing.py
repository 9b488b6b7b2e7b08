import asyncio

import pytest

from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import EVENT, MAP, ODOMETRY, POSE, Writer
from monstertruckd.bus.local import Bus
from monstertruckd.bus.outgoing import BATCH, BEHIND, Outgoing
from tests.bus_kit import gate_state, odometry


def delivered(scenario, seconds=0.02):
    """Topics and milliseconds: when they were sent, when delivered."""
    found = []

    async def main(clock):
        begin = clock.now()
        outgoing = Outgoing(
            seconds,
            lambda row: found.extend(
                (topic.name, round((at - begin) / 10**6), round((clock.now() - begin) / 10**6)) for topic, _, at in row
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

    assert delivered(scenario) == [("state/odometry", 0, 21), ("state/pose", 5, 21), ("state/odometry", 35, 41)]


@pytest.mark.parametrize("rare", [MAP, EVENT])
def test_a_rare_message_leaves_at_once_behind_what_waits(rare):
    async def scenario(send, _, clock):
        send(ODOMETRY)
        await clock.sleep(0.005)
        send(rare)
        send(POSE)
        await clock.sleep(0.1)

    assert delivered(scenario) == [("state/odometry", 0, 5), (rare.name, 5, 5), ("state/pose", 5, 21)]


def test_a_long_row_leaves_in_several_turns_of_the_loop():
    found = []

    async def main(clock):
        outgoing = Outgoing(0.02, found.extend)
        for number in range(2 * BATCH + 1):
            outgoing.send(ODOMETRY, None, number)
        counts = []
        await clock.sleep_until(2 * SECOND // 100 + clock.now() + BEHIND)
        for _ in range(3):
            counts.append(len(found))
            await asyncio.sleep(0)
        assert counts == [BATCH, 2 * BATCH, 2 * BATCH + 1]

    run_virtual(main)
    assert [at for _, _, at in found] == list(range(2 * BATCH + 1))


def test_nothing_waits_if_it_is_configured_so():
    async def scenario(send, _, clock):
        send(ODOMETRY)
        await clock.sleep(0.1)

    assert delivered(scenario, seconds=0.0) == [("state/odometry", 0, 0)]


def test_after_a_failure_the_rest_is_delivered_all_the_same():
    found = []

    def deliver(row):
        found.extend(at for _, _, at in row)
        if found[0] == 0 and len(found) == BATCH:
            raise OSError("full")

    async def main(clock):
        errors = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context["exception"]))
        outgoing = Outgoing(0.02, deliver)
        for number in range(BATCH + 1):
            outgoing.send(ODOMETRY, None, number)
        await clock.sleep(0.1)
        assert [str(error) for error in errors] == ["full"]

    run_virtual(main)
    assert found == list(range(BATCH + 1))


def test_what_was_sent_while_a_row_failed_leaves_in_the_next_turn():
    found = []

    async def main(clock):
        def deliver(row):
            found.extend(at for _, _, at in row)
            if found == [0]:
                outgoing.send(EVENT, None, 1)
                raise OSError("full")

        outgoing = Outgoing(0.0, deliver)
        with pytest.raises(OSError, match="full"):
            outgoing.send(EVENT, None, 0)
        assert found == [0]
        await asyncio.sleep(0)

    run_virtual(main)
    assert found == [0, 1]


def test_a_message_that_cannot_be_encoded_costs_no_other_one():
    async def main(clock):
        asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context["exception"]))
        bus = Bus(clock, 0.02)
        bus.tap(lambda _t, message, *_: got.append(message.seq), [POSE, ODOMETRY, EVENT])
        out = bus.publisher(POSE, Writer.ESTIMATION)
        out.put(odometry(0))
        try:
            bus.publisher(ODOMETRY, Writer.ESTIMATION).put(gate_state(1))
        except ValueError as error:
            errors.append(error)
        out.put(odometry(2))
        await clock.sleep(0.1)

    got, errors = [], []
    run_virtual(main)
    assert got == [0, 2]
    assert len(errors) == 1


def test_a_bug_of_a_tap_costs_neither_its_other_messages_nor_other_taps():
    def broken(_topic, message, *_):
        got.append(("broken", message.seq))
        if message.seq == 0:
            raise OSError("no memory")

    async def main(clock):
        asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context["exception"]))
        bus = Bus(clock, 0.02)
        bus.tap(broken, [ODOMETRY])
        bus.tap(lambda _topic, message, *_: got.append(("sound", message.seq)), [ODOMETRY])
        out = bus.publisher(ODOMETRY, Writer.ESTIMATION)
        for number in range(2):
            out.put(odometry(number))
        await clock.sleep(0.1)

    got, errors = [], []
    run_virtual(main)
    assert got == [("broken", 0), ("broken", 1), ("sound", 0), ("sound", 1)]
    assert [str(error) for error in errors] == ["no memory"]


def test_a_tap_that_ends_in_the_middle_of_a_row_gets_no_more_of_it():
    async def main(clock):
        def once(_topic, message, *_):
            got.append(message.seq)
            tap.close()

        bus = Bus(clock, 0.02)
        tap = bus.tap(once, [ODOMETRY])
        out = bus.publisher(ODOMETRY, Writer.ESTIMATION)
        for number in range(3):
            out.put(odometry(number))
        await clock.sleep(0.1)

    got = []
    run_virtual(main)
    assert got == [0]


def test_each_tap_gets_a_row_before_what_it_makes_others_publish():
    async def main(clock):
        bus = Bus(clock, 0.02)
        events = bus.event_sink()

        def complain(_topic, message, *_):
            if message.seq == 0:
                events(Reason.DISARMED, Severity.INFO, "tap")

        bus.tap(complain, [ODOMETRY])
        bus.tap(lambda topic, *_: got.append(topic.name), [ODOMETRY, EVENT])
        out = bus.publisher(ODOMETRY, Writer.ESTIMATION)
        for number in range(2):
            out.put(odometry(number))
        await clock.sleep(0.1)

    got = []
    run_virtual(main)
    assert got == ["state/odometry", "state/odometry", "event/event"]


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


def test_who_is_informed_may_have_all_that_waits_delivered():
    found = []

    def deliver(row):
        found.extend(at for _, _, at in row)
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
