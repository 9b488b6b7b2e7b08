"""Protocol Buffers encoding from declared fields, without generated classes.

A ``Layout`` is a table of ``Field`` rows. Encoding takes a mapping of field name to value, decoding gives one
back. Packed arrays go through ``ndarray.tobytes``/``numpy.frombuffer``, so that a scan costs microseconds.
Source: https://protobuf.dev/programming-guides/encoding/. Scalars are always written, zero or not.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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
_INT64: Final = struct.Struct("<q")
_UINT32: Final = struct.Struct("<I")
_MASK64: Final = 2**64 - 1


@dataclass(frozen=True, slots=True)
class Kind:
    """How values of one protobuf type look on the wire."""

    wire_type: int
    descriptor_type: int
    """``google.protobuf.FieldDescriptorProto.Type``."""
    write: Callable[[Any], bytes]
    """Value to bytes behind the tag, length prefix included."""
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


@dataclass(frozen=True, slots=True)
class Field:
    """One row of a layout."""

    number: int
    name: str
    kind: Kind
    repeated: bool = False
    """A list of values, each with its own tag; packed kinds are arrays by themselves."""
    tag: bytes = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tag", varint(self.number << 3 | self.kind.wire_type))

    def reader(self) -> Callable[[Any], Any]:
        """Reader of one occurrence, or of the list of all where the field is repeated or joined."""
        read = self.kind.read
        if self.repeated:
            return lambda raws: [read(raw) for raw in raws]
        if self.kind.joined:
            return lambda raws: read(b"".join(raws))
        return read


class Layout:
    """Message type: its full protobuf name and its fields."""

    def __init__(self, name: str, *fields: Field) -> None:
        self.name = name
        self.fields: Sequence[Field] = fields
        self._defaults = {row.name: () if row.repeated else row.kind.default for row in fields}
        self._readers: dict[int, tuple[str, Callable[[Any], Any], bool]] = {}
        """By tag: name, reader, whether it takes the list of all occurrences.

        A field of an unexpected wire type has no row here: it counts as unknown, as protobuf demands.
        """
        for row in fields:
            tag = row.number << 3
            assert tag | row.kind.wire_type not in self._readers, f"{name}: field number {row.number} used twice"
            reader = row.name, row.reader(), row.repeated or row.kind.joined
            self._readers[tag | row.kind.wire_type] = reader
            if row.kind.packed:
                self._readers[tag | FIXED64] = reader

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """Serialize the fields that ``values`` names; absent names are left out of the message."""
        parts: list[bytes] = []
        for row in self.fields:
            if row.name not in values:
                continue
            value = values[row.name]
            if row.repeated:
                for item in value:
                    parts += (row.tag, row.kind.write(item))
            else:
                parts += (row.tag, row.kind.write(value))
        return b"".join(parts)

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
                    name, read, takes_list = readers[tag]
                    if takes_list:
                        lists.setdefault(name, (read, []))[1].append(raw)
                    else:
                        values[name] = read(raw)
        except (LookupError, struct.error):
            at = end + 1
        if at > end:
            msg = f"{self.name}: truncated or not protobuf 3"
            raise InputError(msg)
        for name, (read, raws) in lists.items():
            values[name] = read(raws)
        return values


def varint(value: int) -> bytes:
    """Base-128 form of ``value``; negative numbers as 64-bit two's complement."""
    value &= _MASK64
    if value < 0x80:
        return bytes((value,))
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
    value = shift = 0
    try:
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


def _same(value: Any) -> Any:
    return value


DOUBLE: Final = Kind(FIXED64, 1, _DOUBLE.pack, lambda raw: _DOUBLE.unpack(raw)[0], 0.0)
FIXED_UINT32: Final = Kind(FIXED32, 7, _UINT32.pack, lambda raw: _UINT32.unpack(raw)[0], 0)
INT64: Final = Kind(VARINT, 3, varint, _signed, 0)
INT32: Final = Kind(VARINT, 5, varint, _signed, 0)
FIXED_INT64: Final = Kind(FIXED64, 16, _INT64.pack, lambda raw: _INT64.unpack(raw)[0], 0)
UINT64: Final = Kind(VARINT, 4, varint, _same, 0)
BOOL: Final = Kind(VARINT, 8, varint, bool, default=False)
ENUM: Final = Kind(VARINT, 14, varint, _signed, 0)
STRING: Final = Kind(DELIMITED, 9, lambda value: delimited(value.encode()), _text, "")
BYTES: Final = Kind(DELIMITED, 12, delimited, _same, b"")
DOUBLES: Final = Kind(
    DELIMITED, 1, lambda array: delimited(array.tobytes()), _doubles, np.frombuffer(b""), joined=True, packed=True
)
"""Packed ``repeated double`` from and to a float64 array."""


def message(layout: Layout) -> Kind:
    """Embedded message: written from a mapping or from its ready bytes, read as its bytes.

    Whoever needs its fields decodes them with ``layout``; what is drawn by viewers only is never parsed.
    """

    def write(value: Mapping[str, Any] | bytes) -> bytes:
        return delimited(value if isinstance(value, bytes) else layout.encode(value))

    return Kind(DELIMITED, 11, write, _same, b"", joined=True, layout=layout)
