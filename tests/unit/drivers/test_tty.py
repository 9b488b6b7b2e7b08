"""Serial ports whose device keeps the kernel waiting: the event loop never does.

Ptys never wait, so what the kernel does with a real device is put in their place: ``benchmarks/usb_kernel.py`` asks the
kernel itself.
"""

import asyncio
import fcntl
import os
import struct
import subprocess
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import pytest
import serial

from monstertruck_drivers import tty as ports
from monstertruck_drivers.link import Link
from monstertruck_drivers.tty import MAX_AGE, SerialPort
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.errors import DeviceLostError, DeviceWedgedError, PortBusyError
from monstertruck_schemas.reasons import Reason

LOOP_LIMIT = 0.1
"""Seconds; a loaded machine's threads take turns of 5 ms, and a blocked loop would stand for ever."""


class Line:
    """A pty with a device at the far end, and a kernel that waits for it."""

    def __init__(self) -> None:
        self.device, self._host = os.openpty()
        tty.setraw(self._host)
        self.path = Path(os.ttyname(self._host))
        self.lets_go = threading.Event()
        self.lets_go.set()
        self.opens = threading.Event()
        self.opens.set()
        self.opened: list[str] = []
        self.closed: list[str] = []

    def heard(self) -> bytes:
        os.set_blocking(self.device, False)
        try:
            return os.read(self.device, 1 << 16)
        except BlockingIOError:
            return b""

    def end(self) -> None:
        self.lets_go.set()
        self.opens.set()
        for thread in threading.enumerate():  # the next pty gets the same name, and none of its work
            if thread.name == "serial port":
                thread.join(5)
        os.close(self.device)
        os.close(self._host)


@pytest.fixture
def line(monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    found = Line()
    really_open, really_close = serial.Serial.open, serial.Serial.close

    def opening(port: serial.Serial) -> None:
        found.opened.append(threading.current_thread().name)
        assert found.opens.wait(20)
        really_open(port)

    def closing(port: serial.Serial) -> None:
        if port.is_open:
            assert found.lets_go.wait(20)
            found.closed.append(threading.current_thread().name)
        really_close(port)

    def drain(_: object) -> None:
        assert found.lets_go.wait(20)

    monkeypatch.setattr(serial.Serial, "open", opening)
    monkeypatch.setattr(serial.Serial, "close", closing)
    monkeypatch.setattr(termios, "tcdrain", drain)
    yield found
    found.end()


class Watch:
    """Longest time for which the event loop did not run."""

    def __init__(self) -> None:
        self.longest = 0.0

    async def __aenter__(self) -> Self:
        self._task = asyncio.create_task(self._tick())
        await asyncio.sleep(0)
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.sleep(0.01)
        self._task.cancel()

    async def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        before = loop.time()
        while True:
            await asyncio.sleep(0.002)
            now = loop.time()
            self.longest, before = max(self.longest, now - before), now


async def opened_soon(port: SerialPort) -> Link:
    async with asyncio.timeout(5):
        while True:
            try:
                return await port.open()
            except DeviceWedgedError:
                await asyncio.sleep(0.01)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "PATIENCE", 0.1)


@pytest.mark.usefixtures("quick")
async def test_a_port_that_does_not_close_stops_nothing_but_itself(line: Line):
    port = SerialPort(line.path)
    async with Watch() as loop:
        link = await port.open()
        line.lets_go.clear()
        link.write(b"stop")
        link.close()
        for _ in range(3):
            with pytest.raises(DeviceWedgedError, match="has not released it") as refused:
                await port.open()
        assert refused.value.reason is Reason.DEVICE_WEDGED
        assert line.closed == []
        line.lets_go.set()
        (await opened_soon(port)).close()
    assert loop.longest < LOOP_LIMIT
    assert line.heard() == b"stop"


@pytest.mark.usefixtures("quick")
async def test_what_is_known_to_be_wedged_is_said_at_once(line: Line):
    link = await SerialPort(line.path).open()
    line.lets_go.clear()
    link.close()
    clock = WallClock()
    waited = []
    for _ in range(2):
        begin = clock.now()
        with pytest.raises(DeviceWedgedError):
            await SerialPort(line.path).open()
        waited.append((clock.now() - begin) / SECOND)
    assert waited[0] > 0.09
    assert waited[1] < 0.05
    assert sum(thread.name == "serial port" for thread in threading.enumerate()) == 1


