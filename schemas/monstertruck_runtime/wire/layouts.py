"""The well-known ``foxglove.*`` protobuf messages as layouts, with our own fields added.

Fields below 1000 are Foxglove's own and are filled for viewers; fields from 1000 on are ours and carry what
the well-known message cannot, exactly. Stock readers skip them. A field's number is never reused.
"""

import math
import struct
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.wire.protobuf import (
    BOOL,
    BYTES,
    DELIMITED,
    DOUBLE,
    DOUBLES,
    ENUM,
    FIXED_INT64,
    FIXED_UINT32,
    INT32,
    INT64,
    OPTIONAL_DOUBLE,
    STRING,
    UINT8_ARRAY,
    UINT64,
    Field,
    Kind,
    Layout,
    message,
    read_varint,
    varint,
)

FIRST_OWN_FIELD: Final = 1000
"""Field numbers from here on are ours."""

TIMESTAMP: Final = Layout("google.protobuf.Timestamp", Field(1, "seconds", INT64), Field(2, "nanos", INT32))


def write_stamp(stamp: int) -> bytes:
    """Serialized timestamp of ``stamp``, ns."""
    seconds, nanos = divmod(stamp, SECOND)
    return b"\x08%b\x10%b" % (varint(seconds), varint(nanos))


def read_stamp(timestamp: bytes) -> int:
    """Nanoseconds of a serialized timestamp."""
    if timestamp[:1] == b"\x08":  # as ``write_stamp`` does
        seconds, at = read_varint(timestamp, 1)
        if timestamp[at : at + 1] == b"\x10":
            nanos, at = read_varint(timestamp, at + 1)
            if at == len(timestamp) and max(seconds, nanos) < 2**63:
                return seconds * SECOND + nanos
    values = TIMESTAMP.decode(timestamp)
    return int(values["seconds"]) * SECOND + int(values["nanos"])


STAMP: Final = Kind(DELIMITED, 11, write_stamp, read_stamp, 0, joined=True, layout=TIMESTAMP)
"""``google.protobuf.Timestamp`` from and to nanoseconds."""
VECTOR2: Final = Layout("foxglove.Vector2", Field(1, "x", DOUBLE), Field(2, "y", DOUBLE))
VECTOR3: Final = Layout("foxglove.Vector3", Field(1, "x", DOUBLE), Field(2, "y", DOUBLE), Field(3, "z", DOUBLE))
QUATERNION: Final = Layout(
    "foxglove.Quaternion", Field(1, "x", DOUBLE), Field(2, "y", DOUBLE), Field(3, "z", DOUBLE), Field(4, "w", DOUBLE)
)
POSE: Final = Layout(
    "foxglove.Pose", Field(1, "position", message(VECTOR3)), Field(2, "orientation", message(QUATERNION))
)
PACKED_ELEMENT: Final = Layout(
    "foxglove.PackedElementField", Field(1, "name", STRING), Field(2, "offset", FIXED_UINT32), Field(3, "type", ENUM)
)
FRAME_TRANSFORM: Final = Layout(
    "foxglove.FrameTransform",
    Field(1, "timestamp", STAMP, key="stamp"),
    Field(2, "parent_frame_id", STRING, key="parent"),
    Field(3, "child_frame_id", STRING, key="child"),
    Field(4, "translation", message(VECTOR3)),
    Field(5, "rotation", message(QUATERNION)),
)

_PLANAR_POSE: Final = struct.Struct("<3sdBd3sdBd")


def planar_pose(x: float, y: float, yaw: float) -> bytes:
    """Serialized ``foxglove.Pose`` in the plane; what is zero there is left out."""
    half = yaw / 2
    return _PLANAR_POSE.pack(b"\x0a\x12\x09", x, 0x11, y, b"\x12\x12\x19", math.sin(half), 0x21, math.cos(half))


IDENTITY: Final = planar_pose(0.0, 0.0, 0.0)
"""Serialized pose of what is drawn in its own frame."""

