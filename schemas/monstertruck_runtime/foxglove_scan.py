"""The scan's codec written out: what ``LASER_SCAN`` says, without its loops, which would take twice the time.

A scan comes ten times a second, so its code runs from cold caches, and what counts is how little of it there is: a
message of a shape seen before is taken apart by one ``struct``, and its values are compared with the model's limits
here. Everything else goes through the table and the model's validation, which also teach the shape.
"""

import struct
from math import inf
from typing import Any, Final, NamedTuple

import numpy as np

from monstertruck_runtime.foxglove_layouts import IDENTITY, LASER_SCAN, read_stamp, write_stamp
from monstertruck_runtime.protobuf import delimited, read_varint, varint
from monstertruck_schemas.base import assembled
from monstertruck_schemas.sensor import LaserScan

_T: Final = {row.name: row.tag for row in LASER_SCAN.fields}
_STAMP, _FRAME, _RANGES, _CODES = _T["timestamp"], _T["frame_id"], _T["ranges"], _T["codes"]
_START, _END = _T["pose"] + delimited(IDENTITY) + _T["start_angle"], _T["end_angle"]
_RECV, _SEQ, _INC, _SCAN = _T["received"], _T["seq"], _T["time_increment"], _T["scan_time"]
_MIN, _MAX, _ONE_TILT = _T["range_min"], _T["range_max"], _T["tilt"] + varint(8)
_ANGLES: Final = struct.Struct(f"<{len(_START)}sdsds")
_RECEIVED: Final = struct.Struct("<2sq2s")
_TIMES: Final = struct.Struct("<2sd2sd2sd2sd2s")
_TILT: Final = struct.Struct("<3sd")
_UINT8: Final = np.dtype(np.uint8)
_TOP: Final = 2**63
_MOST: Final = 64
"""Shapes and frames remembered; a robot has a few."""


class _Shape(NamedTuple):
    """Scans of equal sizes: a constant before each value."""

    row: struct.Struct
    constants: tuple[bytes, ...]


_shapes: Final[dict[tuple[int, int], _Shape]] = {}
"""By the bytes of message and stamp; where two shapes share these, the newest."""
_frames: Final[dict[bytes, str]] = {}
"""Valid ones."""


def encode_scan(scan: LaserScan) -> bytes:
    """Serialize ``scan``."""
    stamp, frame = write_stamp(scan.stamp), scan.frame.encode()
    ranges, codes, tilt = scan.ranges.tobytes(), scan.codes.tobytes(), scan.tilt
    return b"".join(
        (
            _STAMP,
            varint(len(stamp)),
            stamp,
            _FRAME,
            varint(len(frame)),
            frame,
            _ANGLES.pack(_START, scan.start_angle, _END, scan.end_angle, _RANGES),
            varint(len(ranges)),
            ranges,
            _RECEIVED.pack(_RECV, scan.received, _SEQ),
            varint(scan.seq),
            _TIMES.pack(
                _INC, scan.time_increment, _SCAN, scan.scan_time, _MIN, scan.range_min, _MAX, scan.range_max, _CODES
            ),
            varint(len(codes)),
            codes,
            b"" if tilt is None else _TILT.pack(_ONE_TILT, tilt),
        )
    )


def decode_scan(data: bytes) -> LaserScan:
    """Parse a serialized scan, whoever wrote it.

    Raises:
        InputError: truncated or invalid bytes.
        pydantic.ValidationError: values out of the model's range.
    """
    shape = _shapes.get((len(data), data[1] if len(data) > 1 else 0))
    if shape is not None and (scan := _decode_known(shape, data)) is not None:
        return scan
    scan = LaserScan.model_validate(LASER_SCAN.decode(data))
    _learn(scan, data)
    return scan


def _learn(scan: LaserScan, data: bytes) -> None:
    """Remember the shape of a valid message, if it is one that ``encode_scan`` writes."""
    if encode_scan(scan) != data:
        return
    stamp, frame, seq = len(write_stamp(scan.stamp)), scan.frame.encode(), len(varint(scan.seq))
    ranges, codes = scan.ranges.nbytes, scan.codes.nbytes
    parts = [
        (_STAMP + varint(stamp), f"{stamp}s"),
        (_FRAME + varint(len(frame)), f"{len(frame)}s"),
        (_START, "d"),
        (_END, "d"),
        (_RANGES + varint(ranges), f"{ranges}s"),
        (_RECV, "q"),
        (_SEQ, f"{seq}s"),
        (_INC, "d"),
        (_SCAN, "d"),
        (_MIN, "d"),
        (_MAX, "d"),
        (_CODES + varint(codes), f"{codes}s"),
        *([] if scan.tilt is None else [(_ONE_TILT, "d")]),
    ]
    for table in (_shapes, _frames):
        if len(table) >= _MOST:
            table.clear()
    row = struct.Struct("<" + "".join(f"{len(constant)}s{code}" for constant, code in parts))
    _shapes[len(data), stamp] = _Shape(row, tuple(constant for constant, _ in parts))
    _frames[frame] = scan.frame


def _decode_known(shape: _Shape, data: bytes) -> LaserScan | None:
    """Scan of a known shape with values within the model's limits; None if it is anything else."""
    fields = shape.row.unpack(data)
    if fields[::2] != shape.constants:
        return None
    raw, name, start, end, ranges, received, number, increment, turn, least, greatest, codes, *tilts = fields[1::2]
    frame, (seq, used), stamp = _frames.get(name), read_varint(number, 0), read_stamp(raw)
    tilt = tilts[0] if tilts else None
    if not (
        frame is not None
        and used == len(number)
        and max(seq, stamp) < _TOP
        and -inf < start < inf
        and -inf < end < inf
        and 0.0 <= increment < inf
        and 0.0 < turn < inf
        and 0.0 <= least < inf
        and 0.0 < greatest < inf
        and (tilt is None or 0.0 <= tilt < inf)
    ):
        return None
    values: dict[str, Any] = {
        "stamp": stamp,
        "received": received,
        "seq": seq,
        "frame": frame,
        "start_angle": start,
        "end_angle": end,
        "time_increment": increment,
        "scan_time": turn,
        "range_min": least,
        "range_max": greatest,
        "ranges": np.frombuffer(ranges),
        "codes": np.frombuffer(codes, _UINT8),
        "tilt": tilt,
    }
    return assembled(LaserScan, values)
