"""Conversion of our messages to ``foxglove.*`` protobuf messages, which standard viewers display.

The fields of ``foxglove_fields.proto`` extend Foxglove's published descriptors, in a separate descriptor pool, because
the default pool contains the published ones under the same names. Bytes of version 0.1.0, which also writes zero
fields, and of any other protobuf writer can be read, too.
"""

import itertools
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, Final, TypeVar

import numpy as np
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.unknown_fields import UnknownFieldSet
from numpy.typing import NDArray

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.wire import foxglove_fields_pb2
from monstertruck_schemas.base import Message, Pose2D, Twist2D
from monstertruck_schemas.event import LogLevel, LogRecord
from monstertruck_schemas.plan import Path
from monstertruck_schemas.sensor import CompressedImage, LaserScan
from monstertruck_schemas.state import Grid, Ground, Odometry, Transform, Transforms

M = TypeVar("M", bound=Message)


def _files(file: FileDescriptor) -> dict[str, FileDescriptorProto]:
    """``file`` and its imports by name, imports first."""
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


def _message_class(name: str, *, packed: bool) -> type[Any]:
    """Class of ``name``; ``packed``: with each ``repeated double`` replaced by ``bytes``, its packed form."""
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set(name)).file:
        for field in itertools.chain.from_iterable(message.field for message in file.message_type if packed):
            if (field.type, field.label) == (field.TYPE_DOUBLE, field.LABEL_REPEATED):
                field.type, field.label = field.TYPE_BYTES, field.LABEL_OPTIONAL
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(name))


def _write_header(message: Message, proto: Any) -> None:
    proto.timestamp.seconds, proto.timestamp.nanos = divmod(message.stamp, SECOND)
    proto.frame_id = message.frame
    proto.received = message.received
    proto.seq = message.seq


def _own_header(proto: Any) -> dict[str, Any]:
    return {
        "stamp": proto.timestamp.seconds * SECOND + proto.timestamp.nanos,
        "received": proto.received,
        "seq": proto.seq,
        "frame": proto.frame_id,
    }


def _write_planar(pose: Any, x: float, y: float, yaw: float) -> None:
    """Fill a ``foxglove.Pose`` in the plane."""
    pose.position.x, pose.position.y = x, y
    pose.orientation.z, pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)


def _planar(pose: Any) -> tuple[float, float, float]:
    """(x, y, yaw) of a ``foxglove.Pose``."""
    q = pose.orientation
    yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    return pose.position.x, pose.position.y, yaw


_Numbers = Sequence[float] | bytes
"""A field of type ``repeated double``, or its packed bytes."""
_Fields = dict[str, Any]
"""Values of one of our models by name, not yet validated."""


_DOUBLES: Final = {count: struct.Struct(f"<{count}d") for count in (1, 3)}
"""Format of this many packed numbers."""


def _bytes(numbers: _Numbers) -> bytes:
    return numbers if isinstance(numbers, bytes) else np.array(numbers, np.float64).tobytes()


def _array(numbers: _Numbers) -> NDArray[np.float64]:
    """Read-only array of a repeated field."""
    data = _bytes(numbers)
    if len(data) % 8:
        msg = f"packed numbers of {len(data)} bytes: expected 8 for each"
        raise InputError(msg)
    return np.frombuffer(data, np.float64)


def _packed(*numbers: float) -> bytes:
    return _DOUBLES[len(numbers)].pack(*numbers)


def _unpacked(numbers: _Numbers, count: int) -> tuple[float, ...]:
    """Return the numbers after checking their count."""
    data = _bytes(numbers)
    try:
        return _DOUBLES[count].unpack(data)
    except struct.error:
        msg = f"expected {count} numbers, got {len(data) / 8:g}"
        raise InputError(msg) from None


def _pose2d(exact: _Numbers, pose: Any) -> Pose2D:
    """Return our exact (x, y, yaw) if the writer included it, otherwise the standard pose."""
    x, y, yaw = _unpacked(exact, 3) if exact else _planar(pose)
    return Pose2D(x=x, y=y, yaw=yaw)


