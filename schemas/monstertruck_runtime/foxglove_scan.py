"""The scan's codec written out: what ``LASER_SCAN`` says, without its loops, which would take twice the time.

A scan comes ten times a second, so its code runs from cold caches, at five to ten times its usual cost, and what counts
is how little of it there is: every call, object and name more takes a microsecond or two. A message is put together
and taken apart by one ``struct`` for its sizes, and its values are compared with the model's limits here. Whatever is
unusual goes through the table and the model's validation.
"""

import struct
from math import inf
from typing import Final

import numpy as np

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.foxglove_layouts import IDENTITY, LASER_SCAN
from monstertruck_runtime.protobuf import delimited, read_varint, varint
from monstertruck_schemas.base import array_bytes, assembled
from monstertruck_schemas.sensor import LaserScan

_Sizes = tuple[int, int, int, int, int, int, bool]
"""Bytes of seconds, nanoseconds, frame, ranges, number and codes; whether there is a tilt."""
_Shape = tuple[struct.Struct, tuple[bytes, ...]]
"""Scans of equal sizes: a constant before each value. A tilt that is missing is two times nothing."""

_TAGS: Final = {row.name: row.tag for row in LASER_SCAN.fields}
_UINT8: Final = np.dtype(np.uint8)
_TOP: Final = 2**63
_MOST: Final = 64
"""Shapes and frames remembered; a robot has a few."""

_shapes: Final[dict[_Sizes, _Shape]] = {}
_known: Final[dict[tuple[int, bytes], _Shape]] = {}
"""Shapes that came in, by the sizes of message and stamp; where two share these, the newest."""
_frames: Final[dict[bytes, str]] = {}
"""Valid ones."""


def encode_scan(scan: LaserScan) -> bytes:
    """Serialize ``scan``."""
    whole, part = divmod(scan.stamp, SECOND)
    seconds, nanos, frame, seq = varint(whole), varint(part), scan.frame.encode(), varint(scan.seq)
    ranges, codes, tilt = array_bytes(scan.ranges), array_bytes(scan.codes), scan.tilt
    sizes = len(seconds), len(nanos), len(frame), len(ranges), len(seq), len(codes), tilt is not None
    row, c = _shapes.get(sizes) or _new_shape(sizes)
    # fmt: off
    return row.pack(
        c[0], seconds, c[1], nanos, c[2], frame, c[3], scan.start_angle, c[4], scan.end_angle, c[5], ranges,
        c[6], scan.received, c[7], seq, c[8], scan.time_increment, c[9], scan.scan_time,
        c[10], scan.range_min, c[11], scan.range_max, c[12], codes, c[13], b"" if tilt is None else tilt,
    )
    # fmt: on


def decode_scan(data: bytes) -> LaserScan:
    """Parse a serialized scan, whoever wrote it.

    Raises:
        InputError: truncated or invalid bytes.
        pydantic.ValidationError: values out of the model's range.
    """
    shape = _known.get((len(data), data[1:2]))
    if shape is None:
        return _decode_any(data)
    row, constants = shape
    fields = row.unpack(data)
    if fields[::2] != constants:
        return _decode_any(data)
    # fmt: off
    (
        seconds, nanos, name, start, end, ranges, received, number, increment, turn, least, greatest, codes, tilt,
    ) = fields[1::2]
    # fmt: on
    whole, first = read_varint(seconds, 0)
    part, second = read_varint(nanos, 0)
    seq, third = read_varint(number, 0)
    stamp = whole * SECOND + part
    if type(tilt) is bytes:
        tilt = None
    if not (
        first == len(seconds)
        and second == len(nanos)
        and third == len(number)
        and stamp < _TOP
        and seq < _TOP
        and name in _frames
        and -inf < start < inf
        and -inf < end < inf
        and 0.0 <= increment < inf
        and 0.0 < turn < inf
        and 0.0 <= least < inf
        and 0.0 < greatest < inf
        and (tilt is None or 0.0 <= tilt < inf)
    ):
        return _decode_any(data)
    return assembled(
        LaserScan,
        {
            "stamp": stamp,
            "received": received,
            "seq": seq,
            "frame": _frames[name],
            "start_angle": start,
            "end_angle": end,
            "time_increment": increment,
            "scan_time": turn,
            "range_min": least,
            "range_max": greatest,
            "ranges": np.frombuffer(ranges),
            "codes": np.frombuffer(codes, _UINT8),
            "tilt": tilt,
        },
    )


def _decode_any(data: bytes) -> LaserScan:
    """Parse by the table and the model; remembers the shape if it is one that ``encode_scan`` writes."""
    scan = LaserScan.model_validate(LASER_SCAN.decode(data))
    if encode_scan(scan) == data:
        for table in (_known, _frames):
            if len(table) >= _MOST:
                table.clear()
        frame = scan.frame.encode()
        seconds, nanos, seq = (len(varint(number)) for number in (*divmod(scan.stamp, SECOND), scan.seq))
        sizes = seconds, nanos, len(frame), scan.ranges.nbytes, seq, scan.codes.nbytes, scan.tilt is not None
        _known[len(data), data[1:2]] = _shapes[sizes]
        _frames[frame] = scan.frame
    return scan


def _new_shape(sizes: _Sizes) -> _Shape:
    """Shape of scans whose values have so many bytes; remembered."""
    seconds, nanos, frame, ranges, seq, codes, tilted = sizes
    parts = (
        (_TAGS["timestamp"] + varint(seconds + nanos + 2) + b"\x08", f"{seconds}s"),
        (b"\x10", f"{nanos}s"),
        (_TAGS["frame_id"] + varint(frame), f"{frame}s"),
        (_TAGS["pose"] + delimited(IDENTITY) + _TAGS["start_angle"], "d"),
        (_TAGS["end_angle"], "d"),
        (_TAGS["ranges"] + varint(ranges), f"{ranges}s"),
        (_TAGS["received"], "q"),
        (_TAGS["seq"], f"{seq}s"),
        *((_TAGS[name], "d") for name in ("time_increment", "scan_time", "range_min", "range_max")),
        (_TAGS["codes"] + varint(codes), f"{codes}s"),
        (_TAGS["tilt"] + varint(8), "d") if tilted else (b"", "0s"),
    )
    row = struct.Struct("<" + "".join(f"{len(constant)}s{code}" for constant, code in parts))
    if len(_shapes) >= _MOST:
        _shapes.clear()
    shape = _shapes[sizes] = row, tuple(constant for constant, _ in parts)
    return shape
