"""The real camera's path down to the system calls, against a kernel that answers them."""

import asyncio
import errno
import threading

import pytest

from monstertruck_drivers.webcam import protocol as v4l2
from monstertruck_drivers.webcam import v4l2_source
from monstertruck_drivers.webcam.config import WebcamConfig
from monstertruck_drivers.webcam.identity import identify
from monstertruck_drivers.webcam.rendered_source import PathSource
from monstertruck_drivers.webcam.source import Mode
from monstertruck_drivers.webcam.v4l2_source import V4l2Source, find_node
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import (
    DeviceError,
    DeviceFaultError,
    DeviceLostError,
    DeviceMismatchError,
    PortBusyError,
)
from monstertruck_runtime.threads import inline
from tests.unit.drivers.webcam.fake_kernel import META_CAPTURE, YUYV, FakeKernel, Node

MODE = Mode(640, 480, 15.0)


def metadata() -> Node:
    return Node(flags=META_CAPTURE | v4l2.CAP_STREAMING, formats=())


def source(kernel: FakeKernel, pattern: str = "/dev/video*") -> V4l2Source:
    return V4l2Source(pattern, kernel, inline)


async def test_the_capturing_node_is_taken_and_not_the_metadata_node():
    kernel = FakeKernel(video0=metadata(), video1=Node(formats=(YUYV,)), video2=Node())
    assert find_node("/dev/video*", kernel) == "/dev/video2"
    async with await source(kernel).open(MODE, 4) as stream:
        assert stream.mode == MODE
        assert kernel.by_path["/dev/video2"].streaming
    assert not any(node.opened for node in kernel.by_path.values())


async def test_pictures_come_with_stamp_and_sequence():
    kernel = FakeKernel(video0=Node())
    node = kernel.by_path["/dev/video0"]
    async with await source(kernel).open(MODE, 4) as stream:
        node.push(b"one", stamp=5_000_001_000)
        first = await stream.next()
        node.push(b"two", stamp=5_066_000_000, damaged=True)
        second = await stream.next()
        node.push(b"three", monotonic=False)
        third = await stream.next()
    assert (first.data, first.stamp, first.sequence, first.damaged) == (b"one", 5_000_001_000, 0, False)
    assert (second.data, second.sequence, second.damaged) == (b"two", 1, True)
    assert third.stamp is None


async def test_buffers_go_back_and_only_the_newest_picture_waits():
    kernel = FakeKernel(video0=Node())
    node = kernel.by_path["/dev/video0"]
    async with await source(kernel).open(MODE, 2) as stream:
        for number in range(20):
            node.push(b"%d" % number)
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        frame = await stream.next()
        assert (frame.data, frame.sequence) == (b"19", 19)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.02):
                await stream.next()


async def test_a_slow_reader_shows_as_a_gap_in_the_sequence():
    kernel = FakeKernel(video0=Node(granted_buffers=2))
    node = kernel.by_path["/dev/video0"]
    async with await source(kernel).open(MODE, 8) as stream:
        for number in range(5):  # the loop does not run: two buffers only
            node.push(b"%d" % number)
        assert (await stream.next()).sequence == 0
        assert (await stream.next()).sequence == 1
        node.push(b"5")
        assert (await stream.next()).sequence == 5


async def test_everything_is_let_go():
    kernel = FakeKernel(video0=Node())
    node = kernel.by_path["/dev/video0"]
    async with await source(kernel).open(MODE, 4):
        assert (node.opened, node.mapped, node.streaming) == (1, 4, True)
    assert (node.opened, node.mapped, node.streaming) == (0, 0, False)


@pytest.mark.parametrize("code", [errno.ENODEV, errno.EIO])
async def test_unplugged_in_mid_stream(code: int):
    kernel = FakeKernel(video0=Node())
    node = kernel.by_path["/dev/video0"]
    async with await source(kernel).open(MODE, 4) as stream:
        node.push(b"one")
        await stream.next()
        node.fail(code)
        node.errors[v4l2.STREAMOFF] = code
        for _ in range(2):
            with pytest.raises(DeviceLostError, match="cannot take a picture"):
                await stream.next()
    assert (node.opened, node.mapped) == (0, 0)


@pytest.mark.parametrize(
    ("request_number", "code", "kind", "text"),
    [
        (v4l2.S_FMT, errno.EINVAL, DeviceMismatchError, "cannot set the format"),
        (v4l2.S_FMT, errno.EBUSY, PortBusyError, "another program uses the camera"),
        (v4l2.REQBUFS, errno.EBUSY, PortBusyError, "cannot get buffers"),
        (v4l2.STREAMON, errno.ENOSPC, DeviceFaultError, "no USB bandwidth"),
        (v4l2.STREAMON, errno.EINVAL, DeviceError, "cannot start streaming"),
        (v4l2.S_PARM, errno.EIO, DeviceLostError, "cannot set the rate"),
        (v4l2.QUERYCAP, errno.ENODEV, DeviceLostError, "cannot ask it what it is"),
        (v4l2.ENUM_FMT, errno.EIO, DeviceLostError, "cannot ask"),
    ],
)
async def test_errors_of_opening(request_number: int, code: int, kind: type[DeviceError], text: str):
    kernel = FakeKernel(video0=Node(errors={request_number: code}))
    with pytest.raises(kind, match=text) as caught:
        await source(kernel).open(MODE, 4)
    assert type(caught.value) is kind
    node = kernel.by_path["/dev/video0"]
    assert (node.opened, node.mapped, node.streaming) == (0, 0, False)


