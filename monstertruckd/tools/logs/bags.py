"""Scans, odometry and frames from bags and MCAP files of other programs: ROS and Foxglove messages."""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from mcap.records import McapRecord

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.outside import reading
from monstertruckd.recorder.reader import joined

METADATA: Final = "metadata.yaml"
"""File that identifies a folder as a ROS 2 bag."""
SCANS: Final = "foxglove.LaserScan or sensor_msgs/LaserScan"
"""Messages that are read as scans."""


@dataclass(frozen=True, slots=True)
class MessageTimes:
    """Times of one message (ns)."""

    stamp: int
    """Stamp in its header."""
    logged: int
    """Time of recording."""


@dataclass(frozen=True, slots=True)
class BagScan:
    """One scan as in its message."""

    times: MessageTimes
    frame: str
    pose: Array
    """Origin of the beams in ``frame``, shape (4, 4)."""
    start_angle: float
    angle_increment: float
    time_increment: float
    ranges: Array
    """Shape (n,) (m)."""
    limits: tuple[float, float] | None
    """Minimum and maximum range (m); None if not in the message."""


@dataclass(frozen=True, slots=True)
class BagPose:
    """Pose of frame ``child`` in ``parent``: odometry, or a transform."""

    times: MessageTimes
    parent: str
    child: str
    pose: Array
    """Shape (4, 4)."""


@dataclass(slots=True)
class BagContent:
    """Content of a bag for mapping, by topic."""

    scans: dict[str, list[BagScan]] = field(default_factory=dict)
    odometry: dict[str, list[BagPose]] = field(default_factory=dict)
    transforms: list[BagPose] = field(default_factory=list)
    others: dict[str, str] = field(default_factory=dict)
    """Schemas of the topics that are not read."""

    @property
    def topics(self) -> list[str]:
        """Names of all topics except transforms."""
        return sorted({*self.scans, *self.odometry, *self.others})


@dataclass(frozen=True, slots=True)
class RawMessage:
    """Encoded message."""

    topic: str
    schema: str
    encoding: str
    """``ros1``, ``cdr``, ``protobuf`` or ``json``."""
    logged: int
    data: bytes
    definition: bytes = b""
    """Text of the schema, if the log contains one."""


def homogeneous(translation: Any, rotation: Any) -> Array:
    """Return the matrix (4, 4) of a translation and a quaternion, each with components x, y, z (and w).

    Raises:
        ValueError: the quaternion is zero, or a component is not finite.
    """
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not (length > 0 and math.isfinite(length + translation.x + translation.y + translation.z)):
        raise ValueError(f"rotation {x:g} {y:g} {z:g} {w:g}: expected a unit quaternion, and a finite translation")
    x, y, z, w = x / length, y / length, z / length, w / length
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), translation.x),
            (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), translation.y),
            (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), translation.z),
            (0.0, 0.0, 0.0, 1.0),
        )
    )


def mcap_messages(records: Iterator[McapRecord]) -> Iterator[RawMessage]:
    """Yield the messages among MCAP records."""
    for record, channel, schema in joined(records):
        name, definition = ("", b"") if schema is None else (schema.name, schema.data)
        yield RawMessage(channel.topic, name, channel.message_encoding, record.log_time, record.data, definition)


def content_of(path: Path, messages: Iterator[RawMessage]) -> BagContent:
    """Decode scans, odometry and transforms.

    Args:
        path: path of the log, for error messages.
        messages: messages of the log, in any order.

    Raises:
        InputError: one of these messages is damaged; the text names the topic.
    """
    content = BagContent()
    for raw in messages:
        schema = raw.schema if "/msg/" in raw.schema else raw.schema.replace("/", "/msg/")
        read = READERS.get(schema)
        if read is None or raw.encoding not in _PARSERS:
            known = f"{raw.schema or 'no schema'} ({raw.encoding or 'no encoding'})"
            content.others.setdefault(raw.topic, known)
            continue
        with reading(f"{path}: {raw.topic}", schema):
            read(content, raw, _PARSERS[raw.encoding](schema, raw.data))
    return content


def _protobuf(schema: str, data: bytes) -> Any:
    name = schema.removeprefix("foxglove.")
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name).FromString(data)


def _json(_: str, data: bytes) -> Any:
    return json.loads(data, object_hook=lambda values: SimpleNamespace(**values))


def _ros(encoding: str) -> Callable[[str, bytes], Any]:
    def parse(schema: str, data: bytes) -> Any:
        ros1, ros2 = _ros_types()
        if encoding == "ros1":
            return ros1.deserialize_ros1(data, "tf2_msgs/msg/TFMessage" if schema == "tf/msg/tfMessage" else schema)
        return ros2.deserialize_cdr(data, schema)

    return parse


