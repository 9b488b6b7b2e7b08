"""Our messages as the well-known ``foxglove.*`` protobuf messages, so that stock viewers draw them."""

import math
from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.wire.layouts import (
    COMPRESSED_IMAGE,
    FRAME_TRANSFORM,
    FRAME_TRANSFORMS,
    GRID,
    LASER_SCAN,
    LOG,
    OCCUPANCY,
    POSE,
    POSE_IN_FRAME,
    POSES_IN_FRAME,
    QUATERNION,
    VECTOR2,
    VECTOR3,
    planar_pose,
)
from monstertruck_runtime.wire.poses import encode_odometry, encode_transform
from monstertruck_runtime.wire.protobuf import Layout
from monstertruck_runtime.wire.scan import decode_scan, encode_scan
from monstertruck_schemas.base import Message, Pose2D, Twist2D
from monstertruck_schemas.event import LogLevel, LogRecord
from monstertruck_schemas.plan import Path
from monstertruck_schemas.sensor import CompressedImage, LaserScan
from monstertruck_schemas.state import Grid, Odometry, Transform, Transforms


def _header(message: Message) -> dict[str, Any]:
    return {"stamp": message.stamp, "frame": message.frame, "received": message.received, "seq": message.seq}


def _own_header(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: values[key] for key in ("stamp", "frame", "received", "seq")}


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
        "fields": [OCCUPANCY],
        "data": grid.cells.tobytes(),
        "origin2d": array("d", (origin.x, origin.y, origin.yaw)),
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
    return _header(tree) | {"transforms": [encode_transform(transform) for transform in tree.transforms]}


def _transforms_model(values: dict[str, Any]) -> Transforms:
    return Transforms.model_validate(values | {"transforms": tuple(map(_transform, values["transforms"]))})


def _transform(raw: bytes) -> Transform:
    values = FRAME_TRANSFORM.decode(raw)
    values["translation"] = tuple(VECTOR3.decode(values["translation"]).values())
    values["rotation"] = tuple(QUATERNION.decode(values["rotation"]).values())
    return Transform.model_validate(values)


_LEVELS: Final = dict(enumerate(LogLevel, start=1))
"""Numbers of ``foxglove.Log.Level``; 0 is unknown."""
_LEVEL_NUMBERS: Final = {level: number for number, level in _LEVELS.items()}


def _log_values(record: LogRecord) -> dict[str, Any]:
    return vars(record) | {"level": _LEVEL_NUMBERS[record.level]}


def _log_model(values: dict[str, Any]) -> LogRecord:
    return LogRecord.model_validate(values | {"level": _LEVELS.get(values["level"], LogLevel.INFO)})


@dataclass(frozen=True, slots=True)
class Binding:
    """How one of our models travels as a well-known message."""

    layout: Layout
    encode: Callable[[Any], bytes]
    """Model to bytes; raises ``InputError``."""
    decode: Callable[[bytes], Message]
    """Bytes to model; raises ``InputError`` or ``pydantic.ValidationError``."""


def _by_values(
    layout: Layout, values: Callable[[Any], Mapping[str, Any]], model: Callable[[dict[str, Any]], Message]
) -> Binding:
    """Binding by way of the layout's mappings."""
    return Binding(layout, lambda message: layout.encode(values(message)), lambda data: model(layout.decode(data)))


BINDINGS: Final[Mapping[type[Message], Binding]] = {
    LaserScan: Binding(LASER_SCAN, encode_scan, decode_scan),
    CompressedImage: _by_values(COMPRESSED_IMAGE, vars, CompressedImage.model_validate),
    Odometry: Binding(POSE_IN_FRAME, encode_odometry, lambda data: _odometry_model(POSE_IN_FRAME.decode(data))),
    Path: _by_values(POSES_IN_FRAME, _path_values, _path_model),
    Grid: _by_values(GRID, _grid_values, _grid_model),
    Transforms: _by_values(FRAME_TRANSFORMS, _transforms_values, _transforms_model),
    LogRecord: _by_values(LOG, _log_values, _log_model),
}
