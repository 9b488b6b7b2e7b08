"""Emulated ports on pseudo-terminals: the device side of a tty that any program can open."""

import asyncio
import contextlib
import os
import tty
from pathlib import Path
from typing import Final

from monstertruck_drivers.cable import DeviceEnd

FRAME: Final = 0.001
"""Seconds of a USB frame: what a device says within one reaches the host together."""


class PtyPort:
    """A pty behind a stable symlink; unplugging closes it, replugging makes a new one.

    Args:
        path: symlink to create; its folder must exist.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self.device = DeviceEnd(self.name)
        self._path = path
        self._fds: tuple[int, int] | None = None
        self._frame = bytearray()

    def plug(self) -> None:
        """Create the pty, raw, and point the symlink at it. Needs a running loop."""
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
        """Remove the symlink and close the pty: reads of the host's end fail with EIO."""
        if self._fds is None:
            return
        master, slave = self._fds
        self._fds = None
        self._frame.clear()
        self.device.connect(None)
        asyncio.get_running_loop().remove_reader(master)
        self._path.unlink(missing_ok=True)
        os.close(master)
        os.close(slave)
        if self.device.on_plug is not None:
            self.device.on_plug(False)

    def _readable(self) -> None:
        assert self._fds is not None
        # The slave stays open on our side, so EIO cannot come while we are plugged.
        with contextlib.suppress(BlockingIOError):
            self.device.take(os.read(self._fds[0], 4096))

    def _send(self, data: bytes) -> None:
        if not self._frame:
            asyncio.get_running_loop().call_later(FRAME, self._end_frame)
        self._frame += data

    def _end_frame(self) -> None:
        if self._fds is None:
            return
        # A full buffer means nobody reads: the bytes are lost, as a USB device's are.
        with contextlib.suppress(BlockingIOError):
            os.write(self._fds[0], self._frame)
        self._frame.clear()