async def test_no_camera_no_permission_no_motion_jpeg():
    with pytest.raises(DeviceLostError, match="no camera"):
        await source(FakeKernel()).open(MODE, 4)
    with pytest.raises(DeviceError, match="group 'video'"):
        await source(FakeKernel(video0=Node(open_error=errno.EACCES))).open(MODE, 4)
    with pytest.raises(DeviceMismatchError, match="no node captures motion JPEG"):
        await source(FakeKernel(video0=metadata(), video1=Node(formats=(YUYV,)))).open(MODE, 4)
    with pytest.raises(DeviceMismatchError, match="sends YUYV instead of motion JPEG"):
        await source(FakeKernel(video0=Node(forced_format=YUYV))).open(MODE, 4)


async def test_one_bad_node_does_not_hide_a_good_one():
    kernel = FakeKernel(video0=Node(open_error=errno.EACCES), video1=Node())
    assert find_node("/dev/video*", kernel) == "/dev/video1"


async def test_the_nearest_mode_is_granted_and_a_fixed_rate_is_no_error():
    kernel = FakeKernel(video0=Node())
    async with await source(kernel).open(Mode(352, 288, 25.0), 4) as stream:
        assert stream.mode == Mode(320, 240, 30.0)
    kernel = FakeKernel(video0=Node(errors={v4l2.S_PARM: errno.ENOTTY}))
    async with await source(kernel).open(MODE, 4) as stream:
        assert stream.mode == MODE


async def test_the_probe_lists_nodes_modes_and_errors():
    kernel = FakeKernel(video0=Node(), video1=metadata(), video2=Node(open_error=errno.EBUSY))
    found = await identify("/dev/video*", WallClock(), WebcamConfig(), kernel, inline)
    camera, meta, busy = found["nodes"]
    assert camera["card"] == "UVC Camera (046d:080a)"
    assert camera["formats"] == ["YUYV", "MJPG"]
    assert camera["mjpg_modes"] == [
        {"width": 640, "height": 480, "rate": 30.0},
        {"width": 640, "height": 480, "rate": 15.0},
        {"width": 320, "height": 240, "rate": 30.0},
    ]
    assert (meta["captures"], meta["formats"], meta["mjpg_modes"]) == (False, [], [])
    assert "another program" in busy["error"]


async def test_an_enumeration_that_never_ends_is_cut_off():
    class Endless(FakeKernel):
        def _enum_fmt(self, node: Node, data: bytes) -> bytes:
            return data

    assert (await identify("/dev/video*", WallClock(), WebcamConfig(), Endless(video0=Node()), inline))["nodes"][0][
        "formats"
    ] == [""] * 256


async def test_cancelled_while_the_kernel_is_slow_the_camera_is_let_go():
    go = threading.Event()

    class Slow(FakeKernel):
        def _streamon(self, node: Node, data: bytes) -> None:
            go.wait(5)
            super()._streamon(node, data)

    kernel = Slow(video0=Node())
    task = asyncio.create_task(V4l2Source("/dev/video*", kernel).open(MODE, 4))
    while v4l2.STREAMON not in kernel.requests:
        await asyncio.sleep(0.001)
    task.cancel()
    done, _ = await asyncio.wait([task], timeout=1)
    assert task in done, "the driver ends although the kernel does not"
    assert task.cancelled()
    go.set()
    await let_go(kernel)


async def let_go(kernel: FakeKernel) -> None:
    node = kernel.by_path["/dev/video0"]
    async with asyncio.timeout(5):
        while (node.opened, node.mapped, node.streaming) != (0, 0, False):
            await asyncio.sleep(0.005)


async def test_cancelled_in_the_instant_in_which_it_has_started_the_camera_is_let_go():
    kernel = FakeKernel(video0=Node())

    async def offload(function):
        function()
        raise asyncio.CancelledError

    with pytest.raises(asyncio.CancelledError):
        await V4l2Source("/dev/video*", kernel, offload).open(MODE, 4)
    await let_go(kernel)


async def test_a_camera_that_does_not_stop_is_not_waited_for(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(v4l2_source, "CAMERA_STOP_LIMIT", 0.05)
    go = threading.Event()

    class Stuck(FakeKernel):
        def _streamoff(self, node: Node, data: bytes) -> None:
            go.wait(5)
            super()._streamoff(node, data)

    kernel = Stuck(video0=Node())
    async with asyncio.timeout(1):
        async with await V4l2Source("/dev/video*", kernel).open(MODE, 4):
            pass
    assert kernel.by_path["/dev/video0"].opened
    go.set()
    await let_go(kernel)


async def test_setting_up_is_never_done_on_the_loop():
    threads: set[int] = set()

    class Watched(FakeKernel):
        def ioctl(self, fd: int, request: int, argument: bytearray) -> None:
            if request not in (v4l2.DQBUF, v4l2.QBUF):
                threads.add(threading.get_ident())
            super().ioctl(fd, request, argument)

    async with await V4l2Source("/dev/video*", Watched(video0=Node())).open(MODE, 4):
        pass
    assert threading.get_ident() not in threads


async def test_a_path_that_is_no_pty_is_a_v4l2_node():
    with pytest.raises(DeviceLostError, match="no camera"):
        await PathSource("/dev/no-such-video*", WallClock()).open(MODE, 4)
