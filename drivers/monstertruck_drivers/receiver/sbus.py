"""SBUS frames from a receiver (Futaba and others); source: the PX4 decoder (``src/lib/rc/sbus.cpp``).

100000 baud, 8 data bits, even parity, 2 stop bits, inverted line: an adapter or a transistor must invert it back. A
25-byte frame arrives every 7 or 14 ms: 0F, the channels, flags, and 00 (or 04, 14, 24, 34 in SBUS 2). Flag 4 marks a
lost radio packet, flag 8 the loss of the transmitter. There is no checksum, so a wrong bit is a wrong position: after
damage, a frame is accepted only if the next frame begins where it ends.
"""

from typing import Final

from monstertruck_drivers.receiver.frames import ReceiverFrame
from monstertruck_drivers.receiver.protocol import (
    PACKED,
    SBUS_FAILSAFE,
    SBUS_HEADER,
    SBUS_LOST,
    SBUS_SIZE,
    ChannelWords,
    pack,
    unpack,
)

FOOTERS: Final = frozenset((0x00, 0x04, 0x14, 0x24, 0x34))


def frame(channels: ChannelWords, *, lost: bool = False, failsafe: bool = False) -> bytes:
    """Return the bytes of a frame."""
    flags = SBUS_LOST * lost | SBUS_FAILSAFE * failsafe
    return bytes((SBUS_HEADER,)) + pack(channels) + bytes((flags, 0))


class SbusParser:
    """Extracts messages from a byte stream."""

    def __init__(self) -> None:
        self.refused = 0
        self._buffer = bytearray()
        self._in_step = False
        """Whether the buffer begins where a frame ended."""

    def feed(self, data: bytes) -> list[ReceiverFrame]:
        """Return the completed messages."""
        self._buffer += data
        messages = []
        buffer = self._buffer
        while len(buffer) >= (SBUS_SIZE if self._in_step else 2 * SBUS_SIZE):
            if _is_frame(buffer) and (self._in_step or _is_frame(buffer[SBUS_SIZE:])):
                if self._in_step:
                    messages.append(_message(bytes(buffer[:SBUS_SIZE])))
                self._in_step = True
                del buffer[:SBUS_SIZE]
            else:
                self._in_step = False
                del buffer[0]
                self.refused += 1
        return messages


def _is_frame(data: bytearray) -> bool:
    return data[0] == SBUS_HEADER and data[SBUS_SIZE - 1] in FOOTERS


def _message(data: bytes) -> ReceiverFrame:
    flags = data[1 + PACKED]
    return ReceiverFrame(
        channels=unpack(data[1 : 1 + PACKED]), failsafe=bool(flags & SBUS_FAILSAFE), lost=bool(flags & SBUS_LOST)
    )
