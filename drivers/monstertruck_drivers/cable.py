"""Device side of a cable, for emulators: byte streams, line faults, in-memory ports and ptys."""

import asyncio
import contextlib
import contextvars
import errno
import fcntl
import os
import socket
import struct
import tty
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final, Protocol

from monstertruck_drivers.link import Link
from monstertruck_runtime.errors import BusyError, DeviceLostError, InputError, PortBusyError

FRAME: Final = 0.001
"""Duration of a USB frame: bytes that a device sends within one arrive together (s)."""


class DeviceEnd:
    """Device side of a port, read and written by an emulator, whichever process has opened the host side.

    Bytes without a reader are dropped, as with a USB device. ``baud`` paces both directions like a real line (10 bits
    per byte). The end also injects cable faults.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.baud: int | None = None
        self.faults = LineFaults()
        self.on_plug: Callable[[bool], None] | None = None
        """Called with True/False when the cable is plugged/unplugged."""
        self.on_bytes: Callable[[bool, bytes], None] | None = None
        """Called with all traffic: (True, bytes that reached the device), (False, bytes that reached the host)."""
        self._received = Link(name, lambda _: None, lambda: None)
        self._out = _Direction()
        self._in = _Direction()
        self._deliver: Callable[[bytes], None] | None = None

    def connect(self, deliver: Callable[[bytes], None] | None) -> None:
        """Connect the host that opened the port, or pass None when the host closes it."""
        self._deliver = deliver

    async def read(self, within: float | None = None) -> bytes:
        """Wait for bytes from the host, at least one, even while unplugged or closed.

        Raises:
            TimeoutError: no byte within ``within`` seconds.
        """
        return await self._received.read(within)

    def write(self, data: bytes, after: float = 0.0) -> None:
        """Send to the host ``after`` seconds from now, subject to baud pacing and line faults."""
        for chunk in self.faults.corrupt(data):
            self._send(self._out, len(chunk), partial(self._emit, chunk), after)

    def take(self, data: bytes) -> None:
        """Put bytes from the host on the line."""
        data = self.faults.shorten(data)
        self._send(self._in, len(data), partial(self._accept, data))

    def _send(self, direction: "_Direction", count: int, arrive: Callable[[], None], after: float = 0.0) -> None:
        """Deliver ``count`` bytes after all earlier bytes, plus their own transfer time."""
        delay = self.faults.delay + after
        if self.baud is None and delay <= 0 and direction.is_free():
            arrive()
        else:
            direction.enter(delay, count * 10 / self.baud if self.baud else 0.0, arrive)

    def _emit(self, data: bytes) -> None:
        if self._deliver is not None and not self.faults.stalled:
            if self.on_bytes is not None:
                self.on_bytes(False, data)
            self._deliver(data)

    def _accept(self, data: bytes) -> None:
        if not self.faults.deaf:
            if self.on_bytes is not None:
                self.on_bytes(True, data)
            self._received.feed(data)


CABLE: Final = contextvars.Context()
"""Context of bytes in transit: they arrive even if their sender is cancelled."""


class _Direction:
    """One direction of the line. Timers may fire in any order, but bytes arrive in the order sent."""

    def __init__(self) -> None:
        self._free = 0.0
        """Loop time at which all sent bytes have passed."""
        self._sent: deque[Callable[[], None]] = deque()

    def is_free(self) -> bool:
        return not self._sent and self._free <= asyncio.get_running_loop().time()

    def enter(self, delay: float, duration: float, arrive: Callable[[], None]) -> None:
        loop = asyncio.get_running_loop()
        # 0.1 us apart, so that they do not arrive in the same iteration of the virtual loop.
        self._free = max(self._free + 1e-7, loop.time() + delay) + duration
        self._sent.append(arrive)
        loop.call_at(self._free, self._arrive, context=CABLE)

    def _arrive(self) -> None:
        self._sent.popleft()()


class LineFaults:
    """Faults of a cable; all off by default. ``seed`` seeds the random faults."""

    def __init__(self) -> None:
        self.stalled = False
        """Whether no byte reaches the host."""
        self.deaf = False
        """Whether no byte reaches the device."""
        self.delay = 0.0
        """Seconds added to every transfer."""
        self.chunk: int | None = None
        """Maximum number of bytes delivered at a time (1: one-byte reads)."""
        self.flip_rate = 0.0
        """Probability that one bit of a byte is flipped."""
        self.drop_rate = 0.0
        """Probability that a byte is lost."""
        self.lose_rate = 0.0
        """Probability that a whole message of the device is lost."""
        self.double_rate = 0.0
        """Probability that a whole message of the device is sent twice."""
        self.garbage = b""
        """Bytes sent once before the next ones."""
        self.short_writes = 0
        """Number of the host's next multi-byte writes that are truncated."""
        self._state = 0x9E3779B9

    def seed(self, seed: int) -> None:
        """Seed the random faults."""
        self._state = (seed * 2654435761 + 1) & 0xFFFFFFFF

    def corrupt(self, data: bytes) -> list[bytes]:
        """Apply the faults; return the chunks to deliver."""
        if self.garbage:
            data, self.garbage = self.garbage + data, b""
        if self.lose_rate > 0 and self._random() < self.lose_rate:
            return []
        if self.double_rate > 0 and self._random() < self.double_rate:
            data += data
        if self.flip_rate or self.drop_rate:
            out = bytearray()
            for byte in data:
                if self._random() < self.drop_rate:
                    continue
                out.append(byte ^ (1 << int(self._random() * 8)) if self._random() < self.flip_rate else byte)
            data = bytes(out)
        if self.chunk is None:
            return [data] if data else []
        return [data[i : i + self.chunk] for i in range(0, len(data), self.chunk)]

    def shorten(self, data: bytes) -> bytes:
        """Return the bytes of one host write that reach the line."""
        if self.short_writes <= 0 or len(data) < 2:
            return data
        self.short_writes -= 1
        return data[: len(data) // 2]

    def _random(self) -> float:
        self._state ^= (self._state << 13) & 0xFFFFFFFF
        self._state ^= self._state >> 17
        self._state ^= (self._state << 5) & 0xFFFFFFFF
        return self._state / 2**32


class EmulatedPort(Protocol):
    """A port with an emulated device that can be plugged in and unplugged."""

    name: str
    device: DeviceEnd

    def plug(self) -> None:
        """Connect the cable."""

    def unplug(self) -> None:
        """Unplug the cable: the host's link is lost."""


class MemoryPort:
    """Port and device end in one process, for the virtual clock."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.device = DeviceEnd(name)
        self._plugged = False
        self._link: Link | None = None

    def plug(self) -> None:
        """Connect the cable."""
        if not self._plugged:
            self._plugged = True
            if self.device.on_plug is not None:
                self.device.on_plug(True)

    def unplug(self) -> None:
        """Unplug the cable: an open link is lost."""
        if self._plugged:
            self._plugged = False
            self.device.connect(None)
            link, self._link = self._link, None
            if link is not None:
                link.lose("unplugged")
            if self.device.on_plug is not None:
                self.device.on_plug(False)

    async def open(self) -> Link:
        """Open the host side.

        Raises:
            DeviceLostError: the cable is unplugged.
            PortBusyError: it is already open.
        """
        if not self._plugged:
            raise DeviceLostError(f"{self.name}: not plugged in")
        if self._link is not None:
            raise PortBusyError(f"{self.name}: held by another process")
        link = Link(self.name, self.device.take, self._hang_up, self.device.baud)
        self._link = link
        self.device.connect(link.feed)
        return link

    def _hang_up(self) -> None:
        self._link = None
        self.device.connect(None)


@contextlib.contextmanager
def reserved(*links: Path) -> Iterator[None]:
    """Reserve pty names for this program within the context, without replacing those of other programs.

    Args:
        links: symlinks to create; their folders must exist.

    Raises:
        BusyError: another program serves one of the links; the message names its process.
        InputError: the name exists and is not a link.
        OSError: the link cannot be created.
    """
    with contextlib.ExitStack() as stack:
        for link in links:
            if os.path.lexists(link) and not link.is_symlink():
                raise InputError(f"{link}: already exists and is not a link, so a pty cannot replace it")
            lock = link.with_name(f".{link.name}.lock")
            try:
                file = stack.enter_context(lock.open("a+"))  # keeps the holder's text
            except OSError as error:
                error.filename = str(link)
                raise
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                process = f" (process {number})" if (number := file.read().strip()) else ""
                raise BusyError(f"{link}: another program{process} serves this port") from None
            stack.callback(lock.unlink, missing_ok=True)
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
        yield


class PtyPort:
    """A pty behind a stable symlink; unplugging closes the pty, and replugging creates a new one.

    Args:
        path: symlink to create; its folder must exist.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self.device = DeviceEnd(self.name)
        self._path = path
        self._fds: tuple[int, int] | None = None
        self._frame = bytearray()
        self._timer: asyncio.TimerHandle | None = None

    def plug(self) -> None:
        """Create the pty in raw mode and point the symlink at it. Needs a running loop."""
        if self._fds is not None:
            return
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._fds = (master, slave)
        scratch = self._path.with_name(self._path.name + ".new")
        scratch.unlink(missing_ok=True)
        scratch.symlink_to(os.ttyname(slave))
        scratch.replace(self._path)
        asyncio.get_running_loop().add_reader(master, self._readable)
        self.device.connect(self._send)
        if self.device.on_plug is not None:
            self.device.on_plug(True)

    def unplug(self) -> None:
        """Remove the symlink and close the pty: reads on the host side fail with EIO."""
        if self._fds is None:
            return
        master, slave = self._fds
        self._fds = None
        self._frame.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self.device.connect(None)
        asyncio.get_running_loop().remove_reader(master)
        self._path.unlink(missing_ok=True)
        os.close(master)
        os.close(slave)
        if self.device.on_plug is not None:
            self.device.on_plug(False)

    def _readable(self) -> None:
        assert self._fds is not None
        # The slave stays open on this side, so EIO cannot occur while plugged in.
        with contextlib.suppress(BlockingIOError):
            self.device.take(os.read(self._fds[0], 4096))

    def _send(self, data: bytes) -> None:
        self._frame += data
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(FRAME, self._end_frame)

    def _end_frame(self) -> None:
        assert self._fds is not None
        self._timer = None
        frame = bytes(self._frame)
        self._frame.clear()
        # Bytes beyond a pty's capacity of about 10 kB are lost, like unread bytes of a USB device.
        with contextlib.suppress(BlockingIOError):
            os.write(self._fds[0], frame)


class SocketPort:
    """A network device emulated at a loopback address; it serves one client at a time.

    While unplugged, it is silent. When plugged in again, it behaves as after a power loss and resets the earlier
    connection.

    Args:
        address: address in 127.0.0.0/8.
        number: TCP port; 0 selects any free port.

    Raises:
        BusyError: another program uses the port.
        OSError: this computer has no such address.
    """

    def __init__(self, address: str, number: int) -> None:
        try:
            self._listener = socket.create_server((address, number), backlog=1)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise BusyError(f"{address}:{number}: another program serves this port") from None
            raise
        self._listener.setblocking(False)
        self.address: tuple[str, int] = self._listener.getsockname()
        self.name = f"{address}:{self.address[1]}"
        self.device = DeviceEnd(self.name)
        self._client: socket.socket | None = None
        self._plugged = False

    def plug(self) -> None:
        """Connect the cable. Needs a running loop."""
        if self._plugged:
            return
        self._plugged = True
        self._drop()
        while (gone := self._next_client()) is not None:  # the kernel connected them meanwhile
            _reset(gone)
        asyncio.get_running_loop().add_reader(self._listener, self._accept)
        if self.device.on_plug is not None:
            self.device.on_plug(True)

    def unplug(self) -> None:
        """Unplug the cable: the host no longer receives anything."""
        if not self._plugged:
            return
        self._plugged = False
        self.device.connect(None)
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._listener)
        if self._client is not None:
            loop.remove_reader(self._client)
        if self.device.on_plug is not None:
            self.device.on_plug(False)

    def close(self) -> None:
        """Release the address."""
        self.unplug()
        self._drop()
        self._listener.close()

    def _accept(self) -> None:
        if self._client is not None:
            self._readable()  # its end may have come before the new client
        client = self._next_client()
        if client is None:
            return
        if self._client is not None:
            _reset(client)
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client
        asyncio.get_running_loop().add_reader(client, self._readable)
        self.device.connect(self._send)

    def _next_client(self) -> socket.socket | None:
        """Return a waiting client; None if there is none."""
        try:
            return self._listener.accept()[0]
        except BlockingIOError:
            return None

    def _readable(self) -> None:
        assert self._client is not None
        try:
            data = self._client.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self.device.take(data)
        else:
            self._drop()

    def _send(self, data: bytes) -> None:
        assert self._client is not None
        # Bytes that do not fit into the socket are dropped.
        with contextlib.suppress(OSError):
            self._client.send(data)

    def _drop(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            self.device.connect(None)
            asyncio.get_running_loop().remove_reader(client)
            _reset(client)


def _reset(client: socket.socket) -> None:
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()
