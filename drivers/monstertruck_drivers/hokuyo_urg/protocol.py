"""SCIP 1.1 and 2.0 as pure functions: checksums, 6-bit encoding, requests, replies, text fields, ranges. No I/O.

A reply is an echo line, a status line, any number of lines and an empty line; in SCIP 2.0 every line
after the echo ends with a checksum character. Source: SCIP 2.0 specification, checked against a capture of
firmware 3.1.04.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from monstertruck_runtime.errors import ProtocolError
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM

ScanFormat = Literal["MD", "MS"]
"""Three characters per range (up to 262143 mm) or two (up to 4095 mm)."""

RANGE_WIDTH: Final[dict[str, int]] = {"MD": 3, "GD": 3, "ME": 3, "GE": 3, "MS": 2, "GS": 2, "G": 2}
"""Characters of one range, and of one intensity, by command."""
COUNTER_BITS: Final = 24
COUNTER_MASK: Final = (1 << COUNTER_BITS) - 1
"""The millisecond counter wraps after 4 h 39 min 37.2 s."""
LINE_PAYLOAD: Final = 64
"""Maximum number of payload characters in a data line."""
TAG_LIMIT: Final = 16
"""Maximum length of the echoed string after ``;``."""
UNRETURNED: Final = 65533
"""Value of a UST's beam without a return."""
MAX_REPLY: Final = 8192
"""Bytes kept while waiting for the end of a reply; the longest real one (1081 ranges with intensities) has 6700."""


# Sums and numbers


def line_sum(text: bytes) -> int:
    """Checksum character for the bytes of a line (without checksum and LF)."""
    return (sum(text) & 0x3F) + 0x30


def sum_matches(line: bytes) -> bool:
    """Whether ``line`` with its checksum character is intact; the checksum may or may not cover a preceding ``;``."""
    text, check = line[:-1], line[-1:]
    if not check:
        return False
    return check[0] == line_sum(text) or (text.endswith(b";") and check[0] == line_sum(text[:-1]))


def encode(value: int, width: int) -> bytes:
    """Encode ``value`` as ``width`` characters of six bits each, most significant first.

    Raises:
        ValueError: ``value`` does not fit.
    """
    if not 0 <= value < 1 << 6 * width:
        raise ValueError(f"{value} does not fit into {width} characters")
    return bytes((value >> shift & 0x3F) + 0x30 for shift in range(6 * (width - 1), -1, -6))


def decode(text: bytes) -> int:
    """Inverse of :func:`encode`.

    Raises:
        ProtocolError: a character is outside ``0`` to ``o``.
    """
    value = 0
    for byte in text:
        if not 0x30 <= byte <= 0x6F:
            raise ProtocolError(f"SCIP: byte 0x{byte:02X} in an encoded number")
        value = value << 6 | (byte - 0x30)
    return value


def encode_array(values: NDArray[np.integer], width: int) -> bytes:
    """Encode an array of shape (n,) as ``n * width`` characters; excess bits are dropped."""
    shifts = np.arange(6 * (width - 1), -1, -6)
    return ((values[:, None] >> shifts & 0x3F) + 0x30).astype(np.uint8).tobytes()


def decode_array(payload: bytes, width: int) -> NDArray[np.int32]:
    """Inverse of :func:`encode_array`.

    Raises:
        ProtocolError: a character is outside ``0`` to ``o``, or a number is truncated.
    """
    if len(payload) % width:
        raise ProtocolError(f"SCIP: {len(payload)} characters are not a whole number of {width}-character ranges")
    digits = np.frombuffer(payload, np.uint8) - np.uint8(0x30)  # a byte below 0x30 wraps to a large value
    if digits.size and digits.max() > 0x3F:
        raise ProtocolError("SCIP: byte outside the encoding in a data line")
    columns = digits.reshape(-1, width).astype(np.int32)
    values = columns[:, 0]
    for column in range(1, width):
        values = values << 6 | columns[:, column]
    return values


def wrap_lines(payload: bytes, *, sums: bool = True) -> list[bytes]:
    """Split ``payload`` into data lines without LF, with checksum characters if ``sums``."""
    lines = [payload[at : at + LINE_PAYLOAD] for at in range(0, len(payload), LINE_PAYLOAD)]
    return [line + bytes((line_sum(line),)) for line in lines] if sums else lines


