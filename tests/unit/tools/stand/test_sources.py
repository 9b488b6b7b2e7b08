"""Pictures of rendered cameras come through their port, one after the other."""

import asyncio
import contextlib
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.webcam.emulator import WebcamEmulator
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.stand.config import FileSource, RenderedCamera
from monstertruckd.tools.stand.sources import pictures_in, stream


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


def test_a_picture_or_film_too_large_to_be_held_is_refused_before_it_is_decoded(tmp_path: Path):
    Image.new("1", (16_000, 16_000)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a\.png: .*256000000 pixels.*expected at most 25000000 pixels"):
        pictures_in(tmp_path)
    film = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (6000, 4200))
    film.write(np.zeros((4200, 6000, 3), np.uint8))
    film.release()
    with pytest.raises(InputError, match=r"film\.avi: 6000 x 4200 pixels: expected at most 25000000"):
        list(stream(FileSource(path=tmp_path / "film.avi"), (64, 48), 10.0))


def test_a_length_in_a_damaged_picture_reserves_no_memory(tmp_path: Path):
    Image.new("L", (80, 60)).save(tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    length = (1 << 30).to_bytes(4, "big")
    begin = data.index(b"IDAT") - 4
    (tmp_path / "a.png").write_bytes(data[:begin] + length + data[begin + 4 :])
    Path("/proc/self/clear_refs").write_text("5")  # the peak so far is forgotten
    before = peak()
    with contextlib.suppress(InputError):
        pictures_in(tmp_path)
    assert peak() - before < 50


def peak() -> float:
    """Greatest resident memory, MB."""
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) / 1000


def test_pictures_of_all_depths_keep_their_shade_and_the_order_of_their_colours(tmp_path: Path):
    Image.fromarray(np.full((4, 6), 40_000, np.uint16)).save(tmp_path / "a.png")
    Image.new("RGB", (6, 4), (200, 100, 50)).save(tmp_path / "b.png")
    Image.new("1", (6, 4), 1).save(tmp_path / "c.png")
    deep, coloured, white = pictures_in(tmp_path)
    assert [int(it[0, 0]) for it in (deep, coloured, white)] == [155, 124, 255]
    seen = list(stream(FileSource(path=tmp_path), (6, 4), 10.0, colour=True))
    assert [it[0, 0].tolist() for it in seen] == [[155] * 3, [50, 100, 200], [255] * 3]
