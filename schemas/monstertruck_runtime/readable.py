"""Waiting for input that others share: a terminal is one open file of the shell, the screen and every program."""

import asyncio
import os
from collections.abc import Callable


def when_readable(fd: int, callback: Callable[[], object]) -> None:
    """Have the loop call back, and leave the mode of ``fd`` alone.

    uvloop makes it non-blocking, forever, and with it the screen and whatever else shares the open terminal.

    Raises:
        PermissionError: it is a file.
    """
    blocking = os.get_blocking(fd)
    try:
        asyncio.get_running_loop().add_reader(fd, callback)
    finally:
        os.set_blocking(fd, blocking)