def _write_scan(scan: LaserScan, proto: Any) -> None:
    _write_header(scan, proto)
    proto.pose.orientation.w = 1.0
    proto.start_angle = scan.start_angle
    proto.end_angle = scan.end_angle
    proto.time_increment = scan.time_increment
    proto.scan_time = scan.scan_time
    proto.range_min = scan.range_min
    proto.range_max = scan.range_max
    proto.ranges = scan.ranges.tobytes()
    proto.codes = scan.codes.tobytes()
    if scan.intensities is not None:
        proto.intensities = scan.intensities.astype(np.float64).tobytes()
    if scan.tilt is not None:
        proto.tilt = _packed(scan.tilt)
    if scan.range_noise is not None:
        proto.range_noise = _packed(scan.range_noise)


def _read_scan(proto: Any) -> _Fields:
    return {
        **_own_header(proto),
        "start_angle": proto.start_angle,
        "end_angle": proto.end_angle,
        "time_increment": proto.time_increment,
        "scan_time": proto.scan_time,
        "range_min": proto.range_min,
        "range_max": proto.range_max,
        "ranges": _array(proto.ranges),
        "codes": np.frombuffer(proto.codes, np.uint8),
        "intensities": _array(proto.intensities).astype(np.uint8) if proto.intensities else None,
        "tilt": _unpacked(proto.tilt, 1)[0] if proto.tilt else None,
        "range_noise": _unpacked(proto.range_noise, 1)[0] if proto.range_noise else None,
    }


def _write_image(image: CompressedImage, proto: Any) -> None:
    _write_header(image, proto)
    proto.data = image.data
    proto.format = image.format
    proto.sequence = image.sequence


def _read_image(proto: Any) -> _Fields:
    return {**_own_header(proto), "data": proto.data, "format": proto.format, "sequence": proto.sequence}


def _write_odometry(odometry: Odometry, proto: Any) -> None:
    pose, twist = odometry.pose, odometry.twist
    _write_header(odometry, proto)
    _write_planar(proto.pose, pose.x, pose.y, pose.yaw)
    proto.child = odometry.child
    proto.pose2d = _packed(pose.x, pose.y, pose.yaw)
    proto.twist2d = _packed(twist.vx, twist.vy, twist.wz)
    proto.pose_covariance = odometry.pose_covariance.tobytes()
    proto.twist_covariance = odometry.twist_covariance.tobytes()
    proto.age = odometry.age
    proto.sources.extend(odometry.sources)
    proto.degraded = odometry.degraded


def _read_odometry(proto: Any) -> _Fields:
    vx, vy, wz = _unpacked(proto.twist2d, 3)
    return {
        **_own_header(proto),
        "child": proto.child,
        "pose": _pose2d(proto.pose2d, proto.pose),
        "twist": Twist2D(vx=vx, vy=vy, wz=wz),
        "pose_covariance": _array(proto.pose_covariance),
        "twist_covariance": _array(proto.twist_covariance),
        "age": proto.age,
        "sources": tuple(proto.sources),
        "degraded": proto.degraded,
    }


def _write_path(path: Path, proto: Any) -> None:
    if len(path.poses) % 3:
        msg = f"path of {len(path.poses)} numbers: expected (x, y, yaw) of each pose"
        raise InputError(msg)
    _write_header(path, proto)
    for x, y, yaw in path.poses.reshape(-1, 3).tolist():
        _write_planar(proto.poses.add(), x, y, yaw)
    proto.poses2d = path.poses.tobytes()
    proto.directions = path.directions.tobytes()
    proto.steering.extend(path.steering)
    proto.clearance = path.clearance.tobytes()
    proto.speeds = path.speeds.tobytes()
    proto.closed = path.closed
    proto.halts = path.halts
    proto.name = path.name


