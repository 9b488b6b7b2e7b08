"""Transactions over a link that resume in the callback that delivers the next bytes.

In a byte-by-byte handshake, a coroutine needs one task wake-up per byte; here a generator receives the bytes directly.
"""

import asyncio
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Final, Generic, NamedTuple, TypeVar

from monstertruck_drivers.link import Link
from monstertruck_runtime.errors import DeviceLostError, DeviceTimeoutError, ProtocolError

T = TypeVar("T")

MISSES: Final = 3
"""Default number of consecutive exchanges without a usable answer after which a session ends."""


class Misses:
    """Context for consecutive exchanges: suppresses answer errors until ``limit`` occur in a row.

    Args:
        limit: number of consecutive exchanges without a usable answer that ends the session.
    """

    def __init__(self, limit: int = MISSES) -> None:
        self._limit = limit
        self.count = 0
        """Number of consecutive failed exchanges."""

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        failed = isinstance(error, (DeviceTimeoutError, ProtocolError))
        self.count = self.count + 1 if failed else 0
        return failed and self.count < self._limit


class WaitFor(NamedTuple):
    """Wait condition of a transaction: ``size`` bytes within a time (s); if the size is 0, only the time."""

    size: int
    within: float


Steps = Generator[WaitFor, bytes, T]
"""Yields wait conditions and receives the bytes; ``TimeoutError`` and ``DeviceLostError`` are thrown in."""


class Transaction(Generic[T]):
    """One transaction; it starts immediately and runs to its end, whether or not a task waits for it.

    Args:
        link: link whose only reader is this transaction until it ends.
        steps: the transaction.
    """

    def __init__(self, link: Link, steps: Steps[T]) -> None:
        self.ended = False
        self._link = link
        self._steps = steps
        self._size = 0
        self._value: T | None = None
        self._error: BaseException | None = None
        self._waiters: list[asyncio.Future[None]] = []
        self._loop = asyncio.get_running_loop()
        with self._ending_by_any_error():
            self._advance(None)

    async def result(self) -> T:
        """Wait for the end; a cancelled wait does not end the transaction.

        Raises:
            Exception: the exception raised by the transaction.
        """
        await self.end()
        if self._error is not None:
            raise self._error
        return self._value  # type: ignore[return-value]  # set, as there was no error

    async def end(self) -> None:
        """Wait for the end and ignore the result."""
        if not self.ended:
            waiter = self._loop.create_future()
            self._waiters.append(waiter)
            await waiter

    def cancel(self) -> None:
        """Cancel the transaction."""
        if not self.ended:
            self._link.end_wait()
            try:
                self._steps.close()
            finally:
                self._finish(None, asyncio.CancelledError())

    def on_bytes(self) -> None:
        """See ``link.LinkWaiter``."""
        with self._ending_by_any_error():
            if not self._size:
                if not self._link.is_lost:
                    return
                data: bytes | None = b""
            else:
                try:
                    data = self._link.take(self._size)
                except DeviceLostError as error:
                    self._throw(error)
                    return
            if data is not None:
                self._link.end_wait()
                self._advance(data)

    def on_timeout(self) -> None:
        """See ``link.LinkWaiter``."""
        with self._ending_by_any_error():
            if self._size:
                self._throw(TimeoutError())
            else:
                self._link.end_wait()
                self._advance(b"")

    @contextmanager
    def _ending_by_any_error(self) -> Iterator[None]:
        """End the transaction on exceptions outside ``Exception``, which a signal may raise: waiters must not hang."""
        try:
            yield
        except BaseException as error:
            if not self.ended:
                self._link.end_wait()
                self._finish(None, error)
            raise

    def _throw(self, error: Exception) -> None:
        self._link.end_wait()
        self._advance(None, error)

    def _advance(self, data: bytes | None, error: Exception | None = None) -> None:
        """Continue until the parser needs bytes that have not arrived."""
        try:
            while True:
                wait = self._steps.send(data) if error is None else self._steps.throw(error)  # type: ignore[arg-type]
                self._size, error, data = wait.size, None, None
                if wait.size:
                    try:
                        data = self._link.take(wait.size)
                    except DeviceLostError as lost:
                        error = lost
                if data is None and error is None:
                    self._link.begin_wait(self, self._loop.time() + wait.within)
                    return
        except StopIteration as stop:
            self._finish(stop.value, None)
        except Exception as raised:  # noqa: BLE001  # raised where the result is awaited
            self._finish(None, raised)

    def _finish(self, value: T | None, error: BaseException | None) -> None:
        self.ended, self._value, self._error = True, value, error
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)
