"""Answers to stations, sent by separate threads.

A reply, and the final message of a query that is dropped, waits for room in the queue to its station: 2 s if the
station reads nothing. Neither the event loop nor the receiving threads may block for that long.

While Zenoh closes the connection to a station, it serves no other station, and this takes 2 s more for each further
thread that still waits for room: 14 s with eight threads. So each owner may have only one reply in progress. Queries
without a source share one: Zenoh does not report the session of a query, and a client's own claims prove nothing.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Final

import zenoh

from monstertruck_schemas.topics import owner_of
from monstertruckd.bus.access import ANONYMOUS

log = logging.getLogger(__name__)

THREADS: Final = 8
"""Replies under way at once, each to another owner; as many further ones to orders."""

Reply = Callable[[zenoh.Query], object]
"""Sends replies to a query."""


class Replies:
    """Ends queries: sends their replies and their final messages."""

    def __init__(self) -> None:
        self._orders = ThreadPoolExecutor(THREADS, "order-replies")
        self._others = ThreadPoolExecutor(THREADS, "replies")
        self._change = threading.Condition()
        self._waiting, self._most = 0, 4096  # queries that wait for their reply; the next is taken when one has left
        self._queues: dict[tuple[str, bool], deque[tuple[zenoh.Query, Reply | None]]] = {}
        """Waiting replies by owner, orders separate; the first of each is under way."""

    def wait_for_room(self) -> None:
        """Wait until there is room for another reply; must not be called on the event loop."""
        with self._change:
            self._change.wait_for(lambda: self._waiting < self._most)

    def end(
        self, query: zenoh.Query, reply: Reply | None = None, source: str | None = None, *, order: bool = False
    ) -> None:
        """Reply to the query and end it, without waiting; may be called from any thread.

        Args:
            query: query to end; must not be used afterwards.
            reply: the reply; None to end the query without an answer.
            source: caller; None if the query names no source.
            order: whether the query is an order: replies to orders do not wait behind the others.
        """
        key = owner_of(source or ANONYMOUS), order
        with self._change:
            self._waiting += 1
            queue = self._queues.setdefault(key, deque())
            queue.append((query, reply))
            if len(queue) > 1:
                return
        with suppress(RuntimeError):  # closed meanwhile
            (self._orders if order else self._others).submit(self._end_all, key)

    def close(self) -> None:
        """Wait for all replies; once the sessions are closed, they fail immediately."""
        for pool in (self._orders, self._others):
            pool.shutdown()

    def _end_all(self, key: tuple[str, bool]) -> None:
        queue = self._queues[key]
        while True:
            _end(*queue[0])
            with self._change:
                queue.popleft()
                self._waiting -= 1
                self._change.notify_all()
                if not queue:
                    del self._queues[key]
                    return


def _end(query: zenoh.Query, reply: Reply | None) -> None:
    try:
        with query:
            if reply is not None:
                reply(query)
    except zenoh.ZError as error:  # the station has left
        log.debug("no reply: %s", error)
    except Exception:
        log.exception("reply: bug")