def _read_path(proto: Any) -> _Fields:
    poses = proto.poses2d or [value for pose in proto.poses for value in _planar(pose)]
    return {
        **_own_header(proto),
        "poses": _array(poses),
        "directions": _array(proto.directions),
        "steering": tuple(proto.steering),
        "clearance": _array(proto.clearance),
        "speeds": _array(proto.speeds),
        "closed": proto.closed,
        "halts": proto.halts,
        "name": proto.name,
    }


def _write_grid(grid: Grid, proto: Any) -> None:
    if grid.cells.size != grid.width * grid.height:
        msg = f"grid of {grid.width} x {grid.height} has {grid.cells.size} cells"
        raise InputError(msg)
    _write_header(grid, proto)
    origin = grid.origin.x, grid.origin.y, grid.origin.yaw
    _write_planar(proto.pose, *origin)
    proto.origin2d = _packed(*origin)
    proto.column_count = proto.row_stride = grid.width
    proto.cell_stride = 1
    proto.cell_size.x = proto.cell_size.y = grid.resolution
    proto.fields.add(name="occupancy", offset=0, type="INT8")
    proto.data = grid.cells.tobytes()


def _read_grid(proto: Any) -> _Fields:
    width, data = proto.column_count, proto.data
    if proto.cell_stride != 1 or proto.row_stride != width or width == 0 or len(data) % width:
        msg = f"grid of {len(data)} bytes, {width} columns: expected whole rows of one int8 per cell"
        raise InputError(msg)
    return {
        **_own_header(proto),
        "resolution": proto.cell_size.x,
        "width": width,
        "height": len(data) // width,
        "origin": _pose2d(proto.origin2d, proto.pose),
        "cells": np.frombuffer(data, np.int8),
    }


_GROUND: Final = ("tilt", "roughness")
"""Layers of a ``Ground``: one byte each per cell."""


def _write_ground(ground: Ground, proto: Any) -> None:
    layers = [getattr(ground, name) for name in _GROUND]
    if any(layer.size != ground.width * ground.height for layer in layers):
        msg = f"ground of {ground.width} x {ground.height} has {[layer.size for layer in layers]} cells"
        raise InputError(msg)
    _write_header(ground, proto)
    origin = ground.origin.x, ground.origin.y, ground.origin.yaw
    _write_planar(proto.pose, *origin)
    proto.origin2d = _packed(*origin)
    proto.column_count = ground.width
    proto.row_stride = ground.width * len(_GROUND)
    proto.cell_stride = len(_GROUND)
    proto.cell_size.x = proto.cell_size.y = ground.resolution
    for offset, name in enumerate(_GROUND):
        proto.fields.add(name=name, offset=offset, type="UINT8")
    proto.data = np.column_stack(layers).tobytes()


def _read_ground(proto: Any) -> _Fields:
    width, data, stride = proto.column_count, proto.data, len(_GROUND)
    if proto.cell_stride != stride or proto.row_stride != stride * width or width == 0 or len(data) % (stride * width):
        msg = f"ground of {len(data)} bytes, {width} columns: expected whole rows of {stride} bytes per cell"
        raise InputError(msg)
    layers = np.frombuffer(data, np.uint8).reshape(-1, stride)
    return {
        **_own_header(proto),
        "resolution": proto.cell_size.x,
        "width": width,
        "height": len(layers) // width,
        "origin": _pose2d(proto.origin2d, proto.pose),
        "tilt": layers[:, 0].copy(),
        "roughness": layers[:, 1].copy(),
    }


def _write_transforms(tree: Transforms, proto: Any) -> None:
    proto.received = tree.received
    proto.seq = tree.seq
    proto.stamp = tree.stamp
    proto.frame = tree.frame
    for transform in tree.transforms:
        _write_transform(transform, proto.transforms.add())


def _write_transform(transform: Transform, proto: Any) -> None:
    proto.timestamp.seconds, proto.timestamp.nanos = divmod(transform.stamp, SECOND)
    proto.parent_frame_id = transform.parent
    proto.child_frame_id = transform.child
    t, q = proto.translation, proto.rotation
    t.x, t.y, t.z = transform.translation
    q.x, q.y, q.z, q.w = transform.rotation


