"""Writers of the poses that go out a hundred times a second: what their layouts say, without the layouts' loops.

As with scans, such code runs from cold caches, and what counts is how little of it there is.
"""

import struct
from functools import lru_cache
from typing import Final

from monstertruck_runtime.wire.layouts import (
    FRAME_TRANSFORM,
    IDENTITY,
    POSE_IN_FRAME,
    planar_pose,
    write_stamp,
)
from monstertruck_runtime.wire.protobuf import delimited, varint
from monstertruck_schemas.state import Odometry, Transform

_TEXTS: Final = 64
"""Combinations of names remembered; a robot has a few."""

_POSE: Final = {row.name: row.tag for row in POSE_IN_FRAME.fields}
_TRANSFORM: Final = {row.name: row.tag for row in FRAME_TRANSFORM.fields}

_BEFORE_POSE: Final = _POSE["pose"] + varint(len(IDENTITY))
_BEFORE_SEQ: Final = struct.Struct("<{}sq{}s".format(*map(len, (_POSE["received"], _POSE["seq"]))))
_THREE: Final = varint(3 * 8)
_NINE: Final = varint(9 * 8)
# fmt: off
_END: Final = (
    _POSE["pose2d"] + _THREE, _POSE["twist2d"] + _THREE, _POSE["pose_covariance"] + _NINE,
    _POSE["twist_covariance"] + _NINE, _POSE["age"],
)
_END_ROW: Final = struct.Struct("<{}s3d{}s3d{}s72s{}s72s{}sd".format(*map(len, _END)))
_TRANSLATION: Final = _TRANSFORM["translation"] + b"\x1b\x09"
_ROTATION: Final = _TRANSFORM["rotation"] + b"\x24\x09"
_TRANSFORM_ROW: Final = struct.Struct(f"<{len(_TRANSLATION)}sdBdBd{len(_ROTATION)}sdBdBdBd")
# fmt: on


def encode_odometry(odometry: Odometry) -> bytes:
    """Serialize ``odometry`` as ``POSE_IN_FRAME``."""
    pose, twist = odometry.pose, odometry.twist
    x, y, yaw = pose.x, pose.y, pose.yaw
    stamp = write_stamp(odometry.stamp)
    frame, child, sources = _names(odometry.frame, odometry.child, odometry.sources)
    pose2d, twist2d, pose_covariance, twist_covariance, age = _END
    # fmt: off
    return b"".join((
        _POSE["timestamp"], varint(len(stamp)), stamp, frame,
        _BEFORE_POSE, planar_pose(x, y, yaw),
        _BEFORE_SEQ.pack(_POSE["received"], odometry.received, _POSE["seq"]), varint(odometry.seq), child,
        _END_ROW.pack(
            pose2d, x, y, yaw, twist2d, twist.vx, twist.vy, twist.wz,
            pose_covariance, odometry.pose_covariance.tobytes(),
            twist_covariance, odometry.twist_covariance.tobytes(),
            age, odometry.age,
        ),
        sources,
    ))
    # fmt: on


def encode_transform(transform: Transform) -> bytes:
    """Serialize ``transform`` as ``FRAME_TRANSFORM``."""
    stamp = write_stamp(transform.stamp)
    (x, y, z), (qx, qy, qz, qw) = transform.translation, transform.rotation
    # fmt: off
    return b"".join((
        _TRANSFORM["timestamp"], varint(len(stamp)), stamp, _ends(transform.parent, transform.child),
        _TRANSFORM_ROW.pack(_TRANSLATION, x, 0x11, y, 0x19, z, _ROTATION, qx, 0x11, qy, 0x19, qz, 0x21, qw),
    ))
    # fmt: on


@lru_cache(_TEXTS)
def _names(frame: str, child: str, sources: tuple[str, ...]) -> tuple[bytes, bytes, bytes]:
    """Fields of odometry's frames and sources."""
    return (
        _POSE["frame_id"] + delimited(frame.encode()),
        _POSE["child"] + delimited(child.encode()),
        b"".join(_POSE["sources"] + delimited(source.encode()) for source in sources),
    )


@lru_cache(_TEXTS)
def _ends(parent: str, child: str) -> bytes:
    """Fields of a transform's two frames."""
    return b"".join(
        _TRANSFORM[name] + delimited(frame.encode())
        for name, frame in (("parent_frame_id", parent), ("child_frame_id", child))
    )
