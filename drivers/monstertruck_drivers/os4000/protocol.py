"""OS4000 sentences and commands: format 1, with tagged fields and an XOR checksum.

Source: manufacturer's user guides of the OS4000 and OS5000 series (same command family).
"""

import math
import re
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from functools import reduce
from operator import xor
from typing import Final

ESC: Final = 0x1B
SENTENCE_LIMIT: Final = 200
"""Number of bytes without a line end after which the collected bytes are dropped."""

FACTORY_BAUD: Final = 19200
"""Factory baud rate; the kind's row in the catalog makes it the default of a port."""
BAUDS: Final = (4800, 9600, 14400, 19200, 38400, 57600, 115200)
"""Baud rates by the value of the baud command; a change takes effect at the next power-up."""
RATE_MIN: Final = -100
RATE_MAX: Final = 40
"""Maximum value of the rate command (sentences/s); negative: seconds per sentence; 0: none."""


class Fields(IntFlag):
    """Field mask: the fields that a sentence contains."""

    HEADING = 1
    PITCH = 2
    ROLL = 4
    TEMPERATURE = 8
    DEPTH = 16
    FIELD_LENGTH = 32
    FIELD = 64
    ACCELERATION_LENGTH = 128
    ACCELERATION = 256


class Key(IntEnum):
    """Command keys, sent after ESC."""

    FACTORY_BAUD = ord("B")
    RATE = ord("R")
    FORMAT = ord("*")
    FIELDS = ord("X")
    MOUNTING = ord("E")
    CALIBRATE_LEVEL = ord("C")
    CALIBRATE_VERTICAL = ord("Z")
    TEMPERATURE_OFFSET = ord("+")
    VERSION = ord("V")
    CONFIGURATION = ord("&")
    DEPTH_MODE = ord("M")
    ZERO_DEPTH = ord("P")


FORMAT_TAGGED: Final = 1

Xyz = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Sentence:
    """One sentence in the device's units; a field that is missing or not a number is None."""

    heading: float | None = None
    """Heading, clockwise from magnetic north (degrees)."""
    pitch: float | None = None
    """Pitch, nose up positive (degrees)."""
    roll: float | None = None
    """Roll, right side down positive (degrees)."""
    temperature: float | None = None
    """Temperature (degrees Celsius)."""
    depth: float | None = None
    field_length: float | None = None
    field: Xyz | None = None
    """Magnetic field (milligauss), if the unit was calibrated with the local field strength."""
    acceleration_length: float | None = None
    acceleration: Xyz | None = None
    """Acceleration (g)."""

    @property
    def fields(self) -> Fields:
        """Mask of the fields present."""
        present = {
            Fields.HEADING: self.heading,
            Fields.PITCH: self.pitch,
            Fields.ROLL: self.roll,
            Fields.TEMPERATURE: self.temperature,
            Fields.DEPTH: self.depth,
            Fields.FIELD_LENGTH: self.field_length,
            Fields.FIELD: self.field,
            Fields.ACCELERATION_LENGTH: self.acceleration_length,
            Fields.ACCELERATION: self.acceleration,
        }
        return reduce(
            lambda mask, bit: mask | bit, (bit for bit, value in present.items() if value is not None), Fields(0)
        )


def checksum(body: bytes) -> int:
    """XOR of all bytes between ``$`` and ``*``."""
    return reduce(xor, body, 0)


_FRAME = re.compile(rb"\$([^$*]*)\*([0-9A-Fa-f]{1,2})\s*")
# Longer tags first: Mx before M, Ax before A.
_TAG = re.compile(r"(Mx|My|Mz|Ax|Ay|Az|[CPRTDMA])((?:[+-]?(?:\d+\.?\d*|\.\d+|(?i:nan|inf)))?)")


def parse(line: bytes) -> Sentence:
    """Parse one sentence, with or without its line end.

    Raises:
        ValueError: not a sentence, wrong checksum, or an unknown or repeated tag; the message names the error.
    """
    frame = _FRAME.fullmatch(line)
    if frame is None:
        raise ValueError(f"{line!r} is not $...*hh")
    body, given = frame.groups()
    if (wanted := checksum(body)) != int(given, 16):
        raise ValueError(f"checksum of {line!r} is {given.decode()}, expected {wanted:02X}")
    values: dict[str, float | None] = {}
    text = body.decode("latin-1")
    at = 0
    while at < len(text):
        match = _TAG.match(text, at)
        if match is None or match[1] in values:
            raise ValueError(f"{line!r}: unknown or repeated field at {text[at:]!r}")
        number = float(match[2]) if match[2] else math.nan
        values[match[1]] = number if math.isfinite(number) else None
        at = match.end()
    if not values:
        raise ValueError(f"{line!r} is empty")
    return Sentence(
        heading=values.get("C"),
        pitch=values.get("P"),
        roll=values.get("R"),
        temperature=values.get("T"),
        depth=values.get("D"),
        field_length=values.get("M"),
        field=_vector(values, "M"),
        acceleration_length=values.get("A"),
        acceleration=_vector(values, "A"),
    )


