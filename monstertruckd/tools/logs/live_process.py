"""A running robot in the rerun viewer, drawn by a separate process.

The SDK buffers messages that the viewer does not read, and blocks when the buffer is full. In the station's process it
would block the page as well. The process runs only while a viewer listens.
"""

import asyncio
import sys
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import Sequence
from contextlib import suppress
from typing import Final
from urllib.parse import urlsplit

from monstertruck_runtime.clock import Clock

VIEWER: Final = "rerun+http://127.0.0.1:9876/proxy"
"""Address of a viewer on this machine: ``rerun --bind 127.0.0.1``."""
LISTENER_LOOK_PERIOD: Final = 2.0
"""Interval between checks whether a viewer listens (s)."""
PROGRAM: Final = (sys.executable, "-m", "monstertruckd.tools.logs.live")


async def show_live(
    robot: str, endpoint: str, clock: Clock, viewer: str = VIEWER, program: Sequence[str] = PROGRAM
) -> None:
    """Show a robot until cancelled, in a viewer whenever there is one.

    Args:
        robot: name of the robot.
        endpoint: endpoint of the robot.
        clock: time.
        viewer: address of the rerun viewer.
        program: program that draws, given robot, endpoint and viewer.
    """
    while True:
        while not await listens(viewer):
            await clock.sleep(LISTENER_LOOK_PERIOD)
        # A separate session: Ctrl-C goes to the station, which ends this process.
        drawing = await asyncio.create_subprocess_exec(
            *program, robot, endpoint, viewer, stdin=PIPE, stdout=DEVNULL, start_new_session=True
        )
        try:
            while drawing.returncode is None and await listens(viewer):
                await clock.sleep(LISTENER_LOOK_PERIOD)
        finally:
            with suppress(ProcessLookupError):
                drawing.kill()
            await drawing.wait()
        await clock.sleep(LISTENER_LOOK_PERIOD)


async def listens(viewer: str) -> bool:
    """Return whether a viewer answers at an address."""
    place = urlsplit(viewer)
    try:
        async with asyncio.timeout(LISTENER_LOOK_PERIOD):
            _, writer = await asyncio.open_connection(place.hostname, place.port)
    except (OSError, TimeoutError):
        return False
    writer.close()
    return True
