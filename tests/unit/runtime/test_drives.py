"""Paths of clients that do not arm the robot themselves."""

import asyncio
import math
from types import SimpleNamespace

from monstertruck_runtime.clock import run_virtual
from monstertruck_runtime.drives import _disarmed
from monstertruck_schemas.state import GateMode, GateState


def test_a_path_is_given_up_once_the_robot_has_been_disarmed_for_the_time_allowed():
    def state(mode):
        return GateState(stamp=0, received=0, seq=0, mode=mode, nonce="n", speed_limit=0.2)

    async def main(clock):
        stand = SimpleNamespace(gate=SimpleNamespace(latest=state(GateMode.DISARMED)))
        waiting = asyncio.create_task(_disarmed(clock, stand, 10.0))
        for mode, seconds in ((GateMode.DISARMED, 9.0), (GateMode.DRIVING, 20.0), (GateMode.DISARMED, 9.0)):
            stand.gate.latest = state(mode)
            await clock.sleep(seconds)
            assert not waiting.done()
        await clock.sleep(2.0)
        assert waiting.result().text.startswith("disarmed for 10 s")
        forever = asyncio.create_task(_disarmed(clock, stand, math.inf))
        await clock.sleep(3600.0)
        assert not forever.done()
        forever.cancel()

    run_virtual(main)
