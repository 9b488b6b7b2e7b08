"""CDR, the encoding of ROS 2 messages (XCDR1, little endian): a message is a dictionary of the interface's fields.

An omitted field is zero or empty. Sequences of numbers are numpy arrays, or bytes; decoded ones are read-only. The
decoder rejects invalid data and never allocates more memory than the size of the message.
"""

import math
import struct
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Final

import numpy as np

from monstertruck_runtime.errors import InputError
from monstertruckd.ros2.interfaces import ARRAY, RosField, interfaces

RosMessage = dict[str, Any]
"""Values by field; values of nested interfaces are dictionaries as well."""

HEADER: Final = b"\x00\x01\x00\x00"
"""Little endian, no options; alignment starts after this header."""

_CODES: Final = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""Format characters of ``struct``, also used for numpy except ``?`` and similar ones."""

Write = Callable[[bytearray, Any], None]
Read = Callable[[memoryview, int], tuple[Any, int]]
"""Reads a value at an offset; returns it and the offset after it."""

_EMPTY: Final[RosMessage] = {}
_COUNT: Final = struct.Struct("<I")
_FLOAT32: Final = struct.Struct("<f")


def encode(name: str, message: Mapping[str, Any]) -> bytes:
    """Encode a message, including the header.

    Raises:
        ValueError: the message has an unknown field or an array of the wrong length.
        struct.error: a number does not fit its field.
    """
    body = bytearray()
    _struct_writer(name)(body, message)
    return HEADER + body


def decode(name: str, data: bytes) -> RosMessage:
    """Decode a message.

    Raises:
        InputError: the bytes do not match the interface; bytes after its end are ignored, as in ROS 2.
    """
    if data[:2] != HEADER[:2]:
        raise InputError(f"{name}: expected little-endian CDR, found {data[:4].hex() or 'no data'}")
    try:
        found: RosMessage
        found, _ = _struct_reader(name)(memoryview(data)[len(HEADER) :], 0)
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{name}: {error}") from None
    return found


def _pad(body: bytearray, size: int) -> None:
    if extra := -len(body) % size:
        body += bytes(extra)


def _aligned(at: int, size: int) -> int:
    return at + -at % size


@cache
def _struct_writer(name: str) -> Write:
    fields = [(field.name, _field_writer(field), _default(field)) for field in interfaces()[name]]
    names = frozenset(field for field, _, _ in fields)
    packed = _packed_writer(interfaces()[name])

    def write(body: bytearray, message: Mapping[str, Any]) -> None:
        if not message.keys() <= names:
            unknown = ", ".join(sorted(message.keys() - names))
            raise ValueError(f"{name} has no field {unknown}")
        if packed is not None:
            packed(body, message)
            return
        for field, writer, default in fields:
            writer(body, message.get(field, default))

    return write


def _packed_writer(fields: tuple[RosField, ...]) -> Write | None:
    """Return a writer for an interface whose fields are numbers of one size, such as a point; None for any other."""
    kinds = {field.kind for field in fields}
    sizes = {struct.calcsize(_CODES.get(kind, "0s")) for kind in kinds}
    if len(sizes) > 1 or not kinds <= _CODES.keys() or "float32" in kinds or any(field.many for field in fields):
        return None
    row = struct.Struct("<" + "".join(_CODES[field.kind] for field in fields))
    names, (size,) = [field.name for field in fields], sizes

    def write(body: bytearray, message: Mapping[str, Any]) -> None:
        _pad(body, size)
        body += row.pack(*[message.get(name, 0) for name in names])

    return write


def _default(field: RosField) -> Any:
    if field.many == ARRAY:
        return np.zeros(field.count) if field.nested is None else (_EMPTY,) * field.count
    if field.many:
        return ()
    if field.nested is not None:
        return _EMPTY
    return "" if field.kind == "string" else 0


def _field_writer(field: RosField) -> Write:
    one = _writer(field)
    if not field.many:
        return one
    fixed = field.count if field.many == ARRAY else None
    numbers = field.kind in _CODES
    size = struct.calcsize(_CODES[field.kind]) if numbers else 1
    dtype = np.dtype(f"<{_CODES[field.kind]}") if numbers else None

    def write(body: bytearray, values: Any) -> None:
        if fixed is None:
            _pad(body, 4)
            body += _COUNT.pack(len(values))
        elif len(values) != fixed:
            raise ValueError(f"{field.name}: expected {fixed} values, found {len(values)}")
        if dtype is None:
            for value in values:
                one(body, value)
        elif len(values):
            _pad(body, size)
            body += values if isinstance(values, bytes) else _as_bytes(np.asarray(values), dtype)

    return write


def _as_bytes(values: np.ndarray[Any, Any], dtype: np.dtype[Any]) -> bytes:
    if values.dtype == dtype:
        return values.tobytes()
    with np.errstate(over="ignore"):
        return values.astype(dtype).tobytes()


def _writer(field: RosField) -> Write:
    if field.nested is not None:
        return _struct_writer(field.nested)
    if field.kind == "string":
        return _write_text
    number = struct.Struct(f"<{_CODES[field.kind]}")
    size, pack = number.size, number.pack
    if field.kind == "float32":
        return _write_float32

    def write(body: bytearray, value: Any) -> None:
        if extra := -len(body) % size:
            body += bytes(extra)
        body += pack(value)

    return write


def _write_float32(body: bytearray, value: float) -> None:
    """Write a float32; values beyond its range become infinite, as in numpy arrays."""
    _pad(body, _FLOAT32.size)
    try:
        body += _FLOAT32.pack(value)
    except OverflowError:
        body += _FLOAT32.pack(math.copysign(math.inf, value))


def _write_text(body: bytearray, text: str) -> None:
    data = text.encode()
    _pad(body, 4)
    body += _COUNT.pack(len(data) + 1)
    body += data
    body.append(0)


@cache
def _struct_reader(name: str) -> Read:
    fields = [(field.name, _field_reader(field)) for field in interfaces()[name]]

    def read(data: memoryview, at: int) -> tuple[RosMessage, int]:
        message: RosMessage = {}
        for field, reader in fields:
            message[field], at = reader(data, at)
        return message, at

    return read


def _field_reader(field: RosField) -> Read:
    one = _reader(field)
    if not field.many:
        return one
    fixed = field.count if field.many == ARRAY else None
    dtype = np.dtype(f"<{_CODES[field.kind]}") if field.kind in _CODES else None

    def read(data: memoryview, at: int) -> tuple[Any, int]:
        count = fixed
        if count is None:
            at = _aligned(at, 4)
            (count,) = _COUNT.unpack_from(data, at)
            at += 4
        if dtype is not None:
            at = _aligned(at, dtype.itemsize) if count else at
            return np.frombuffer(data, dtype, count, at) if count else np.empty(0, dtype), at + count * dtype.itemsize
        if count > len(data) - at:  # every value has at least one byte
            raise ValueError(f"{field.name}: {count} values in {len(data) - at} bytes")
        values = []
        for _ in range(count):
            value, at = one(data, at)
            values.append(value)
        return values, at

    return read


def _reader(field: RosField) -> Read:
    if field.nested is not None:
        return _struct_reader(field.nested)
    if field.kind == "string":
        return _read_text
    number = struct.Struct(f"<{_CODES[field.kind]}")
    size, unpack = number.size, number.unpack_from

    def read(data: memoryview, at: int) -> tuple[Any, int]:
        at += -at % size
        return unpack(data, at)[0], at + size

    return read


def _read_text(data: memoryview, at: int) -> tuple[str, int]:
    at = _aligned(at, 4)
    (count,) = _COUNT.unpack_from(data, at)
    at += 4
    if count > len(data) - at:
        raise ValueError(f"a text of {count} bytes in {len(data) - at}")
    return bytes(data[at : at + max(count - 1, 0)]).decode(), at + count
