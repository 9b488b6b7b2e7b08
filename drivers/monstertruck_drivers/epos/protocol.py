"""Frames and power states of the first-generation EPOS over RS232 (maxon Communication Guide; DS402).

One exchange, strictly one at a time (``>`` host, ``<`` controller)::

    > opcode                    < 'O' ready, 'F' busy
    > length-1, words, CRC      < 'O' accepted, 'F' CRC wrong
                                < 0x00 (answer opcode)
    > 'O'                       < length-1, words, CRC
    > 'O' accepted, 'F' CRC wrong

Words are 16 bits, low byte first on the wire; the CRC sees them high byte first.

This module needs only the standard library, so that a stop script can use it.
"""

import binascii
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import NamedTuple

from monstertruck_drivers.epos.objects import CONTROLWORD, ObjectEntry

EPOS_BAUD = 38400
"""Baud rate of the RS232 line in the author's controller."""

READY = 0x4F
"""'O': ready for the next bytes, or accepted."""
REFUSED = 0x46
"""'F': busy, or CRC wrong."""
ANSWER = 0x00
"""Opcode of every answer."""

MAX_WORDS = 63


class FrameError(ValueError):
    """Bytes that are not a frame: wrong size or checksum."""


class Opcode(IntEnum):
    """Services of the controller."""

    NMT = 0x0E
    READ = 0x10
    WRITE = 0x11
    INITIATE_SEGMENTED_READ = 0x12
    SEGMENTED_READ = 0x14


class NmtCommand(IntEnum):
    """Network management commands, which the controller does not answer."""

    START = 1
    STOP = 2
    PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class Frame(NamedTuple):
    """Opcode and its data words (1 to 63 unsigned 16-bit numbers)."""

    opcode: int
    words: tuple[int, ...]

    @property
    def head(self) -> bytes:
        """Opcode byte, which requests permission to send ``body``."""
        return bytes((self.opcode,))

    @property
    def body(self) -> bytes:
        """All bytes after the opcode: length-1, words, CRC."""
        words = (*self.words, checksum(self.opcode, self.words))
        return struct.pack(f"<B{len(words)}H", len(self.words) - 1, *words)


def crc(words: Sequence[int]) -> int:
    """CRC-CCITT (0x1021, start 0) over 16-bit words, most significant bit first."""
    return binascii.crc_hqx(struct.pack(f">{len(words)}H", *words), 0)


def checksum(opcode: int, words: Sequence[int]) -> int:
    """CRC of a frame, whose first word holds the opcode and length-1."""
    return crc(((opcode << 8) | (len(words) - 1), *words))


def body_size(length_byte: int) -> int:
    """Number of bytes after the length byte: words and CRC."""
    return 2 * (length_byte + 2)


def decode_body(opcode: int, body: bytes) -> Frame:
    """Parse a frame from ``body`` (length byte first).

    Raises:
        FrameError: the size or the CRC is wrong.
    """
    if not body or len(body) != 1 + body_size(body[0]):
        raise FrameError(f"frame of {len(body)} bytes does not match its length byte")
    *words, received = struct.unpack(f"<{body[0] + 2}H", body[1:])
    if received != (expected := checksum(opcode, words)):
        raise FrameError(f"CRC 0x{received:04X}, expected 0x{expected:04X}")
    return Frame(opcode, tuple(words))


def read_request(entry: ObjectEntry, node: int) -> Frame:
    """Return a ReadObject request."""
    return Frame(Opcode.READ, (entry.index, (node << 8) | entry.sub))


def write_request(entry: ObjectEntry, value: int, node: int) -> Frame:
    """Return a WriteObject request.

    Raises:
        ValueError: ``value`` does not fit the object.
    """
    return Frame(Opcode.WRITE, (entry.index, (node << 8) | entry.sub, *split(entry.encode(value))))


def segmented_read_request(entry: ObjectEntry, node: int) -> Frame:
    """Return an InitiateSegmentedRead request; ``segment_request`` then reads the segments."""
    return Frame(Opcode.INITIATE_SEGMENTED_READ, (entry.index, (node << 8) | entry.sub))


def segment_request(toggle: bool) -> Frame:
    """Return a SegmentedRead request for the next segment; the toggle bit alternates, starting with False."""
    return Frame(Opcode.SEGMENTED_READ, (0x40 if toggle else 0,))