def unwrap_lines(lines: list[bytes], *, sums: bool = True) -> bytes:
    """Join data lines and verify their checksums.

    Raises:
        ProtocolError: a line has a wrong checksum or more than 64 payload characters.
    """
    if not sums:
        return b"".join(lines)
    payload = []
    for line in lines:
        text = line[:-1]
        if not text or (sum(text) & 0x3F) + 0x30 != line[-1] or len(text) > LINE_PAYLOAD:
            raise ProtocolError("SCIP: bad checksum in a data line")
        payload.append(text)
    return b"".join(payload)


# Requests


def request(command: str, tag: str = "") -> bytes:
    """Encode a command, with an optional tag that the sensor echoes.

    Raises:
        ValueError: the sensor would refuse a character, or the tag is too long.
    """
    if len(tag) > TAG_LIMIT:
        raise ValueError(f"tag {tag!r} is longer than {TAG_LIMIT} characters")
    text = f"{command};{tag}" if tag else command
    if not text.isascii() or not text.isprintable() or ";" in command or not command:
        raise ValueError(f"{text!r} is not a SCIP request")
    return text.encode("ascii") + b"\n"


def scan_command(scan_format: ScanFormat, start: int, end: int, cluster: int = 1, skip: int = 0, count: int = 0) -> str:
    """Return ``MD`` or ``MS`` for steps ``start`` to ``end``; skip ``skip`` turns between scans (count 0: no end).

    Raises:
        ValueError: a parameter has too many digits.
    """
    _digits(start=(start, 9999), end=(end, 9999), cluster=(cluster, 99), skip=(skip, 9), count=(count, 99))
    return f"{scan_format}{start:04d}{end:04d}{cluster:02d}{skip:d}{count:02d}"


def scip1_scan_command(start: int, end: int, cluster: int = 1) -> str:
    """Return ``G`` (SCIP 1.1), which requests the latest revolution once.

    Raises:
        ValueError: a parameter has too many digits.
    """
    _digits(start=(start, 999), end=(end, 999), cluster=(cluster, 99))
    return f"G{start:03d}{end:03d}{cluster:02d}"


def _digits(**limits: tuple[int, int]) -> None:
    for name, (value, greatest) in limits.items():
        if not 0 <= value <= greatest:
            raise ValueError(f"{name} {value} is not within 0..{greatest}")


# Replies


@dataclass(frozen=True, slots=True)
class Reply:
    """One complete reply or scan block."""

    echo: str
    """First line, an exact copy of the request (scan blocks: with the remaining count)."""
    status: str
    """Two characters in SCIP 2.0, one in SCIP 1.1."""
    lines: list[bytes]
    """Lines after the status, without LF, with their checksum characters, unchecked."""

    @property
    def scip1(self) -> bool:
        """Whether the answering sensor uses SCIP 1.1."""
        return len(self.status) == 1

    def answers_scan(self, command: str) -> bool:
        """Whether this reply belongs to the stream started by ``command`` (MD/MS), whatever count remains."""
        return len(self.echo) == len(command) and self.echo[:13] == command[:13] and self.echo[13:].isdigit()


def build_reply(echo: str, status: str, lines: list[bytes] | None = None) -> bytes:
    """Encode a reply; ``lines`` already contain their checksum characters."""
    head = status.encode("ascii")
    if len(status) > 1:
        head += bytes((line_sum(head),))
    return b"\n".join([echo.encode("latin-1"), head, *(lines or []), b"", b""])


_ECHO = rb"(?:VV|PP|II|BM|QT|RS|TM[012]|SS\d{6}|SCIP2\.0|G[DES]\d{10}|M[DES]\d{13}|V|L[01]|G\d{8})"
# Not anchored at the start of a line: the header may directly follow a truncated line.
_HEADER = re.compile(_ECHO + rb"\n(?:[0-9A-Z]{2}[0-o]|[0-9A-Z])\n")
_FIRST_LINES = re.compile(rb"([\x20-\x7e]{1,64})\n(?:([0-9A-Z]{2})([0-o])|([0-9A-Z]))\n")
_TEXT_LINE = re.compile(rb"[A-Z]{4}:")


