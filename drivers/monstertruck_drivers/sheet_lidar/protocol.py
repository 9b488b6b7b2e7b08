"""Frames of a laser scanner described by its data sheet (a protocol of this project).

A frame is one scan, with numbers sent low byte first: "SL", number of beams (2 bytes), milliseconds of the scanner's
clock at the first beam (3 bytes, wraps), a 2-byte range for each beam (mm; 0 = no return), and the CRC-16 (CCITT,
initial value 0) of all preceding bytes. The scanner streams without a request and accepts no commands.
"""

import binascii
import struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

HEADER: Final = b"SL"
STAMP_TURN: Final = 1 << 24
"""Period at which the time stamp wraps (ms)."""
MOST_BEAMS: Final = 8192
_HEAD: Final = struct.Struct("<2sHHB")
_CRC: Final = struct.Struct("<H")


class SheetScan(NamedTuple):
    """One scan."""

    stamp: int
    """Scanner's clock at the first beam (ms)."""
    ranges: NDArray[np.uint16]
    """Ranges, shape (n,) (mm); 0 = no return."""


def build(scan: SheetScan) -> bytes:
    """Encode a scan as a frame."""
    stamp = scan.stamp % STAMP_TURN
    body = _HEAD.pack(HEADER, len(scan.ranges), stamp & 0xFFFF, stamp >> 16) + scan.ranges.astype("<u2").tobytes()
    return body + _CRC.pack(binascii.crc_hqx(body, 0))


class SheetParser:
    """Extracts scans from a byte stream; counts the bytes outside scans.

    Args:
        beams: beams per scan; frames with a different number are rejected.
    """

    def __init__(self, beams: int) -> None:
        self.refused = 0
        self._size = _HEAD.size + 2 * beams + _CRC.size
        self._begin = HEADER + struct.pack("<H", beams)
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[SheetScan]:
        """Return the completed scans."""
        self._buffer += data
        buffer, at, scans = self._buffer, 0, []
        while (found := buffer.find(self._begin, at)) >= 0 and len(buffer) - found >= self._size:
            self.refused += found - at
            body = bytes(buffer[found : found + self._size - _CRC.size])
            at = found + self._size
            if _CRC.unpack_from(buffer, at - _CRC.size)[0] == binascii.crc_hqx(body, 0):
                _, _, low, high = _HEAD.unpack_from(body)
                scans.append(SheetScan(low + (high << 16), np.frombuffer(body, "<u2", offset=_HEAD.size)))
            else:
                at = found + 1
                self.refused += 1
        keep = len(buffer) - found if found >= 0 else min(len(buffer) - at, len(self._begin) - 1)
        self.refused += len(buffer) - keep - at
        del buffer[: len(buffer) - keep]
        return scans
