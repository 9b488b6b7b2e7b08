"""Random lives of serial ports: whatever the kernel and the device do, in any order, nothing leaks and nothing waits.

One life is a sequence of openings, transfers and faults on one pty, whose kernel answers as that of a real port may.
"""

import asyncio
import contextlib
import errno
import fcntl
import gc
import os
import struct
import termios
import threading
import tty
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monstertruck_drivers import tty as ports
from monstertruck_drivers.link import Link
from monstertruck_drivers.tty import MAX_AGE, SerialPort
from monstertruck_runtime.errors import DeviceError, DeviceLostError, PortBusyError
from tests.unit.drivers.test_tty import LOOP_LIMIT, Watch

LIVES = 25
STEPS = 30
BUFFER = 300
"""Bytes that the kernel keeps for a device that takes none; few, so that its buffer is often full."""
SOON = 2 * MAX_AGE + 0.5
"""Seconds until a link notices whatever ended it, on a computer that runs other tests as well."""


class Kernel:
    """Calls on the ports of one test, which fail or wait as the test says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.lets_go = threading.Event()
        self.lets_go.set()
        self.read_errors: list[int] = []
        """Errors of the next reads."""
        self.write_errors: list[int] = []
        self.read_limit = 1 << 16
        """Most bytes of one read."""
        self.is_deaf = False
        """The device takes no bytes."""
        self.untaken = 0
        self.loop = threading.get_ident()
        self.opened: set[int] = set()
        self.late: list[str] = []
        """Calls on the event loop that wait for a device."""
        self._calls = {name: getattr(os, name) for name in ("open", "read", "write", "close")}
        self._ioctl = fcntl.ioctl
        for name in self._calls:
            monkeypatch.setattr(os, name, getattr(self, name))
        monkeypatch.setattr(fcntl, "ioctl", self.ioctl)
        monkeypatch.setattr(termios, "tcdrain", lambda _: self._wait("tcdrain"))

    def open(self, path: Any, *arguments: Any, **named: Any) -> int:
        line: int = self._calls["open"](path, *arguments, **named)
        if str(path).startswith("/dev/pts/"):
            self._wait("open", line)
            self.opened.add(line)
        return line

    def read(self, line: int, count: int) -> bytes:
        if line not in self.opened:
            return self._calls["read"](line, count)  # type: ignore[no-any-return]
        if self.read_errors:
            self._fail(self.read_errors.pop())
        return self._calls["read"](line, min(count, self.read_limit))  # type: ignore[no-any-return]

    def write(self, line: int, data: bytes) -> int:
        if line not in self.opened:
            return self._calls["write"](line, data)  # type: ignore[no-any-return]
        if self.write_errors:
            self._fail(self.write_errors.pop())
        if self.is_deaf:
            if self.untaken > BUFFER:
                self._fail(errno.EAGAIN)
            self.untaken += len(data)
            return len(data)
        return self._calls["write"](line, data)  # type: ignore[no-any-return]

    def ioctl(self, line: Any, request: int, *arguments: Any) -> Any:
        if request == termios.TIOCOUTQ and line in self.opened:
            return struct.pack("I", self.untaken)
        return self._ioctl(line, request, *arguments)

    def close(self, line: int) -> None:
        if line in self.opened:
            self._wait("close")
            self.opened.discard(line)
        self._calls["close"](line)

    def _wait(self, what: str, line: int | None = None) -> None:
        if threading.get_ident() == self.loop:
            self.late.append(what)
        elif not self.lets_go.wait(20):
            if line is not None:
                self._calls["close"](line)
            raise TimeoutError(what)

    def _fail(self, number: int) -> None:
        raise OSError(number, os.strerror(number))


class Life:
    """One port and the device at its far end."""

    def __init__(self, kernel: Kernel, rng: np.random.Generator) -> None:
        self._kernel, self._rng = kernel, rng
        self.device, self._host = -1, -1
        self._link: Link | None = None
        self._locked = -1
        self._said, self._heard = b"", b""
        self._others: list[int] = []
        self.plug()

    def plug(self) -> None:
        self.device, self._host = os.openpty()
        tty.setraw(self._host)
        self._port = SerialPort(Path(os.ttyname(self._host)))

    # What happens

    async def open(self) -> None:
        if self._link is None:
            try:
                self._link = await self._port.open()
            except (DeviceError, PortBusyError):
                return
            self._said = self._heard = b""

    async def open_and_give_up(self) -> None:
        opening = asyncio.create_task(self._port.open())
        await asyncio.sleep(self._rng.uniform(0, 0.004))
        opening.cancel()
        await asyncio.wait([opening])
        if not opening.cancelled() and opening.exception() is None:
            opening.result().close()

    async def write(self) -> None:
        if self._link is not None:
            with contextlib.suppress(DeviceLostError):
                self._link.write(bytes(self._rng.integers(0, 256, self._rng.integers(1, 300), dtype=np.uint8)))

    async def hear(self) -> None:
        if self.device >= 0 and self._link is not None and not self._link.is_lost:
            data = self._rng.bytes(int(self._rng.integers(1, 60)))
            os.write(self.device, data)
            self._said += data
            with contextlib.suppress(DeviceLostError, TimeoutError):
                while len(self._heard) < len(self._said):
                    self._heard += await self._link.read(0.1)
            assert self._said.startswith(self._heard), "bytes are lost or of another port"

    async def close(self) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None

    async def hang_up(self) -> None:
        """The cable is pulled out, and in again: another node."""
        os.close(self.device)
        self.device = -1
        await self.lost()
        os.close(self._host)
        self.plug()

    async def read_error(self) -> None:
        if self._link is not None and not self._link.is_lost:
            self._kernel.read_errors.append(errno.EIO)
            os.write(self.device, b"x")
            await self.lost()
            self._kernel.read_errors.clear()

    async def write_error(self) -> None:
        self._kernel.write_errors.append(errno.EIO)
        await self.write()
        self._kernel.write_errors.clear()

    async def busy_for_a_moment(self) -> None:
        self._kernel.read_errors.append(errno.EAGAIN)
        self._kernel.write_errors.append(errno.EAGAIN)
        await self.write()
        await self.hear()
        self._kernel.read_errors.clear()
        self._kernel.write_errors.clear()

    async def short_reads(self) -> None:
        self._kernel.read_limit = int(self._rng.choice((1, 3, 1 << 16)))

    async def deaf(self) -> None:
        self._kernel.is_deaf = not self._kernel.is_deaf
        self._kernel.untaken = 0

    async def wedged(self) -> None:
        """The kernel does not let go of ports, or lets go of all."""
        if self._kernel.lets_go.is_set():
            self._kernel.lets_go.clear()
        else:
            self._kernel.lets_go.set()

    async def lock(self) -> None:
        """Another program takes the lock, or gives it back."""
        if self._locked < 0:
            self._locked = os.dup(self._host)
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(self._locked, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            self.unlock()

    async def reuse_numbers(self) -> None:
        """Files that get the numbers of ports that were closed: none may be read, written or closed as a port."""
        self._others.append(os.memfd_create("other"))
        os.write(self._others[-1], b"other")

    async def pause(self) -> None:
        await asyncio.sleep(self._rng.uniform(0, 0.03))

    # What must hold

    async def lost(self) -> None:
        if self._link is not None:
            link, self._link = self._link, None
            async with asyncio.timeout(SOON):
                while not link.is_lost:
                    await asyncio.sleep(0.005)
            with pytest.raises(DeviceLostError):
                link.write(b"x")
            link.close()

    def unlock(self) -> None:
        if self._locked >= 0:
            os.close(self._locked)
            self._locked = -1

    async def end(self) -> None:
        await self.close()
        self._kernel.lets_go.set()
        self.unlock()
        for other in self._others:
            assert os.pread(other, 99, 0) == b"other"
            os.close(other)
        for thread in threading.enumerate():
            if thread.name == "serial port":
                await asyncio.to_thread(thread.join, 5)
        os.close(self.device)
        os.close(self._host)

    def actions(self) -> list[Callable[[], Awaitable[None]]]:
        common = [self.open] * 4 + [self.write] * 4 + [self.hear] * 4 + [self.close] * 2
        rare = [self.open_and_give_up, self.hang_up, self.read_error, self.write_error, self.busy_for_a_moment]
        return [*common, *rare, self.short_reads, self.deaf, self.wedged, self.lock, self.reuse_numbers, self.pause]


def open_files() -> int:
    return len([*Path("/proc/self/fd").iterdir()])


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Iterator[Kernel]:
    monkeypatch.setattr(ports, "PATIENCE", 0.05)
    made = Kernel(monkeypatch)
    yield made
    made.lets_go.set()


@pytest.mark.parametrize("seed", range(LIVES))
async def test_a_port_leaks_nothing_and_stops_nothing(kernel: Kernel, seed: int):
    rng = np.random.default_rng(seed)
    await asyncio.to_thread(int)  # the pool's thread and files are there before
    before = open_files()
    async with Watch() as loop:
        life = Life(kernel, rng)
        actions = life.actions()
        done = []
        for _ in range(STEPS):
            act = actions[rng.integers(len(actions))]
            done.append(act.__name__)
            await act()
        await life.end()
    gc.collect()
    await asyncio.sleep(0.01)
    assert kernel.late == [], done
    assert loop.longest < LOOP_LIMIT, done
    assert not [thread for thread in threading.enumerate() if thread.name == "serial port"], done
    assert open_files() == before, done
    assert kernel.opened == set(), done
