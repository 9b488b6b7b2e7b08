"""Real camera: finds its node, configures it, and reads pictures from kernel buffers."""

import asyncio
import contextlib
import errno
import fcntl
import os
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from mmap import MAP_SHARED, PROT_READ, mmap
from pathlib import Path
from typing import Any, Final, Self

from monstertruck_drivers.webcam import protocol as v4l2
from monstertruck_drivers.webcam.source import SET_FORMAT, CameraFrame, Mode, device_error
from monstertruck_runtime.errors import DeviceError, DeviceLostError, DeviceMismatchError
from monstertruck_runtime.threads import Offload, in_daemon_thread

CAMERA_STOP_LIMIT: Final = 2.0
"""Maximum wait for the camera to stop at the end of a session (s)."""


class Kernel:
    """System calls for a camera; each of them may block."""

    def nodes(self, pattern: str) -> list[str]:
        """Return the device nodes that match a glob pattern, in numeric order (video2 before video10)."""
        return sorted(map(str, Path("/").glob(pattern.lstrip("/"))), key=lambda path: (len(path), path))

    def open(self, path: str) -> int:
        """Open a node without blocking later reads; raises ``OSError``."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self, fd: int) -> None:
        """Close a node."""
        os.close(fd)

    def ioctl(self, fd: int, request: int, argument: bytearray) -> None:
        """Execute a request; ``argument`` is changed in place. Raises ``OSError``."""
        fcntl.ioctl(fd, request, argument, True)

    def map(self, fd: int, length: int, offset: int) -> mmap:
        """Map a buffer for reading; raises ``OSError``."""
        return mmap(fd, length, MAP_SHARED, PROT_READ, offset=offset)


class V4l2Source:
    """Camera at a device node.

    Args:
        pattern: node, symlink or glob pattern, such as ``/dev/v4l/by-path/*usb-0:1.2:1.0-video-index*``. A camera has
            several nodes; the first matching one that captures motion JPEG is used.
        kernel: system calls.
        offload: runs set-up and release: control transfers over USB take tens of milliseconds, and 5 s each if the
            camera does not answer.
    """

    def __init__(
        self, pattern: str = "/dev/video*", kernel: Kernel | None = None, offload: Offload = in_daemon_thread
    ) -> None:
        self.name = pattern
        self._kernel = kernel or Kernel()
        self._offload = offload

    async def open(self, mode: Mode, buffers: int) -> "V4l2Stream":
        """Start the camera; see ``FrameSource``."""
        starting = _Starting(self.name, self._kernel, mode, buffers)
        try:
            return V4l2Stream(await self._offload(starting.run), self._offload)
        except asyncio.CancelledError:
            starting.give_up()
            raise


class Camera:
    """An open node; its methods block."""

    def __init__(self, path: str, kernel: Kernel, fd: int) -> None:
        self.path = path
        self.fd = fd
        self.mode = Mode(0, 0, 0.0)
        self._kernel = kernel
        self._memory: list[mmap] = []

    @classmethod
    def start(cls, pattern: str, kernel: Kernel, mode: Mode, buffers: int) -> "Camera":
        """Open the node that captures motion JPEG and start streaming."""
        path = find_node(pattern, kernel)
        with _doing(path, "open it"):
            camera = cls(path, kernel, kernel.open(path))
        try:
            camera._set(mode)
            camera._map(buffers)
            with _doing(path, "start streaming"):
                kernel.ioctl(camera.fd, v4l2.STREAMON, bytearray(v4l2.NUMBER.pack(v4l2.CAPTURE)))
        except BaseException:
            camera.stop()
            raise
        return camera

    def take(self) -> CameraFrame | None:
        """Return the oldest picture that is ready, if any, and give its buffer back to the kernel.

        Raises:
            DeviceLostError: the camera was unplugged.
            DeviceError: streaming failed.
        """
        argument = v4l2.buffer(0)
        try:
            with _doing(self.path, "take a picture"):
                self._kernel.ioctl(self.fd, v4l2.DQBUF, argument)
                filled = v4l2.Filled.unpack(argument)
                data = self._memory[filled.index][: filled.used]
                self._kernel.ioctl(self.fd, v4l2.QBUF, v4l2.buffer(filled.index))
        except BlockingIOError:
            return None
        return CameraFrame(filled.stamp, filled.sequence, data, damaged=bool(filled.flags & v4l2.FLAG_ERROR))

    def stop(self) -> None:
        """Stop streaming, unmap and close; also releases a camera that has vanished."""
        with contextlib.suppress(OSError):
            self._kernel.ioctl(self.fd, v4l2.STREAMOFF, bytearray(v4l2.NUMBER.pack(v4l2.CAPTURE)))
        for memory in self._memory:
            memory.close()
        self._memory.clear()
        with contextlib.suppress(OSError):
            self._kernel.close(self.fd)

    def _set(self, mode: Mode) -> None:
        argument = v4l2.format_request(mode)
        with _doing(self.path, SET_FORMAT):
            self._kernel.ioctl(self.fd, v4l2.S_FMT, argument)
        width, height, pixel_format = v4l2.format_granted(argument)
        if pixel_format != v4l2.MJPG:
            raise DeviceMismatchError(f"{self.path}: sends {v4l2.fourcc(pixel_format)} instead of motion JPEG")
        rate = v4l2.rate_request(mode.rate)
        try:
            self._kernel.ioctl(self.fd, v4l2.S_PARM, rate)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTTY):  # camera with a fixed rate
                raise device_error(self.path, "set the rate", error) from error
        self.mode = Mode(width, height, v4l2.rate_granted(rate, mode.rate))

    def _map(self, count: int) -> None:
        with _doing(self.path, "get buffers"):
            request = bytearray(v4l2.REQUEST_BUFFERS.pack(count, v4l2.CAPTURE, v4l2.MMAP, 0, 0))
            self._kernel.ioctl(self.fd, v4l2.REQBUFS, request)
            granted, *_ = v4l2.REQUEST_BUFFERS.unpack(request)
            for index in range(granted):
                argument = v4l2.buffer(index)
                self._kernel.ioctl(self.fd, v4l2.QUERYBUF, argument)
                found = v4l2.Filled.unpack(argument)
                self._memory.append(self._kernel.map(self.fd, found.length, found.offset))
                self._kernel.ioctl(self.fd, v4l2.QBUF, v4l2.buffer(index))


class _Starting:
    """A camera start that the caller may abandon before the kernel has completed it.

    Args:
        pattern: see ``V4l2Source``.
        kernel: system calls.
        mode: requested mode.
        buffers: number of buffers.
    """

    def __init__(self, pattern: str, kernel: Kernel, mode: Mode, buffers: int) -> None:
        self._start = partial(Camera.start, pattern, kernel, mode, buffers)
        self._lock = threading.Lock()
        self._is_given_up = False
        self._camera: Camera | None = None

    def run(self) -> Camera:
        """Start the camera; blocks."""
        camera = self._start()
        with self._lock:
            self._camera = camera
            if self._is_given_up:
                camera.stop()
        return camera

    def give_up(self) -> None:
        """Release the camera, now or as soon as it has started."""
        with self._lock:
            self._is_given_up = True
            if self._camera is not None:
                threading.Thread(target=self._camera.stop, name="camera", daemon=True).start()


class V4l2Stream:
    """Stream from a real camera."""

    def __init__(self, camera: Camera, offload: Offload) -> None:
        self.mode = camera.mode
        self._camera = camera
        self._offload = offload
        self._frame: CameraFrame | None = None
        self._error: DeviceError | None = None
        self._news = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(camera.fd, self._readable)

    async def next(self) -> CameraFrame:
        """Wait for a picture; see ``FrameStream``."""
        await self._news.wait()
        if self._error is not None:
            raise self._error
        self._news.clear()
        frame, self._frame = self._frame, None
        assert frame is not None
        return frame

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        """Release the camera; waits only briefly if it does not answer the kernel."""
        self._loop.remove_reader(self._camera.fd)
        stopping = asyncio.ensure_future(self._offload(self._camera.stop))
        try:
            await asyncio.wait([stopping], timeout=CAMERA_STOP_LIMIT)
        finally:
            stopping.cancel()

    def _readable(self) -> None:
        try:
            frame = self._camera.take()
        except DeviceError as error:
            # The node remains readable forever after this.
            self._loop.remove_reader(self._camera.fd)
            self._error = error
            self._news.set()
            return
        if frame is not None:
            self._frame = frame
            self._news.set()


def find_node(pattern: str, kernel: Kernel) -> str:
    """Return the first node matching ``pattern`` that captures motion JPEG.

    Raises:
        DeviceLostError: there is no such node.
        DeviceMismatchError: nodes match, but none captures motion JPEG.
        DeviceError: a node cannot be queried.
    """
    paths = kernel.nodes(pattern)
    if not paths:
        raise DeviceLostError(f"{pattern}: no camera")
    failed: DeviceError | None = None
    for path in paths:
        try:
            if v4l2.MJPG in pixel_formats(path, kernel):
                return path
        except DeviceError as error:
            failed = failed or error
    raise failed or DeviceMismatchError(f"{', '.join(paths)}: no node captures motion JPEG")


def pixel_formats(path: str, kernel: Kernel) -> list[int]:
    """Return the pixel formats that a node can capture; empty if it does not capture.

    Raises:
        DeviceError: the node cannot be queried.
    """
    with asked(path, kernel) as (fd, capability):
        return enumerate_formats(fd, kernel) if capability.captures else []


@contextmanager
def asked(path: str, kernel: Kernel) -> Iterator[tuple[int, v4l2.Capability]]:
    """Open a node and query its capabilities; close it at the end of the context."""
    with _doing(path, "ask it what it is"):
        fd = kernel.open(path)
        try:
            argument = bytearray(v4l2.CAPABILITY.size)
            kernel.ioctl(fd, v4l2.QUERYCAP, argument)
            yield fd, v4l2.Capability.unpack(argument)
        finally:
            kernel.close(fd)


def enumerate_formats(fd: int, kernel: Kernel) -> list[int]:
    """Return the pixel formats that an open node can capture."""
    rows = _enumerate(fd, kernel, v4l2.ENUM_FMT, v4l2.FORMAT_DESCRIPTION, v4l2.CAPTURE)
    return [int(row[4]) for row in rows]


def enumerate_modes(fd: int, kernel: Kernel) -> list[Mode]:
    """Return the discrete sizes and rates for motion JPEG; stepwise ranges are omitted."""
    modes = []
    for _, _, size_kind, width, height, *_ in _enumerate(fd, kernel, v4l2.ENUM_FRAMESIZES, v4l2.FRAME_SIZE, v4l2.MJPG):
        if size_kind != v4l2.DISCRETE:
            continue
        intervals = _enumerate(fd, kernel, v4l2.ENUM_FRAMEINTERVALS, v4l2.FRAME_INTERVAL, v4l2.MJPG, width, height)
        modes += [
            Mode(width, height, denominator / numerator)
            for _, _, _, _, kind, numerator, denominator, *_ in intervals
            if kind == v4l2.DISCRETE and numerator
        ]
    return modes


def _enumerate(fd: int, kernel: Kernel, request: int, layout: struct.Struct, *key: int) -> list[tuple[Any, ...]]:
    """Return the rows of an enumeration; each request contains the index and key and returns the complete structure."""
    head = struct.Struct(f"@{1 + len(key)}I")
    rows: list[tuple[Any, ...]] = []
    while len(rows) < 256:  # maximum number of rows: a broken driver may never report the end
        argument = bytearray(layout.size)
        head.pack_into(argument, 0, len(rows), *key)
        try:
            kernel.ioctl(fd, request, argument)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                break
            raise
        rows.append(layout.unpack(argument))
    return rows


@contextmanager
def _doing(path: str, what: str) -> Iterator[None]:
    """Convert kernel errors into ``DeviceError``; EAGAIN ("no data yet") is not an error."""
    try:
        yield
    except BlockingIOError:
        raise
    except OSError as error:
        raise device_error(path, what, error) from error
