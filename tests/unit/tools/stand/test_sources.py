"""Pictures of rendered cameras come through their port, one after the other."""

import asyncio
from pathlib import Path

import numpy as np

from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.webcam.emulator import WebcamEmulator
from monstertruck_runtime.clock import WallClock
from monstertruckd.tools.stand.config import RenderedCamera
from monstertruckd.tools.stand.sources import stream


class Grey:
    def exposure(self, time_ns: int, size: tuple[int, int]):
        del time_ns
        return lambda: np.full((size[1], size[0], 3), 90, np.uint8)


def test_a_rendered_camera_streams_through_its_port(tmp_path: Path):
    def two() -> list[np.ndarray]:
        pictures = stream(RenderedCamera(port=tmp_path / "camera"), (160, 120), 30.0)
        found = [next(pictures), next(pictures)]
        pictures.close()
        return found

    async def main() -> list[np.ndarray]:
        port = PtyPort(tmp_path / "camera")
        serving = asyncio.create_task(WebcamEmulator(WallClock(), Grey()).run(port.device))
        port.plug()
        try:
            return await asyncio.to_thread(two)
        finally:
            port.unplug()
            serving.cancel()
            await asyncio.wait([serving])

    first, second = asyncio.run(main())
    assert first.shape == second.shape == (120, 160)
    assert abs(int(first[100, 100]) - 90) < 4
