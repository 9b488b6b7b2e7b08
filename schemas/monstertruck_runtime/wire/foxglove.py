"""Our messages as the well-known ``foxglove.*`` protobuf messages, so that stock viewers draw them.

Foxglove's published descriptors are extended by the fields of ``foxglove_fields.proto``, in a descriptor pool of their
own: the default pool holds the published ones under the same names. Bytes of version 0.1.0, which also has fields that
are zero, and bytes of any other protobuf writer are read alike.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, Final

import numpy as np
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from numpy.typing import NDArray

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.wire import foxglove_fields_pb2
from monstertruck_schemas.base import Message, Pose2D, Twist2D
from monstertruck_schemas.event import LogLevel, LogRecord
from monstertruck_schemas.plan import Path
from monstertruck_schemas.sensor import CompressedImage, LaserScan
from monstertruck_schemas.state import Grid, Odometry, Transform, Transforms


def _files(file: FileDescriptor) -> dict[str, FileDescriptorProto]:
    """``file`` and what it imports by name, imports first."""
    files: dict[str, FileDescriptorProto] = {}
    for dependency in file.dependencies:
        files |= _files(dependency)
    files[file.name] = FileDescriptorProto()
    file.CopyToProto(files[file.name])
    return files


@cache
def descriptor_set(name: str) -> bytes:
    """Serialized ``FileDescriptorSet`` of ``foxglove.<Name>`` with our fields added, dependencies first."""
    short = name.removeprefix("foxglove.")
    published = import_module(f"foxglove_schemas_protobuf.{short}_pb2").DESCRIPTOR
    files = _files(published)
    own = FileDescriptorProto.FromString(foxglove_fields_pb2.DESCRIPTOR.serialized_pb)
    for message in files[published.name].message_type:
        for ours in own.message_type:
            if ours.name == message.name == short:
                message.field.extend(ours.field)
    return FileDescriptorSet(file=files.values()).SerializeToString(deterministic=True)


def _message_class(name: str) -> type[Any]:
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set(name)).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(name))


def _timestamp(stamp: int) -> dict[str, int]:
    seconds, nanos = divmod(stamp, SECOND)
    return {"seconds": seconds, "nanos": nanos}


def _nanoseconds(timestamp: Any) -> int:
    return int(timestamp.seconds) * SECOND + int(timestamp.nanos)


def _counters(message: Message) -> dict[str, Any]:
    return {"received": message.received, "seq": message.seq}


def _header(message: Message) -> dict[str, Any]:
    return {"timestamp": _timestamp(message.stamp), "frame_id": message.frame, **_counters(message)}


def _own_header(proto: Any) -> dict[str, Any]:
    return {
        "stamp": _nanoseconds(proto.timestamp),
        "received": proto.received,
        "seq": proto.seq,
        "frame": proto.frame_id,
    }


def _planar_pose(x: float, y: float, yaw: float) -> dict[str, dict[str, float]]:
    """A ``foxglove.Pose`` in the plane."""
    return {"position": {"x": x, "y": y}, "orientation": {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}}


def _planar(pose: Any) -> tuple[float, float, float]:
    """(x, y, yaw) of a ``foxglove.Pose``."""
    q = pose.orientation
    yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    return pose.position.x, pose.position.y, yaw


def _array(values: Sequence[float]) -> NDArray[np.float64]:
    """Read-only array of a repeated field."""
    array = np.array(values, np.float64)
    array.flags.writeable = False
    return array


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    if len(values) != 3:
        msg = f"expected 3 numbers, got {len(values)}"
        raise InputError(msg)
    a, b, c = values
    return a, b, c


def _pose2d(exact: Sequence[float], pose: Any) -> Pose2D:
    """Our exact (x, y, yaw) if the writer gave it, else the standard pose."""
    x, y, yaw = _three(exact) if exact else _planar(pose)
    return Pose2D(x=x, y=y, yaw=yaw)


_SCAN: Final = ("start_angle", "end_angle", "time_increment", "scan_time", "range_min", "range_max")
_IDENTITY: Final = _planar_pose(0.0, 0.0, 0.0)
"""Pose of what is drawn in its own frame."""
_PackedRanges: Final = GetMessageClass(foxglove_fields_pb2.DESCRIPTOR.message_types_by_name["PackedRanges"])


def _write_scan(scan: LaserScan) -> dict[str, Any]:
    return {
        **_header(scan),
        **{name: getattr(scan, name) for name in _SCAN},
        "pose": _IDENTITY,
        "codes": scan.codes.tobytes(),
        "tilt": () if scan.tilt is None else (scan.tilt,),
    }


def _pack_ranges(scan: LaserScan) -> bytes:
    return _PackedRanges(ranges=scan.ranges.tobytes()).SerializeToString()


def _read_scan(proto: Any) -> LaserScan:
    return LaserScan(
        **_own_header(proto),
        **{name: getattr(proto, name) for name in _SCAN},
        ranges=_array(proto.ranges),
        codes=np.frombuffer(proto.codes, np.uint8),
        tilt=proto.tilt[0] if proto.tilt else None,
    )


def _write_image(image: CompressedImage) -> dict[str, Any]:
    return {**_header(image), "data": image.data, "format": image.format, "sequence": image.sequence}


def _read_image(proto: Any) -> CompressedImage:
    return CompressedImage(**_own_header(proto), data=proto.data, format=proto.format, sequence=proto.sequence)


def _write_odometry(odometry: Odometry) -> dict[str, Any]:
    pose, twist = odometry.pose, odometry.twist
    return {
        **_header(odometry),
        "pose": _planar_pose(pose.x, pose.y, pose.yaw),
        "child": odometry.child,
        "pose2d": (pose.x, pose.y, pose.yaw),
        "twist2d": (twist.vx, twist.vy, twist.wz),
        "pose_covariance": odometry.pose_covariance.tolist(),
        "twist_covariance": odometry.twist_covariance.tolist(),
        "age": odometry.age,
        "sources": odometry.sources,
    }


def _read_odometry(proto: Any) -> Odometry:
    vx, vy, wz = _three(proto.twist2d)
    return Odometry(
        **_own_header(proto),
        child=proto.child,
        pose=_pose2d(proto.pose2d, proto.pose),
        twist=Twist2D(vx=vx, vy=vy, wz=wz),
        pose_covariance=_array(proto.pose_covariance),
        twist_covariance=_array(proto.twist_covariance),
        age=proto.age,
        sources=tuple(proto.sources),
    )


def _write_path(path: Path) -> dict[str, Any]:
    if len(path.poses) % 3:
        msg = f"path of {len(path.poses)} numbers: expected (x, y, yaw) of each pose"
        raise InputError(msg)
    return {
        **_header(path),
        "poses": [_planar_pose(*pose) for pose in path.poses.reshape(-1, 3).tolist()],
        "poses2d": path.poses.tolist(),
        "directions": path.directions.tolist(),
        "steering": path.steering,
        "closed": path.closed,
        "name": path.name,
    }


def _read_path(proto: Any) -> Path:
    poses = proto.poses2d or [value for pose in proto.poses for value in _planar(pose)]
    return Path(
        **_own_header(proto),
        poses=_array(poses),
        directions=_array(proto.directions),
        steering=tuple(proto.steering),
        closed=proto.closed,
        name=proto.name,
    )


_OCCUPANCY: Final = {"name": "occupancy", "offset": 0, "type": "INT8"}
"""Description of a grid's one byte per cell."""


