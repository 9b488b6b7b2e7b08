"""Mailboxes: delivery, counting, waking, closing; and the hop from foreign threads."""

import asyncio
import sys
import threading
import time
from collections import deque

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_runtime.threads import ThreadHop
from monstertruck_schemas.base import Message


def message(seq: int) -> Message:
    return Message(stamp=seq, received=seq, seq=seq)


async def test_latest_supersedes_without_counting():
    box: Mailbox[Message] = Mailbox(latest())
    for seq in range(5):
        box.put(message(seq))
    assert (await box.next()).seq == 4
    assert box.drops == 0
    box.lose(3)
    assert box.drops == 0


async def test_fifo_keeps_the_newest_in_order_and_counts():
    box: Mailbox[Message] = Mailbox(fifo(3))
    for seq in range(5):
        box.put(message(seq))
    assert [(await box.next()).seq for _ in range(3)] == [2, 3, 4]
    assert box.drops == 2
    box.lose(3)
    assert box.drops == 5


async def test_draining_takes_what_is_unread_without_waiting():
    box: Mailbox[Message] = Mailbox(fifo(3))
    assert box.drain() == []
    for seq in range(4):
        box.put(message(seq))
    assert [m.seq for m in box.drain()] == [1, 2, 3]
    assert box.drain() == []
    assert box.latest is not None
    box.put(message(9))
    assert (await box.next()).seq == 9


def test_a_wait_with_a_limit_ends_with_a_message_or_at_its_time():
    async def main(clock: VirtualClock) -> list[tuple[int | None, int]]:
        box: Mailbox[Message] = Mailbox(fifo(3))
        start, found = clock.now(), []
        for seq, due in ((0, 0.25), (1, 0.5)):
            asyncio.get_running_loop().call_later(due, box.put, message(seq))
        for limit in (0.1, 1.0, -1.0, 1.0):
            got = await box.next_within(limit)
            found.append((None if got is None else got.seq, round((clock.now() - start) / 1e7)))
        box.put(message(2))
        assert await box.next_within(-1.0) == message(2)
        asyncio.get_running_loop().call_later(0.1, box.close)
        with pytest.raises(RuntimeError, match="closed"):
            await box.next_within(1.0)
        return found

    assert run_virtual(main) == [(None, 10), (0, 25), (None, 25), (1, 50)]


def test_a_message_that_is_taken_on_its_way_wakes_nobody_and_counts_as_read():
    async def main(clock: VirtualClock) -> None:
        box: Mailbox[Message] = Mailbox(latest())
        loop, offered = asyncio.get_running_loop(), []

        def take(given: Message) -> bool:
            assert given is box.latest
            offered.append(given.seq)
            return given.seq < 2

        for seq in range(3):
            loop.call_later(0.1 + 0.1 * seq, box.put, message(seq))
        start = clock.now()
        got = await box.next_within(1.0, take)
        assert got == message(2)
        assert round((clock.now() - start) / SECOND, 2) == 0.3
        assert await box.next_within(0.05, take) is None
        box.put(message(5))
        assert await box.next_within(0.05, take) == message(5), "nobody waited when it came"
        loop.call_later(0.1, box.put, message(0))
        assert await box.next_within(0.2, take) is None
        assert offered == [0, 1, 2, 0]
        assert box.latest == message(0)
        assert box.drops == 0

    run_virtual(main)


