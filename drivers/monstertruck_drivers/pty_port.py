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
        self._timer: asyncio.TimerHandle | None = None

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
        # The slave stays open on our side, so EIO cannot come while we are plugged.
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
        # What a pty has no room for, of about 10 kB, is lost as a USB device's bytes are that nobody fetches in time.
        with contextlib.suppress(BlockingIOError):
            os.write(self._fds[0], frame)