class ScipParser:
    """Incremental reply parser; it resynchronises after lost, flipped or foreign bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._searched = 0
        self._last = Reply("", "", [])
        self.replies = 0
        """Number of replies recognised."""
        self.rejected = 0
        """Number of byte runs without a readable header."""

    def feed(self, data: bytes) -> list[Reply]:
        """Parse received bytes in chunks of any size; return the completed replies."""
        self._buffer += data
        found: list[Reply] = []
        while (at := self._buffer.find(b"\n\n", self._searched)) >= 0:
            group = bytes(self._buffer[: at + 1])
            del self._buffer[: at + 2]
            self._searched = 0
            found += self._read(group.lstrip(b"\n"))
        if len(self._buffer) > MAX_REPLY:
            del self._buffer[: -MAX_REPLY // 2]
            self.rejected += 1
        self._searched = max(0, len(self._buffer) - 1)
        self.replies += len(found)
        return found

    def reset(self) -> None:
        """Discard a partially received reply."""
        self._buffer.clear()
        self._searched = 0

    def _read(self, group: bytes) -> list[Reply]:
        """Parse the text up to an empty line: one reply, or several if the end of one was lost."""
        if not group:
            return []
        starts = [match.start() for match in _HEADER.finditer(group)]
        if starts[:1] != [0]:
            starts.insert(0, 0)
        parts = [group[a:b] for a, b in zip(starts, [*starts[1:], len(group)], strict=True)]
        return [reply for part in parts if (reply := self._part(part)) is not None]

    def _part(self, part: bytes) -> Reply | None:
        match = _FIRST_LINES.match(part)
        if match is not None and (match[2] is None or line_sum(match[2]) == match[3][0]):
            status = (match[2] or match[4]).decode("ascii")
            self._last = Reply(match[1].decode("ascii"), status, part[match.end() :].split(b"\n")[:-1])
            return self._last
        if self._last.echo[:2] in ("VV", "PP", "II") and _TEXT_LINE.match(part):
            # Some units put an empty line into the middle of VV: the rest continues it.
            return Reply(self._last.echo, self._last.status, part.split(b"\n")[:-1])
        self.rejected += 1
        return None


# Statuses


class StatusMeaning(Enum):
    """Action that a status requires from the host."""

    OK = auto()
    ALREADY = auto()
    """Nothing to do: the laser was already on, or the mode already entered or left."""
    DATA = auto()
    """A scan follows."""
    VERIFYING = auto()
    """21-49: stopped to verify a suspected fault; wait for RESUMED."""
    RESUMED = auto()
    LASER_OFF = auto()
    BUSY = auto()
    """0B: drain and retry once."""
    UNSTABLE = auto()
    """0M: this revolution has no data."""
    UPDATE_MODE = auto()
    """0I: firmware update mode; leave it with RS."""
    FAULT = auto()
    """50-97, 0A, 0L, or a laser that failed to light."""
    BAD_REQUEST = auto()
    """Invalid request of this driver; a retry cannot help."""


def classify(command: str, status: str) -> StatusMeaning:
    """Classify the ``status`` of a reply to ``command``, of which the first characters suffice."""
    if len(status) == 1:
        return StatusMeaning.OK if status == "0" else StatusMeaning.BAD_REQUEST
    shared = {
        "00": StatusMeaning.OK,
        "0A": StatusMeaning.FAULT,
        "0B": StatusMeaning.BUSY,
        "0I": StatusMeaning.UPDATE_MODE,
        "0L": StatusMeaning.FAULT,
        "0M": StatusMeaning.UNSTABLE,
    }
    if status in shared:
        return shared[status]
    if command.startswith("BM"):
        return {"01": StatusMeaning.FAULT, "02": StatusMeaning.ALREADY}.get(status, StatusMeaning.BAD_REQUEST)
    if command.startswith("TM"):
        return StatusMeaning.ALREADY if status in ("02", "03") else StatusMeaning.BAD_REQUEST
    if command.startswith("SS"):
        return StatusMeaning.ALREADY if status == "03" else StatusMeaning.BAD_REQUEST
    if status.isdigit() and command[:2] in RANGE_WIDTH:
        code = int(status)
        if code == 99:
            return StatusMeaning.DATA
        if code == 98:
            return StatusMeaning.RESUMED
        if code >= 50:
            return StatusMeaning.FAULT
        if code >= 21:
            return StatusMeaning.VERIFYING
        if code == 10:
            return StatusMeaning.LASER_OFF
    return StatusMeaning.BAD_REQUEST


# Scans


@dataclass(frozen=True, slots=True)
class ScanBlock:
    """Decoded data of one revolution."""

    counter: int | None
    """Millisecond counter at step 0, 24 bits; None in SCIP 1.1."""
    values: NDArray[np.int32]
    """Ranges (mm), shape (n,); a value below the sensor's minimum range is an error code."""


