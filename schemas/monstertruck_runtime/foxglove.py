"""Our messages as the well-known ``foxglove.*`` protobuf messages, so that stock viewers draw them.

Fields below 1000 are Foxglove's own and are filled for viewers; fields from 1000 on are ours and carry what
the well-known message cannot, exactly. Stock readers skip them. A field's number is never reused.
"""

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.protobuf import (
    BOOL,
    BYTES,
    DOUBLE,
    DOUBLES,
    ENUM,
    FIXED_INT64,
    FIXED_UINT32,
    INT32,
    INT64,
    STRING,
    UINT64,
    Field,
    Layout,
    message,
)
from monstertruck_schemas.base import Message, Pose2D, Twist2D
from monstertruck_schemas.plan import Path
from monstertruck_schemas.sensor import CompressedImage, LaserScan
from monstertruck_schemas.state import Grid, Odometry, Transform, Transforms

FIRST_OWN_FIELD: Final = 1000
"""Field numbers from here on are ours."""

TIMESTAMP: Final = Layout("google.protobuf.Timestamp", Field(1, "seconds", INT64), Field(2, "nanos", INT32))
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
    Field(1, "timestamp", message(TIMESTAMP)),
    Field(2, "parent_frame_id", STRING),
    Field(3, "child_frame_id", STRING),
    Field(4, "translation", message(VECTOR3)),
    Field(5, "rotation", message(QUATERNION)),
)

_HEADER: Final = (Field(1, "timestamp", message(TIMESTAMP)), Field(2, "frame_id", STRING))
_OWN_HEADER: Final = (Field(1000, "received", FIXED_INT64), Field(1001, "seq", UINT64))

