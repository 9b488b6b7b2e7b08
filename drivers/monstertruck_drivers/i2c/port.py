"""Kernel I2C buses. Each bus has its own transfer thread, because a device may stretch the clock."""

import asyncio
import errno
import os
import queue
import stat
import threading
from contextlib import suppress
from pathlib import Path

from monstertruck_drivers.i2c import bus
from monstertruck_drivers.i2c.protocol import I2cAnswer, I2cRequest, Packets
from monstertruck_drivers.link import Link
from monstertruck_drivers.tty import SerialPort
from monstertruck_runtime.errors import DeviceLostError


class I2cPort:
    """A kernel I2C bus, or an emulated one behind a pty. Other programs may use the bus at the same time.

    Args:
        path: device node, such as /dev/i2c-1.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._path = path

    async def open(self) -> Link:
        """Open the bus; the link carries packets as defined in ``protocol``.

        Raises:
            DeviceLostError: the node does not exist, is not permitted, or is not an I2C bus.
            DeviceWedgedError: see ``SerialPort``.
            PortBusyError: another process holds the emulated bus.
        """
        try:
            node = self._path.stat()
            if os.major(node.st_rdev) != 89 or not stat.S_ISCHR(node.st_mode):  # I2C_MAJOR of the kernel
                return await SerialPort(self._path).open()
            return serve(self.name, os.open(self._path, os.O_RDWR | os.O_CLOEXEC))
        except OSError as error:
            hint = ": the user must be in the group 'i2c'" if error.errno == errno.EACCES else ""
            raise DeviceLostError(f"{self.name}: {error.strerror}{hint}") from error


def serve(name: str, file: int) -> Link:
    """Return a link to the bus opened as ``file``; the bus thread closes the file after the link."""
    loop = asyncio.get_running_loop()
    waiting: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    link = Link(name, waiting.put, lambda: waiting.put(None))

    def work() -> None:
        packets = Packets(I2cRequest)
        try:
            with suppress(OSError):
                bus.limit_waits(file)
            while (data := waiting.get()) is not None:
                answers = b"".join(bytes(_done(file, request)) for request in packets.feed(data))
                with suppress(RuntimeError):  # the loop was closed meanwhile
                    loop.call_soon_threadsafe(link.feed, answers)
        finally:
            os.close(file)

    threading.Thread(target=work, name=f"i2c {name}", daemon=True).start()
    return link


def _done(file: int, request: I2cRequest) -> I2cAnswer:
    try:
        return I2cAnswer(request.number, 0, bus.transfer(file, request.address, request.data, request.size))
    except OSError as error:
        return I2cAnswer(request.number, error.errno or errno.EIO, b"")
