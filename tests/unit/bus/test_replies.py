"""Replies wait for their stations in threads of their own, and in a bounded number."""

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Self

import pytest
import zenoh

from monstertruck_runtime.client import TruckClient
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import MAP, Writer
from monstertruckd.bus.replies import THREADS, Replies
from tests.bus_kit import gate_state, running_robot
from tests.unit.bus.test_zenoh_frozen import other_station
from tests.unit.bus.test_zenoh_session import GRID


class Question:
    """Query of a station that takes nothing until ``taken`` is set."""

    def __init__(self, taken: threading.Event | None = None) -> None:
        self._taken = taken
        self.answers: list[int] = []
        """Threads in which it was answered."""
        self.ended = threading.Event()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._taken is not None:
            self._taken.wait(10.0)
        self.ended.set()


def answer(query: Question) -> None:
    query.answers.append(threading.get_ident())


def test_neither_replies_nor_finals_are_sent_where_the_query_ends():
    replies, answered, dropped = Replies(), Question(), Question()
    replies.end(answered, answer)
    replies.end(dropped)
    replies.close()
    assert answered.ended.is_set()
    assert len(answered.answers) == 1
    assert answered.answers[0] != threading.get_ident()
    assert dropped.ended.is_set()
    assert dropped.answers == []


def test_answers_to_orders_wait_behind_no_others():
    replies, taken, order = Replies(), threading.Event(), Question()
    stuck = [Question(taken) for _ in range(3 * THREADS)]
    for number, query in enumerate(stuck):
        replies.end(query, answer, f"s{number}")
    replies.end(order, answer, "s0", order=True)
    assert order.ended.wait(5.0)
    assert not any(query.ended.is_set() for query in stuck)
    taken.set()
    replies.close()
    assert all(query.ended.is_set() for query in stuck)


def test_an_owner_has_one_reply_under_way_and_holds_up_no_other():
    replies, taken, other = Replies(), threading.Event(), Question()
    begun = []
    stuck = [Question(taken) for _ in range(2 * THREADS)]
    for number, query in enumerate(stuck):
        replies.end(query, begun.append, f"ann:{number}")
    replies.end(other, answer, "bob")
    assert other.ended.wait(5.0)
    assert begun == stuck[:1]
    taken.set()
    replies.close()
    assert begun == stuck


def test_where_too_many_wait_no_more_are_taken_until_one_has_left(monkeypatch: pytest.MonkeyPatch):
    replies, taken = Replies(), threading.Event()
    monkeypatch.setattr(replies, "_most", 20)
    for _ in range(19):
        replies.end(Question(taken))
    replies.wait_for_room()
    replies.end(Question(taken))
    with ThreadPoolExecutor() as pool:
        room = pool.submit(replies.wait_for_room)
        with pytest.raises(TimeoutError):
            room.result(0.1)
        taken.set()
        room.result(5.0)
    replies.close()


def test_a_reply_that_fails_is_logged_unless_the_station_has_left(caplog: pytest.LogCaptureFixture):
    def left(_: Question) -> None:
        raise zenoh.ZError("gone")

    replies, queries = Replies(), [Question(), Question()]
    replies.end(queries[0], left)
    replies.end(queries[1], lambda _: 1 / 0)
    replies.close()
    assert all(query.ended.is_set() for query in queries)
    assert [record.message for record in caplog.records if record.levelname == "ERROR"] == ["reply: bug"]
    replies.end(queries[0])  # after the end of all sessions nothing is sent


async def test_a_station_that_takes_nothing_and_asks_does_not_hold_up_the_loop():
    async with running_robot(deadline=5.0) as robot:

        async def estop(_: object) -> dict[str, object]:
            return gate_state(2).model_dump(mode="json")

        robot.rpc.register("estop", estop, AccessRole.OBSERVER)
        loop = asyncio.get_running_loop()
        longest = 0.0

        async def watch() -> None:
            nonlocal longest
            while True:
                start = loop.time()
                await asyncio.sleep(0.005)
                longest = max(longest, loop.time() - start)

        maps = robot.bus.publisher(MAP, Writer.ESTIMATION)
        async with TruckClient(endpoint=robot.endpoint) as client, other_station("asker", robot.endpoint) as asker:
            for _ in range(60):
                maps.put(GRID)
                await asyncio.sleep(0.02)
            watching = asyncio.create_task(watch())
            assert asker.stdin is not None
            asker.stdin.write(b"\n")
            asker.stdin.flush()
            assert asker.stdout is not None
            assert await asyncio.to_thread(asker.stdout.readline) == b"asked\n"
            async with asyncio.timeout(10):
                for _ in range(20):
                    await client.call("estop")
                    await asyncio.sleep(0.1)
            watching.cancel()
    assert longest < 1.0, "Zenoh waits 2 s for room"