def decode_counter(line: bytes) -> int:
    """Parse the millisecond counter of a time line with its checksum.

    Raises:
        ProtocolError: the checksum or the length is wrong.
    """
    if len(line) != 5 or line_sum(line[:4]) != line[4]:
        raise ProtocolError("SCIP: bad time line")
    return decode(line[:4])


def decode_scan(reply: Reply, start: int, end: int, cluster: int = 1) -> ScanBlock:
    """Decode a scan block for steps ``start`` to ``end``.

    The last, partial cluster may be present or absent: the specification does not say which.

    Raises:
        ProtocolError: a checksum is wrong, or the number of ranges differs from the request.
    """
    name = reply.echo[:1] if reply.scip1 else reply.echo[:2]
    if name not in RANGE_WIDTH or (not reply.scip1 and len(reply.lines) < 2):
        raise ProtocolError(f"SCIP: {reply.echo!r} contains no scan")
    counter = None if reply.scip1 else decode_counter(reply.lines[0])
    payload = unwrap_lines(reply.lines if reply.scip1 else reply.lines[1:], sums=not reply.scip1)
    values = decode_array(payload, RANGE_WIDTH[name])
    steps, width = end - start + 1, max(cluster, 1)
    if len(values) not in (steps // width, -(-steps // width)):
        raise ProtocolError(f"SCIP: {len(values)} ranges received, {-(-steps // width)} requested")
    return ScanBlock(counter, values)


def split_ranges(values: NDArray[np.int32], least: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Separate ranges from error codes.

    Args:
        values: shape (n,), mm or error codes.
        least: minimum range (mm, ``DMIN``); lower values are error codes.

    Returns:
        Ranges (m, +inf where invalid) and error codes (255 where valid), each of shape (n,) and read-only for use in
        messages.
    """
    valid = values >= least
    ranges = np.where(valid, values / 1000.0, np.inf)
    codes = np.where(valid, VALID_BEAM, np.minimum(values, VALID_BEAM - 1)).astype(np.uint8)
    ranges.flags.writeable = codes.flags.writeable = False
    return ranges, codes


def split_lx_ranges(
    values: NDArray[np.int32], least: int, greatest: int, *, free: bool
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Like ``split_ranges``, but for the UST and UTM series: values outside the measuring range are errors.

    If nothing is in range, a UTM reports 1 (table 4 of the SCIP 2.0 specification) and a UST a value beyond its range.
    Other error values carry no information.

    Args:
        values: shape (n,), mm or error values.
        least: minimum range (mm, ``DMIN``).
        greatest: maximum range (mm, ``DMAX``).
        free: whether a beam without a return is free up to the scanner's maximum range.
    """
    valid = (values >= least) & (values <= greatest)
    ranges = np.where(valid, values / 1000.0, np.inf)
    unreturned = (values > greatest) | (values == 1)
    codes = np.where(valid, VALID_BEAM, np.where(unreturned & free, NO_ECHO, NO_ECHO + 1)).astype(np.uint8)
    ranges.flags.writeable = codes.flags.writeable = False
    return ranges, codes


# Text fields of VV, PP and II


@dataclass(frozen=True, slots=True)
class LidarIdentity:
    """Reply to VV (or V)."""

    vendor: str
    product: str
    firmware: str
    protocol: str
    serial: str


@dataclass(frozen=True, slots=True)
class Parameters:
    """Reply to PP: all parameters that define the scan geometry."""

    model: str
    least_mm: int
    """Minimum valid range (mm); values below it are error codes."""
    greatest_mm: int
    steps_per_turn: int
    first_step: int
    """First measuring step."""
    last_step: int
    front_step: int
    """Step that points straight ahead."""
    rpm: int

    @property
    def period(self) -> float:
        """Revolution period (s)."""
        return 60.0 / self.rpm

    @property
    def step_time(self) -> float:
        """Time between neighbouring steps (s)."""
        return self.period / self.steps_per_turn

    def angle(self, step: float) -> float:
        """Direction of a step (rad), counter-clockwise from straight ahead."""
        return (step - self.front_step) * 2.0 * math.pi / self.steps_per_turn


@dataclass(frozen=True, slots=True)
class InternalState:
    """Reply to II."""

    laser_on: bool
    speed: str
    mode: str
    counter: int
    """Millisecond counter, 24 bits."""
    status: str


SCIP1_PARAMETERS: Final = Parameters("URG-04LX", 20, 4095, 1024, 44, 725, 384, 600)
"""Parameters of a URG-04LX with firmware below 3, which has no PP; 4095 mm is the maximum of its encoding."""


def parse_fields(lines: list[bytes], *, sums: bool = True) -> dict[str, str]:
    """Parse ``KEY:value;`` lines into a mapping.

    Accepts a wrong checksum on SERI, which some units send, and checksums that exclude the text after ``<-``, as in
    some models' replies to II.

    Raises:
        ProtocolError: any other line has a wrong checksum, or a line is malformed.
    """
    fields: dict[str, str] = {}
    for line in lines:
        key, colon, value = line.partition(b":")
        if not colon or len(key) != 4:
            raise ProtocolError(f"SCIP: expected 'KEY:value', got {line!r}")
        if sums:
            note = line.partition(b"<-")[0]
            if not (sum_matches(line) or sum_matches(note + line[-1:]) or key == b"SERI"):
                raise ProtocolError(f"SCIP: bad checksum in {line!r}")
            value = value[:-1]
        name, text = (part.decode("ascii", "backslashreplace") for part in (key, value.removesuffix(b";")))
        fields[name] = text.strip()
    return fields


def build_fields(fields: Mapping[str, str | int]) -> list[bytes]:
    """Build ``KEY:value;`` lines as firmware 3.1 does: the checksum excludes the ``;``."""
    lines = []
    for key, value in fields.items():
        text = f"{key}:{value}".encode("latin-1")
        lines.append(text + b";" + bytes((line_sum(text),)))
    return lines


def parse_identity(fields: dict[str, str]) -> LidarIdentity:
    """Parse the fields of VV; missing fields are empty, because old units omit some."""
    return LidarIdentity(*(fields.get(key, "") for key in ("VEND", "PROD", "FIRM", "PROT", "SERI")))


def parse_parameters(fields: dict[str, str]) -> Parameters:
    """Parse the fields of PP.

    Raises:
        ProtocolError: a field is missing or not a number, or the geometry is impossible.
    """
    try:
        numbers = [int(fields[key]) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")]
    except (KeyError, ValueError) as error:
        raise ProtocolError(f"SCIP: PP has no number for {error}") from error
    found = Parameters(fields.get("MODL", ""), *numbers)
    sound = (
        0 <= found.least_mm < found.greatest_mm
        and 0 <= found.first_step < found.last_step < found.steps_per_turn
        and found.rpm > 0
    )
    if not sound:
        raise ProtocolError(f"SCIP: PP states an impossible geometry: {found}")
    return found


def parse_state(fields: dict[str, str]) -> InternalState:
    """Parse the fields of II.

    Raises:
        ProtocolError: TIME is missing or not hexadecimal.
    """
    try:
        counter = int(fields["TIME"], 16)
    except (KeyError, ValueError) as error:
        raise ProtocolError(f"SCIP: II has no hexadecimal TIME: {error}") from error
    return InternalState(
        laser_on=fields.get("LASR", "") == "ON",
        speed=fields.get("SCSP", ""),
        mode=fields.get("MESM", ""),
        counter=counter,
        status=fields.get("STAT", ""),
    )
