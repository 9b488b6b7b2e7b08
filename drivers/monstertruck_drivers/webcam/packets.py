"""Packets from an emulated camera: the answers and pictures that the kernel would deliver for a real camera.

Host to camera: lines ``OPEN <width> <height> <rate>`` and ``CLOSE``. Camera to host: little-endian packets of a header
with its own CRC-32 and a payload.
"""

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from monstertruck_drivers.webcam.source import Mode
from monstertruck_runtime.errors import ProtocolError

MAGIC: Final = b"\x89MTC"
_HEADER: Final = struct.Struct("<4sB3xIqI")
_CRC: Final = struct.Struct("<I")
_MODE: Final = struct.Struct("<IId")
HEADER_SIZE: Final = _HEADER.size + _CRC.size


class PacketKind(IntEnum):
    """Kind of a packet."""

    GRANTED = 1
    """Streaming begins; the payload is the mode."""
    REFUSED = 2
    """``number`` is the kernel's error number."""
    PICTURE = 3
    """``number`` is the camera's count, ``stamp`` the time of exposure."""


@dataclass(frozen=True, slots=True)
class CameraPacket:
    """One packet."""

    kind: PacketKind
    number: int = 0
    stamp: int = 0
    payload: bytes = b""

    def encode(self) -> bytes:
        """Encode the packet."""
        header = _HEADER.pack(MAGIC, self.kind, self.number, self.stamp, len(self.payload))
        return header + _CRC.pack(zlib.crc32(header)) + self.payload


def encode_mode(mode: Mode) -> bytes:
    """Encode the payload of ``GRANTED``."""
    return _MODE.pack(mode.width, mode.height, mode.rate)


def decode_mode(payload: bytes) -> Mode:
    """Decode the payload of ``GRANTED``.

    Raises:
        ProtocolError: the length is wrong.
    """
    if len(payload) != _MODE.size:
        raise ProtocolError(f"mode needs {_MODE.size} bytes, got {len(payload)}")
    return Mode(*_MODE.unpack(payload))


class PacketParser:
    """Extracts packets from bytes in chunks of any size; after lost bytes, it resumes at the next valid header."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._header: tuple[PacketKind, int, int, int] | None = None

    @property
    def missing(self) -> int:
        """Number of bytes needed to complete the next packet, at least 1."""
        whole = HEADER_SIZE if self._header is None else self._header[3]
        return max(whole - len(self._buffer), 1)

    def feed(self, data: bytes) -> list[CameraPacket]:
        """Return the completed packets, in order."""
        self._buffer += data
        packets: list[CameraPacket] = []
        while (packet := self._next()) is not None:
            packets.append(packet)
        return packets

    def _next(self) -> CameraPacket | None:
        if self._header is None and not self._find_header():
            return None
        assert self._header is not None
        kind, number, stamp, length = self._header
        if len(self._buffer) < length:
            return None
        payload = bytes(self._buffer[:length])
        del self._buffer[:length]
        self._header = None
        return CameraPacket(kind, number, stamp, payload)

    def _find_header(self) -> bool:
        while True:
            at = self._buffer.find(MAGIC)
            if at < 0:
                del self._buffer[: -len(MAGIC) + 1]
                return False
            del self._buffer[:at]
            if len(self._buffer) < HEADER_SIZE:
                return False
            header = bytes(self._buffer[: _HEADER.size])
            _, kind, number, stamp, length = _HEADER.unpack(header)
            (crc,) = _CRC.unpack(self._buffer[_HEADER.size : HEADER_SIZE])
            # 1 << 22: bytes of a payload at most
            if crc == zlib.crc32(header) and length <= 1 << 22 and kind in list(PacketKind):
                del self._buffer[:HEADER_SIZE]
                self._header = PacketKind(kind), number, stamp, length
                return True
            del self._buffer[: len(MAGIC)]
