"""Frames of the BNO085's UART-RVC mode (CEVA, "BNO08X Data Sheet", section 1.3.5.2).

The unit streams 100 frames of 19 bytes per second: AA AA, an index that counts frames, yaw, pitch and roll in 0.01
degree, acceleration along x, y and z in 0.001 g, each signed with the low byte first, three reserved bytes, and the sum
of the sixteen bytes starting with the index. The unit accepts no commands in this mode.
"""

import struct
from math import degrees, radians
from typing import Final, NamedTuple

from monstertruck_schemas.sensor import STANDARD_GRAVITY

BNO085_BAUD: Final = 115200
RATE: Final = 100
HEADER: Final = b"\xaa\xaa"
RVC_SIZE: Final = 19
INDICES: Final = 256
_BODY: Final = struct.Struct("<B6h3x")
_ANGLE: Final = radians(0.01)
_FORCE: Final = STANDARD_GRAVITY / 1000
_MOST: Final = 32767

Xyz = tuple[float, float, float]


class RvcFrame(NamedTuple):
    """Raw values of one frame."""

    number: int
    """Index of the frame, which wraps at 256."""
    yaw: int
    """Yaw since power-up, 0.01 degree, -18000 to 18000."""
    pitch: int
    roll: int
    x: int
    """Acceleration, 0.001 g."""
    y: int
    z: int

    @property
    def angles(self) -> Xyz:
        """Yaw, pitch and roll (rad)."""
        return self.yaw * _ANGLE, self.pitch * _ANGLE, self.roll * _ANGLE

    @property
    def acceleration(self) -> Xyz:
        """Specific force (m/s^2)."""
        return self.x * _FORCE, self.y * _FORCE, self.z * _FORCE


def build(frame: RvcFrame) -> bytes:
    """Encode a frame.

    Raises:
        struct.error: a value exceeds its range.
    """
    body = _BODY.pack(*frame)
    return HEADER + body + bytes((sum(body) & 0xFF,))


def measured(index: int, angles: Xyz, acceleration: Xyz) -> RvcFrame:
    """Return the frame for a measurement in rad and m/s^2, clipped to the unit's range."""
    yaw, pitch, roll = (round(100 * degrees(angle)) for angle in angles)
    x, y, z = (max(-_MOST, min(_MOST, round(force / _FORCE))) for force in acceleration)
    return RvcFrame(index % INDICES, (yaw + 18_000) % 36_000 - 18_000, pitch, roll, x, y, z)


class RvcParser:
    """Extracts frames from a byte stream; counts the bytes outside frames."""

    def __init__(self) -> None:
        self.refused = 0
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[RvcFrame]:
        """Return the completed frames."""
        self._buffer += data
        frames = []
        while (frame := self._next()) is not None:
            frames.append(frame)
        return frames

    def _next(self) -> RvcFrame | None:
        buffer = self._buffer
        while len(buffer) >= RVC_SIZE:
            if buffer.startswith(HEADER) and sum(buffer[2 : RVC_SIZE - 1]) & 0xFF == buffer[RVC_SIZE - 1]:
                frame = RvcFrame(*_BODY.unpack(buffer[2 : RVC_SIZE - 1]))
                del buffer[:RVC_SIZE]
                return frame
            del buffer[0]
            self.refused += 1
        return None
