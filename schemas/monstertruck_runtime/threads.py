"""Between the event loop and threads: blocking work beside the loop, and the hop back onto it."""

import asyncio
import threading
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Generic, Protocol, TypeVar

T = TypeVar("T")


class ThreadHop(Generic[T]):
    """Bounded queue from any thread to one loop; a burst costs the loop a single wake-up.

    Args:
        deliver: called on the loop for every item, in the order of ``put``.
        depth: items that may wait; beyond that the oldest is lost.
        on_loss: told on the loop how many were lost since the last delivery.
    """

    def __init__(self, deliver: Callable[[T], None], depth: int, on_loss: Callable[[int], None]) -> None:
        self._deliver = deliver
        self._on_loss = on_loss
        self._items: deque[T] = deque(maxlen=depth)
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._scheduled = False
        self._closed = False
        self._lost = 0

    def put(self, item: T) -> None:
        """Queue ``item``; callable from any thread, never blocks."""
        with self._lock:
            if self._closed:
                return
            if len(self._items) == self._items.maxlen:
                self._lost += 1
            self._items.append(item)
            if not self._scheduled:
                self._scheduled = True
                self._loop.call_soon_threadsafe(self._drain)

    def close(self) -> None:
        """Discard what waits and everything to come; to be called while the loop lives."""
        with self._lock:
            self._closed = True
            self._items.clear()

    def _drain(self) -> None:
        with self._lock:
            self._scheduled = False
            batch = list(self._items)
            self._items.clear()
            lost, self._lost = self._lost, 0
        if lost:
            self._on_loss(lost)
        for item in batch:
            self._deliver(item)


async def in_thread(function: Callable[[], T]) -> T:
    """Run a blocking ``function`` beside the loop, to its end even if the caller is cancelled meanwhile."""
    work = asyncio.ensure_future(asyncio.to_thread(function))
    try:
        return await asyncio.shield(work)
    except asyncio.CancelledError:
        await asyncio.wait([work])
        raise


async def inline(function: Callable[[], T]) -> T:
    """Run ``function`` on the loop: for the virtual clock, whose time would run on beside a thread."""
    return function()


class Offload(Protocol):
    """Where blocking work is done: ``in_thread``, or ``inline`` on the virtual clock."""

    def __call__(self, function: Callable[[], T], /) -> Awaitable[T]:
        """Run ``function`` and wait for its result."""
        ...
