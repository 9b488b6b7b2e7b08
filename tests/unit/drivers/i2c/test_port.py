"""The kernel's buses: the calls made, their errors, and what is no bus."""

import asyncio
import ctypes
import errno
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.i2c import bus, port
from monstertruck_drivers.i2c.host import I2cBus
from monstertruck_drivers.i2c.port import I2cPort
from monstertruck_drivers.i2c.protocol import serve
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import DeviceLostError, DeviceTimeoutError
from tests.unit.drivers.kit import background

ADAPTER_TIMEOUT, READ, I2C_TIMEOUT, MAJOR = 5, 0x0001, 0x0702, 89


class Kernel:
    """Stands in for ``fcntl.ioctl``: a device at 0x40 that answers 1, 2, 3 ..."""

    def __init__(self):
        self.calls = []
        self.error = 0

    def ioctl(self, file, request, argument):
        if request == I2C_TIMEOUT:
            self.calls.append(("timeout", argument))
            return
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        for message in argument.messages[: argument.count]:
            if message.flags & READ:
                ctypes.memmove(message.buffer, bytes(range(1, message.length + 1)), message.length)
                self.calls.append(("read", message.address, message.length))
            else:
                self.calls.append(("write", message.address, ctypes.string_at(message.buffer, message.length)))


@pytest.fixture
def kernel(monkeypatch):
    found = Kernel()
    monkeypatch.setattr(bus.fcntl, "ioctl", found.ioctl)
    return found


def test_writing_and_reading_are_one_call_with_a_repeated_start(kernel):
    assert bus.transfer(9, 0x40, b"\x06", 3) == b"\x01\x02\x03"
    assert bus.transfer(9, 0x40, b"\x06\x00\x10") == b""
    assert bus.transfer(9, 0x41, b"", 1) == b"\x01"
    assert kernel.calls == [
        ("write", 0x40, b"\x06"),
        ("read", 0x40, 3),
        ("write", 0x40, b"\x06\x00\x10"),
        ("read", 0x41, 1),
    ]


def on_node(monkeypatch, test):
    """Run ``test`` with a link to the kernel's bus, whose node is a pipe."""

    async def main():
        node = SimpleNamespace(st_rdev=os.makedev(MAJOR, 1), st_mode=0o020660)
        monkeypatch.setattr(Path, "stat", lambda _: node)
        there, here = os.pipe()
        monkeypatch.setattr(port.os, "open", lambda *_: there)
        async with await I2cPort(Path("/dev/i2c-1")).open() as link:
            monkeypatch.undo_stat()
            await test(I2cBus(link, WallClock(), 5.0))
        async with asyncio.timeout(5):
            while _is_open(there):
                await asyncio.sleep(0.005)
        os.close(here)

    asyncio.run(main())


def _is_open(file):
    try:
        os.fstat(file)
    except OSError:
        return False
    return True


@pytest.fixture
def patched(monkeypatch):
    original = Path.stat
    monkeypatch.undo_stat = lambda: monkeypatch.setattr(Path, "stat", original)
    return monkeypatch


def test_transfers_run_in_a_thread_and_the_node_is_closed_after_the_link(kernel, patched):
    async def test(host):
        assert await host.transfer(0x40, b"\x00", 2) == b"\x01\x02"
        host.send(0x40, b"\x06\x01")
        assert await host.transfer(0x40, b"\x00", 1) == b"\x01"
        assert ("write", 0x40, b"\x06\x01") in kernel.calls
        assert kernel.calls[0] == ("timeout", ADAPTER_TIMEOUT)

    on_node(patched, test)


def test_a_missing_acknowledgement(kernel, patched):
    async def test(host):
        for number in (errno.ENXIO, errno.EREMOTEIO):
            kernel.error = number
            with pytest.raises(DeviceTimeoutError, match="no acknowledgement of address 0x40"):
                await host.transfer(0x40, b"\x00", 2)
        kernel.error = errno.ENODEV
        with pytest.raises(DeviceLostError, match="the bus was removed"):
            await host.transfer(0x40, b"\x00", 2)

    on_node(patched, test)


def test_a_node_that_is_missing_or_not_permitted(monkeypatch, tmp_path):
    with pytest.raises(DeviceLostError, match="No such file"):
        asyncio.run(I2cPort(tmp_path / "i2c-1").open())

    def refuse(_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "stat", refuse)
    with pytest.raises(DeviceLostError, match="in the group 'i2c'"):
        asyncio.run(I2cPort(tmp_path / "i2c-1").open())


def test_an_emulated_bus_is_behind_a_pty(tmp_path):
    async def main():
        cable = PtyPort(tmp_path / "i2c")
        cable.plug()
        try:
            emulated = serve(cable.device, lambda address, data, count: bytes(count))
            async with background(emulated), await I2cPort(tmp_path / "i2c").open() as link:
                assert await I2cBus(link, WallClock(), 5.0).transfer(0x40, b"\x00", 2) == b"\0\0"
        finally:
            cable.unplug()

    asyncio.run(main())
