"""CRSF frames from a receiver (TBS Crossfire, ExpressLRS).

Source: TBS, "CRSF protocol" (github.com/tbs-fpv/tbs-crsf-spec). A frame consists of an address (C8), the length of the
rest, a type, the payload, and a CRC-8 (polynomial D5, start 0) of type and payload; 64 bytes at most. Type 16 carries
the channels, type 14 the quality of the radio link: signal at two antennas (dBm without its sign), fraction of packets
received (%), and more. Without its transmitter, an ExpressLRS receiver sends no channels and reports a link quality of
0.
"""

from typing import Final

from monstertruck_drivers.receiver.frames import ReceiverFrame
from monstertruck_drivers.receiver.protocol import (
    CHANNELS_TYPE,
    CRSF_ADDRESS,
    LINK_SIZE,
    LINK_TYPE,
    PACKED,
    ChannelWords,
    pack,
    unpack,
)


def _crc_of(byte: int) -> int:
    for _ in range(8):
        byte = (byte << 1 ^ 0xD5 if byte & 0x80 else byte << 1) & 0xFF
    return byte


_TABLE: Final = tuple(_crc_of(byte) for byte in range(256))


def crc8(data: bytes) -> int:
    """Return the CRC of a frame's type and payload."""
    crc = 0
    for byte in data:
        crc = _TABLE[crc ^ byte]
    return crc


def frame(kind: int, payload: bytes) -> bytes:
    """Return the bytes of a frame."""
    body = bytes((kind,)) + payload
    return bytes((CRSF_ADDRESS, len(body) + 1)) + body + bytes((crc8(body),))


def channels_frame(channels: ChannelWords) -> bytes:
    """Return a frame with the positions of all sticks and switches."""
    return frame(CHANNELS_TYPE, pack(channels))


def link_frame(quality: float, rssi: float) -> bytes:
    """Return a frame with the quality of the radio link; unused fields are 0."""
    signal = max(0, min(255, round(-rssi)))
    return frame(LINK_TYPE, bytes((signal, signal, round(100 * quality), *bytes(LINK_SIZE - 3))))


class CrsfParser:
    """Extracts messages from a byte stream; skips frames of other types."""

    def __init__(self) -> None:
        self.refused = 0
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[ReceiverFrame]:
        """Return the completed messages."""
        self._buffer += data
        messages = []
        while (body := self._next()) is not None:
            if (message := _message(body)) is not None:
                messages.append(message)
        return messages

    def _next(self) -> bytes | None:
        """Return type and payload of the next complete frame; None until more bytes arrive."""
        buffer = self._buffer
        while len(buffer) >= 2:
            size = buffer[1] + 2
            longest = 62  # greatest length byte
            if buffer[0] == CRSF_ADDRESS and 4 <= size <= longest + 2:
                if len(buffer) < size:
                    return None
                body = bytes(buffer[2 : size - 1])
                if crc8(body) == buffer[size - 1]:
                    del buffer[:size]
                    return body
            del buffer[0]
            self.refused += 1
        return None


def _message(body: bytes) -> ReceiverFrame | None:
    kind, payload = body[0], body[1:]
    if kind == CHANNELS_TYPE and len(payload) == PACKED:
        return ReceiverFrame(channels=unpack(payload))
    if kind == LINK_TYPE and len(payload) == LINK_SIZE:
        quality = payload[2] / 100
        signals = [signal for signal in payload[:2] if signal]
        rssi = -float(min(signals)) if signals else None
        return ReceiverFrame(quality=min(quality, 1.0), rssi=rssi, failsafe=quality == 0.0)
    return None
