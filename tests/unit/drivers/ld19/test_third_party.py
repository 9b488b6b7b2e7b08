"""A client that is not ours, lds2d (Apache licence), at the emulated LD19, over a pty."""

import asyncio
import contextlib

import numpy as np
import pytest
from lds2d import Lidar

from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.ld19.emulator import Ld19Emulator
from monstertruck_runtime.clock import WallClock
from tests.unit.drivers.scanning.kit import Room

pytestmark = pytest.mark.wall


async def test_points_of_whole_turns_are_the_rooms(tmp_path):
    port, emulator = PtyPort(tmp_path / "lidar"), Ld19Emulator(WallClock(), Room())
    running = asyncio.create_task(emulator.run(port.device))
    await asyncio.sleep(0)
    port.plug()

    def listen() -> list[list[tuple[float, int, int]]]:
        with Lidar.open("LD19", port.name) as client:
            scans = client.scans()
            return [[(p.angle_deg, p.dist_mm, p.quality) for p in next(scans)] for _ in range(25)]

    try:
        async with asyncio.timeout(30):
            scans = await asyncio.to_thread(listen)
    finally:
        port.unplug()
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
    for scan in scans[20:]:
        angles, millimetres, strengths = np.array(scan).T
        ways = np.radians(-angles)
        true = Room().half / np.maximum(np.abs(np.cos(ways)), np.abs(np.sin(ways)))
        assert len(scan) == pytest.approx(450, abs=15)
        assert np.abs(millimetres / 1000 - true).max() < 0.003
        assert strengths.min() > 0
