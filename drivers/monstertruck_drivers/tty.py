"""Kernel serial ports, opened and closed in separate threads.

Both operations may block on the device: opening makes several USB transfers, each of which takes up to 5 s if the
device does not answer; closing waits 30 s for a device that accepts no bytes. Only reading and writing run on the event
loop.
"""

import asyncio
import atexit
import contextlib
import errno
import fcntl
import os
import termios
import threading
from collections.abc import Callable
from concurrent import futures
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol
from weakref import WeakValueDictionary

import serial
import serial_asyncio

from monstertruck_drivers.link import BAUD, Framing, Link, Port
from monstertruck_runtime.errors import DeviceLostError, DeviceWedgedError, PortBusyError
from monstertruck_runtime.open_files import holders

PATIENCE: Final = 2.0
"""Time limit for the kernel to open or close a port (s); then the port is reported as wedged."""
MAX_AGE: Final = 0.25
"""Time without progress after which unsent bytes are outdated and their device is wedged (s): longer than the resume
time of a hub, and about as long as the gate drives without feedback.
"""

_PTY_MAJORS: Final = range(136, 144)
"""Device numbers of pseudo terminals."""


class OpenSerial(Protocol):
    """Factory for the port at a serial node: ``SerialPort``, or the port of an emulated computer."""

    def __call__(
        self,
        path: Path,
        baud: int = BAUD,
        *,
        dtr: bool = True,
        rts: bool = True,
        low_latency: bool = False,
        framing: Framing = "8N1",
    ) -> Port:
        """See ``SerialPort``."""


class SerialPort:
    """A tty at a path (``/dev/truck/lidar``, ``/dev/serial/by-path/...``, a pty).

    Args:
        path: device node or a symlink to it; the symlink is resolved at every open.
        baud: bits per second; meaningless on USB-CDC and ptys.
        dtr: level of the DTR line while the port is open; the kernel itself briefly raises DTR and RTS on opening.
        rts: level of the RTS line while the port is open.
        low_latency: whether to ask the adapter's driver not to buffer received bytes.
        framing: data bits, parity and stop bits.
    """

    def __init__(
        self,
        path: Path,
        baud: int = BAUD,
        *,
        dtr: bool = True,
        rts: bool = True,
        low_latency: bool = False,
        framing: Framing = "8N1",
    ) -> None:
        self.name = str(path)
        self._path = path
        self._make = partial(_Tty, str(path), baud, dtr=dtr, rts=rts, low_latency=low_latency, framing=framing)

    async def open(self) -> Link:
        """Open the port raw and exclusive, with empty buffers; first wait for a closing link of this process.

        Raises:
            DeviceLostError: the node does not exist or vanished.
            DeviceWedgedError: the kernel does not finish opening the port, or closing it after earlier use.
            PortBusyError: another process holds it.
        """
        if not self._path.exists():
            raise DeviceLostError(f"{self.name}: not plugged in")
        node = _node(self._path)
        tty = await node.open(self.name, partial(self._open, node))
        return _SerialProtocol(self.name, tty).link

    def _open(self, node: "_PortNode") -> "_Tty":
        """Open the port in this thread; raises the same errors as ``open``."""
        try:
            return self._make(node=node)
        except serial.SerialException as error:
            raise self._open_error(error) from error
        except (OSError, termios.error) as error:
            raise DeviceLostError(f"{self.name}: {error.args[-1]}") from error

    def _open_error(self, error: serial.SerialException) -> Exception:
        busy = error.errno in (errno.EBUSY, errno.EWOULDBLOCK, errno.EAGAIN) or "exclusively lock" in str(error)
        if busy:
            by = ", ".join(holders({os.path.realpath(self._path)}))
            return PortBusyError(f"{self.name}: held by {by or 'another process'}")
        cause = error.__context__
        number = cause.args[0] if error.errno is None and isinstance(cause, termios.error) else error.errno
        if number is None:
            return DeviceLostError(f"{self.name}: {error}")
        return DeviceLostError(f"{self.name}: {'no serial port' if number == errno.ENOTTY else os.strerror(number)}")


_closing: set[Future[None]] = set()
"""Futures of the threads that close ports."""


@atexit.register
def _await_last_words() -> None:
    """Let closing ports send their last bytes. The end of the process kills the threads of wedged ports."""
    # Maximum wait for ports to close at the end of the program (s): a closing port sends its last bytes.
    last_words = 1.0
    futures.wait(_closing, last_words)


