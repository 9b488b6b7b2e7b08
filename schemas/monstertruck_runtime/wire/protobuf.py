"""Protocol Buffers encoding from declared fields, without generated classes.

A ``Layout`` is a table of ``Field`` rows. Encoding takes a mapping of field name to value, decoding gives one
back. Packed arrays go through ``ndarray.tobytes``/``numpy.frombuffer``, so that a scan costs microseconds.
Source: https://protobuf.dev/programming-guides/encoding/. Scalars are always written, zero or not.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import methodcaller
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_runtime.errors import InputError

VARINT: Final = 0
FIXED64: Final = 1
DELIMITED: Final = 2
FIXED32: Final = 5

_FIXED: Final = {FIXED64: 8, FIXED32: 4}
_DOUBLE: Final = struct.Struct("<d")
_MASK64: Final = 2**64 - 1
_FIVE: Final = struct.Struct("<Q")
_CONTINUED: Final = [0, *(int.from_bytes(b"\x80" * count, "little") for count in range(5))]
_SHORT: Final = [bytes((value,)) for value in range(0x80)]


@dataclass(frozen=True, slots=True)
class Kind:
    """How values of one protobuf type look on the wire."""

    wire_type: int
    descriptor_type: int
    """``google.protobuf.FieldDescriptorProto.Type``."""
    write: Callable[[Any], bytes]
    """Value to bytes behind the tag, and behind the length where there is one."""
    read: Callable[[Any], Any]
    """Number of a varint, or bytes of anything else, to value."""
    default: Any
    """Value of a field that is not on the wire."""
    joined: bool = False
    """Several occurrences of a singular field are one value, in pieces (else the last one counts)."""
    packed: bool = False
    """Array of scalars in one record; the reader takes them one by one as well."""
    layout: "Layout | None" = None
    """Of an embedded message."""
    code: str | None = None
    """Format of ``struct``, where the value has a fixed size."""


@dataclass(frozen=True, slots=True)
class Field:
    """One row of a layout."""

    number: int
    name: str
    kind: Kind
    repeated: bool = False
    """A list of values, each with its own tag; packed kinds are arrays by themselves."""
    key: str = ""
    """Its name in mappings; by default ``name``."""
    constant: bytes | None = None
    """What always stands behind its tag and is never read, empty = nothing; mappings do not have it."""
    tag: bytes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "key", self.key or self.name)
        object.__setattr__(self, "tag", varint(self.number << 3 | self.kind.wire_type))

    def writer(self, before: bytes = b"") -> Callable[[Any], bytes]:
        """Writer of ``before``, the tag and a value; of None, ``before`` alone."""
        if self.repeated:
            write_one = replace(self, repeated=False).writer()
            return lambda values: before + b"".join([write_one(value) for value in values])
        tag, write = before + self.tag, self.kind.write
        if self.kind.code is not None:
            return partial(struct.Struct(f"<{len(tag)}s{self.kind.code}").pack, tag)
        if self.kind.wire_type == VARINT:
            return lambda value: tag + write(value)

        def with_length(value: Any) -> bytes:
            if value is None:
                return before
            body = write(value)
            return b"%b%b%b" % (tag, varint(len(body)), body)

        return with_length

    def reader(self) -> Callable[[Any], Any]:
        """Reader of one occurrence, or of the list of all where the field is repeated or joined."""
        read = self.kind.read
        if self.repeated:
            return lambda raws: [read(raw) for raw in raws]
        if self.kind.joined:
            return lambda raws: read(raws[0] if len(raws) == 1 else b"".join(raws))
        return read


class Layout:
    """Message type: its full protobuf name and its fields, of which the last one is no constant."""

    def __init__(self, name: str, *fields: Field) -> None:
        self.name = name
        self.fields: Sequence[Field] = fields
        self._writers: list[tuple[str, Callable[[Any], bytes]]] = []
        self._defaults: dict[str, Any] = {}
        self._readers: dict[int, tuple[str, Callable[[Any], Any], bool]] = {}
        """By tag: key, reader, whether it takes the list of all occurrences.

        A field of an unexpected wire type has no row here: it counts as unknown, as protobuf demands.
        """
        constants = b""
        for row in fields:
            tag = row.number << 3
            assert tag | row.kind.wire_type not in self._readers, f"{name}: field number {row.number} used twice"
            if row.constant is not None:
                constants += row.tag + delimited(row.constant) if row.constant else b""
                continue
            self._writers.append((row.key, row.writer(constants)))
            constants = b""
            self._defaults[row.key] = () if row.repeated else row.kind.default
            reader = row.key, row.reader(), row.repeated or row.kind.joined
            self._readers[tag | row.kind.wire_type] = reader
            if row.kind.packed:
                self._readers[tag | FIXED64] = reader

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """Serialize the fields that ``values`` has a value for; the others are left out of the message."""
        return b"".join([write(values[key]) for key, write in self._writers if key in values])

    def decode(self, data: bytes) -> dict[str, Any]:
        """Parse a serialized message.

        Returns:
            Every field of the layout; those not on the wire have their default. Unknown fields are skipped.

        Raises:
            InputError: truncated or invalid bytes.
        """
        values = self._defaults.copy()
        lists: dict[str, tuple[Callable[[Any], Any], list[Any]]] = {}
        at, end, readers = 0, len(data), self._readers
        try:
            while at < end:
                # Tags and lengths of one and two bytes are read in place: calls would double the time.
                tag = data[at]
                at += 1
                if tag > 0x7F:
                    tag += (data[at] << 7) - 0x80
                    at += 1
                    if tag > 0x3FFF:
                        tag, at = read_varint(data, at - 2)
                wire_type = tag & 7
                raw: Any
                if wire_type == VARINT:
                    raw, at = read_varint(data, at)
                else:
                    if wire_type == DELIMITED:
                        length = data[at]
                        at += 1
                        if length > 0x7F:
                            length, at = read_varint(data, at - 1)
                    else:
                        length = _FIXED[wire_type]
                    start, at = at, at + length
                    raw = data[start:at]
                if tag in readers:
                    key, read, takes_list = readers[tag]
                    if takes_list:
                        lists.setdefault(key, (read, []))[1].append(raw)
                    else:
                        values[key] = read(raw)
        except (LookupError, struct.error):
            at = end + 1
        if at > end:
            msg = f"{self.name}: truncated or not protobuf 3"
            raise InputError(msg)
        for key, (read, raws) in lists.items():
            values[key] = read(raws)
        return values


def varint(value: int) -> bytes:
    """Base-128 form of ``value``; negative numbers as 64-bit two's complement."""
    if 0 <= value < 0x8_0000_0000:
        if value < 0x80:
            return _SHORT[value]
        if value < 0x4000:
            return bytes((value & 0x7F | 0x80, value >> 7))
        groups = value & 0x7F | value << 1 & 0x7F00 | value << 2 & 0x7F_0000 | value << 3 & 0x7F00_0000
        count = (value.bit_length() + 6) // 7
        return _FIVE.pack(groups | value << 4 & 0x7F_0000_0000 | _CONTINUED[count])[:count]
    value &= _MASK64
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def read_varint(data: bytes, at: int) -> tuple[int, int]:
    """Number at ``at`` and the position behind it.

    Raises:
        InputError: truncated, or longer than 64 bits.
    """
    try:
        value = data[at]
        at += 1
        if value < 0x80:
            return value, at
        value, shift = value & 0x7F, 7
        while True:
            byte = data[at]
            at += 1
            if byte < 0x80:
                return (value | byte << shift) & _MASK64, at
            value |= (byte & 0x7F) << shift
            shift += 7
            if shift > 63:
                msg = f"number before byte {at} is longer than 64 bits"
                raise InputError(msg)
    except IndexError:
        msg = f"truncated after byte {at}"
        raise InputError(msg) from None


