"""Video4Linux2 structures and requests for a motion-JPEG camera.

``struct`` uses native sizes and alignment, as in the kernel header. Source: kernel documentation,
userspace-api/media/v4l, and include/uapi/linux/videodev2.h.
"""

import struct
from dataclasses import dataclass
from typing import Final

from monstertruck_drivers.webcam.source import Mode
from monstertruck_runtime.clock import SECOND

CAPTURE: Final = 1
"""V4L2_BUF_TYPE_VIDEO_CAPTURE."""
MMAP: Final = 1
"""V4L2_MEMORY_MMAP."""
DISCRETE: Final = 1
"""V4L2_FRMSIZE_TYPE_DISCRETE and V4L2_FRMIVAL_TYPE_DISCRETE."""
MJPG: Final = int.from_bytes(b"MJPG", "little")

CAP_CAPTURE: Final = 0x1
CAP_STREAMING: Final = 0x04000000
CAP_DEVICE_CAPS: Final = 0x80000000
"""The node's capabilities are reported in addition to the whole device's capabilities."""
FLAG_ERROR: Final = 0x40
TIMESTAMP_MONOTONIC: Final = 0x2000

CAPABILITY: Final = struct.Struct("@16s32s32s6I")
FORMAT_DESCRIPTION: Final = struct.Struct("@3I32s5I")
FRAME_SIZE: Final = struct.Struct("@3I6I2I")
FRAME_INTERVAL: Final = struct.Struct("@5I6I2I")
FORMAT: Final = struct.Struct("@I0L12I152x")
STREAM_PARAMETERS: Final = struct.Struct("@6I180x")
REQUEST_BUFFERS: Final = struct.Struct("@5I")
BUFFER: Final = struct.Struct("@5I2l2I4B4s2IL3I0L")
NUMBER: Final = struct.Struct("@i")

_WRITE, _READ = 1, 2

Bytes = bytes | bytearray


def _request(direction: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | ord("V") << 8 | number


QUERYCAP: Final = _request(_READ, 0, CAPABILITY.size)
ENUM_FMT: Final = _request(_READ | _WRITE, 2, FORMAT_DESCRIPTION.size)
S_FMT: Final = _request(_READ | _WRITE, 5, FORMAT.size)
REQBUFS: Final = _request(_READ | _WRITE, 8, REQUEST_BUFFERS.size)
QUERYBUF: Final = _request(_READ | _WRITE, 9, BUFFER.size)
QBUF: Final = _request(_READ | _WRITE, 15, BUFFER.size)
DQBUF: Final = _request(_READ | _WRITE, 17, BUFFER.size)
STREAMON: Final = _request(_WRITE, 18, NUMBER.size)
STREAMOFF: Final = _request(_WRITE, 19, NUMBER.size)
S_PARM: Final = _request(_READ | _WRITE, 22, STREAM_PARAMETERS.size)
ENUM_FRAMESIZES: Final = _request(_READ | _WRITE, 74, FRAME_SIZE.size)
ENUM_FRAMEINTERVALS: Final = _request(_READ | _WRITE, 75, FRAME_INTERVAL.size)


@dataclass(frozen=True, slots=True)
class Capability:
    """Answer to QUERYCAP."""

    driver: str
    card: str
    bus: str
    """Bus address, such as ``usb-0000:00:14.0-1.2``."""
    flags: int
    """Capabilities of the node, not of the whole device."""

    @property
    def captures(self) -> bool:
        """Whether the node can stream pictures; false for a camera's second node, which carries metadata."""
        return self.flags & (CAP_CAPTURE | CAP_STREAMING) == CAP_CAPTURE | CAP_STREAMING

    @classmethod
    def unpack(cls, data: Bytes) -> "Capability":
        """Unpack the kernel's structure."""
        driver, card, bus, _, whole, node, *_ = CAPABILITY.unpack(data)
        return cls(_text(driver), _text(card), _text(bus), node if whole & CAP_DEVICE_CAPS else whole)


@dataclass(frozen=True, slots=True)
class Filled:
    """Answer to DQBUF and QUERYBUF."""

    index: int
    used: int
    """Size of the picture (bytes)."""
    flags: int
    stamp: int | None
    """Time stamp on CLOCK_MONOTONIC (ns); None if it uses another clock."""
    sequence: int
    offset: int
    """Offset for mapping the buffer."""
    length: int

    @classmethod
    def unpack(cls, data: Bytes) -> "Filled":
        """Unpack the kernel's structure."""
        index, _, used, flags, _, seconds, micros, *_, sequence, _, offset, length, _, _ = BUFFER.unpack(data)
        monotonic = flags & 0xE000 == TIMESTAMP_MONOTONIC  # bits of the clock of its stamps
        stamp = seconds * SECOND + micros * 1000 if monotonic else None
        return cls(index, used, flags, stamp, sequence, offset & 0xFFFFFFFF, length)


def buffer(index: int) -> bytearray:
    """Return the argument for QUERYBUF, QBUF and DQBUF."""
    return bytearray(BUFFER.pack(index, CAPTURE, *([0] * 5), *([0] * 6), bytes(4), 0, MMAP, 0, 0, 0, 0))


def format_request(mode: Mode) -> bytearray:
    """Return the argument of S_FMT for motion JPEG."""
    return bytearray(FORMAT.pack(CAPTURE, mode.width, mode.height, MJPG, 0, *([0] * 8)))  # any field order


def format_granted(data: Bytes) -> tuple[int, int, int]:
    """Width, height and pixel format that the driver granted."""
    _, width, height, pixel_format, *_ = FORMAT.unpack(data)
    return width, height, pixel_format


def rate_request(rate: float) -> bytearray:
    """Return the argument of S_PARM."""
    return bytearray(STREAM_PARAMETERS.pack(CAPTURE, 0, 0, 1000, round(rate * 1000), 0))


def rate_granted(data: Bytes, asked: float) -> float:
    """Rate that the driver granted, or ``asked`` if the rate cannot be set."""
    _, _, _, numerator, denominator, _ = STREAM_PARAMETERS.unpack(data)
    return denominator / numerator if numerator and denominator else asked


def fourcc(pixel_format: int) -> str:
    """Four-character name of a pixel format."""
    return pixel_format.to_bytes(4, "little").decode("latin-1").strip("\0 ")


def _text(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("utf-8", "backslashreplace")
