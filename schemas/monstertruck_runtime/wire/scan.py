"""The scan's codec written out: what ``LASER_SCAN`` says, without its loops, which would take thrice the time.

A scan comes ten times a second, so its code runs from cold caches, at five to ten times its usual cost, and what counts
is how little of it there is: every call, object and name more takes a microsecond or two. What is the same in every
scan of a device is therefore put together and checked once, as its shape; one ``struct`` sets the rest between that, or
takes it out. Whatever is unusual goes through the table and the model's validation.
"""

import struct
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.wire.layouts import IDENTITY, LASER_SCAN
from monstertruck_runtime.wire.protobuf import delimited, read_varint, varint
from monstertruck_schemas.base import array_bytes, assembled
from monstertruck_schemas.sensor import LaserScan


class _Shape(NamedTuple):
    """Scans that differ in time, number, ranges, codes and tilt only, and whose values are of the same sizes."""

    row: struct.Struct
    constants: tuple[bytes, ...]
    """What stands before each value. A tilt that is missing is two times nothing."""


_Same = tuple[str, bytes, int, int, int, int, int, bool]
"""What is the same in all scans of a shape: frame, doubles, bytes of seconds, nanoseconds, ranges, number and codes,
and whether there is a tilt."""

_TAGS: Final = {row.name: row.tag for row in LASER_SCAN.fields}
_DOUBLES: Final = struct.Struct("<6d")
_UINT8: Final = np.dtype(np.uint8)
_TOP: Final = 2**63
_MOST: Final = 64
"""Shapes remembered; a robot has a few."""
_seconds: Final = lru_cache(maxsize=8)(varint)
_read_seconds: Final = lru_cache(maxsize=8)(read_varint)
"""Ten scans share a second."""

_shapes: Final[dict[_Same, _Shape]] = {}
_known: Final[dict[tuple[int, bytes], tuple[_Shape, dict[str, Any]]]] = {}
"""Shapes that came in and one scan's valid values, by the sizes of message and stamp; where two share these, the
newest."""


def encode_scan(scan: LaserScan) -> bytes:
    """Serialize ``scan``."""
    whole, part = divmod(scan.stamp, SECOND)
    seconds, nanos, seq = _seconds(whole), varint(part), varint(scan.seq)
    ranges, codes = array_bytes(scan.ranges), array_bytes(scan.codes)
    row, c = _shape(scan, len(seconds), len(nanos), len(ranges), len(seq), len(codes))
    tilt = b"" if scan.tilt is None else scan.tilt
    return row.pack(
        c[0], seconds, c[1], nanos, c[2], ranges, c[3], scan.received, c[4], seq, c[5], codes, c[6], tilt
    )  # fmt: skip


def decode_scan(data: bytes) -> LaserScan:
    """Parse a serialized scan, whoever wrote it.

    Raises:
        InputError: truncated or invalid bytes.
        pydantic.ValidationError: values out of the model's range.
    """
    known = _known.get((len(data), data[1:2]))
    if known is None:
        return _decode_any(data)
    (row, constants), same = known
    fields = row.unpack(data)
    if fields[::2] != constants:
        return _decode_any(data)
    seconds, nanos, ranges, received, number, codes, tilt = fields[1::2]
    whole, first = _read_seconds(seconds, 0)
    part, second = read_varint(nanos, 0)
    seq, third = read_varint(number, 0)
    stamp = whole * SECOND + part
    if type(tilt) is bytes:
        tilt = None
    elif not 0.0 <= tilt < np.inf:
        return _decode_any(data)
    if first != len(seconds) or second != len(nanos) or third != len(number) or stamp >= _TOP or seq >= _TOP:
        return _decode_any(data)
    values = same.copy()
    values["stamp"] = stamp
    values["received"] = received
    values["seq"] = seq
    values["ranges"] = np.frombuffer(ranges)
    values["codes"] = np.frombuffer(codes, _UINT8)
    values["tilt"] = tilt
    return assembled(LaserScan, values)


def _decode_any(data: bytes) -> LaserScan:
    """Parse by the table and the model; remembers the shape if it is one that ``encode_scan`` writes."""
    scan = LaserScan.model_validate(LASER_SCAN.decode(data))
    if encode_scan(scan) == data:
        if len(_known) >= _MOST:
            _known.clear()
        numbers = (varint(number) for number in (*divmod(scan.stamp, SECOND), scan.seq))
        seconds, nanos, seq = map(len, numbers)
        shape = _shape(scan, seconds, nanos, scan.ranges.nbytes, seq, scan.codes.nbytes)
        _known[len(data), data[1:2]] = shape, dict(scan)
    return scan


def _shape(scan: LaserScan, seconds: int, nanos: int, ranges: int, seq: int, codes: int) -> _Shape:
    """Shape of ``scan``, whose values have so many bytes."""
    doubles = _DOUBLES.pack(
        scan.start_angle, scan.end_angle, scan.time_increment, scan.scan_time, scan.range_min, scan.range_max
    )
    same = scan.frame, doubles, seconds, nanos, ranges, seq, codes, scan.tilt is not None
    return _shapes.get(same) or _new_shape(*same)


def _new_shape(
    frame: str, doubles: bytes, seconds: int, nanos: int, ranges: int, seq: int, codes: int, tilted: bool
) -> _Shape:
    """Shape of what is the same; remembered."""
    start, end, *rest = (doubles[at : at + 8] for at in range(0, len(doubles), 8))
    angles = _TAGS["start_angle"] + start + _TAGS["end_angle"] + end
    device = b"".join(
        _TAGS[name] + value
        for name, value in zip(("time_increment", "scan_time", "range_min", "range_max"), rest, strict=True)
    )
    name = _TAGS["frame_id"] + delimited(frame.encode())
    parts = (
        (_TAGS["timestamp"] + varint(seconds + nanos + 2) + b"\x08", f"{seconds}s"),
        (b"\x10", f"{nanos}s"),
        (name + _TAGS["pose"] + delimited(IDENTITY) + angles + _TAGS["ranges"] + varint(ranges), f"{ranges}s"),
        (_TAGS["received"], "q"),
        (_TAGS["seq"], f"{seq}s"),
        (device + _TAGS["codes"] + varint(codes), f"{codes}s"),
        (_TAGS["tilt"] + varint(8), "d") if tilted else (b"", "0s"),
    )
    row = struct.Struct("<" + "".join(f"{len(constant)}s{code}" for constant, code in parts))
    if len(_shapes) >= _MOST:
        _shapes.clear()
    same = frame, doubles, seconds, nanos, ranges, seq, codes, tilted
    shape = _shapes[same] = _Shape(row, tuple(constant for constant, _ in parts))
    return shape
