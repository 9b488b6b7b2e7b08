"""Cameras at the level of system calls: the kernel's side of every request, with its checks and errors."""

import errno
import os
from collections import deque
from dataclasses import dataclass, field
from fnmatch import fnmatch

from monstertruck_drivers.webcam import protocol as v4l2
from monstertruck_drivers.webcam.source import Mode

YUYV = int.from_bytes(b"YUYV", "little")
META_CAPTURE = 0x00800000
PAGE = 4096
BUFFER_LENGTH = 65536


@dataclass
class Node:
    """One /dev/video*: what it can, what it was given, what it has to give."""

    flags: int = v4l2.CAP_CAPTURE | v4l2.CAP_STREAMING
    formats: tuple[int, ...] = (YUYV, v4l2.MJPG)
    modes: tuple[Mode, ...] = (Mode(640, 480, 30.0), Mode(640, 480, 15.0), Mode(320, 240, 30.0))
    errors: dict[int, int] = field(default_factory=dict)
    """Request to the error it fails with."""
    open_error: int = 0
    card: bytes = b"UVC Camera (046d:080a)"
    granted_buffers: int = 32
    forced_format: int | None = None
    # state
    fd: int = -1
    mode: Mode | None = None
    streaming: bool = False
    memory: list[bytearray] = field(default_factory=list)
    queued: deque[int] = field(default_factory=deque)
    done: deque[bytes] = field(default_factory=deque)
    opened: int = 0
    mapped: int = 0
    sequence: int = 0
    rate: tuple[int, int] = (0, 0)

    def push(self, data: bytes, *, stamp: int = 0, monotonic: bool = True, damaged: bool = False) -> None:
        """The camera finished a picture; without a queued buffer it is lost, but counted."""
        sequence, self.sequence = self.sequence, self.sequence + 1
        if not self.streaming or not self.queued:
            return
        index = self.queued.popleft()
        self.memory[index][: len(data)] = data
        flags = (v4l2.TIMESTAMP_MONOTONIC if monotonic else 0) | (v4l2.FLAG_ERROR if damaged else 0)
        seconds, rest = divmod(stamp, 10**9)
        head = (index, v4l2.CAPTURE, len(data), flags, 0, seconds, rest // 1000)
        self.done.append(v4l2.BUFFER.pack(*head, *([0] * 6), bytes(4), sequence, v4l2.MMAP, 0, BUFFER_LENGTH, 0, 0))
        os.eventfd_write(self.fd, 1)

    def fail(self, code: int) -> None:
        """From now on taking a picture fails, and the node is readable, as a vanished one is."""
        self.errors[v4l2.DQBUF] = code
        os.eventfd_write(self.fd, 1)


class Memory:
    def __init__(self, node: Node, content: bytearray) -> None:
        self._node = node
        self._content = content
        node.mapped += 1

    def __getitem__(self, part: slice) -> bytes:
        return bytes(self._content[part])

    def close(self) -> None:
        self._node.mapped -= 1


class FakeKernel:
    """``Kernel`` over scripted nodes."""

    def __init__(self, **nodes: Node) -> None:
        self.by_path = {f"/dev/{name}": node for name, node in nodes.items()}
        self.by_fd: dict[int, Node] = {}
        self.requests: list[int] = []

    def nodes(self, pattern: str) -> list[str]:
        return [path for path in self.by_path if fnmatch(path, pattern)]

    def open(self, path: str) -> int:
        if path not in self.by_path:
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
        node = self.by_path[path]
        if node.open_error:
            raise OSError(node.open_error, os.strerror(node.open_error))
        fd = os.eventfd(0, os.EFD_NONBLOCK)
        self.by_fd[fd] = node
        node.fd = fd
        node.opened += 1
        return fd

    def close(self, fd: int) -> None:
        node = self.by_fd.pop(fd)
        node.opened -= 1
        os.close(fd)

    def map(self, fd: int, length: int, offset: int) -> Memory:
        node = self.by_fd[fd]
        assert (length, offset % PAGE) == (BUFFER_LENGTH, 0)
        return Memory(node, node.memory[offset // PAGE])

    def ioctl(self, fd: int, request: int, argument: bytearray) -> None:
        node = self.by_fd[fd]
        self.requests.append(request)
        if code := node.errors.get(request):
            raise OSError(code, os.strerror(code))
        assert len(argument) == request >> 16 & 0x3FFF
        answer = getattr(self, f"_{NAMES[request]}")(node, bytes(argument))
        if answer is not None:
            argument[:] = answer

    def _querycap(self, node: Node, _: bytes) -> bytes:
        whole = node.flags | v4l2.CAP_CAPTURE | META_CAPTURE | v4l2.CAP_DEVICE_CAPS
        return v4l2.CAPABILITY.pack(
            b"uvcvideo", node.card, b"usb-0000:00:14.0-1.2", 6 << 16, whole, node.flags, 0, 0, 0
        )

    def _enum_fmt(self, node: Node, data: bytes) -> bytes:
        index, kind, *_ = v4l2.FORMAT_DESCRIPTION.unpack(data)
        if kind != v4l2.CAPTURE or index >= len(node.formats):
            raise OSError(errno.EINVAL, "")
        return v4l2.FORMAT_DESCRIPTION.pack(index, kind, 0, b"a format", node.formats[index], 0, 0, 0, 0)

    def _enum_framesizes(self, node: Node, data: bytes) -> bytes:
        index, pixel_format, *_ = v4l2.FRAME_SIZE.unpack(data)
        sizes = list(dict.fromkeys((mode.width, mode.height) for mode in node.modes))
        if pixel_format != v4l2.MJPG or index >= len(sizes):
            raise OSError(errno.EINVAL, "")
        return v4l2.FRAME_SIZE.pack(index, pixel_format, v4l2.DISCRETE, *sizes[index], 0, 0, 0, 0, 0, 0)

    def _enum_frameintervals(self, node: Node, data: bytes) -> bytes:
        index, pixel_format, width, height, *_ = v4l2.FRAME_INTERVAL.unpack(data)
        rates = [mode.rate for mode in node.modes if (mode.width, mode.height) == (width, height)]
        if index >= len(rates):
            raise OSError(errno.EINVAL, "")
        interval = (333333, 10_000_000) if rates[index] == 30.0 else (1, round(rates[index]))
        return v4l2.FRAME_INTERVAL.pack(
            index, pixel_format, width, height, v4l2.DISCRETE, *interval, 0, 0, 0, 0, 0, 0
        )  # fmt: skip

    def _s_fmt(self, node: Node, data: bytes) -> bytes:
        kind, width, height, pixel_format, *_ = v4l2.FORMAT.unpack(data)
        assert kind == v4l2.CAPTURE
        best = min(node.modes, key=lambda mode: abs(mode.width - width) + abs(mode.height - height))
        node.mode = best
        return v4l2.FORMAT.pack(kind, best.width, best.height, node.forced_format or pixel_format, *([1] * 9))

    def _s_parm(self, node: Node, data: bytes) -> bytes:
        kind, _, _, numerator, denominator, _ = v4l2.STREAM_PARAMETERS.unpack(data)
        assert node.mode is not None
        wanted = denominator / numerator
        rates = [mode.rate for mode in node.modes if mode.width == node.mode.width]
        node.rate = (1, round(min(rates, key=lambda rate: abs(rate - wanted))))
        return v4l2.STREAM_PARAMETERS.pack(kind, 0x1000, 0, *node.rate, 0)

    def _reqbufs(self, node: Node, data: bytes) -> bytes:
        count, kind, memory, *_ = v4l2.REQUEST_BUFFERS.unpack(data)
        assert (kind, memory) == (v4l2.CAPTURE, v4l2.MMAP)
        node.memory = [bytearray(BUFFER_LENGTH) for _ in range(min(count, node.granted_buffers))]
        node.queued.clear()
        node.done.clear()
        return v4l2.REQUEST_BUFFERS.pack(len(node.memory), kind, memory, 0, 0)

    def _querybuf(self, node: Node, data: bytes) -> bytes:
        index, kind, *_ = v4l2.BUFFER.unpack(data)
        assert index < len(node.memory)
        return v4l2.BUFFER.pack(
            index, kind, *([0] * 5), *([0] * 6), bytes(4), 0, v4l2.MMAP, index * PAGE, BUFFER_LENGTH, 0, 0
        )  # fmt: skip

    def _qbuf(self, node: Node, data: bytes) -> None:
        index, *_ = v4l2.BUFFER.unpack(data)
        assert index not in node.queued
        node.queued.append(index)

    def _dqbuf(self, node: Node, _: bytes) -> bytes:
        if not node.done:
            raise BlockingIOError(errno.EAGAIN, "")
        answer = node.done.popleft()
        if not node.done:
            os.eventfd_read(node.fd)
        return answer

    def _streamon(self, node: Node, data: bytes) -> None:
        assert v4l2.NUMBER.unpack(data) == (v4l2.CAPTURE,)
        node.streaming = True

    def _streamoff(self, node: Node, _: bytes) -> None:
        node.streaming = False


NAMES = {
    getattr(v4l2, name.upper()): name
    for name in (
        "querycap", "enum_fmt", "enum_framesizes", "enum_frameintervals", "s_fmt", "s_parm", "reqbufs", "querybuf",
        "qbuf", "dqbuf", "streamon", "streamoff",
    )
}  # fmt: skip
