"""The stand's link to a robot: poses carry the time of the robot's clock, whatever computer the stand runs on."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Self

import pytest

from monstertruck_runtime import client
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import NotPermittedError
from monstertruck_runtime.mailbox import Delivery, Mailbox
from monstertruck_runtime.presence import GONE
from monstertruck_schemas.sensor import StandPose
from monstertruck_schemas.state import GateState
from monstertruckd.tools.cli.stand_session import RobotLink
from monstertruckd.tools.stand.poses import RobotPose
from tests.bus_kit import gate_state

LATE = 0.03
"""Seconds that a message takes, or more."""


class Robot:
    """Tells its gate's state ten times a second, by a clock that is ``behind`` that of the stand."""

    def __init__(self, clock: VirtualClock, behind: float) -> None:
        self.clock, self.behind = clock, round(behind * SECOND)
        self.box: Mailbox[GateState] | None = None
        self.poses: list[StandPose] = []

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    @contextmanager
    def subscribe(self, _: object, delivery: Delivery) -> Iterator[Mailbox[GateState]]:
        self.box = Mailbox(delivery)
        yield self.box

    async def live(self, seconds: float) -> None:
        for number in range(round(10 * seconds)):
            await self.clock.sleep(0.1)
            if self.box is not None:
                stamp = self.clock.now() - self.behind - round(LATE * (1 + number % 3) * SECOND)
                self.box.put(gate_state(0).model_copy(update={"stamp": stamp}))

    def publish_stand_pose(self, pose: StandPose) -> None:
        self.poses.append(pose)


def test_why_a_robot_gets_no_poses_is_said_once(monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object, **__: object) -> None:
        raise NotPermittedError("station.key: other users may read it")

    async def main(clock: VirtualClock) -> None:
        monkeypatch.setattr(client, "TruckClient", refuse)
        said: list[str] = []
        running = asyncio.create_task(RobotLink("truck", "tls/there", clock, said.append).run())
        await clock.sleep(20.0)
        running.cancel()
        assert said == ["robot truck: station.key: other users may read it"]

    run_virtual(main)


@pytest.mark.parametrize(("behind", "error"), [(5000.0, LATE), (-5000.0, LATE), (0.0, 0.0)])
def test_poses_are_stamped_by_the_robots_clock(behind: float, error: float, monkeypatch: pytest.MonkeyPatch):
    async def main(clock: VirtualClock) -> None:
        robot = Robot(clock, behind)
        monkeypatch.setattr(client, "TruckClient", lambda *_, **__: robot)
        said: list[str] = []
        link = RobotLink("truck", "tcp/there", clock, said.append)
        seen = RobotPose("truck", 0, 1.0, 2.0, 0.5, 0.001, 0.002, ("left",))
        running = asyncio.create_task(link.run())
        link.put(seen)
        await robot.live(3.0)
        at = clock.now()
        link.put(seen._replace(stamp=at))
        (pose,) = robot.poses
        assert (pose.stamp - (at - robot.behind)) / SECOND == pytest.approx(-error, abs=1e-6)
        assert pose.received == pose.stamp
        await clock.sleep(GONE + 0.5)
        link.put(seen)
        assert len(robot.poses) == 1, "it is gone"
        assert said == ["robot truck: receives its poses", "robot truck: is silent or not running"]
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running

    run_virtual(main, start=10_000 * SECOND)
