"""Announcements wake the watcher; a machine without udev is no error."""

import asyncio
import builtins
import os
import socket
from collections import deque
from collections.abc import Iterator
from typing import Any

import pytest

from monstertruck_drivers.computer import SUBSYSTEMS, NoWatcher, UdevWatcher, open_watcher


class Monitor:
    """Looks like ``pyudev.Monitor``: a file descriptor and a queue."""

    def __init__(self) -> None:
        self.events: deque[Any] = deque()
        self._read, self._write = os.pipe()
        self.started = False

    def start(self) -> None:
        self.started = True

    def fileno(self) -> int:
        return self._read

    def announce(self, *events: Any) -> None:
        self.events.extend(events)
        os.write(self._write, b"!")

    def poll(self, timeout: float) -> Any:
        assert timeout == 0, "never blocks the loop"
        if not self.events:
            os.read(self._read, 100)
            return None
        event = self.events.popleft()
        if isinstance(event, OSError):
            os.read(self._read, 100)
            raise event
        return event

    def close(self) -> None:
        os.close(self._read)
        os.close(self._write)


@pytest.fixture
def monitor() -> Iterator[Monitor]:
    monitor = Monitor()
    yield monitor
    monitor.close()


async def test_a_burst_is_one_hint(monitor: Monitor):
    hints = []
    watcher = UdevWatcher(monitor)
    watcher.start(lambda: hints.append(1))
    assert monitor.started
    monitor.announce("add usb", "add tty", "bind usb")
    await asyncio.sleep(0.01)
    assert (len(hints), len(monitor.events)) == (1, 0)
    watcher.stop()
    monitor.announce("remove")
    await asyncio.sleep(0.01)
    assert len(hints) == 1
    watcher.stop()


async def test_lost_announcements_are_a_hint_too(monitor: Monitor):
    hints = []
    watcher = UdevWatcher(monitor)
    watcher.start(lambda: hints.append(1))
    monitor.announce(OSError(105, "No buffer space available"))
    await asyncio.sleep(0.01)
    assert hints == [1]
    watcher.stop()


class Overrun:
    """A socket whose pending error the kernel reports as netlink's lost messages: EPOLLERR, and an exception once."""

    def __init__(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
            gone.bind(("127.0.0.1", 0))
            nobody = gone.getsockname()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(nobody)
        self._socket.setblocking(False)

    def start(self) -> None:
        pass

    def fileno(self) -> int:
        return self._socket.fileno()

    def overrun(self) -> None:
        self._socket.send(b"nobody listens")

    def poll(self, timeout: float) -> Any:
        try:
            return self._socket.recv(100)
        except BlockingIOError:
            return None

    def close(self) -> None:
        self._socket.close()


async def test_every_overrun_is_a_hint_not_only_the_first():
    monitor, hints = Overrun(), []
    watcher = UdevWatcher(monitor)
    watcher.start(lambda: hints.append(1))
    for count in range(1, 4):
        monitor.overrun()
        async with asyncio.timeout(5):
            while len(hints) < count:
                await asyncio.sleep(0.01)
    watcher.stop()
    monitor.close()


async def test_real_udev_is_listened_to_where_there_is_one():
    watcher = open_watcher()
    watcher.start(lambda: None)
    watcher.stop()


def test_only_what_matters_is_asked_for(monkeypatch: pytest.MonkeyPatch):
    pyudev = pytest.importorskip("pyudev")
    asked: list[str] = []

    class Netlink:
        def filter_by(self, subsystem: str) -> None:
            asked.append(subsystem)

    class Monitors:
        @staticmethod
        def from_netlink(context: object, source: str) -> Netlink:
            assert source == "udev", "not before udev's rules ran"
            return Netlink()

    monkeypatch.setattr(pyudev, "Context", object)
    monkeypatch.setattr(pyudev, "Monitor", Monitors)
    assert isinstance(open_watcher(), UdevWatcher)
    assert tuple(asked) == SUBSYSTEMS


def test_without_the_library_nothing_is_announced(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    real = builtins.__import__

    def without(name: str, *args: Any) -> Any:
        if name == "pyudev":
            raise ImportError("No module named 'pyudev'")
        return real(name, *args)

    monkeypatch.setattr(builtins, "__import__", without)
    watcher = open_watcher()
    assert isinstance(watcher, NoWatcher)
    assert "no udev announcements" in caplog.text
    watcher.start(lambda: None)
    watcher.stop()
