"""The station of a drill, which outlives daemons."""

import asyncio
from types import SimpleNamespace

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruckd.tools.drill.truck import DrivingStation


class Bus:
    def __init__(self):
        self.sent = []

    def subscribe(self, topic, delivery):
        return SimpleNamespace(latest=None)

    def inject(self, topic, request):
        self.sent.append(request.seq)


def test_attached_to_another_daemon_it_is_silent_at_first_and_goes_on_there():
    first, second = Bus(), Bus()

    async def main(clock: VirtualClock) -> None:
        station = DrivingStation(first, clock)
        asking = asyncio.create_task(station.run())
        await clock.sleep(0.11)
        assert first.sent == []
        station.silent = False
        await clock.sleep(0.1)
        station.attach(second)
        await clock.sleep(0.1)
        assert second.sent == []
        station.silent = False
        await clock.sleep(0.1)
        asking.cancel()

    run_virtual(main)
    assert first.sent == [1, 2]
    assert second.sent == [3, 4]