@cache
def _ros_types() -> tuple[Any, Any]:
    """Return the type stores of ROS 1 and 2, whose layouts are the same in all versions: a bag's own are not needed."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415 - comes with an extra

    ros1 = get_typestore(Stores.ROS1_NOETIC)
    ros1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return ros1, get_typestore(Stores.ROS2_JAZZY)


_PARSERS: Final[dict[str, Callable[[str, bytes], Any]]] = {
    "cdr": _ros("cdr"),
    "ros1": _ros("ros1"),
    "protobuf": _protobuf,
    "json": _json,
}


def _ros_time(stamp: Any) -> int:
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def _foxglove_time(stamp: Any) -> int:
    """Return the time of a protobuf timestamp or of its JSON form (ns)."""
    if hasattr(stamp, "seconds"):
        return int(stamp.seconds) * SECOND + int(stamp.nanos)
    return int(stamp.sec) * SECOND + int(stamp.nsec)


def _frame(name: str) -> str:
    """Return a frame name without the leading slash that early tf used."""
    return name.removeprefix("/")


def _ros_scan(content: BagContent, raw: RawMessage, message: Any) -> None:
    scan = BagScan(
        MessageTimes(_ros_time(message.header.stamp), raw.logged),
        _frame(message.header.frame_id),
        np.eye(4),
        float(message.angle_min),
        float(message.angle_increment),
        float(message.time_increment),
        np.asarray(message.ranges, np.float64),
        (float(message.range_min), float(message.range_max)),
    )
    content.scans.setdefault(raw.topic, []).append(_checked(scan))


def _foxglove_scan(content: BagContent, raw: RawMessage, message: Any) -> None:
    ranges = np.array(message.ranges, np.float64)
    scan = BagScan(
        MessageTimes(_foxglove_time(message.timestamp), raw.logged),
        _frame(message.frame_id),
        homogeneous(message.pose.position, message.pose.orientation),
        float(message.start_angle),
        (float(message.end_angle) - float(message.start_angle)) / max(len(ranges) - 1, 1),
        0.0,
        ranges,
        None,
    )
    content.scans.setdefault(raw.topic, []).append(_checked(scan))


def _checked(scan: BagScan) -> BagScan:
    """Return the scan after a check.

    Raises:
        ValueError: its angles, times or limits are not numbers, or all its beams have the same angle.
    """
    numbers = scan.start_angle, scan.angle_increment, scan.time_increment, *(scan.limits or ())[:1]
    if not all(map(math.isfinite, numbers)) or scan.angle_increment == 0:
        raise ValueError(f"first beam at {scan.start_angle:g} rad, {scan.angle_increment:g} rad between beams")
    return scan


def _ros_odometry(content: BagContent, raw: RawMessage, message: Any) -> None:
    header, pose = message.header, message.pose.pose
    times = MessageTimes(_ros_time(header.stamp), raw.logged)
    at = BagPose(
        times, _frame(header.frame_id), _frame(message.child_frame_id), homogeneous(pose.position, pose.orientation)
    )
    content.odometry.setdefault(raw.topic, []).append(at)


def _foxglove_odometry(content: BagContent, raw: RawMessage, message: Any) -> None:
    times, pose = MessageTimes(_foxglove_time(message.timestamp), raw.logged), message.pose
    at = BagPose(
        times, _frame(message.frame_id), _frame(message.body_frame_id), homogeneous(pose.position, pose.orientation)
    )
    content.odometry.setdefault(raw.topic, []).append(at)


def _ros_transforms(content: BagContent, raw: RawMessage, message: Any) -> None:
    for one in message.transforms:
        matrix = homogeneous(one.transform.translation, one.transform.rotation)
        times = MessageTimes(_ros_time(one.header.stamp), raw.logged)
        content.transforms.append(BagPose(times, _frame(one.header.frame_id), _frame(one.child_frame_id), matrix))


def _foxglove_transform(content: BagContent, raw: RawMessage, message: Any) -> None:
    times = MessageTimes(_foxglove_time(message.timestamp), raw.logged)
    matrix = homogeneous(message.translation, message.rotation)
    content.transforms.append(BagPose(times, _frame(message.parent_frame_id), _frame(message.child_frame_id), matrix))


def _foxglove_transforms(content: BagContent, raw: RawMessage, message: Any) -> None:
    for one in message.transforms:
        _foxglove_transform(content, raw, one)


READERS: Final[dict[str, Callable[[BagContent, RawMessage, Any], None]]] = {
    "sensor_msgs/msg/LaserScan": _ros_scan,
    "nav_msgs/msg/Odometry": _ros_odometry,
    "tf2_msgs/msg/TFMessage": _ros_transforms,
    "tf/msg/tfMessage": _ros_transforms,
    "foxglove.LaserScan": _foxglove_scan,
    "foxglove.Odometry": _foxglove_odometry,
    "foxglove.FrameTransform": _foxglove_transform,
    "foxglove.FrameTransforms": _foxglove_transforms,
}
"""Handlers of messages by schema."""