async def test_reopening_in_the_same_turn_waits(line: Line):
    port = SerialPort(line.path)
    link = await port.open()
    line.lets_go.clear()
    asyncio.get_running_loop().call_later(0.1, line.lets_go.set)
    link.close()
    again = await port.open()
    again.write(b"again")
    again.close()
    assert line.heard() == b"again"
    for _ in range(20):
        async with await port.open() as link:
            link.write(b"x")


async def test_a_port_in_use_stays_refused(line: Line):
    async with await SerialPort(line.path).open():
        with pytest.raises(PortBusyError, match=rf": held by process {os.getpid()} \(.*python.*\)$"):
            await SerialPort(line.path).open()


async def test_a_port_of_another_user_is_refused_too(line: Line, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ports, "holders", lambda _: iter(()))  # only root sees what others have open
    async with await SerialPort(line.path).open():
        with pytest.raises(PortBusyError, match=r": held by another process$"):
            await SerialPort(line.path).open()


@pytest.mark.usefixtures("quick")
async def test_a_port_that_does_not_open_is_wedged_and_not_kept_when_it_opens_late(line: Line):
    line.opens.clear()
    port = SerialPort(line.path)
    async with Watch() as loop:
        with pytest.raises(DeviceWedgedError, match="does not open"):
            await port.open()
        with pytest.raises(DeviceWedgedError):
            await port.open()
        assert len(line.opened) == 1, "one thread waits, however often the port is tried"
        line.opens.set()
        (await opened_soon(port)).close()
    assert loop.longest < LOOP_LIMIT
    assert len(line.closed) >= 1


async def test_who_is_cancelled_while_a_port_opens_leaves_it_free(line: Line):
    line.opens.clear()
    port = SerialPort(line.path)
    opening = asyncio.create_task(port.open())
    await asyncio.sleep(0.05)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    line.opens.set()
    (await port.open()).close()


async def test_neither_opening_nor_closing_is_done_by_the_loops_thread(line: Line):
    async with await SerialPort(line.path).open():
        pass
    (await SerialPort(line.path).open()).close()
    assert set(line.opened) == {"serial port"}
    assert set(line.closed) == {"serial port"}


async def test_another_name_opens_while_the_old_one_hangs(line: Line):
    """A device that is enumerated again has another node; the kernel may hold the old one for half a minute."""
    link = await SerialPort(line.path).open()
    line.lets_go.clear()
    link.close()
    other = Line()
    try:
        async with await SerialPort(other.path).open() as link:
            os.write(other.device, b"here")
            assert await link.exactly(4, 1.0) == b"here"
            line.lets_go.set()
    finally:
        other.end()


def test_the_end_of_the_program_waits_for_last_words_but_not_for_a_wedged_port(tmp_path: Path):
    """In a process of its own, whose kernel holds one port for ever and another one for 0.2 s."""
    quick, wedged = Line(), Line()
    script = tmp_path / "ends.py"
    script.write_text(
        f"""
import asyncio, serial, sys, time
from pathlib import Path
from monstertruck_drivers.tty import SerialPort
from monstertruck_runtime.clock import run_wall
really = serial.Serial.close
def close(port):
    time.sleep(30 if port.port == {str(wedged.path)!r} else 0.2)
    really(port)
    Path({str(tmp_path)!r}, "closed").write_text(port.port)
serial.Serial.close = close
async def main(clock):
    for path in sys.argv[1:]:
        (await SerialPort(Path(path)).open()).close()
run_wall(main)
"""
    )
    begin = WallClock().now()
    subprocess.run([sys.executable, script, quick.path, wedged.path], check=True, timeout=25)
    assert (WallClock().now() - begin) / SECOND < 10
    assert (tmp_path / "closed").read_text() == str(quick.path)
    quick.end()
    wedged.end()


# What a device does not take