@dataclass(frozen=True, slots=True)
class ObjectSegment:
    """One segment of a long object."""

    data: bytes
    toggle: bool
    more: bool

    @property
    def words(self) -> tuple[int, ...]:
        """Data words after the error code: control byte, then the data bytes, padded to complete words."""
        raw = bytes((len(self.data) | (0x40 * self.toggle) | (0x80 * self.more),)) + self.data
        raw += bytes(len(raw) % 2)
        return struct.unpack(f"<{len(raw) // 2}H", raw)


def decode_segment(words: Sequence[int]) -> ObjectSegment:
    """Decode a segment from the words after the error code.

    Raises:
        FrameError: there are fewer bytes than announced.
    """
    raw = struct.pack(f"<{len(words)}H", *words)
    if not raw or len(raw) < 1 + (raw[0] & 0x3F):
        raise FrameError("segment shorter than its length")
    return ObjectSegment(raw[1 : 1 + (raw[0] & 0x3F)], bool(raw[0] & 0x40), bool(raw[0] & 0x80))


def answer(error: int = 0, *data: int) -> Frame:
    """Return an answer frame: 32-bit error code, then data words."""
    return Frame(ANSWER, (*split(error), *data))


def error_of(frame: Frame) -> int:
    """Error code of an answer; 0 = ok.

    Raises:
        FrameError: the frame is too short for an error code.
    """
    if len(frame.words) < 2:
        raise FrameError("answer without an error code")
    return join(frame.words[0], frame.words[1])


def split(value: int) -> tuple[int, int]:
    """Split a 32-bit value into words, low word first."""
    return value & 0xFFFF, value >> 16


def join(low: int, high: int) -> int:
    """Inverse of ``split``."""
    return low | (high << 16)


class Control(IntEnum):
    """Complete controlwords."""

    DISABLE_VOLTAGE = 0x0000
    QUICK_STOP = 0x0002
    SHUTDOWN = 0x0006
    SWITCH_ON = 0x0007
    ENABLE = 0x000F
    HALT = 0x010F
    FAULT_RESET = 0x0080


class State(Enum):
    """DS402 state: statusword & ``STATE_MASK``."""

    START = 0x0000
    NOT_READY = 0x0100
    SWITCH_ON_DISABLED = 0x0140
    READY = 0x0121
    SWITCHED_ON = 0x0123
    REFRESH = 0x4123
    MEASURE_INIT = 0x4133
    ENABLED = 0x0137
    QUICK_STOP = 0x0117
    FAULT_REACTION_DISABLED = 0x010F
    FAULT_REACTION_ENABLED = 0x011F
    FAULT = 0x0108
    UNKNOWN = -1
    """Undocumented bit pattern; treated as a transient state."""


STATE_MASK = 0x417F
FAULTED = frozenset((State.FAULT_REACTION_DISABLED, State.FAULT_REACTION_ENABLED, State.FAULT))
POWERED = frozenset((State.ENABLED, State.QUICK_STOP))
OFF = frozenset((State.START, State.NOT_READY, State.SWITCH_ON_DISABLED))

_STATES = {state.value: state for state in State}


def state_of(statusword: int) -> State:
    """Power state in a statusword."""
    return _STATES.get(statusword & STATE_MASK, State.UNKNOWN)


_PREPARED = (State.READY, State.SWITCHED_ON, State.REFRESH, State.MEASURE_INIT, State.ENABLED, State.UNKNOWN)
_STEPS: dict[State, dict[State, Control]] = {
    State.ENABLED: {
        State.SWITCH_ON_DISABLED: Control.SHUTDOWN,
        State.READY: Control.SWITCH_ON,
        State.SWITCHED_ON: Control.ENABLE,
        State.QUICK_STOP: Control.ENABLE,
    },
    State.QUICK_STOP: dict.fromkeys(_PREPARED, Control.QUICK_STOP),
    State.SWITCH_ON_DISABLED: dict.fromkeys((*_PREPARED, State.QUICK_STOP), Control.DISABLE_VOLTAGE),
}


def next_control(state: State, goal: State) -> Control | None:
    """Controlword that brings ``state`` one step closer to ``goal``; None to wait, or if the goal is already reached.

    Args:
        state: current state.
        goal: ENABLED, QUICK_STOP (or off, if it was not running) or SWITCH_ON_DISABLED.
    """
    return _STEPS[goal].get(state)


def stop_frames(node: int) -> tuple[Frame, Frame]:
    """Quick stop, then power stage off: these two writes make any state safe."""
    return (
        write_request(CONTROLWORD, Control.QUICK_STOP, node),
        write_request(CONTROLWORD, Control.DISABLE_VOLTAGE, node),
    )
