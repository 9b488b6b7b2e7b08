"""The daemon on a kernel that waits for a device: ``python -m tests.daemon.wedged_port FLAG PORT run ...``.

While the file FLAG exists, the device behind PORT takes no bytes and sends none: the kernel keeps what is written until
its buffer is full, and draining or closing the port waits, as with ``cdc_acm`` of Linux 6.1, where closing takes 31 s.
Ptys do none of this.
"""

import errno
import fcntl
import os
import struct
import sys
import termios
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from monstertruckd.__main__ import main

BUFFER = 4096
"""Bytes that the kernel keeps for a device."""
POLL = 0.02


class Kernel:
    """Calls of the kernel on one port.

    Args:
        flag: the device is wedged while this file exists.
        port: its path.
    """

    def __init__(self, flag: Path, port: Path) -> None:
        self._flag, self._port = flag, port
        self._untaken = 0
        self._write, self._read, self._ioctl = os.write, os.read, fcntl.ioctl

    def _is_wedged(self, line: int) -> bool:
        if not self._flag.exists():
            self._untaken = 0
            return False
        return Path(f"/proc/self/fd/{line}").readlink() == self._port.resolve()

    def write(self, line: int, data: bytes) -> int:
        if not self._is_wedged(line):
            return self._write(line, data)
        if self._untaken >= BUFFER:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        self._untaken += len(data)
        return len(data)

    def read(self, line: int, count: int) -> bytes:
        data = self._read(line, count)
        if data and self._is_wedged(line):
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return data

    def ioctl(self, line: Any, request: int, *arguments: Any) -> Any:
        if request == termios.TIOCOUTQ and self._is_wedged(line):
            return struct.pack("I", self._untaken)
        return self._ioctl(line, request, *arguments)

    def wait_and(self, call: Callable[[int], None], line: int) -> None:
        """Drain or close: wait for the device first."""
        while self._is_wedged(line):
            time.sleep(POLL)
        call(line)

    def take_over(self) -> None:
        """Stand in for the kernel in this process."""
        os.write, os.read, fcntl.ioctl = self.write, self.read, self.ioctl  # type: ignore[assignment]
        os.close, termios.tcdrain = partial(self.wait_and, os.close), partial(self.wait_and, termios.tcdrain)  # type: ignore[assignment]


if __name__ == "__main__":
    Kernel(Path(sys.argv[1]), Path(sys.argv[2])).take_over()
    sys.argv[1:] = sys.argv[3:]
    main()
