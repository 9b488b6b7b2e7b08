"""The screen of a terminal that is gone."""

import errno
import io

from monstertruck_runtime.clock import WallClock
from monstertruckd.tools.cli.drive_session import DriveSession


class Gone(io.StringIO):
    """A terminal whose other end was closed."""

    def isatty(self) -> bool:
        return True

    def write(self, _text: str) -> int:
        raise OSError(errno.EIO, "Input/output error")


async def test_the_screen_of_a_terminal_that_is_gone_ends_quietly():
    session = DriveSession(None, WallClock(), None, Gone())
    await session._draw(None)
