"""A client that is not ours, witmotion (MIT licence), at the emulated WT61, over a pty.

Its gravity is 9.8 m/s^2, its rates are in degrees a second. It reads temperatures by the formula of later models.
"""

import asyncio
import contextlib
from math import degrees

import pytest
import witmotion

from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.emulation import ImuReading
from monstertruck_drivers.wt61.emulator import Wt61Emulator
from monstertruck_drivers.wt61.protocol import WT61_BAUD
from monstertruck_runtime.clock import WallClock

pytestmark = pytest.mark.wall


class Turning:
    """A unit on a robot that turns left and speeds up."""

    def imu(self, time_ns: int) -> ImuReading:
        return ImuReading((0.1, -0.2, 0.5), (0.6, -0.3, 9.8), 30.0)


async def test_rates_and_specific_force_are_the_worlds(tmp_path):
    port, emulator = PtyPort(tmp_path / "imu"), Wt61Emulator(WallClock(), Turning())
    running = asyncio.create_task(emulator.run(port.device))
    await asyncio.sleep(0)
    port.plug()
    client = witmotion.IMU(port.name, baudrate=WT61_BAUD)
    try:
        async with asyncio.timeout(10):
            while client.last_a is None or client.last_w is None:
                await asyncio.sleep(0.05)
    finally:
        await asyncio.to_thread(client.close)
        client.ser.close()
        port.unplug()
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
    assert client.last_w == pytest.approx([degrees(0.1), degrees(-0.2), degrees(0.5)], abs=1.0)
    assert client.last_a == pytest.approx([0.6, -0.3, 9.8], abs=0.1)