class _PortNode:
    """One kernel device node; its opens and closes run one at a time.

    A node that the kernel does not release occupies one thread; the device gets another node when it is enumerated
    again.
    """

    def __init__(self) -> None:
        self._work: list[Future[None]] = []
        self._overdue: Future[None] | None = None
        """Work that has exceeded its time limit."""

    async def open(self, name: str, make: "Callable[[], _Tty]") -> "_Tty":
        """Run ``make`` in a thread, which closes the tty again if it opened too late or the caller was cancelled.

        Args:
            name: name of the port, for error messages.
            make: opens the tty.

        Raises:
            DeviceWedgedError: ``make`` has not returned after ``PATIENCE``, or earlier work on this node has not ended.
            Exception: the exception raised by ``make``.
        """
        await self._previous_work(name)
        outcome: Future[_Tty] = Future()

        def work() -> None:
            try:
                tty = make()
            except BaseException as error:  # noqa: BLE001  # raised where the result is awaited
                if outcome.set_running_or_notify_cancel():
                    outcome.set_exception(error)
                return
            if outcome.set_running_or_notify_cancel():
                outcome.set_result(tty)
            else:
                tty.release()

        _start(work, self.begin())
        try:
            await _ended(outcome, PATIENCE)
        except asyncio.CancelledError:
            if not outcome.cancel() and outcome.exception() is None:
                outcome.result().close()
            raise
        if outcome.cancel():
            raise DeviceWedgedError(f"{name}: does not open: the device does not answer the kernel")
        return outcome.result()

    def begin(self) -> Future[None]:
        """Announce work that must end before the node is opened."""
        ended: Future[None] = Future()
        ended.set_running_or_notify_cancel()
        self._work.append(ended)
        return ended

    async def _previous_work(self, name: str) -> None:
        while self._work:
            work = self._work[0]
            if work is not self._overdue:
                await _ended(work, PATIENCE)
            if not work.done():
                self._overdue = work
                raise DeviceWedgedError(
                    f"{name}: the kernel has not released it since its last use, because the device "
                    "accepts no bytes or does not answer; switch it off and on, or replug it"
                )
            self._work = [work for work in self._work if not work.done()]


_nodes: WeakValueDictionary[str, _PortNode] = WeakValueDictionary()
"""Nodes in use, by their real path."""


def _node(path: Path) -> _PortNode:
    real = os.path.realpath(path)
    node = _nodes.get(real)
    if node is None:
        node = _nodes[real] = _PortNode()
    return node


def _start(work: Callable[[], None], ended: Future[None]) -> None:
    """Do blocking work in a thread that the process does not wait for when it exits."""

    def run() -> None:
        try:
            work()
        finally:
            ended.set_result(None)

    threading.Thread(target=run, name="serial port", daemon=True).start()


