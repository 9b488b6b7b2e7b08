"""Maestro serial protocol: compact and Pololu forms, CRC-7, error bits.

Source: Maestro user's guide, sections 5.c (protocols), 5.d (CRC), 5.e (commands), 4.e (errors).
"""

from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import Final, NamedTuple

POLOLU_START: Final = 0xAA
MINI_SSC_START: Final = 0xFF
CHANNELS: Final = 6
"""Number of channels of the Micro Maestro."""
POSITION_MAX: Final = 0x3FFF
"""Maximum position or target of the 14-bit format (quarter microseconds)."""
OUTPUT_THRESHOLD: Final = 6000
"""Minimum target that switches a digital output high."""
ADC_MAX: Final = 1023
ERROR_MASK: Final = 0x01FF


class Error(IntFlag):
    """Bits of the error word, which is cleared when read."""

    SERIAL_SIGNAL = 1 << 0
    SERIAL_OVERRUN = 1 << 1
    BUFFER_FULL = 1 << 2
    CRC = 1 << 3
    PROTOCOL = 1 << 4
    SERIAL_TIMEOUT = 1 << 5
    SCRIPT_STACK = 1 << 6
    SCRIPT_CALL_STACK = 1 << 7
    SCRIPT_COUNTER = 1 << 8


class Code(IntEnum):
    """Command bytes in the compact form."""

    SET_TARGET = 0x84
    SET_SPEED = 0x87
    SET_ACCELERATION = 0x89
    GET_POSITION = 0x90
    GET_MOVING_STATE = 0x93
    GET_ERRORS = 0xA1
    GO_HOME = 0xA2
    STOP_SCRIPT = 0xA4
    RESTART_SCRIPT = 0xA7
    RESTART_SCRIPT_PARAMETER = 0xA8
    GET_SCRIPT_STATUS = 0xAE
    MINI_SSC = MINI_SSC_START
    """Not a command byte: represents a Mini-SSC packet with data (channel, value)."""


DATA_BYTES: Final[dict[int, int]] = {
    Code.SET_TARGET: 3,
    Code.SET_SPEED: 3,
    Code.SET_ACCELERATION: 3,
    Code.GET_POSITION: 1,
    Code.GET_MOVING_STATE: 0,
    Code.GET_ERRORS: 0,
    Code.GO_HOME: 0,
    Code.STOP_SCRIPT: 0,
    Code.RESTART_SCRIPT: 1,
    Code.RESTART_SCRIPT_PARAMETER: 3,
    Code.GET_SCRIPT_STATUS: 0,
}
"""Number of data bytes after each command of the Micro."""


def error_names(word: int) -> list[str]:
    """Names of the bits set in an error word; unknown bits are given in hexadecimal."""
    names = [(bit.name or "").lower() for bit in Error if word & bit]
    unknown = word & ~ERROR_MASK
    return [*names, hex(unknown)] if unknown else names


