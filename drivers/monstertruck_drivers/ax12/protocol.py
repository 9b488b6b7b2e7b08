"""Dynamixel protocol 1.0 packets and the AX-12A control table.

Source: manufacturer's e-manual, "DYNAMIXEL Protocol 1.0" and "AX-12A" (control table, units, error bits).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final, Self

HEADER: Final = b"\xff\xff"
BROADCAST: Final = 254
"""Broadcast id: all units execute the instruction, none answers."""
ID_MAX: Final = 253
LONGEST_PACKET: Final = 150
"""Maximum length byte that a parser accepts; higher values are treated as damage."""
AX12_BAUD: Final = 1_000_000
MODEL: Final = 12
"""Model number of an AX-12A."""
POSITION_MAX: Final = 1023
WORD_SIGN: Final = 1 << 10
"""Bit of speed and load words that means clockwise."""

STEP: Final = math.radians(300 / POSITION_MAX)
"""Radians per position step."""
SPEED_UNIT: Final = 0.111 * math.tau / 60
"""Speed unit (rad/s)."""
LOAD_UNIT: Final = 0.001
"""Load unit, as a fraction of the maximum torque."""
VOLT_UNIT: Final = 0.1
DELAY_UNIT: Final = 2e-6
"""Unit of the return delay (s)."""


class Instruction(IntEnum):
    """Instruction code of a request."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    RESET = 0x06
    SYNC_WRITE = 0x83
    BULK_READ = 0x92


class Alarm(IntFlag):
    """Error bits of a status packet. Several may be set; the packet's data remains valid."""

    VOLTAGE = 1 << 0
    ANGLE = 1 << 1
    OVERHEAT = 1 << 2
    RANGE = 1 << 3
    CHECKSUM = 1 << 4
    OVERLOAD = 1 << 5
    INSTRUCTION = 1 << 6


def alarm_names(bits: int) -> str:
    """Names of the set bits, joined; unknown bits are given in hexadecimal."""
    names = [(bit.name or "").lower() for bit in Alarm if bits & bit]
    unknown = bits & ~sum(Alarm)
    return "+".join([*names, hex(unknown)] if unknown else names) or "none"


@dataclass(frozen=True, slots=True)
class Register:
    """One register of the control table."""

    address: int
    size: int = 1
    default: int = 0
    high: int = 255
    """Maximum value of a write."""
    read_only: bool = False

    @property
    def is_stored(self) -> bool:
        """Whether the register is stored in EEPROM."""
        return self.address < RAM_START

    def encode(self, value: int) -> bytes:
        """Encode a value as little-endian bytes."""
        return value.to_bytes(self.size, "little")

    def decode(self, table: bytes | bytearray) -> int:
        """Value of this register in a complete control table."""
        return int.from_bytes(table[self.address : self.address + self.size], "little")


RAM_START: Final = 24
TABLE_SIZE: Final = 50

MODEL_NUMBER: Final = Register(0, 2, MODEL, 0xFFFF, read_only=True)
FIRMWARE: Final = Register(2, 1, 24, read_only=True)
ID: Final = Register(3, 1, 1, ID_MAX)
BAUD_CODE: Final = Register(4, 1, 1, 254)
RETURN_DELAY: Final = Register(5, 1, 250, 254)
CW_LIMIT: Final = Register(6, 2, 0, POSITION_MAX)
CCW_LIMIT: Final = Register(8, 2, POSITION_MAX, POSITION_MAX)
TEMPERATURE_LIMIT: Final = Register(11, 1, 70, 100)
VOLTAGE_MIN: Final = Register(12, 1, 60, 160)
VOLTAGE_MAX: Final = Register(13, 1, 140, 160)
MAX_TORQUE: Final = Register(14, 2, 1023, 1023)
STATUS_LEVEL: Final = Register(16, 1, 2, 2)
ALARM_LED: Final = Register(17, 1, 36, 127)
SHUTDOWN: Final = Register(18, 1, 36, 127)
TORQUE_ENABLE: Final = Register(24, 1, 0, 1)
LED: Final = Register(25, 1, 0, 1)
CW_MARGIN: Final = Register(26, 1, 1)
CCW_MARGIN: Final = Register(27, 1, 1)
CW_SLOPE: Final = Register(28, 1, 32, 254)
CCW_SLOPE: Final = Register(29, 1, 32, 254)
GOAL_POSITION: Final = Register(30, 2, 0, POSITION_MAX)
MOVING_SPEED: Final = Register(32, 2, 0, 2047)
TORQUE_LIMIT: Final = Register(34, 2, 1023, 1023)
PRESENT_POSITION: Final = Register(36, 2, 0, 0xFFFF, read_only=True)
PRESENT_SPEED: Final = Register(38, 2, 0, 0xFFFF, read_only=True)
PRESENT_LOAD: Final = Register(40, 2, 0, 0xFFFF, read_only=True)
PRESENT_VOLTAGE: Final = Register(42, read_only=True)
PRESENT_TEMPERATURE: Final = Register(43, read_only=True)
REGISTERED: Final = Register(44, read_only=True)
MOVING: Final = Register(46, read_only=True)
LOCK: Final = Register(47, 1, 0, 1)
PUNCH: Final = Register(48, 2, 32, 1023)