_HEADER: Final = (Field(1, "timestamp", STAMP, key="stamp"), Field(2, "frame_id", STRING, key="frame"))
_OWN_HEADER: Final = (Field(1000, "received", FIXED_INT64), Field(1001, "seq", UINT64))

LASER_SCAN: Final = Layout(
    "foxglove.LaserScan",
    *_HEADER,
    Field(3, "pose", message(POSE), constant=IDENTITY),
    Field(4, "start_angle", DOUBLE),
    Field(5, "end_angle", DOUBLE),
    Field(6, "ranges", DOUBLES),
    Field(7, "intensities", DOUBLES, constant=b""),
    *_OWN_HEADER,
    Field(1002, "time_increment", DOUBLE),
    Field(1003, "scan_time", DOUBLE),
    Field(1004, "range_min", DOUBLE),
    Field(1005, "range_max", DOUBLE),
    Field(1006, "codes", UINT8_ARRAY),
    Field(1007, "tilt", OPTIONAL_DOUBLE),
)
POSE_IN_FRAME: Final = Layout(
    "foxglove.PoseInFrame",
    *_HEADER,
    Field(3, "pose", message(POSE)),
    *_OWN_HEADER,
    Field(1002, "child", STRING),
    Field(1003, "pose2d", DOUBLES),
    Field(1004, "twist2d", DOUBLES),
    Field(1005, "pose_covariance", DOUBLES),
    Field(1006, "twist_covariance", DOUBLES),
    Field(1007, "age", DOUBLE),
    Field(1008, "sources", STRING, repeated=True),
)
POSES_IN_FRAME: Final = Layout(
    "foxglove.PosesInFrame",
    *_HEADER,
    Field(3, "poses", message(POSE), repeated=True),
    *_OWN_HEADER,
    Field(1002, "poses2d", DOUBLES),
    Field(1003, "directions", DOUBLES),
    Field(1004, "closed", BOOL),
    Field(1005, "name", STRING),
)
GRID: Final = Layout(
    "foxglove.Grid",
    *_HEADER,
    Field(3, "pose", message(POSE)),
    Field(4, "column_count", FIXED_UINT32),
    Field(5, "cell_size", message(VECTOR2)),
    Field(6, "row_stride", FIXED_UINT32),
    Field(7, "cell_stride", FIXED_UINT32),
    Field(8, "fields", message(PACKED_ELEMENT), repeated=True),
    Field(9, "data", BYTES),
    *_OWN_HEADER,
    Field(1002, "origin2d", DOUBLES),
)
COMPRESSED_IMAGE: Final = Layout(
    "foxglove.CompressedImage",
    Field(1, "timestamp", STAMP, key="stamp"),
    Field(2, "data", BYTES),
    Field(3, "format", STRING),
    Field(4, "frame_id", STRING, key="frame"),
    *_OWN_HEADER,
    Field(1002, "sequence", UINT64),
)
FRAME_TRANSFORMS: Final = Layout(
    "foxglove.FrameTransforms",
    Field(1, "transforms", message(FRAME_TRANSFORM), repeated=True),
    *_OWN_HEADER,
    Field(1002, "stamp", FIXED_INT64),
    Field(1003, "frame", STRING),
)
LOG: Final = Layout(
    "foxglove.Log",
    Field(1, "timestamp", STAMP, key="stamp"),
    Field(2, "level", ENUM),
    Field(3, "message", STRING, key="text"),
    Field(4, "name", STRING),
    Field(5, "file", STRING),
    Field(6, "line", FIXED_UINT32),
    *_OWN_HEADER,
    Field(1002, "frame", STRING),
)

_INT8: Final = 2
"""``foxglove.PackedElementField.NumericType.INT8``."""
OCCUPANCY: Final = PACKED_ELEMENT.encode({"name": "occupancy", "offset": 0, "type": _INT8})
"""Serialized description of a grid's one byte per cell."""
