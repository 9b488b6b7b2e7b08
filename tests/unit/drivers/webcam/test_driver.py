"""Driver and emulated camera on the virtual clock; driver and V4L2 camera on the wall clock."""

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monstertruck_drivers.cable import EmulatedPort, MemoryPort, PtyPort
from monstertruck_drivers.webcam import protocol as v4l2
from monstertruck_drivers.webcam.config import WebcamConfig
from monstertruck_drivers.webcam.driver import WebcamDriver
from monstertruck_drivers.webcam.emulator import WebcamEmulator
from monstertruck_drivers.webcam.packets import CameraPacket, PacketKind, encode_mode
from monstertruck_drivers.webcam.rendered_source import PathSource, RenderedSource
from monstertruck_drivers.webcam.source import FrameSource, Mode
from monstertruck_drivers.webcam.v4l2_source import V4l2Source
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceMismatchError,
    DeviceTimeoutError,
    InputError,
    PortBusyError,
    ProtocolError,
)
from monstertruck_runtime.service import RestartPolicy, supervise
from monstertruck_runtime.threads import Offload, inline
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import CompressedImage
from tests.unit.drivers.kit import Events, Kept, background
from tests.unit.drivers.webcam.fake_kernel import FakeKernel, Node
from tests.unit.drivers.webcam.pictures import picture, pixels

SMALL = {"width": 160, "height": 120}


