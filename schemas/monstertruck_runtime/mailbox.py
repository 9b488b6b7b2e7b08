"""Mailboxes: read ends of topics, whose delivery is chosen by the reader."""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

from monstertruck_schemas.base import Message

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class Delivery:
    """Maximum number of unread messages, and whether dropping the oldest counts as a loss.

    See ``latest`` and ``fifo``.
    """

    depth: int
    counted: bool


def latest() -> Delivery:
    """Keep only the latest message; replaced messages do not count as lost."""
    return Delivery(1, counted=False)


def fifo(depth: int) -> Delivery:
    """Keep up to ``depth`` messages in order; beyond that the oldest is dropped and counted."""
    if depth < 1:
        raise ValueError(f"a FIFO holds at least one message, got {depth}")
    return Delivery(depth, counted=True)


class Mailbox(Generic[M]):
    """Subscription of one reader; iterate it, or await ``next()``.

    Args:
        delivery: queueing of messages while the reader is busy.
        on_close: called once when the mailbox is closed.
    """

    def __init__(self, delivery: Delivery, on_close: Callable[["Mailbox[M]"], None] = lambda _: None) -> None:
        self._unread: deque[M] = deque(maxlen=delivery.depth)
        self._counted = delivery.counted
        self._on_close = on_close
        self._latest: M | None = None
        self._drops = 0
        self._reader: asyncio.Future[bool] | None = None
        self._take: Callable[[M], bool] | None = None
        self._closed = False

    @property
    def latest(self) -> M | None:
        """Latest message, or None before the first; reading it does not consume it."""
        return self._latest

    @property
    def drops(self) -> int:
        """Number of messages lost because the FIFO was full."""
        return self._drops

    def lose(self, count: int) -> None:
        """Count messages lost before they reached this mailbox."""
        if self._counted:
            self._drops += count

    def put(self, message: M) -> None:
        """Deliver ``message``; never blocks. A waiting reader runs in the next loop iteration."""
        if self._closed:
            return
        self._latest = message
        if self._counted and len(self._unread) == self._unread.maxlen:
            self._drops += 1
        self._unread.append(message)
        reader = self._reader
        if reader is not None and not reader.done():
            if self._take is None:
                reader.set_result(True)
            else:
                self._offer(message, reader, self._take)

    async def next(self) -> M:
        """Wait for a message not returned by ``next`` yet.

        Raises:
            RuntimeError: the mailbox is closed, or another task already waits on it.
        """
        while not self._unread:
            if self._closed:
                raise RuntimeError("the subscription is closed")
            await self._news()
        return self._unread.popleft()

    async def next_within(self, seconds: float, take: Callable[[M], bool] | None = None) -> M | None:
        """Return as ``next`` does, or None if no message arrives within ``seconds``.

        A timer costs much less than a deadline, which has to cancel its task, and ``take`` much less than a wake-up.

        Args:
            seconds: timeout, s.
            take: called immediately with a message that arrives during the wait, in its writer's callback; if it
                returns True the wait continues, and the message counts as read.

        Raises:
            RuntimeError: as for ``next``.
            Exception: raised by ``take``.
        """
        due = asyncio.get_running_loop().time() + max(seconds, 0.0)
        while not self._unread and not self._closed:
            if not await self._news(due, take):
                return None
        return await self.next()

    def drain(self) -> list[M]:
        """Return all unread messages, oldest first, without waiting."""
        unread = list(self._unread)
        self._unread.clear()
        return unread

    def close(self) -> None:
        """End the subscription; unread messages are discarded and iteration ends. Repeated calls have no effect."""
        if self._closed:
            return
        self._closed = True
        self._unread.clear()
        if self._reader is not None:
            _answer(self._reader, True)
        self._on_close(self)

    async def _news(self, due: float | None = None, take: Callable[[M], bool] | None = None) -> bool:
        """Wait for the next message or the end; return False if ``due`` (loop time) came first."""
        if self._reader is not None:
            raise RuntimeError("a subscription has only one reader; subscribe again for another")
        loop = asyncio.get_running_loop()
        reader: asyncio.Future[bool] = loop.create_future()
        self._reader, self._take = reader, take
        alarm = None if due is None else loop.call_at(due, _answer, reader, False)
        try:
            return await reader
        finally:
            self._reader = None
            if alarm is not None:
                alarm.cancel()

    def _offer(self, message: M, reader: "asyncio.Future[bool]", take: Callable[[M], bool]) -> None:
        try:
            taken = take(message)
        except Exception as bug:  # noqa: BLE001  # the reader fails, not the writer
            reader.set_exception(bug)
        else:
            if taken:
                self._unread.clear()
            else:
                reader.set_result(True)

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> M:
        while not self._unread:
            if self._closed:
                raise StopAsyncIteration
            await self._news()
        return self._unread.popleft()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _answer(reader: asyncio.Future[bool], news: bool) -> None:
    if not reader.done():
        reader.set_result(news)
