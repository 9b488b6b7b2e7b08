"""Packets of the LDROBOT LD06, LD19 and STL-19P ("LD19 development manual", section 3).

A packet has 47 bytes, with numbers sent low byte first: 0x54, 0x2C (the low five bits are the number of points, 12),
speed (degrees per second), start angle (0.01 degrees), twelve points of distance (mm) and intensity, end angle, time
stamp (ms, wraps at 30000), and a CRC-8 of all bytes before it. Angles increase clockwise seen from above; 0 is straight
ahead. The points between the first and the last are evenly spaced. The unit accepts no commands.
"""

import struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import RangeSheet

LD19_BAUD: Final = 230400
POINTS: Final = 12
LD19_SIZE: Final = 47
HEADER: Final = b"\x54\x2c"
STAMP_TURN: Final = 30_000
"""Period at which the time stamp wraps (ms)."""
FULL_TURN: Final = 36_000
"""Full turn, in hundredths of a degree."""
_POLYNOMIAL: Final = 0x4D
_PACKET: Final = struct.Struct("<2sHH36sHHB")
POINT: Final = np.dtype([("distance", "<u2"), ("intensity", "u1")])


class ModelSheet(NamedTuple):
    """Data sheet of a model."""

    title: str
    ranges: RangeSheet
    rate: int
    """Measuring rate (points/s)."""
    frequency: float
    """Rotation rate while the PWM pin is not driven (Hz)."""


MODELS: Final = {
    "ld06": ModelSheet("LDROBOT LD06", RangeSheet(0.02, 12.0, 0.045, 0.0), 4500, 10.0),
    "ld19": ModelSheet("LDROBOT LD19", RangeSheet(0.02, 12.0, 0.045, 0.0), 4500, 10.0),
    "stl19p": ModelSheet("LDROBOT STL-19P", RangeSheet(0.03, 12.0, 0.045, 0.0), 5000, 10.0),
}


class Ld19Packet(NamedTuple):
    """Raw values of one packet."""

    speed: int
    """Rotation speed (degrees/s)."""
    start: int
    """Angle of the first point (0.01 degrees)."""
    points: bytes
    """Twelve ``POINT``."""
    end: int
    """Angle of the last point (0.01 degrees)."""
    stamp: int
    """Time stamp (ms)."""

    @property
    def span(self) -> int:
        """Angle from the first to the last point (0.01 degrees)."""
        return (self.end - self.start) % FULL_TURN

    def decoded(self) -> NDArray[np.void]:
        """Points as an array of ``POINT``, shape (12,)."""
        return np.frombuffer(self.points, POINT)


def _table() -> bytes:
    table = bytearray()
    for value in range(256):
        for _ in range(8):
            value = (value << 1 ^ _POLYNOMIAL if value & 0x80 else value << 1) & 0xFF  # noqa: PLW2901
        table.append(value)
    return bytes(table)


_CRC: Final = _table()


def crc8(data: bytes) -> int:
    """CRC-8 with polynomial 0x4D, most significant bit first, initial value 0."""
    crc = 0
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc


def build(packet: Ld19Packet) -> bytes:
    """Encode a packet.

    Raises:
        struct.error: a number exceeds 16 bits.
    """
    body = _PACKET.pack(HEADER, *packet, 0)[:-1]
    return body + bytes((crc8(body),))


class Ld19Parser:
    """Extracts packets from a byte stream; counts the bytes outside packets."""

    def __init__(self) -> None:
        self.refused = 0
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Ld19Packet]:
        """Return the completed packets."""
        self._buffer += data
        buffer, at, packets = self._buffer, 0, []
        while (found := buffer.find(HEADER, at)) >= 0 and len(buffer) - found >= LD19_SIZE:
            self.refused += found - at
            body = bytes(buffer[found : found + LD19_SIZE])
            if crc8(body[:-1]) == body[-1]:
                _, speed, start, points, end, stamp, _ = _PACKET.unpack(body)
                at = found + LD19_SIZE
                packets.append(Ld19Packet(speed, start, points, end, stamp))
            else:
                at = found + 1
                self.refused += 1
        if found < 0:  # its last byte may begin a header
            keep = 1 if buffer.endswith(HEADER[:1]) else 0
            self.refused += max(len(buffer) - keep - at, 0)
            at = max(len(buffer) - keep, at)
        else:
            self.refused += found - at
            at = found
        del buffer[:at]
        return packets