LASER_SCAN: Final = Layout(
    "foxglove.LaserScan",
    *_HEADER,
    Field(3, "pose", message(POSE)),
    Field(4, "start_angle", DOUBLE),
    Field(5, "end_angle", DOUBLE),
    Field(6, "ranges", DOUBLES),
    Field(7, "intensities", DOUBLES),
    *_OWN_HEADER,
    Field(1002, "time_increment", DOUBLE),
    Field(1003, "scan_time", DOUBLE),
    Field(1004, "range_min", DOUBLE),
    Field(1005, "range_max", DOUBLE),
    Field(1006, "codes", BYTES),
    Field(1007, "tilt", DOUBLES),  # none or one: stock writers leave out a plain 0
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
    Field(1, "timestamp", message(TIMESTAMP)),
    Field(2, "data", BYTES),
    Field(3, "format", STRING),
    Field(4, "frame_id", STRING),
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

_INT8: Final = 2
"""``foxglove.PackedElementField.NumericType.INT8``."""
_OCCUPANCY: Final = PACKED_ELEMENT.encode({"name": "occupancy", "offset": 0, "type": _INT8})
_PLANAR_POSE: Final = struct.Struct("<3sdBd3sdBd")


def planar_pose(x: float, y: float, yaw: float) -> bytes:
    """Serialized ``foxglove.Pose`` in the plane; what is zero there is left out."""
    half = yaw / 2
    return _PLANAR_POSE.pack(b"\x0a\x12\x09", x, 0x11, y, b"\x12\x12\x19", math.sin(half), 0x21, math.cos(half))


_IDENTITY: Final = planar_pose(0.0, 0.0, 0.0)


def _header(message: Message) -> dict[str, Any]:
    return {
        "timestamp": _timestamp(message.stamp),
        "frame_id": message.frame,
        "received": message.received,
        "seq": message.seq,
    }


def _own_header(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "stamp": _stamp(values["timestamp"]),
        "frame": values["frame_id"],
        "received": values["received"],
        "seq": values["seq"],
    }


def _timestamp(stamp: int) -> dict[str, int]:
    seconds, nanos = divmod(stamp, SECOND)
    return {"seconds": seconds, "nanos": nanos}


def _stamp(timestamp: bytes) -> int:
    values = TIMESTAMP.decode(timestamp)
    return int(values["seconds"]) * SECOND + int(values["nanos"])


def _row(pose: bytes) -> tuple[float, float, float]:
    """(x, y, yaw) of a standard pose."""
    parts = POSE.decode(pose)
    position, q = VECTOR3.decode(parts["position"]), QUATERNION.decode(parts["orientation"])
    yaw = math.atan2(2 * (q["w"] * q["z"] + q["x"] * q["y"]), 1 - 2 * (q["y"] ** 2 + q["z"] ** 2))
    return position["x"], position["y"], yaw


def _pose2d(exact: Any, pose: bytes) -> Pose2D:
    """Our exact (x, y, yaw) if the writer gave it, else the standard pose."""
    x, y, yaw = _doubles3(exact) if len(exact) else _row(pose)
    return Pose2D(x=x, y=y, yaw=yaw)


def _doubles3(values: Any) -> tuple[float, float, float]:
    if len(values) != 3:
        msg = f"expected 3 numbers, got {len(values)}"
        raise InputError(msg)
    a, b, c = values.tolist()
    return a, b, c


def _scan_values(scan: LaserScan) -> dict[str, Any]:
    return _header(scan) | {
        "pose": _IDENTITY,
        "start_angle": scan.start_angle,
        "end_angle": scan.end_angle,
        "ranges": scan.ranges,
        "time_increment": scan.time_increment,
        "scan_time": scan.scan_time,
        "range_min": scan.range_min,
        "range_max": scan.range_max,
        "codes": scan.codes.tobytes(),
        "tilt": np.array([] if scan.tilt is None else [scan.tilt]),
    }


def _scan_model(values: Mapping[str, Any]) -> LaserScan:
    return LaserScan(
        **_own_header(values),
        start_angle=values["start_angle"],
        end_angle=values["end_angle"],
        time_increment=values["time_increment"],
        scan_time=values["scan_time"],
        range_min=values["range_min"],
        range_max=values["range_max"],
        ranges=values["ranges"],
        codes=np.frombuffer(values["codes"], np.uint8),
        tilt=float(values["tilt"][0]) if len(values["tilt"]) else None,
    )


def _image_values(image: CompressedImage) -> dict[str, Any]:
    return _header(image) | {"data": image.data, "format": image.format, "sequence": image.sequence}


def _image_model(values: Mapping[str, Any]) -> CompressedImage:
    return CompressedImage(
        **_own_header(values), data=values["data"], format=values["format"], sequence=values["sequence"]
    )


def _odometry_values(odometry: Odometry) -> dict[str, Any]:
    pose, twist = odometry.pose, odometry.twist
    return _header(odometry) | {
        "pose": planar_pose(pose.x, pose.y, pose.yaw),
        "child": odometry.child,
        "pose2d": np.array((pose.x, pose.y, pose.yaw)),
        "twist2d": np.array((twist.vx, twist.vy, twist.wz)),
        "pose_covariance": odometry.pose_covariance,
        "twist_covariance": odometry.twist_covariance,
        "age": odometry.age,
        "sources": odometry.sources,
    }


def _odometry_model(values: Mapping[str, Any]) -> Odometry:
    vx, vy, wz = _doubles3(values["twist2d"])
    return Odometry(
        **_own_header(values),
        child=values["child"],
        pose=_pose2d(values["pose2d"], values["pose"]),
        twist=Twist2D(vx=vx, vy=vy, wz=wz),
        pose_covariance=values["pose_covariance"],
        twist_covariance=values["twist_covariance"],
        age=values["age"],
        sources=tuple(values["sources"]),
    )


def _path_values(path: Path) -> dict[str, Any]:
    if len(path.poses) % 3:
        msg = f"path of {len(path.poses)} numbers: expected rows of (x, y, yaw)"
        raise InputError(msg)
    return _header(path) | {
        "poses": [planar_pose(*row) for row in path.poses.reshape(-1, 3).tolist()],
        "poses2d": path.poses,
        "directions": path.directions,
        "closed": path.closed,
        "name": path.name,
    }


def _path_model(values: Mapping[str, Any]) -> Path:
    exact = values["poses2d"]
    return Path(
        **_own_header(values),
        poses=exact if len(exact) else np.array([_row(pose) for pose in values["poses"]]).ravel(),
        directions=values["directions"],
        closed=values["closed"],
        name=values["name"],
    )


def _grid_values(grid: Grid) -> dict[str, Any]:
    if grid.cells.size != grid.width * grid.height:
        msg = f"grid of {grid.width} x {grid.height} has {grid.cells.size} cells"
        raise InputError(msg)
    origin = grid.origin
    return _header(grid) | {
        "pose": planar_pose(origin.x, origin.y, origin.yaw),
        "column_count": grid.width,
        "cell_size": {"x": grid.resolution, "y": grid.resolution},
        "row_stride": grid.width,
        "cell_stride": 1,
        "fields": [_OCCUPANCY],
        "data": grid.cells.tobytes(),
        "origin2d": np.array((origin.x, origin.y, origin.yaw)),
    }


def _grid_model(values: Mapping[str, Any]) -> Grid:
    width, data = values["column_count"], values["data"]
    if values["cell_stride"] != 1 or values["row_stride"] != width or width == 0 or len(data) % width:
        msg = f"grid of {len(data)} bytes in rows of {width}: expected whole rows of one int8 per cell"
        raise InputError(msg)
    return Grid(
        **_own_header(values),
        resolution=VECTOR2.decode(values["cell_size"])["x"],
        width=width,
        height=len(data) // width,
        origin=_pose2d(values["origin2d"], values["pose"]),
        cells=np.frombuffer(data, np.int8),
    )


def _transforms_values(tree: Transforms) -> dict[str, Any]:
    return {
        "transforms": [
            {
                "timestamp": _timestamp(transform.stamp),
                "parent_frame_id": transform.parent,
                "child_frame_id": transform.child,
                "translation": dict(zip("xyz", transform.translation, strict=True)),
                "rotation": dict(zip("xyzw", transform.rotation, strict=True)),
            }
            for transform in tree.transforms
        ],
        "stamp": tree.stamp,
        "received": tree.received,
        "seq": tree.seq,
        "frame": tree.frame,
    }


def _transforms_model(values: Mapping[str, Any]) -> Transforms:
    return Transforms(
        stamp=values["stamp"],
        received=values["received"],
        seq=values["seq"],
        frame=values["frame"],
        transforms=tuple(_transform(raw) for raw in values["transforms"]),
    )


def _transform(raw: bytes) -> Transform:
    values = FRAME_TRANSFORM.decode(raw)
    return Transform.model_validate(
        {
            "parent": values["parent_frame_id"],
            "child": values["child_frame_id"],
            "stamp": _stamp(values["timestamp"]),
            "translation": tuple(VECTOR3.decode(values["translation"]).values()),
            "rotation": tuple(QUATERNION.decode(values["rotation"]).values()),
        }
    )


@dataclass(frozen=True, slots=True)
class Binding:
    """How one of our models travels as a well-known message."""

    layout: Layout
    values: Callable[[Any], dict[str, Any]]
    """Model to field values."""
    model: Callable[[Mapping[str, Any]], Message]
    """Field values to model; raises ``InputError`` or ``pydantic.ValidationError``."""

    def encode(self, message: Message) -> bytes:
        """Serialize ``message``."""
        return self.layout.encode(self.values(message))

    def decode(self, data: bytes) -> Message:
        """Parse ``data``."""
        return self.model(self.layout.decode(data))


BINDINGS: Final[Mapping[type[Message], Binding]] = {
    LaserScan: Binding(LASER_SCAN, _scan_values, _scan_model),
    CompressedImage: Binding(COMPRESSED_IMAGE, _image_values, _image_model),
    Odometry: Binding(POSE_IN_FRAME, _odometry_values, _odometry_model),
    Path: Binding(POSES_IN_FRAME, _path_values, _path_model),
    Grid: Binding(GRID, _grid_values, _grid_model),
    Transforms: Binding(FRAME_TRANSFORMS, _transforms_values, _transforms_model),
}
