"""The live screen follows a robot that comes, goes and comes back."""

import asyncio
from contextlib import suppress

from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import NotFoundError
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.health import LoopHealth
from monstertruck_schemas.topics import EVENT, LOOP
from monstertruckd.tools.status import watch
from monstertruckd.tools.status.screen import ScreenState


class Station:
    """Connects from the third attempt on; its robot speaks for a while."""

    def __init__(self, clock):
        self.clock = clock
        self.attempts = 0
        self.robot, self.endpoint = "truck", "tcp/there"
        self.boxes = {}

    def client(self, *_, **__):
        return self

    async def __aenter__(self):
        self.attempts += 1
        if self.attempts < 3:
            await self.clock.sleep(1.0)
            raise NotFoundError("no robot answers at tcp/there within 1 s")
        return self

    async def __aexit__(self, *_):
        pass

    def subscribe(self, topic, delivery):
        return self.boxes.setdefault(topic.name, Mailbox(delivery if topic is EVENT else latest()))

    async def speak(self, seconds):
        for seq in range(round(seconds * 10)):
            now = self.clock.now()
            late = {"ticks": 5, "lateness_p50": 0.0, "lateness_p99": 0.0, "lateness_max": 0.0}
            self.boxes[LOOP.name].put(LoopHealth(stamp=now, received=now, seq=seq, **late))
            await self.clock.sleep(0.1)


def test_silence_is_counted_and_ends_when_the_robot_is_back(monkeypatch):
    async def main(clock):
        station = Station(clock)
        monkeypatch.setattr(watch, "TruckClient", station.client)
        state = ScreenState("truck", clock.now())
        following = asyncio.create_task(watch._follow(clock, "truck", "tcp/there", state))
        await clock.sleep(1.5)
        assert state.trouble == "no robot answers at tcp/there within 1 s"
        assert 0.9 < state.silence < 1.6
        assert state.began is None
        await clock.sleep(1.5)
        assert state.trouble == ""
        await station.speak(2.0)
        assert state.silence < 0.2
        said = state.now
        await clock.sleep(12.0)
        assert 11.9 < state.silence < 12.2
        assert state.now == said
        assert clock.now() - said > 11 * SECOND
        await station.speak(0.5)
        assert state.silence < 0.2
        following.cancel()
        with suppress(asyncio.CancelledError):
            await following

    run_virtual(main)
