"""RoboClaw packet serial protocol (Basicmicro, "RoboClaw Series User Manual", chapters "Packet Serial", "Encoders").

A request consists of the unit's address, a command and its arguments. An answer consists of data and a two-byte CRC,
high byte first, over the request's address and command and the data: CRC-16 with polynomial 0x1021, initial value 0.
The unit drops a request that contains a pause of more than 10 ms.
"""

import binascii
import struct
from enum import IntEnum
from typing import Final

NAME: Final = b"roboclaw"
"""Part of the unit's version text, case-insensitive."""
ADDRESSES: Final = (0x80, 0x87)
"""Lowest and highest address."""
LONGEST_NAME: Final = 48
PACKET_GAP: Final = 0.01
"""Timeout of a partial request in the unit (s)."""
COUNTER: Final = 1 << 32
_COUNTS: Final = struct.Struct(">II")
_CRC: Final = struct.Struct(">H")
COUNTS_SIZE: Final = _COUNTS.size + _CRC.size


class RoboclawCommand(IntEnum):
    """Requests that the driver uses; none of them moves a motor or changes a setting."""

    VERSION = 21
    """Answer: a text that ends with a line feed and 0."""
    COUNTS = 78
    """Answer: both counters, 32 bits each."""


def request(address: int, command: RoboclawCommand) -> bytes:
    """Encode a request without arguments."""
    return bytes((address, command))


def signed(asked: bytes, data: bytes) -> bytes:
    """Encode an answer to a request: the data and its CRC."""
    return data + _CRC.pack(binascii.crc_hqx(asked + data, 0))


def is_intact(asked: bytes, answer: bytes) -> bool:
    """Whether the CRC at the end of an answer to ``asked`` is valid."""
    return len(answer) > _CRC.size and signed(asked, answer[: -_CRC.size]) == answer


def counts(answer: bytes) -> tuple[int, int]:
    """Decode counters 1 and 2, unsigned, from an intact answer to ``COUNTS``."""
    first, second = _COUNTS.unpack(answer[: _COUNTS.size])
    return first, second


def counted(first: int, second: int) -> bytes:
    """Encode the data of an answer to ``COUNTS``."""
    return _COUNTS.pack(first % COUNTER, second % COUNTER)


def step(before: int, now: int) -> int:
    """Counts between two readings of a counter that wraps, in [-2^31, 2^31)."""
    return (now - before + COUNTER // 2) % COUNTER - COUNTER // 2
