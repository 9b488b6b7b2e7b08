"""Blocking work in threads, and calls from threads back to the event loop."""

import asyncio
import threading
from collections import deque
from collections.abc import Awaitable, Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from functools import partial
from typing import Generic, Protocol, TypeVar

T = TypeVar("T")


class ThreadHop(Generic[T]):
    """Bounded queue from any thread to one loop, which delivers one item per iteration, so bursts delay no callbacks.

    Args:
        deliver: called on the loop for every item, in the order of ``put``.
        depth: maximum number of waiting items; beyond that the oldest one of the lowest rank is dropped.
        on_loss: called on the loop with the number dropped since the last delivery.
        rank: rank of an item; None: all are equal.
        discard: called with every undelivered item, on the loop or in the thread of a ``put``.
    """

    def __init__(
        self,
        deliver: Callable[[T], None],
        depth: int,
        on_loss: Callable[[int], None],
        rank: Callable[[T], int] | None = None,
        discard: Callable[[T], object] = lambda _: None,
    ) -> None:
        self._deliver = deliver
        self._depth = depth
        self._on_loss = on_loss
        self._rank = rank
        self._discard = discard
        self._items: deque[T] = deque()
        """Any thread may use the ends of the deque; items in the middle, and with ranks also the left end, need the
        lock.
        """
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._scheduled = False
        self._closed = False
        self._lost = 0

    def put(self, item: T) -> None:
        """Queue ``item``; callable from any thread, never blocks."""
        if self._closed:
            self._discard(item)
            return
        self._items.append(item)
        if len(self._items) > self._depth:
            self._make_room()
        if self._scheduled:
            return
        self._scheduled = True
        try:
            self._loop.call_soon_threadsafe(self._take)
        except RuntimeError:  # the loop was closed meanwhile
            if not self._closed:
                raise

    @property
    def waiting(self) -> int:
        """Items not delivered yet."""
        return len(self._items)

    def close(self) -> None:
        """Discard waiting and later items; call it while the loop lives."""
        self._closed = True

    def _make_room(self) -> None:
        with self._lock:
            if len(self._items) <= self._depth:
                return
            if self._rank is not None:
                # By number, because items may arrive meanwhile.
                ranks = [self._rank(self._items[i]) for i in range(len(self._items))]
                least = ranks.index(min(ranks))
                item: T | None = self._items[least]
                del self._items[least]
            else:
                item = self._pop()
            if item is not None:
                self._lost += 1
                self._discard(item)

    def _take(self) -> None:
        items = self._items
        if self._closed:
            with self._lock:
                while (item := self._pop()) is not None:
                    self._discard(item)
            return
        if self._rank is None:
            item = self._pop()
        else:
            with self._lock:
                item = self._pop()
        if not items:
            self._scheduled = False
        if items:  # a thread that still saw it scheduled may have added an item meanwhile
            self._scheduled = True
            self._loop.call_soon(self._take)
        if self._lost:
            with self._lock:
                lost, self._lost = self._lost, 0
            self._on_loss(lost)
        if item is not None:
            self._deliver(item)

    def _pop(self) -> T | None:
        try:
            return self._items.popleft()
        except IndexError:  # another thread was faster
            return None


async def in_thread(function: Callable[[], T]) -> T:
    """Run a blocking ``function`` off the loop, to its end even if the caller is cancelled meanwhile."""
    work = asyncio.ensure_future(asyncio.to_thread(function))
    try:
        return await asyncio.shield(work)
    except asyncio.CancelledError:
        await asyncio.gather(work, return_exceptions=True)  # no reader is left to report an error to
        raise


async def in_daemon_thread(function: Callable[[], T]) -> T:
    """Run a blocking ``function`` off the loop; neither a cancelled caller nor the process's end waits for it."""
    work: Future[T] = Future()

    def run() -> None:
        try:
            result = function()
        except BaseException as error:  # noqa: BLE001 - it is raised where the result is awaited
            outcome = partial(work.set_exception, error)
        else:
            outcome = partial(work.set_result, result)
        with suppress(RuntimeError, InvalidStateError):  # the loop was closed meanwhile, or the caller cancelled
            outcome()

    threading.Thread(target=run, name="offloaded", daemon=True).start()
    return await asyncio.wrap_future(work)


async def inline(function: Callable[[], T]) -> T:
    """Run ``function`` on the loop: for the virtual clock, which would advance while a thread works."""
    return function()


class Offload(Protocol):
    """Runner of blocking work: ``in_thread``, or ``inline`` on the virtual clock."""

    def __call__(self, function: Callable[[], T], /) -> Awaitable[T]:
        """Run ``function`` and wait for its result."""
