"""Sixteen 11-bit channels, shared by CRSF and SBUS receivers, and the constants of both frames.

Source: TBS, "CRSF protocol" (frame 0x16): channels are packed back to back, least significant bit first; 172, 992 and
1811 correspond to pulses of 988, 1500 and 2012 us. SBUS packs its channels the same way.
"""

from typing import Final

RADIO_CHANNELS: Final = 16
PACKED: Final = 22
"""Size of all channels (bytes)."""
BITS: Final = 11
LOW: Final = 172
CENTRE: Final = 992
HIGH: Final = 1811
_MASK: Final = (1 << BITS) - 1
_HALF: Final = (HIGH - LOW) / 2

# CRSF; source: TBS, "CRSF protocol" (github.com/tbs-fpv/tbs-crsf-spec).
CRSF_BAUD: Final = 420_000
CRSF_ADDRESS: Final = 0xC8
CHANNELS_TYPE: Final = 0x16
LINK_TYPE: Final = 0x14
LINK_SIZE: Final = 10

# SBUS; source: the decoder of PX4 (``src/lib/rc/sbus.cpp``).
SBUS_BAUD: Final = 100_000
SBUS_SIZE: Final = 25
SBUS_HEADER: Final = 0x0F
SBUS_LOST: Final = 0x04
SBUS_FAILSAFE: Final = 0x08
SBUS_PERIOD: Final = 0.014
"""Frame period (s)."""

ChannelWords = tuple[int, ...]
"""Sixteen raw values, 0 to 2047."""


def unpack(data: bytes) -> ChannelWords:
    """Decode the channels from 22 bytes."""
    bits = int.from_bytes(data[:PACKED], "little")
    return tuple(bits >> BITS * i & _MASK for i in range(RADIO_CHANNELS))


def pack(channels: ChannelWords) -> bytes:
    """Encode the channels as 22 bytes."""
    return sum((value & _MASK) << BITS * i for i, value in enumerate(channels)).to_bytes(PACKED, "little")


def position(raw: int) -> float:
    """Return the position of a stick or switch, -1 to 1."""
    return max(-1.0, min(1.0, (raw - CENTRE) / _HALF))


def raw(position: float) -> int:
    """Return the raw value of a position."""
    return round(CENTRE + position * _HALF)
