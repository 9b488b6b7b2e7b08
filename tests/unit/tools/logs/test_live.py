"""A running robot in rerun: what it publishes is drawn as it comes, into a stream that only counts."""

import asyncio
from typing import Any

import pytest

from monstertruck_runtime.clock import WallClock
from monstertruck_schemas.topics import GATE, ODOMETRY, Writer
from tests.bus_kit import gate_state, odometry, running_robot

pytest.importorskip("rerun", reason="the extra 'viewers' is not installed")


class CountingStream:
    """Takes what a recording of rerun takes, and keeps the names."""

    def __init__(self):
        self.logged: list[str] = []
        self.layouts = 0

    def log(self, entity: str, *_: Any, **__: Any) -> None:
        self.logged.append(entity)

    def send_columns(self, entity: str, *_: Any) -> None:
        self.logged.append(f"columns of {entity}")

    def send_blueprint(self, _: Any) -> None:
        self.layouts += 1

    def __getattr__(self, name: str) -> Any:
        assert name in ("set_time", "set_log_time_enabled", "set_log_tick_enabled")
        return lambda *_, **__: None


async def test_what_a_robot_publishes_is_drawn_as_it_comes():
    from monstertruckd.tools.logs.live import follow

    stream = CountingStream()
    async with running_robot() as robot:
        gate = robot.bus.publisher(GATE, Writer.GATE)
        driven = robot.bus.publisher(ODOMETRY, Writer.ESTIMATION)
        following = asyncio.create_task(follow("truck", robot.endpoint, WallClock(), stream))
        async with asyncio.timeout(20):
            while not (stream.layouts and sum(name.startswith("columns of") for name in stream.logged) > 4):
                gate.put(gate_state(len(stream.logged) + 1))
                driven.put(odometry(len(stream.logged) + 1))
                await asyncio.sleep(0.02)
                assert not following.done()
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)
    assert len({name for name in stream.logged if not name.startswith("columns of")}) > 1