class Plain:
    """A wall that becomes brighter."""

    def exposure(self, time_ns: int, size: tuple[int, int]) -> Any:
        return lambda: np.full((size[1], size[0], 3), min(10 + 20 * time_ns // SECOND, 255), np.uint8)


class Rig:
    def __init__(self, clock: Clock, port: EmulatedPort, offload: Offload = inline, **config: Any) -> None:
        self.clock = clock
        self.port = port
        self.emulator = WebcamEmulator(clock, Plain(), offload=offload, usb=port)
        self.out: Kept[CompressedImage] = Kept()
        self.events = Events()
        self.ready = 0
        self.source: FrameSource = RenderedSource(port, clock)  # type: ignore[arg-type]
        self.config = WebcamConfig(**(SMALL | config))

    async def session(self) -> None:
        await self.driver().run(self._ready)

    def driver(self) -> WebcamDriver:
        return WebcamDriver(self.config, self.source, self.clock, self.out, self.events)

    def _ready(self) -> None:
        self.ready += 1

    @property
    def sequences(self) -> list[int]:
        return [image.sequence for image in self.out.kept]


def on_bench(test: Callable[[Rig], Coroutine[Any, Any, None]], **config: Any) -> None:
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, MemoryPort("camera"), **config)
        async with background(rig.emulator.run(rig.port.device)):
            await asyncio.sleep(0)
            rig.port.plug()
            await test(rig)
            rig.port.unplug()

    run_virtual(main)


def test_pictures_come_at_the_configured_rate_with_the_time_of_their_exposure():
    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            await rig.clock.sleep(4)
        assert len(rig.out.kept) == pytest.approx(60, abs=1)
        assert rig.sequences == list(range(len(rig.out.kept)))
        assert [image.seq for image in rig.out.kept] == rig.sequences
        steps = np.diff([image.stamp for image in rig.out.kept])
        np.testing.assert_allclose(steps, SECOND / 15, atol=2000)
        last = rig.out.last
        assert 0 < last.received - last.stamp < 0.02 * SECOND
        assert (last.frame, last.format) == ("camera", "jpeg")
        assert pixels(last.data).shape == (120, 160, 3)
        assert rig.ready > 0
        assert rig.events.kept == []

    on_bench(test)


def test_the_picture_shows_the_world_at_its_stamp():
    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            await rig.clock.sleep(6)
        early, late = (pixels(rig.out.kept[i].data).astype(int)[60, 80].sum() for i in (0, -1))
        assert late > early + 50, "nearer walls are brighter"

    on_bench(test)


def test_two_runs_are_identical():
    runs: list[list[CompressedImage]] = []

    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            await rig.clock.sleep(1)
        runs.append(rig.out.kept)

    on_bench(test)
    on_bench(test)
    assert runs[0] == runs[1]


def test_another_mode_is_used_and_reported_once():
    async def test(rig: Rig) -> None:
        driver = rig.driver()
        for _ in range(2):
            async with background(driver.run(rig._ready)):
                await rig.out.count(3)
        assert rig.events.reasons() == [Reason.DEVICE_MISMATCH]
        assert "offers 160x120 at 30 Hz, expected 150x100 at 60 Hz" in rig.events.kept[0][2]

    on_bench(test, width=150, height=100, rate=60.0)


def test_missing_pictures_are_gaps_in_the_sequence():
    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            await rig.out.count(3)
            rig.emulator.inject("drop", "4")
            await rig.out.count(2)
        assert rig.sequences == [0, 1, 2, 7, 8]
        assert [image.seq for image in rig.out.kept] == [0, 1, 2, 3, 4]

    on_bench(test)


@pytest.mark.parametrize("fault", ["corrupt", "truncate"])
def test_damaged_pictures_are_dropped_and_reported_once(fault: str):
    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            await rig.out.count(3)
            rig.emulator.inject(fault, "5")
            await rig.out.count(2)
            rig.emulator.inject(fault, "1")
            await rig.out.count(2)
        assert rig.sequences == [0, 1, 2, 8, 9, 11, 12]
        assert rig.events.reasons() == [Reason.DEVICE_PROTOCOL] * 2

    on_bench(test)


def test_pictures_without_tables_become_readable():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("bare", "on")
        async with background(rig.session()):
            await rig.out.count(2)
        assert pixels(rig.out.last.data).shape == (120, 160, 3)

    on_bench(test)


@pytest.mark.parametrize("seconds", ["-3", "0.5", "40"])
def test_a_jump_of_the_cameras_time_is_not_believed(seconds: str):
    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            await rig.out.count(3)
            rig.emulator.inject("jump", seconds)
            await rig.out.count(5)
            rig.emulator.inject("jump", "0")
            await rig.out.count(5)
        stamps = [image.stamp for image in rig.out.kept]
        assert stamps == sorted(stamps)
        assert all(0 <= image.received - image.stamp < 0.05 * SECOND for image in rig.out.kept)
        assert [image.received == image.stamp for image in rig.out.kept[3:8]] == [True] * 5
        assert rig.out.last.received != rig.out.last.stamp, "believed again"
        assert rig.events.reasons() == [Reason.DEVICE_PROTOCOL]

    on_bench(test)


def test_a_stuck_camera_ends_the_session_after_the_watchdogs_time():
    async def test(rig: Rig) -> None:
        task = asyncio.create_task(rig.session())
        await rig.out.count(3)
        rig.emulator.inject("stuck", "on")
        before = rig.clock.now()
        with pytest.raises(DeviceTimeoutError, match=r"no image for 2\.0 s"):
            await task
        assert (rig.clock.now() - before) / SECOND == pytest.approx(2.0, abs=0.1)
        rig.emulator.inject("stuck", "off")
        async with background(rig.session()):
            await rig.out.count(3)

    on_bench(test)


def test_a_camera_that_sends_only_garbage_ends_the_session_too():
    async def test(rig: Rig) -> None:
        task = asyncio.create_task(rig.session())
        await rig.out.count(3)
        rig.emulator.inject("truncate", "1000")
        with pytest.raises(ProtocolError, match=r"30 images in 2\.0 s, none complete"):
            await task

    on_bench(test, rate=15.2)  # the limit lies between two pictures


@pytest.mark.parametrize(
    ("refusal", "kind"), [("EINVAL", DeviceMismatchError), ("EBUSY", PortBusyError), ("ENOSPC", DeviceFaultError)]
)
def test_refusals(refusal: str, kind: type[Exception]):
    async def test(rig: Rig) -> None:
        rig.emulator.inject("refuse", refusal)
        with pytest.raises(kind):
            await rig.session()
        assert rig.ready == 0
        rig.emulator.inject("refuse", "off")
        async with background(rig.session()):
            await rig.out.count(1)

    on_bench(test)


def test_gone_in_mid_stream_and_back_by_the_supervisor():
    async def test(rig: Rig) -> None:
        health: list[ServiceHealth] = []
        rng = np.random.default_rng(1)
        async with background(supervise(rig.driver(), RestartPolicy(), rig.clock, health.append, rng)):
            await rig.out.count(3)
            rig.emulator.inject("vanish", "0.5")
            gone = rig.clock.now()
            await rig.out.count(3)
            assert (rig.clock.now() - gone) / SECOND < 2.0
        assert next(row.reason for row in health if row.state is ServiceState.BACKOFF) is Reason.DEVICE_LOST
        assert rig.sequences == [0, 1, 2, 0, 1, 2], "the camera counts anew"
        assert [image.seq for image in rig.out.kept] == list(range(6))

    on_bench(test)


def test_nothing_plugged_in_and_nobody_answering():
    async def test(rig: Rig) -> None:
        rig.port.device.faults.deaf = True
        with pytest.raises(DeviceTimeoutError, match="no camera answers"):
            await rig.session()
        rig.port.device.faults.deaf = False
        rig.port.unplug()
        with pytest.raises(DeviceLostError):
            await rig.session()

    on_bench(test)


def test_bytes_one_by_one_and_flipped_bits():
    async def test(rig: Rig) -> None:
        rig.port.device.faults.chunk = 1
        async with background(rig.session()):
            await rig.out.count(3)
        rig.port.device.faults.chunk = None
        rig.port.device.faults.flip_rate = 2e-4
        rig.port.device.faults.seed(3)
        async with background(rig.session()):
            await rig.out.count(20)

    on_bench(test)


def test_a_host_that_leaves_stops_the_camera_and_one_that_dies_does_not_harm():
    async def test(rig: Rig) -> None:
        async with background(rig.session()):
            await rig.out.count(3)
        await rig.clock.sleep(1)
        async with background(rig.session()):
            await rig.out.count(1)
        assert rig.sequences[-1] <= 4, "it did not stream for nobody"
        link = await rig.port.open()  # type: ignore[attr-defined]
        link.write(b"OPEN 160 120 15\n")
        await rig.clock.sleep(1)
        link.close()  # without a CLOSE
        await rig.clock.sleep(1)
        async with background(rig.session()):
            await rig.out.count(3)
        link = await rig.port.open()  # type: ignore[attr-defined]
        link.write(b"OPEN 160\nOPEN a b c\nWHAT\n" + bytes(10_000))
        await rig.clock.sleep(1)
        link.close()
        async with background(rig.session()):
            await rig.out.count(3)

    on_bench(test)


def test_unknown_faults_are_refused_with_a_list():
    async def test(rig: Rig) -> None:
        for fault in (("explode",), ("drop", "x"), ("refuse", "EPERM")):
            with pytest.raises(InputError, match="known: drop"):
                rig.emulator.inject(*fault)
        rig.emulator.usb = None
        async with background(rig.session()):
            await rig.out.count(3)
            rig.emulator.inject("vanish")  # without a port it only starts anew, and forgets that it was to stream
            await rig.clock.sleep(1)
        assert len(rig.out.kept) == 3

    on_bench(test)


@pytest.mark.wall
async def test_on_the_wall_clock_over_a_pty_with_rendering_in_a_thread(tmp_path: Path):
    clock = WallClock()
    rig = Rig(clock, PtyPort(tmp_path / "camera"), offload=_watched, width=640, height=480, rate=30.0)
    rig.source = PathSource(str(tmp_path / "camera"), clock)
    async with background(rig.emulator.run(rig.port.device)):
        await asyncio.sleep(0)
        rig.port.plug()
        async with background(rig.session()):
            await rig.out.count(10)
        rig.port.unplug()
    assert pixels(rig.out.last.data).shape == (480, 640, 3)
    assert rig.events.kept == []


async def _watched(function: Callable[[], Any]) -> Any:
    return await asyncio.to_thread(function)


async def test_a_v4l2_camera_whose_node_vanishes():
    kernel = FakeKernel(video0=Node())
    node = kernel.by_path["/dev/video0"]
    out: Kept[CompressedImage] = Kept()
    clock, events = WallClock(), Events()
    driver = WebcamDriver(WebcamConfig(), V4l2Source("/dev/video*", kernel, inline), clock, out, events)
    task = asyncio.create_task(driver.run(lambda: None))
    while not node.streaming:
        await asyncio.sleep(0)
    node.push(picture(), stamp=clock.now())
    await out.count(1)
    node.push(picture(seed=1), stamp=clock.now(), damaged=True)
    await asyncio.sleep(0.01)
    node.push(picture(seed=2), monotonic=False)
    await out.count(1)
    assert [image.data for image in out.kept] == [picture(), picture(seed=2)]
    assert out.last.stamp == out.last.received
    assert events.reasons() == [Reason.DEVICE_PROTOCOL]
    node.fail(19)
    with pytest.raises(DeviceLostError):
        await task
    assert (node.opened, node.mapped) == (0, 0)
    node.errors.pop(v4l2.DQBUF)
    async with background(driver.run(lambda: None)):
        while not node.streaming:
            await asyncio.sleep(0)
        node.push(picture(seed=3), stamp=clock.now())
        await out.count(1)


def test_a_picture_that_comes_with_the_grant_is_not_lost():
    async def main(clock: VirtualClock) -> None:
        port, granted = MemoryPort("camera"), Mode(160, 120, 15.0)
        port.plug()

        async def camera() -> None:
            await port.device.read()
            grant = CameraPacket(PacketKind.GRANTED, payload=encode_mode(granted))
            port.device.write(grant.encode() + CameraPacket(PacketKind.PICTURE, 7, 1, b"picture").encode())

        async with (
            background(camera()),
            await RenderedSource(port, clock).open(granted, 4) as stream,
            clock.deadline(1.0),
        ):
            frame = await stream.next()
        assert (frame.sequence, frame.data) == (7, b"picture")

    run_virtual(main)