async def _ended(work: "Future[Any]", seconds: float) -> None:
    """Wait until ``work`` ends, but no longer than ``seconds``."""
    loop, ended = asyncio.get_running_loop(), asyncio.Event()

    def tell(_: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
            loop.call_soon_threadsafe(ended.set)

    work.add_done_callback(tell)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await ended.wait()


class _Tty(serial.Serial):
    """A pyserial port that is closed in a thread and never drained. It must be created in a thread.

    Args:
        path: device node.
        baud: see ``SerialPort``.
        node: device node with its pending work.
        dtr: see ``SerialPort``.
        rts: see ``SerialPort``.
        low_latency: see ``SerialPort``.
        framing: see ``SerialPort``.
    """

    _ending: Future[None] | None = None
    _is_handed_over = False

    def __init__(
        self, path: str, baud: int, *, node: _PortNode, dtr: bool, rts: bool, low_latency: bool, framing: Framing
    ) -> None:
        _, parity, stop = framing
        super().__init__(
            None, baudrate=baud, parity=parity, stopbits=int(stop), timeout=0, write_timeout=0, exclusive=True
        )
        self._node = node
        self.dtr, self.rts = dtr, rts
        self.port = path
        self.open()
        try:
            self._take_over(low_latency=low_latency)
        except BaseException:
            self.release()
            raise

    def _take_over(self, *, low_latency: bool) -> None:
        # A pty keeps the exclusive flag while its other side is open, and would refuse the next daemon.
        if os.major(os.fstat(self.fileno()).st_rdev) not in _PTY_MAJORS:
            fcntl.ioctl(self.fileno(), termios.TIOCEXCL)
        with contextlib.suppress(OSError, termios.error):
            termios.tcflush(self.fileno(), termios.TCIOFLUSH)
        if low_latency:
            with contextlib.suppress(ValueError):  # the line has no such flag
                self.set_low_latency_mode(True)

    def __setattr__(self, name: str, value: Any) -> None:
        """Skip a timeout that is already set: pyserial would reconfigure the open port, which takes USB transfers."""
        if not (name in ("timeout", "write_timeout") and self.is_open and value == getattr(self, name)):
            super().__setattr__(name, value)

    def write(self, data: Any) -> int:
        """Write once; pyserial's own ``write`` repeats until the bytes fit, which blocks the event loop.

        Returns:
            Number of bytes written.

        Raises:
            BlockingIOError: no byte was written.
            serial.SerialException: the port is gone.
        """
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            raise
        except OSError as error:
            raise serial.SerialException(error.errno, error.strerror) from error

    def untaken(self) -> int:
        """Number of bytes that the kernel still holds for the device."""
        try:
            return self.out_waiting
        except OSError:  # unplugged
            return 0

    def flush(self) -> None:
        """Do nothing: pyserial would wait for the device indefinitely."""

    def begin_closing(self) -> None:
        """Make later opens of the node wait until this port is closed."""
        if self._ending is None:
            self._ending = self._node.begin()
            _closing.add(self._ending)
            self._ending.add_done_callback(_closing.discard)

    def close(self) -> None:
        """Close the port in a thread; may be called repeatedly."""
        if self.is_open and not self._is_handed_over:
            self._is_handed_over = True
            self.begin_closing()
            assert self._ending is not None
            _start(self.release, self._ending)

    def release(self) -> None:
        """Close the port in this thread; waits for the device as long as the kernel does."""
        with contextlib.suppress(OSError):
            fcntl.ioctl(self.fileno(), termios.TIOCNXCL)
        super().close()


class _SerialProtocol(asyncio.Protocol):
    """Feeds a ``Link`` from a pyserial-asyncio transport.

    Args:
        name: name for error messages.
        tty: open, exclusive port; closed with the link.
    """

    def __init__(self, name: str, tty: _Tty) -> None:
        self._tty = tty
        self._loop = asyncio.get_running_loop()
        self._transport = serial_asyncio.SerialTransport(self._loop, self, tty)
        self._moved = 0.0
        """Loop time at which the device last accepted bytes."""
        self._untaken = 0
        """Bytes that the kernel held for the device after the last write."""
        self._full_since = 0.0
        """Loop time since which the kernel has had no room for all bytes; valid while the transport holds some."""
        self._alarm: asyncio.TimerHandle | None = None
        self.link = Link(name, self._send, self._hang_up, tty.baudrate)

    def _send(self, data: bytes) -> None:
        """Write immediately: a last command before ``close`` must not remain in a buffer that ``abort`` drops."""
        if self._transport.is_closing():
            return
        now, untaken = self._loop.time(), self._tty.untaken()
        if untaken == 0 or untaken < self._untaken:
            self._moved = now
        elif now - self._moved > MAX_AGE:
            self._give_up()
            return
        if self._transport.get_write_buffer_size() == 0:
            try:
                data = data[self._tty.write(data) :]
            except BlockingIOError:  # no byte fits
                pass
            except OSError as error:  # the transport would log it as a fatal error
                self.link.lose(f"unplugged ({error.strerror})")
                self._hang_up()
                return
            self._full_since = now
        if data:
            self._transport.write(data)
            if self._alarm is None:
                self._alarm = self._loop.call_later(MAX_AGE, self._check_age)
        self._untaken = self._tty.untaken()

    def _check_age(self) -> None:
        """Close the port if its transmit buffer has been full for too long.

        This also applies after a read error, when the transport tries to send its remaining bytes before it ends.
        """
        self._alarm = None
        if self._transport.get_write_buffer_size() == 0:
            return
        left = self._full_since + MAX_AGE - self._loop.time()
        if left > 0:
            self._alarm = self._loop.call_later(left, self._check_age)
        else:
            self._give_up()

    def _give_up(self) -> None:
        """Drop the outdated bytes of a device that accepts none, and report its loss."""
        self.link.lose(f"its device has accepted no bytes for {MAX_AGE:g} s", DeviceWedgedError)
        self._hang_up()

    def _hang_up(self) -> None:
        """Close without delay; the transport's ``close`` never ends if the peer is stalled."""
        if self._alarm is not None:
            self._alarm.cancel()
        self._tty.begin_closing()
        self._transport.abort()

    def data_received(self, data: bytes) -> None:
        """Pass received bytes to the link."""
        self.link.feed(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Report the loss of the port."""
        # Pyserial raises an error without a number if there is nothing to read: the cable is unplugged.
        number = exc.errno if isinstance(exc, OSError) else None
        self.link.lose("unplugged" if number is None else f"unplugged ({os.strerror(number)})")