def delimited(body: bytes) -> bytes:
    """``body`` behind its length."""
    return varint(len(body)) + body


def _signed(value: int) -> int:
    return value - 2**64 if value >= 2**63 else value


def _text(raw: bytes) -> str:
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        msg = f"text is not UTF-8: {error}"
        raise InputError(msg) from None


def _doubles(raw: bytes) -> NDArray[np.float64]:
    if len(raw) % 8:
        msg = f"packed doubles take {len(raw)} bytes, not a multiple of 8"
        raise InputError(msg)
    return np.frombuffer(raw)


def _first_double(raw: bytes) -> float | None:
    doubles = _doubles(raw)
    return float(doubles[0]) if len(doubles) else None


def _codes(raw: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(raw, np.uint8)


def _same(value: Any) -> Any:
    return value


_tobytes: Final = methodcaller("tobytes")


def _fixed(wire_type: int, descriptor_type: int, code: str, default: float) -> Kind:
    row = struct.Struct("<" + code)
    return Kind(wire_type, descriptor_type, row.pack, lambda raw: row.unpack(raw)[0], default, code=code)


DOUBLE: Final = _fixed(FIXED64, 1, "d", 0.0)
FIXED_UINT32: Final = _fixed(FIXED32, 7, "I", 0)
FIXED_INT64: Final = _fixed(FIXED64, 16, "q", 0)
INT64: Final = Kind(VARINT, 3, varint, _signed, 0)
INT32: Final = Kind(VARINT, 5, varint, _signed, 0)
UINT64: Final = Kind(VARINT, 4, varint, _same, 0)
BOOL: Final = Kind(VARINT, 8, varint, bool, default=False)
ENUM: Final = Kind(VARINT, 14, varint, _signed, 0)
STRING: Final = Kind(DELIMITED, 9, str.encode, _text, "")
BYTES: Final = Kind(DELIMITED, 12, _same, _same, b"")
UINT8_ARRAY: Final = Kind(DELIMITED, 12, _tobytes, _codes, _codes(b""))
"""``bytes`` from and to a uint8 array."""
DOUBLES: Final = Kind(DELIMITED, 1, _tobytes, _doubles, np.frombuffer(b""), joined=True, packed=True)
"""Packed ``repeated double`` from and to a float64 array; ``array.array("d")`` is written as well."""
OPTIONAL_DOUBLE: Final = Kind(DELIMITED, 1, _DOUBLE.pack, _first_double, None, joined=True, packed=True)
"""None or one of ``repeated double``: a value that may be absent, as proto3 leaves out a plain 0."""


def message(layout: Layout) -> Kind:
    """Embedded message: written from a mapping or from its ready bytes, read as its bytes.

    Whoever needs its fields decodes them with ``layout``; what is drawn by viewers only is never parsed.
    """

    def write(value: Mapping[str, Any] | bytes) -> bytes:
        return value if isinstance(value, bytes) else layout.encode(value)

    return Kind(DELIMITED, 11, write, _same, b"", joined=True, layout=layout)