class Deaf:
    """Lets a pty look like a device that takes no bytes: the kernel keeps ``untaken`` of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.untaken = 0
        ioctl = fcntl.ioctl

        def asked(fd: int, request: int, argument: Any = 0) -> Any:
            return struct.pack("I", self.untaken) if request == termios.TIOCOUTQ else ioctl(fd, request, argument)

        monkeypatch.setattr(fcntl, "ioctl", asked)


async def test_a_device_that_takes_nothing_is_not_sent_old_set_points(line: Line, monkeypatch: pytest.MonkeyPatch):
    kernel = Deaf(monkeypatch)
    port = SerialPort(line.path)
    link = await port.open()
    sent = 0
    async with asyncio.timeout(5):
        while not link.is_lost:
            link.write(b"set")
            sent += 1
            kernel.untaken += 3
            await asyncio.sleep(0.02)
    assert sent * 0.02 <= MAX_AGE + 0.2
    with pytest.raises(DeviceWedgedError, match="accepted no bytes"):
        await link.read()


async def test_a_slow_device_that_takes_bytes_is_not_given_up(line: Line, monkeypatch: pytest.MonkeyPatch):
    """CDC-ACM counts whole transfers: one byte on its way counts 64, as long as it is on its way."""
    kernel = Deaf(monkeypatch)
    async with await SerialPort(line.path).open() as link:
        for at in range(60):
            link.write(b"set")
            link.write(b"set")
            kernel.untaken = 128 - 64 * (at % 2)
            await asyncio.sleep(0.01)
        assert not link.is_lost


async def test_what_a_full_line_does_not_take_is_dropped_when_it_is_old(line: Line):
    link = await SerialPort(line.path).open()
    set_point = b"0123456789" * 100
    sent = 0
    async with asyncio.timeout(5):
        while not link.is_lost:
            link.write(set_point)
            sent += len(set_point)
            await asyncio.sleep(0.005)
    with pytest.raises(DeviceWedgedError):
        link.write(set_point)
    await asyncio.sleep(0.1)
    heard = b""
    while part := line.heard():
        heard += part
        await asyncio.sleep(0.01)
    assert len(heard) < sent - 10_000, "the line's own buffer, and nothing of what waited for it"


async def test_one_command_that_a_full_line_does_not_take_gets_old_too(line: Line):
    link = await SerialPort(line.path).open()
    link.write(b"x" * 100_000)
    with pytest.raises(DeviceWedgedError):
        await link.read(2.0)


# How a port is opened


async def test_the_control_lines_are_those_of_the_settings(line: Line, monkeypatch: pytest.MonkeyPatch):
    set_lines: list[tuple[bool, int]] = []
    ioctl = fcntl.ioctl

    def asked(fd: int, request: int, argument: Any = 0) -> Any:
        if request in (termios.TIOCMBIS, termios.TIOCMBIC):
            set_lines.append((request == termios.TIOCMBIS, struct.unpack("I", argument)[0]))
            return argument
        return ioctl(fd, request, argument)

    monkeypatch.setattr(fcntl, "ioctl", asked)
    for dtr, rts in ((True, True), (False, True), (True, False), (False, False)):
        set_lines.clear()
        (await SerialPort(line.path, dtr=dtr, rts=rts).open()).close()
        assert set_lines == [(dtr, termios.TIOCM_DTR), (rts, termios.TIOCM_RTS)]


async def test_a_real_port_is_exclusive_for_those_too_who_know_no_lock(line: Line, monkeypatch: pytest.MonkeyPatch):
    marks: list[int] = []
    ioctl = fcntl.ioctl

    def asked(fd: int, request: int, argument: Any = 0) -> Any:
        if request in (termios.TIOCEXCL, termios.TIOCNXCL):
            marks.append(request)
        return ioctl(fd, request, argument)

    monkeypatch.setattr(fcntl, "ioctl", asked)
    (await SerialPort(line.path).open()).close()
    assert termios.TIOCEXCL not in marks, "a pty would keep it beyond our end"
    monkeypatch.setattr(ports, "_PTY_MAJORS", ())
    link = await SerialPort(line.path).open()
    assert marks[-1] == termios.TIOCEXCL
    link.close()
    (await SerialPort(line.path).open()).close()
    assert termios.TIOCNXCL in marks


async def test_the_loop_configures_no_open_port(line: Line, monkeypatch: pytest.MonkeyPatch):
    """Each time it is three USB transfers."""
    by: list[str] = []
    really = termios.tcsetattr

    def configure(*arguments: Any) -> None:
        by.append(threading.current_thread().name)
        really(*arguments)

    monkeypatch.setattr(termios, "tcsetattr", configure)
    asked = termios.tcgetattr

    def changed(fd: int) -> list[Any]:
        by.append(threading.current_thread().name)
        return asked(fd)

    monkeypatch.setattr(termios, "tcgetattr", changed)
    async with await SerialPort(line.path).open() as link:
        link.write(b"x")
    assert set(by) == {"serial port"}


async def test_a_lost_link_says_why(line: Line):
    link = await SerialPort(line.path).open()
    link.close()
    with pytest.raises(DeviceLostError, match="closed"):
        link.write(b"x")
