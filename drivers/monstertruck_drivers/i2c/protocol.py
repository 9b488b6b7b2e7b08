"""Packets for one I2C transfer; a link carries them to a kernel bus or an emulated bus.

Request: mark, sequence number, address, number of bytes to read, number of bytes to write, the bytes to write. Answer:
mark, sequence number, kernel error number, number of bytes read, the bytes read. Each packet ends with a CRC-16.
"""

import errno
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Generic, NamedTuple, TypeVar

from monstertruck_drivers.cable import DeviceEnd

REQUEST_MARK: Final = 0xA5
ANSWER_MARK: Final = 0x5A
CRC_SIZE: Final = 2


class I2cRequest(NamedTuple):
    """Request for one transfer."""

    number: int
    """0..255; the answer repeats it."""
    address: int
    data: bytes
    size: int
    """Bytes to read."""

    def __bytes__(self) -> bytes:
        return _sealed(bytes((REQUEST_MARK, self.number, self.address, self.size, len(self.data))) + self.data)

    @classmethod
    def of(cls, packet: bytes) -> "I2cRequest":
        """Decode the fields of a complete packet."""
        return cls(packet[1], packet[2], packet[5:], packet[3])


class I2cAnswer(NamedTuple):
    """Result of one transfer."""

    number: int
    error: int
    """Error number of the kernel; 0 = done."""
    data: bytes

    def __bytes__(self) -> bytes:
        return _sealed(bytes((ANSWER_MARK, self.number, self.error, len(self.data))) + self.data)

    @classmethod
    def of(cls, packet: bytes) -> "I2cAnswer":
        """Decode the fields of a complete packet."""
        return cls(packet[1], packet[2], packet[4:])


P = TypeVar("P", I2cRequest, I2cAnswer)

HEADS: Final[dict[type, tuple[int, int]]] = {I2cRequest: (REQUEST_MARK, 5), I2cAnswer: (ANSWER_MARK, 4)}
"""Mark, and bytes before the data."""


@dataclass(slots=True)
class Packets(Generic[P]):
    """Incremental parser for one direction; skips damaged bytes.

    Args:
        kind: ``I2cRequest`` or ``I2cAnswer``.
    """

    kind: type[P]
    _buffer: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[P]:
        """Return the packets completed by ``data``."""
        self._buffer += data
        mark, head = HEADS[self.kind]
        found: list[P] = []
        while True:
            start = self._buffer.find(mark)
            del self._buffer[: len(self._buffer) if start < 0 else start]
            if len(self._buffer) < head:
                return found
            size = head + self._buffer[head - 1]
            if len(self._buffer) < size + CRC_SIZE:
                return found
            packet = bytes(self._buffer[:size])
            if _sealed(packet) == self._buffer[: size + CRC_SIZE]:
                found.append(self.kind.of(packet))
                del self._buffer[: size + CRC_SIZE]
            else:
                del self._buffer[:1]


def _sealed(packet: bytes) -> bytes:
    return packet + crc_hqx(packet, 0xFFFF).to_bytes(CRC_SIZE, "big")


Transfer = Callable[[int, bytes, int], bytes | None]
"""Transfer function: takes the address, the bytes to write and the number of bytes to read; returns the bytes read, or
None if no device acknowledges.
"""


async def serve(end: DeviceEnd, transfer: Transfer) -> None:
    """Serve transfers until cancelled, at the real bus speed."""
    packets = Packets(I2cRequest)
    while True:
        for request in packets.feed(await end.read()):
            found = transfer(request.address, request.data, request.size)
            answer = I2cAnswer(request.number, errno.EREMOTEIO if found is None else 0, found or b"")
            # 9 bits a byte, with its acknowledgement; an address before each direction
            length = 9 * (len(request.data) + request.size + 1 + bool(request.size))
            bus_rate = (
                100_000  # clock of the bus (Hz): standard mode, as on a Raspberry Pi that is not configured otherwise
            )
            end.write(bytes(answer), length / bus_rate)