def _write_grid(grid: Grid) -> dict[str, Any]:
    if grid.cells.size != grid.width * grid.height:
        msg = f"grid of {grid.width} x {grid.height} has {grid.cells.size} cells"
        raise InputError(msg)
    origin = (grid.origin.x, grid.origin.y, grid.origin.yaw)
    return {
        **_header(grid),
        "pose": _planar_pose(*origin),
        "column_count": grid.width,
        "cell_size": {"x": grid.resolution, "y": grid.resolution},
        "row_stride": grid.width,
        "cell_stride": 1,
        "fields": (_OCCUPANCY,),
        "data": grid.cells.tobytes(),
        "origin2d": origin,
    }


def _read_grid(proto: Any) -> Grid:
    width, data = proto.column_count, proto.data
    if proto.cell_stride != 1 or proto.row_stride != width or width == 0 or len(data) % width:
        msg = f"grid of {len(data)} bytes, {width} columns: expected whole rows of one int8 per cell"
        raise InputError(msg)
    return Grid(
        **_own_header(proto),
        resolution=proto.cell_size.x,
        width=width,
        height=len(data) // width,
        origin=_pose2d(proto.origin2d, proto.pose),
        cells=np.frombuffer(data, np.int8),
    )


def _write_transforms(tree: Transforms) -> dict[str, Any]:
    return {
        **_counters(tree),
        "stamp": tree.stamp,
        "frame": tree.frame,
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
    }