def crc7(data: bytes) -> int:
    """CRC-7 of a complete command: polynomial 0x91, least significant bit first, initial value 0."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc ^ 0x91 if crc & 1 else crc) >> 1
    return crc


def halves(value: int) -> tuple[int, int]:
    """Low and high seven bits of a 14-bit value.

    Raises:
        ValueError: the value is outside 0..16383.
    """
    if not 0 <= value <= POSITION_MAX:
        raise ValueError(f"{value} does not fit 14 bits")
    return value & 0x7F, value >> 7


def words(answer: bytes) -> list[int]:
    """Little-endian 16-bit words of concatenated two-byte answers."""
    return [answer[i] | answer[i + 1] << 8 for i in range(0, len(answer), 2)]


@dataclass(frozen=True, slots=True)
class Encoder:
    """Builds commands.

    Args:
        device: device number for the Pololu form; None for the compact form.
        crc: whether to append the CRC-7 byte.
    """

    device: int | None = None
    crc: bool = False

    def command(self, code: int, *data: int) -> bytes:
        """Encode a command of any kind."""
        head = bytes((code,)) if self.device is None else bytes((POLOLU_START, self.device, code & 0x7F))
        packet = head + bytes(data)
        return packet + bytes((crc7(packet),)) if self.crc else packet

    def set_target(self, channel: int, quarters: int) -> bytes:
        """Encode a target (quarter microseconds); 0 switches the pulses off."""
        return self.command(Code.SET_TARGET, channel, *halves(quarters))

    def set_speed(self, channel: int, speed: int) -> bytes:
        """Encode a speed limit (0.25 us per 10 ms); 0 means unlimited."""
        return self.command(Code.SET_SPEED, channel, *halves(speed))

    def set_acceleration(self, channel: int, acceleration: int) -> bytes:
        """Encode an acceleration limit (0.25 us per 10 ms per 80 ms), 0..255; 0 means unlimited."""
        return self.command(Code.SET_ACCELERATION, channel, *halves(acceleration))

    def get_position(self, channel: int) -> bytes:
        """Request the current pulse (quarter microseconds) or the input's 10-bit value; the answer has two bytes."""
        return self.command(Code.GET_POSITION, channel)

    def get_errors(self) -> bytes:
        """Request the error word, which the request clears; the answer has two bytes."""
        return self.command(Code.GET_ERRORS)


class ServoCommand(NamedTuple):
    """One complete, valid command as received by the device."""

    code: Code
    data: tuple[int, ...] = ()

    @property
    def value(self) -> int:
        """14-bit value after the channel byte."""
        return self.data[1] | self.data[2] << 7


@dataclass(slots=True)
class Decoder:
    """Device-side parser: turns bytes, in chunks of any size, into commands and errors.

    Args:
        device: own device number; Pololu packets for other devices are skipped.
        crc: whether a CRC-7 byte follows every command.
    """

    device: int = 12
    crc: bool = False
    _packet: bytearray = field(default_factory=bytearray)
    _skipping: bool = False

    def feed(self, data: bytes) -> list[ServoCommand | Error]:
        """Return the completed commands and errors, in order."""
        out: list[ServoCommand | Error] = []
        for byte in data:
            if byte >= 0x80 and not self._is_mini_ssc_value(byte):
                if self._packet:
                    out.append(Error.PROTOCOL)
                self._packet.clear()
                self._skipping = False
            elif not self._packet:
                if not self._skipping:
                    out.append(Error.PROTOCOL)
                continue
            self._packet.append(byte)
            if (item := self._complete()) is not None:
                out.append(item)
        return out

    def _is_mini_ssc_value(self, byte: int) -> bool:
        return len(self._packet) == 2 and self._packet[0] == MINI_SSC_START and byte != MINI_SSC_START

    def _complete(self) -> ServoCommand | Error | None:
        packet = self._packet
        if packet[0] == MINI_SSC_START:
            return ServoCommand(Code.MINI_SSC, tuple(self._take()[1:])) if len(packet) == 3 else None
        head = 1
        if packet[0] == POLOLU_START:
            if len(packet) == 2 and packet[1] != self.device:
                return self._skip(None)
            if len(packet) < 3:
                return None
            head = 3
        code = packet[head - 1] | 0x80
        if code not in DATA_BYTES:
            return self._skip(Error.PROTOCOL)
        if len(packet) < head + DATA_BYTES[code] + self.crc:
            return None
        whole = self._take()
        if self.crc and crc7(whole[:-1]) != whole[-1]:
            return Error.CRC
        return ServoCommand(Code(code), tuple(whole[head : head + DATA_BYTES[code]]))

    def _take(self) -> bytes:
        whole = bytes(self._packet)
        self._packet.clear()
        return whole

    def _skip(self, result: Error | None) -> Error | None:
        """Drop the packet and its remaining data bytes."""
        self._packet.clear()
        self._skipping = True
        return result