REGISTERS: Final = tuple(value for value in list(globals().values()) if isinstance(value, Register))
RESERVED: Final = frozenset(range(TABLE_SIZE)) - {r.address + i for r in REGISTERS for i in range(r.size)}
"""Reserved addresses."""

PRESENT_SIZE: Final = 8
"""Number of bytes from ``PRESENT_POSITION`` to the temperature: one read returns a unit's whole state."""


def slope_of(value: int) -> int:
    """Compliance slope in steps: one of seven values, 2 to 128."""
    return 1 << max(1, min(value, 254).bit_length() - 1) if value > 3 else 2


def from_sign_bit(code: int) -> int:
    """Signed value of a speed or load word: counter-clockwise positive."""
    magnitude = code & (WORD_SIGN - 1)
    return -magnitude if code & WORD_SIGN else magnitude


def to_sign_bit(value: int) -> int:
    """Register word for a signed speed or load; its magnitude is limited to 1023."""
    magnitude = min(abs(value), WORD_SIGN - 1)
    return magnitude | WORD_SIGN if value < 0 else magnitude


def word(data: bytes, at: int = 0) -> int:
    """Little-endian 16-bit word at an offset."""
    return data[at] | data[at + 1] << 8


@dataclass(frozen=True, slots=True)
class Present:
    """Unit state from the eight bytes starting at ``PRESENT_POSITION``, in the unit's own units.

    Counter-clockwise positive.
    """

    position: int
    speed: int
    load: int
    voltage: int
    temperature: int

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Decode ``PRESENT_SIZE`` bytes."""
        return cls(word(data), from_sign_bit(word(data, 2)), from_sign_bit(word(data, 4)), data[6], data[7])


def checksum(body: bytes) -> int:
    """Checksum of all bytes between the header and the checksum."""
    return ~sum(body) & 0xFF


@dataclass(frozen=True, slots=True)
class Packet:
    """A request packet (``code`` is an instruction) or a status packet (``code`` contains error bits)."""

    unit: int
    code: int
    params: bytes = b""

    def encode(self) -> bytes:
        """Encoded packet."""
        body = bytes((self.unit, len(self.params) + 2, self.code)) + self.params
        return HEADER + body + bytes((checksum(body),))


def ping(unit: int) -> bytes:
    """Return a ping request; the unit answers with a status packet without data."""
    return Packet(unit, Instruction.PING).encode()


def read(unit: int, start: Register, count: int) -> bytes:
    """Request ``count`` bytes starting at ``start``."""
    return Packet(unit, Instruction.READ, bytes((start.address, count))).encode()


def write(unit: int, start: Register, data: bytes) -> bytes:
    """Write ``data`` starting at ``start``."""
    return Packet(unit, Instruction.WRITE, bytes((start.address,)) + data).encode()


def sync_write(start: Register, data: Mapping[int, bytes]) -> bytes:
    """Write to several units in one packet, which is not answered.

    Args:
        start: first register.
        data: bytes for each unit, all of the same length.

    Raises:
        ValueError: no units, or the lengths differ.
    """
    lengths = {len(value) for value in data.values()}
    if len(lengths) != 1:
        raise ValueError(f"a sync write needs the same number of bytes for each unit, got {sorted(lengths)}")
    rows = b"".join(bytes((unit,)) + value for unit, value in data.items())
    return Packet(BROADCAST, Instruction.SYNC_WRITE, bytes((start.address, lengths.pop())) + rows).encode()


class Ax12Parser:
    """Extracts packets from a byte stream in any fragmentation; buffers at most one packet.

    The protocol has no byte stuffing: a header may occur inside parameters. The parser therefore delimits packets by
    their length and verifies their checksum; after a failure it resumes the search one byte later.

    Args:
        longest: largest valid length byte.
    """

    def __init__(self, longest: int = LONGEST_PACKET) -> None:
        self.damaged: list[int] = []
        """Units in packets of the last ``feed`` with a wrong checksum."""
        self._longest = longest
        self._buffer = bytearray()

    def __len__(self) -> int:
        """Number of buffered bytes."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Packet]:
        """Return the completed packets, in order."""
        self._buffer += data
        self.damaged = []
        packets: list[Packet] = []
        while (packet := self._next()) is not None:
            packets.append(packet)
        return packets

    def _next(self) -> Packet | None:
        buffer = self._buffer
        while True:
            start = buffer.find(HEADER)
            if start < 0:
                del buffer[: len(buffer) - buffer.endswith(b"\xff")]
                return None
            del buffer[:start]
            if len(buffer) < 4:
                return None
            unit, length = buffer[2], buffer[3]
            if unit != 0xFF and 2 <= length <= self._longest:
                end = 4 + length
                if len(buffer) < end:
                    return None
                if sum(buffer[2:end]) & 0xFF == 0xFF:
                    packet = Packet(unit, buffer[4], bytes(buffer[5 : end - 1]))
                    del buffer[:end]
                    return packet
                self.damaged.append(unit)
            del buffer[:1]
