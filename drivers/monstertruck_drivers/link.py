"""Byte links, with one receive buffer and one state for losing the peer.

A device is plugged into a ``Port``; opening the port returns a ``Link``. Users of a link need not know whether its
bytes come from a tty, a pty or another coroutine.
"""

import asyncio
from collections.abc import Callable
from typing import Literal, Protocol, Self

from monstertruck_runtime.errors import DeviceLostError

BAUD = 115200
"""Default baud rate, for devices that accept any (bit/s)."""
Framing = Literal["8N1", "8E2"]
"""Format of a byte on a serial line: data bits, parity, stop bits."""
BUFFER_LIMIT = 1 << 16
"""Maximum number of unread bytes; beyond it the oldest are dropped, as in a tty's buffer."""
STREAM_LIMIT = 1 << 22
"""Maximum number of unread bytes of a socket or a program, which deliver up to 256 KiB at once."""


class Link:
    """One open connection: buffered reads, immediate writes, one ``lost`` state.

    Args:
        name: name for error messages.
        transmit: sends bytes to the peer.
        hang_up: closes the underlying transport; called once.
        baud: baud rate (bit/s); None if the line has none.
        limit: maximum number of unread bytes.
    """

    def __init__(
        self,
        name: str,
        transmit: Callable[[bytes], None],
        hang_up: Callable[[], None],
        baud: int | None = None,
        limit: int = BUFFER_LIMIT,
    ) -> None:
        self.name = name
        self.baud = baud
        self._limit = limit
        self._transmit = transmit
        self._hang_up = hang_up
        self._buffer = bytearray()
        self._lost: DeviceLostError | None = None
        self._waiting: LinkWaiter | None = None
        self._due: float | None = None
        """Loop time at which the current wait times out."""
        self._alarm: asyncio.TimerHandle | None = None
        """Timer that fires at ``_due`` or earlier; it outlives its wait, because the next wait most likely needs it as
        well.
        """
        self._rings = 0.0
        """Loop time at which the timer fires."""

    # Interface to the transport

    def feed(self, data: bytes) -> None:
        """Store bytes received from the peer."""
        self._buffer += data
        if len(self._buffer) > self._limit:
            del self._buffer[: -self._limit]
        if self._waiting is not None:
            self._waiting.on_bytes()

    def lose(self, why: str, error: type[DeviceLostError] = DeviceLostError) -> None:
        """Mark the transport as lost; pending and later reads raise ``error``."""
        self._hang_up = _nothing
        if self._lost is None:
            self._lost = error(f"{self.name}: {why}")
            if self._waiting is not None:
                self._waiting.on_bytes()
        if self._alarm is not None:
            self._alarm.cancel()
            self._alarm = None

    # Interface to the user

    @property
    def is_lost(self) -> bool:
        """Whether the peer is gone or the link was closed."""
        return self._lost is not None

    def write(self, data: bytes) -> None:
        """Send all of ``data``.

        Raises:
            DeviceLostError: the link is down.
        """
        self._require_up()
        self._transmit(data)

    async def read(self, within: float | None = None, least: int = 1) -> bytes:
        """Return all bytes received so far.

        Args:
            within: maximum wait (s); None for no limit.
            least: minimum number of bytes to wait for.

        Raises:
            DeviceLostError: the link is down and its buffer holds fewer than ``least`` bytes.
            TimeoutError: fewer bytes arrived in time.
        """
        if len(self._buffer) < least:
            due = _due(within)
            while len(self._buffer) < least:
                await self._more(due, least)
        data = bytes(self._buffer)
        self._buffer.clear()
        return data

    async def exactly(self, count: int, within: float | None = None) -> bytes:
        """Read ``count`` bytes; further bytes remain buffered.

        Args:
            count: number of bytes.
            within: maximum wait for the last byte (s); None for no limit.

        Raises:
            DeviceLostError: the link went down before all bytes arrived.
            TimeoutError: not all bytes arrived in time; those received remain buffered.
        """
        if len(self._buffer) < count:
            due = _due(within)
            while len(self._buffer) < count:
                await self._more(due, count)
        data = bytes(self._buffer[:count])
        del self._buffer[:count]
        return data

    def take(self, count: int) -> bytes | None:
        """Remove and return ``count`` received bytes; None if fewer are buffered.

        Raises:
            DeviceLostError: fewer bytes are buffered and the link is down.
        """
        if len(self._buffer) < count:
            self._require_up()
            return None
        data = bytes(self._buffer[:count])
        del self._buffer[:count]
        return data

    def discard(self) -> int:
        """Discard unread bytes; return their number."""
        count = len(self._buffer)
        self._buffer.clear()
        return count

    def close(self) -> None:
        """Close the link immediately and drop unsent bytes; may be called repeatedly."""
        if self._hang_up is not _nothing:
            hang_up, self._hang_up = self._hang_up, _nothing
            hang_up()
        self.lose("closed")

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def begin_wait(self, waiting: "LinkWaiter", due: float | None) -> None:
        """Wake ``waiting`` when bytes arrive, when the link is lost, or at ``due`` (loop time).

        One timer serves many waits; it is rescheduled only when it fires.

        Raises:
            RuntimeError: a task is already waiting.
        """
        if self._waiting is not None:
            raise RuntimeError(f"{self.name}: a second reader: a link has only one")
        self._waiting, self._due = waiting, due
        if due is not None and (self._alarm is None or self._rings > due):
            self._set_alarm(asyncio.get_running_loop(), due)

    def end_wait(self) -> None:
        """Stop notifying the waiter."""
        self._waiting = self._due = None

    async def _more(self, due: float | None = None, count: int = 1) -> None:
        """Wait until ``count`` bytes are buffered or no more can arrive."""
        self._require_up()
        waiter = _Sleeper(lambda: len(self._buffer) >= count or self.is_lost)
        self.begin_wait(waiter, due)
        try:
            await waiter.woken
        finally:
            self.end_wait()

    def _require_up(self) -> None:
        if self._lost is not None:
            raise type(self._lost)(str(self._lost))

    def _set_alarm(self, loop: asyncio.AbstractEventLoop, due: float) -> None:
        if self._alarm is not None:
            self._alarm.cancel()
        self._alarm, self._rings = loop.call_at(due, self._ring, loop), due

    def _ring(self, loop: asyncio.AbstractEventLoop) -> None:
        self._alarm = None
        if self._due is None or self._waiting is None:
            return
        timer_step = 0.001  # seconds; resolution of the loop's timers, which fire up to one and a half of these early
        if self._due - loop.time() > timer_step / 2:
            self._set_alarm(loop, self._due)
        else:
            self._waiting.on_timeout()


class LinkWaiter(Protocol):
    """Waits for bytes from a link."""

    def on_bytes(self) -> None:
        """Handle received bytes or the loss of the link."""

    def on_timeout(self) -> None:
        """Handle the end of the wait by timeout."""


class _Sleeper:
    """Waiting coroutine.

    Args:
        enough: whether the received bytes justify a wake-up.
    """

    def __init__(self, enough: Callable[[], bool]) -> None:
        self._enough = enough
        self.woken: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def on_bytes(self) -> None:
        if not self.woken.done() and self._enough():
            self.woken.set_result(None)

    def on_timeout(self) -> None:
        if not self.woken.done():
            self.woken.set_exception(TimeoutError())


def _nothing() -> None:
    return None


def _due(within: float | None) -> float | None:
    return None if within is None else asyncio.get_running_loop().time() + within


class Port(Protocol):
    """A port that a device may be plugged into."""

    name: str

    async def open(self) -> Link:
        """Open a new link.

        Raises:
            DeviceLostError: nothing is plugged in.
            DeviceWedgedError: the kernel does not finish opening or closing the port.
            PortBusyError: another process holds the port.
        """