async def test_a_bug_in_taking_is_the_readers_not_the_writers():
    box: Mailbox[Message] = Mailbox(latest())
    reader = asyncio.create_task(box.next_within(1.0, lambda _: 1 // 0 > 0))
    await asyncio.sleep(0)
    box.put(message(0))
    box.put(message(1))
    with pytest.raises(ZeroDivisionError):
        await reader


def test_a_fifo_needs_room():
    with pytest.raises(ValueError, match="at least one"):
        fifo(0)


async def test_reading_latest_consumes_nothing():
    box: Mailbox[Message] = Mailbox(fifo(2))
    assert box.latest is None
    first = message(0)
    box.put(first)
    assert box.latest is first
    assert await box.next() is first
    assert box.latest is first


async def test_next_waits_and_a_cancelled_wait_loses_nothing():
    box: Mailbox[Message] = Mailbox(latest())
    waiting = asyncio.create_task(box.next())
    await asyncio.sleep(0)
    box.put(message(1))
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    assert (await box.next()).seq == 1


async def test_a_mailbox_has_one_reader():
    box: Mailbox[Message] = Mailbox(latest())
    waiting = asyncio.create_task(box.next())
    await asyncio.sleep(0)
    with pytest.raises(RuntimeError, match="one reader"):
        await box.next()
    with pytest.raises(RuntimeError, match="one reader"):
        await anext(aiter(box))
    box.put(message(1))
    await waiting


async def test_close_ends_iteration_and_tells_once():
    reported: list[Mailbox[Message]] = []
    box: Mailbox[Message] = Mailbox(fifo(4), reported.append)
    box.put(message(0))

    async def read() -> list[int]:
        return [m.seq async for m in box]

    reading = asyncio.create_task(read())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    with box:
        pass
    box.close()
    box.put(message(1))
    assert await reading == [0]
    assert reported == [box]
    assert [m async for m in box] == []
    with pytest.raises(RuntimeError, match="closed"):
        await box.next()


def test_readers_wake_in_the_order_of_delivery():
    async def main(_: VirtualClock) -> list[str]:
        boxes = {name: Mailbox[Message](latest()) for name in "abcde"}
        woken: list[str] = []

        async def read(name: str) -> None:
            await boxes[name].next()
            woken.append(name)

        tasks = [asyncio.create_task(read(name)) for name in "edcba"]
        await asyncio.sleep(0)
        for box in boxes.values():
            box.put(message(0))
        await asyncio.gather(*tasks)
        return woken

    assert run_virtual(main) == list("abcde")


async def test_a_burst_from_a_thread_wakes_the_loop_once_and_keeps_order():
    loop = asyncio.get_running_loop()
    wakes = 0
    original = loop.call_soon_threadsafe

    def counting(*args, **kwargs):
        nonlocal wakes
        wakes += 1
        return original(*args, **kwargs)

    loop.call_soon_threadsafe = counting
    got: list[int] = []
    lost: list[int] = []
    hop: ThreadHop[int] = ThreadHop(got.append, 100, lost.append)
    thread = threading.Thread(target=lambda: [hop.put(i) for i in range(50)])
    thread.start()
    thread.join()  # the loop cannot run meanwhile
    assert wakes == 1
    await asyncio.sleep(0.01)
    assert got == list(range(50))
    assert lost == []


async def test_a_full_hop_loses_the_oldest_and_says_how_many():
    got: list[int] = []
    lost: list[int] = []
    hop: ThreadHop[int] = ThreadHop(got.append, 3, lost.append)
    for i in range(5):
        hop.put(i)
    for taken in ([2], [2, 3], [2, 3, 4], [2, 3, 4]):  # one in each iteration of the event loop
        await asyncio.sleep(0)
        assert got == taken
    assert lost == [2]
    hop.put(5)
    hop.close()
    hop.put(6)
    await asyncio.sleep(0)
    assert got == [2, 3, 4]


@pytest.mark.parametrize("rank", [None, lambda _: 0])
async def test_a_thread_that_makes_room_late_may_take_the_last_item(rank):
    class Raced(deque[int]):
        """The sender has seen more than one item before; it makes room once the loop has found one to take."""

        def __bool__(self) -> bool:
            if (found := len(self) > 0) and self[0] == 1:
                self.popleft()
            return found

    got: list[int] = []
    hop: ThreadHop[int] = ThreadHop(got.append, 1, lambda _: None, rank)
    hop._items = Raced()
    for item in (1, 2):
        hop.put(item)
        await asyncio.sleep(0.01)
    assert got[-1:] == [2]


@pytest.mark.parametrize("rank", [None, lambda item: item[0] % 3])
async def test_what_several_threads_send_arrives_in_their_order_or_is_counted(rank):
    senders, count = 4, 3000
    got: list[tuple[int, int]] = []
    lost: list[int] = []
    hop: ThreadHop[tuple[int, int]] = ThreadHop(got.append, 5, lost.append, rank)

    def send(sender: int) -> None:
        for number in range(count):
            hop.put((sender, number))
            if number % 100 == 0:
                time.sleep(0.0005)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=send, args=(sender,)) for sender in range(senders)]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            await asyncio.sleep(0)
    finally:
        sys.setswitchinterval(interval)
    for sender in range(senders):
        await asyncio.sleep(0.01)  # nothing waits any more
        hop.put((sender, count))
    await asyncio.sleep(0.01)
    assert [item for item in got if item[1] == count] == [(sender, count) for sender in range(senders)]
    assert len(got) + sum(lost) == senders * (count + 1)
    for sender in range(senders):
        numbers = [number for who, number in got if who == sender]
        assert numbers == sorted(set(numbers))


async def test_a_full_hop_loses_the_least_valuable_first():
    got: list[int] = []
    hop: ThreadHop[int] = ThreadHop(got.append, 3, lambda _: None, rank=lambda item: item // 10)
    for i in (20, 1, 10, 2, 11, 3, 21, 4):
        hop.put(i)
    for _ in range(4):
        await asyncio.sleep(0)
    assert got == [20, 11, 21]


@pytest.mark.parametrize("rank", [None, lambda _: 0])
async def test_what_a_hop_does_not_deliver_is_handed_back(rank):
    got: list[int] = []
    discarded: list[int] = []
    hop: ThreadHop[int] = ThreadHop(got.append, 3, lambda _: None, rank, discarded.append)
    for i in range(5):
        hop.put(i)
    await asyncio.sleep(0)
    hop.close()
    hop.put(5)
    await asyncio.sleep(0)
    assert got == [2]
    assert sorted(discarded) == [0, 1, 3, 4, 5]
