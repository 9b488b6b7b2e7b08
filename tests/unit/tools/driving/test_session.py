"""The screen of a terminal that is gone."""

import asyncio
import errno
import io

from monstertruck_runtime.clock import WallClock
from monstertruck_schemas.req import Order
from monstertruckd.tools.driving.session import DriveSession
from monstertruckd.tools.driving.teleop import TeleopRequest


class Gone(io.StringIO):
    """A terminal whose other end was closed."""

    def isatty(self) -> bool:
        return True

    def write(self, _text: str) -> int:
        raise OSError(errno.EIO, "Input/output error")


async def test_the_screen_of_a_terminal_that_is_gone_ends_quietly():
    session = DriveSession(None, WallClock(), None, Gone())
    await session._draw(None)


class Robot:
    """A client whose orders are published by the call and never answered."""

    def __init__(self) -> None:
        self.published: list[Order] = []

    def order(self, order: Order, *, hold: bool = False, calibrates: bool = False):
        self.published.append(order)
        return self._outcome()

    async def _outcome(self):
        await asyncio.Event().wait()


async def test_an_emergency_stop_that_the_end_follows_at_once_has_left():
    robot = Robot()
    session = DriveSession(None, WallClock(), None, io.StringIO())
    session._commands.put_nowait(Order.ESTOP)
    session._commands.put_nowait("end")
    await asyncio.wait_for(session._obey(robot), 1.0)
    assert robot.published == [Order.ESTOP]


class Driven(Robot):
    """A client that keeps the requests it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.requests = []

    async def drive(self, *motion, lease, unseen):
        self.requests.append(("axles", *motion, unseen))

    async def drive_twist(self, *motion, lease, unseen):
        self.requests.append(("twist", *motion, unseen))


async def test_each_mode_sends_its_form_of_request():
    robot = Driven()
    session = DriveSession(None, WallClock(), None, io.StringIO())
    await session._request(robot, TeleopRequest(0.1, 0.2, 0.0))
    await session._request(robot, TeleopRequest(0.0, 0.0, 0.0, (0.0, 0.1, 0.5), unseen=True))
    assert robot.requests == [("axles", 0.1, 0.2, 0.0, False), ("twist", 0.0, 0.1, 0.5, True)]