def _read_transforms(proto: Any) -> _Fields:
    return {
        "stamp": proto.stamp,
        "received": proto.received,
        "seq": proto.seq,
        "frame": proto.frame,
        "transforms": tuple(map(_read_transform, proto.transforms)),
    }


def _read_transform(proto: Any) -> Transform:
    t, q = proto.translation, proto.rotation
    return Transform(
        parent=proto.parent_frame_id,
        child=proto.child_frame_id,
        stamp=proto.timestamp.seconds * SECOND + proto.timestamp.nanos,
        translation=(t.x, t.y, t.z),
        rotation=(q.x, q.y, q.z, q.w),
    )


_LEVELS: Final = dict(enumerate(LogLevel, start=1))
"""Levels by their numbers of ``foxglove.Log.Level``; 0 is unknown."""
_LEVEL_NUMBERS: Final = {level: number for number, level in _LEVELS.items()}


def _write_log(record: LogRecord, proto: Any) -> None:
    proto.received = record.received
    proto.seq = record.seq
    proto.timestamp.seconds, proto.timestamp.nanos = divmod(record.stamp, SECOND)
    proto.frame = record.frame
    proto.level = _LEVEL_NUMBERS[record.level]
    proto.message = record.text
    proto.name = record.name
    proto.file = record.file
    proto.line = record.line


def _read_log(proto: Any) -> _Fields:
    return {
        "stamp": proto.timestamp.seconds * SECOND + proto.timestamp.nanos,
        "received": proto.received,
        "seq": proto.seq,
        "frame": proto.frame,
        "level": _LEVELS.get(proto.level, LogLevel.INFO),
        "text": proto.message,
        "name": proto.name,
        "file": proto.file,
        "line": proto.line,
    }


@dataclass(frozen=True, slots=True)
class _Binding:
    """Mapping of one of our models to a well-known message."""

    proto: type[Any]
    packed: type[Any]
    """The same message with packed numbers, see ``_message_class``."""
    write: Callable[[Any, Any], None]
    """Fills the packed message from the model; raises ``InputError``."""
    read: Callable[[Any], _Fields]
    """Converts a message, packed or not, to the model's fields; raises ``InputError`` or
    ``pydantic.ValidationError``.
    """


def _binding(name: str, write: Callable[[Any, Any], None], read: Callable[[Any], _Fields]) -> _Binding:
    proto, packed = (_message_class(f"foxglove.{name}", packed=packed) for packed in (False, True))
    return _Binding(proto, packed, write, read)


_BINDINGS: Final[dict[type[Message], _Binding]] = {
    LaserScan: _binding("LaserScan", _write_scan, _read_scan),
    CompressedImage: _binding("CompressedImage", _write_image, _read_image),
    Odometry: _binding("PoseInFrame", _write_odometry, _read_odometry),
    Path: _binding("PosesInFrame", _write_path, _read_path),
    Grid: _binding("Grid", _write_grid, _read_grid),
    Ground: _binding("Grid", _write_ground, _read_ground),
    Transforms: _binding("FrameTransforms", _write_transforms, _read_transforms),
    LogRecord: _binding("Log", _write_log, _read_log),
}


def encode(message: Message) -> bytes:
    """Serialize ``message``.

    Raises:
        InputError: the message is inconsistent.
    """
    binding = _BINDINGS[type(message)]
    proto = binding.packed()
    binding.write(message, proto)
    data: bytes = proto.SerializeToString()
    return data


def decode(model: type[M], data: bytes) -> M:
    """Parse and validate the bytes of one message.

    Raises:
        InputError: truncated or invalid bytes.
        pydantic.ValidationError: values out of the model's range.
    """
    binding = _BINDINGS[model]
    try:
        proto = binding.packed.FromString(data)
        # Numbers that are not packed are unknown fields here; no writer of our fields splits them.
        if not proto.received or len(UnknownFieldSet(proto)):
            proto = binding.proto.FromString(data)
    except DecodeError as error:
        raise InputError(str(error)) from None
    return model.model_validate(binding.read(proto))