def _vector(values: dict[str, float | None], tag: str) -> Xyz | None:
    x, y, z = (values.get(tag + axis) for axis in "xyz")
    return None if x is None or y is None or z is None else (x, y, z)


def frame(body: str) -> bytes:
    """Frame the tagged fields of a sentence."""
    raw = body.encode("ascii")
    return b"$%s*%02X\r\n" % (raw, checksum(raw))


def build(sentence: Sentence, *, mask: Fields | None = None) -> bytes:
    """Encode a sentence as the device prints it.

    Args:
        sentence: values; None values are omitted.
        mask: fields to print; None for all.
    """
    one, two, three = "{}{:.1f}", "{}{:.2f}", "{}{:.3f}"
    columns = (
        (Fields.HEADING, one, "C", sentence.heading),
        (Fields.PITCH, one, "P", sentence.pitch),
        (Fields.ROLL, one, "R", sentence.roll),
        (Fields.TEMPERATURE, one, "T", sentence.temperature),
        (Fields.DEPTH, one, "D", sentence.depth),
        (Fields.FIELD_LENGTH, two, "M", sentence.field_length),
        (Fields.FIELD, two, "M", sentence.field),
        (Fields.ACCELERATION_LENGTH, three, "A", sentence.acceleration_length),
        (Fields.ACCELERATION, three, "A", sentence.acceleration),
    )
    body = ""
    for bit, layout, tag, value in columns:
        if value is None or (mask is not None and bit not in mask):
            continue
        if isinstance(value, tuple):
            body += "".join(layout.format(tag + axis, part) for axis, part in zip("xyz", value, strict=True))
        else:
            body += layout.format(tag, value)
    return frame(body)


def key(command: Key) -> bytes:
    """Encode an immediate command, or the start of a command that takes a value."""
    return bytes((ESC, command))


def value(number: int) -> bytes:
    """Encode the value of a started command, terminated by a space."""
    return b"%d " % number


@dataclass(slots=True)
class Os4000Parser:
    """Extracts sentences from a byte stream in chunks of any size; its buffer is bounded.

    Other text (prompts, answers, other formats) is kept in ``text`` until taken.
    """

    good: int = 0
    bad: int = 0
    """Number of lines with a ``$`` but without a valid sentence, and of floods without a line end."""
    text: list[bytes] = field(default_factory=list)
    """Latest lines without ``$``, and sentences of other formats."""
    _buffer: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[Sentence]:
        """Return the completed sentences."""
        sentences: list[Sentence] = []
        self._buffer += data
        while True:
            end = self._buffer.find(b"\n", 0, SENTENCE_LIMIT + 1)
            if end < 0 and len(self._buffer) <= SENTENCE_LIMIT:
                return sentences
            if end < 0:
                del self._buffer[: SENTENCE_LIMIT + 1]
                self.bad += 1
                continue
            line = bytes(self._buffer[:end])
            del self._buffer[: end + 1]
            if (sentence := self._line(line)) is not None:
                sentences.append(sentence)

    def _line(self, line: bytes) -> Sentence | None:
        # A line may start with the rest of a truncated line, or with a prompt.
        start = line.rfind(b"$")
        if start > 0 or (start < 0 and line.strip()):
            self._keep(line if start < 0 else line[:start])
        if start < 0:
            return None
        try:
            sentence = parse(line[start:])
        except ValueError:
            self.bad += 1
            self._keep(line[start:])
            return None
        self.good += 1
        return sentence

    def _keep(self, line: bytes) -> None:
        self.text = [*self.text[-19:], line.strip()]


_OTHER_FORMAT = re.compile(rb"\$(OHPR|HCHDT),.*|[-+.\d]+(,[-+.\d]*)+", re.DOTALL)


def is_other_format(line: bytes) -> bool:
    """Whether a line looks like another sentence format of the compass."""
    return _OTHER_FORMAT.fullmatch(line.strip()) is not None
