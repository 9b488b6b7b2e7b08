"""WT61 packets (WitMotion, "WT61 communication protocol").

A packet has eleven bytes: 0x55, kind, four signed 16-bit numbers with the low byte first, and the sum of the ten
preceding bytes. The unit streams acceleration, angular velocity and angle in turn, without a request. A command
consists of FF AA and one byte.
"""

import struct
from enum import IntEnum
from math import radians
from typing import Final, NamedTuple

from monstertruck_schemas.sensor import STANDARD_GRAVITY

WT61_BAUD: Final = 115200
RATE: Final = 100
"""Packet triples per second at this baud rate."""
HEADER: Final = 0x55
WT61_SIZE: Final = 11
TOGGLE_SLEEP: Final = b"\xff\xaa\x60"
"""Command that enters or leaves standby."""
_BODY: Final = struct.Struct("<BB4h")
_ACCELERATION: Final = 16 * STANDARD_GRAVITY / 32768
_RATE: Final = radians(2000) / 32768
_MOST: Final = 32767


class Wt61Kind(IntEnum):
    """Second byte of a packet."""

    ACCELERATION = 0x51
    ANGULAR_VELOCITY = 0x52
    ANGLE = 0x53


Xyz = tuple[float, float, float]


class Wt61Packet(NamedTuple):
    """Raw values of one packet."""

    kind: Wt61Kind
    x: int
    y: int
    z: int
    temperature: int

    @property
    def acceleration(self) -> Xyz:
        """Specific force (m/s^2)."""
        return self.x * _ACCELERATION, self.y * _ACCELERATION, self.z * _ACCELERATION

    @property
    def angular_velocity(self) -> Xyz:
        """Angular velocity (rad/s)."""
        return self.x * _RATE, self.y * _RATE, self.z * _RATE

    @property
    def celsius(self) -> float:
        """Temperature in acceleration and angular velocity packets (degrees Celsius)."""
        return self.temperature / 340 + 36.53


def build(packet: Wt61Packet) -> bytes:
    """Encode a packet.

    Raises:
        struct.error: a number exceeds 16 bits.
    """
    body = _BODY.pack(HEADER, *packet)
    return body + bytes((sum(body) & 0xFF,))


def measured(kind: Wt61Kind, vector: Xyz, celsius: float) -> Wt61Packet:
    """Return the packet for a measurement in SI units, clipped to the unit's range."""
    unit = _ACCELERATION if kind is Wt61Kind.ACCELERATION else _RATE
    x, y, z = (max(-_MOST, min(_MOST, round(value / unit))) for value in vector)
    return Wt61Packet(kind, x, y, z, round((celsius - 36.53) * 340))


class Wt61Parser:
    """Extracts packets from a byte stream; counts the bytes outside packets."""

    def __init__(self) -> None:
        self.refused = 0
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Wt61Packet]:
        """Return the completed packets."""
        self._buffer += data
        packets = []
        while (packet := self._next()) is not None:
            packets.append(packet)
        return packets

    def _next(self) -> Wt61Packet | None:
        buffer = self._buffer
        while len(buffer) >= WT61_SIZE:
            known = buffer[0] == HEADER and buffer[1] in tuple(Wt61Kind)
            if known and sum(buffer[: WT61_SIZE - 1]) & 0xFF == buffer[WT61_SIZE - 1]:
                _, kind, *numbers = _BODY.unpack(buffer[: WT61_SIZE - 1])
                del buffer[:WT61_SIZE]
                return Wt61Packet(Wt61Kind(kind), *numbers)
            del buffer[0]
            self.refused += 1
        return None
