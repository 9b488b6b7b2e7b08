"""Waiting for input on a shared file: the shell, the screen and every program share the terminal's open file."""

import asyncio
import os
from collections.abc import Callable


def when_readable(fd: int, callback: Callable[[], object]) -> None:
    """Call back when ``fd`` is readable, without changing its mode.

    uvloop makes it non-blocking permanently, which affects the screen and all other users of the terminal.

    Raises:
        PermissionError: it is a regular file.
    """
    blocking = os.get_blocking(fd)
    try:
        asyncio.get_running_loop().add_reader(fd, callback)
    finally:
        os.set_blocking(fd, blocking)
