"""The scan's codec written out: what ``LASER_SCAN`` says, without its loops, which would take twice the time."""

import struct
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.foxglove_layouts import IDENTITY, LASER_SCAN, read_stamp, write_stamp
from monstertruck_runtime.protobuf import delimited, read_varint, varint
from monstertruck_schemas.sensor import LaserScan

_T: Final = {row.name: row.tag for row in LASER_SCAN.fields}
_STAMP, _FRAME, _LENGTH_OF_ONE = _T["timestamp"], _T["frame_id"], varint(8)
_POSE: Final = _T["pose"] + delimited(IDENTITY)
_ANGLES: Final = struct.Struct(f"<{len(_POSE) + 1}sdsds")
_RECEIVED: Final = struct.Struct("<2sq2s")
_TIMES: Final = struct.Struct("<2sd2sd2sd2sd2s")
_TILT: Final = struct.Struct("<3sd")
_TAGS: Final = (
    _STAMP + _FRAME,
    _POSE + _T["start_angle"],
    _T["end_angle"],
    _T["ranges"],
    _T["received"],
    _T["seq"],
    _T["time_increment"],
    _T["scan_time"],
    _T["range_min"],
    _T["range_max"],
    _T["codes"],
    _T["tilt"] + _LENGTH_OF_ONE,
)
"""What stands between the values, in order."""
_, _START, _END, _RANGES, _RECV, _SEQ, _INC, _SCAN, _MIN, _MAX, _CODES, _ONE_TILT = _TAGS
_UINT8: Final = np.dtype(np.uint8)
_validate: Final[Callable[[Any], LaserScan]] = LaserScan.__pydantic_validator__.validate_python


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
    try:
        scan = _decode_own(data)
    except (LookupError, struct.error, ValueError, InputError):
        scan = None
    return LaserScan.model_validate(LASER_SCAN.decode(data)) if scan is None else scan


def _decode_own(data: bytes) -> LaserScan | None:
    """Parse what ``encode_scan`` wrote; None, or any error, if it is something else."""
    frame_at = 2 + data[1]
    if data[1] | data[frame_at + 1] > 0x7F:  # lengths of several bytes
        return None
    stamp = read_stamp(data[2:frame_at])
    at = frame_at + 2 + data[frame_at + 1]
    frame = data[frame_at + 2 : at].decode()
    tag1, start_angle, tag2, end_angle, tag3 = _ANGLES.unpack_from(data, at)
    size, at = read_varint(data, at + _ANGLES.size)
    ranges, at = data[at : at + size], at + size
    tag4, received, tag5 = _RECEIVED.unpack_from(data, at)
    seq, at = read_varint(data, at + _RECEIVED.size)
    tag6, time_increment, tag7, scan_time, tag8, range_min, tag9, range_max, tag10 = _TIMES.unpack_from(data, at)
    size, at = read_varint(data, at + _TIMES.size)
    codes, at = data[at : at + size], at + size
    tag11, tilt = (_ONE_TILT, None) if at == len(data) else _TILT.unpack(data[at:])
    tags = data[:1] + data[frame_at : frame_at + 1], tag1, tag2, tag3, tag4, tag5, tag6, tag7, tag8, tag9, tag10, tag11
    if tags != _TAGS:
        return None
    return _validate(
        {
            "stamp": stamp,
            "received": received,
            "seq": seq,
            "frame": frame,
            "start_angle": start_angle,
            "end_angle": end_angle,
            "time_increment": time_increment,
            "scan_time": scan_time,
            "range_min": range_min,
            "range_max": range_max,
            "ranges": np.frombuffer(ranges),
            "codes": np.frombuffer(codes, _UINT8),
            "tilt": tilt,
        }
    )
