"""USB-ISS commands in I2C mode, and registers of the SRF08 behind it.

Sources: Devantech, "USB-ISS Technical Specification" and "I2C Mode"; "SRF08 Ultrasonic Ranger, Technical
Specification". A USB-ISS answer has no identifier and no checksum; only its length is known. Bits that no module drives
on the bus read as ones, so a module that is ranging or absent appears with software revision 0xFF.
"""

from enum import IntEnum
from math import ceil
from typing import Final, NamedTuple

ISS: Final = 0x5A
VERSION: Final = bytes((ISS, 0x01))
"""Version request; the answer is module number, firmware and mode."""
MODULE: Final = 0x07
I2C_100KHZ: Final = 0x60
"""I2C mode of the hardware controller."""
IO_INPUTS: Final = 0xAA
SET_MODE: Final = bytes((ISS, 0x02, I2C_100KHZ, IO_INPUTS))
"""Mode request; the answer is 0xFF 0x00, or 0x00 and a reason."""
I2C_AD1: Final = 0x55
ACK: Final = 0xFF

ADDRESSES: Final = tuple(range(0xE0, 0x100, 2))
"""Possible addresses of a module; the lowest bit is set for reading."""
RANGE_IN_MICROSECONDS: Final = 0x52
ABSENT: Final = 0xFF
"""Software revision read if no module drives the bus."""
RANGE_STEP: Final = 0.043
"""Unit of the range register (m), at the manufacturer's speed of sound."""


class Srf08Register(IntEnum):
    """Write registers; reads return the revision, the light level, and the high and low bytes of the first echo."""

    COMMAND = 0
    GAIN = 1
    RANGE = 2


class Srf08Reading(NamedTuple):
    """Contents of registers 0 to 3."""

    revision: int
    light: int
    microseconds: int
    """Time from the ping to the first echo (us); 0 = no echo."""

    @property
    def present(self) -> bool:
        """Whether a module answered."""
        return self.revision != ABSENT


READ_SIZE: Final = 4


def write(address: int, register: int, value: int) -> bytes:
    """Return a command that sets a register; the answer is one byte, 0 if no module acknowledged."""
    return bytes((I2C_AD1, address, register, 1, value))


def read(address: int) -> bytes:
    """Return a request for the revision, the light level and the first echo; the answer has ``READ_SIZE`` bytes."""
    return bytes((I2C_AD1, address | 1, 0, READ_SIZE))


def parse_reading(data: bytes) -> Srf08Reading:
    """Parse the answer to ``read``.

    Raises:
        ValueError: the length is wrong.
    """
    if len(data) != READ_SIZE:
        raise ValueError(f"expected {READ_SIZE} bytes, got {len(data)}")
    return Srf08Reading(data[0], data[1], data[2] << 8 | data[3])


def range_setting(metres: float) -> int:
    """Return the range register value for echoes from up to ``metres``."""
    return max(0, min(255, ceil(metres / RANGE_STEP) - 1))


def ranging_time(setting: int) -> float:
    """Time for which a module is ranging and does not answer (s), given its range register; 65 ms by default."""
    return (setting + 1) * 65e-3 / 256