def _read_transforms(proto: Any) -> Transforms:
    return Transforms(
        stamp=proto.stamp,
        received=proto.received,
        seq=proto.seq,
        frame=proto.frame,
        transforms=tuple(map(_read_transform, proto.transforms)),
    )


def _read_transform(proto: Any) -> Transform:
    t, q = proto.translation, proto.rotation
    return Transform(
        parent=proto.parent_frame_id,
        child=proto.child_frame_id,
        stamp=_nanoseconds(proto.timestamp),
        translation=(t.x, t.y, t.z),
        rotation=(q.x, q.y, q.z, q.w),
    )


_LEVELS: Final = dict(enumerate(LogLevel, start=1))
"""Levels by their numbers of ``foxglove.Log.Level``; 0 is unknown."""
_LEVEL_NUMBERS: Final = {level: number for number, level in _LEVELS.items()}


def _write_log(record: LogRecord) -> dict[str, Any]:
    return {
        **_counters(record),
        "timestamp": _timestamp(record.stamp),
        "frame": record.frame,
        "level": _LEVEL_NUMBERS[record.level],
        "message": record.text,
        "name": record.name,
        "file": record.file,
        "line": record.line,
    }


def _read_log(proto: Any) -> LogRecord:
    return LogRecord(
        stamp=_nanoseconds(proto.timestamp),
        received=proto.received,
        seq=proto.seq,
        frame=proto.frame,
        level=_LEVELS.get(proto.level, LogLevel.INFO),
        text=proto.message,
        name=proto.name,
        file=proto.file,
        line=proto.line,
    )


@dataclass(frozen=True, slots=True)
class _Binding:
    """How one of our models travels as a well-known message."""

    proto: type[Any]
    write: Callable[[Any], dict[str, Any]]
    """Model to the protobuf message's fields; raises ``InputError``."""
    read: Callable[[Any], Message]
    """Protobuf message to model; raises ``InputError`` or ``pydantic.ValidationError``."""
    pack: Callable[[Any], bytes] | None = None
    """Serialized field that ``write`` leaves out; protobuf merges messages that follow each other."""


def _binding(name: str, *functions: Callable[[Any], Any]) -> _Binding:
    return _Binding(_message_class(f"foxglove.{name}"), *functions)


_BINDINGS: Final[dict[type[Message], _Binding]] = {
    LaserScan: _binding("LaserScan", _write_scan, _read_scan, _pack_ranges),
    CompressedImage: _binding("CompressedImage", _write_image, _read_image),
    Odometry: _binding("PoseInFrame", _write_odometry, _read_odometry),
    Path: _binding("PosesInFrame", _write_path, _read_path),
    Grid: _binding("Grid", _write_grid, _read_grid),
    Transforms: _binding("FrameTransforms", _write_transforms, _read_transforms),
    LogRecord: _binding("Log", _write_log, _read_log),
}


def encode(message: Message) -> bytes:
    """Serialize ``message``.

    Raises:
        InputError: it contradicts itself.
    """
    binding = _BINDINGS[type(message)]
    data: bytes = binding.proto(**binding.write(message)).SerializeToString()
    return data if binding.pack is None else data + binding.pack(message)


def decode(model: type[Message], data: bytes) -> Message:
    """Parse and validate the bytes of one message.

    Raises:
        InputError: truncated or invalid bytes.
        pydantic.ValidationError: values out of the model's range.
    """
    binding = _BINDINGS[model]
    try:
        proto = binding.proto.FromString(data)
    except DecodeError as error:
        raise InputError(str(error)) from None
    return binding.read(proto)
