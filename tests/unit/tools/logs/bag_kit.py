"""One drive past a wall as bags of ROS 1, ROS 2, and MCAP with messages of Foxglove."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from monstertruck_runtime.clock import SECOND

START = 1_700_000_000 * SECOND
SCANS = 5
BEAMS = 181
RANGES = 2.0 + 0.1 * np.sin(np.arange(BEAMS))
MOUNT = (0.2, 0.05, 0.3)
"""Of the lidar, x, y and yaw in base."""
ROLL = math.pi
"""Turns the lidar upside down."""
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
ROS2 = get_typestore(Stores.ROS2_JAZZY)


def stamp(k: float) -> int:
    return START + round(k * SECOND / 10)


def quaternion(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> tuple[float, float, float, float]:
    """Components x, y, z, w of a turn about x, then y (one of both), then z."""
    tilt = (math.sin(roll / 2), math.sin(pitch / 2), math.cos((roll or pitch) / 2))
    c, s = math.cos(yaw / 2), math.sin(yaw / 2)
    return tilt[0] * c - tilt[1] * s, tilt[0] * s + tilt[1] * c, tilt[2] * s, tilt[2] * c


class RosMessages:
    """Messages of one version of ROS."""

    def __init__(self, store: Any) -> None:
        self.store = store

    def make(self, kind: str, **values: Any) -> Any:
        return self.store.types[kind](**values)

    def header(self, time: int, frame: str) -> Any:
        seconds, rest = divmod(time, SECOND)
        values = {"stamp": self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest), "frame_id": frame}
        return self.make("std_msgs/msg/Header", **values, **({"seq": 0} if self.store is ROS1 else {}))

    def scan(self, time: int, ranges: np.ndarray = RANGES) -> Any:
        return self.make(
            "sensor_msgs/msg/LaserScan", header=self.header(time, "laser"), angle_min=-1.5, angle_max=1.5,
            angle_increment=3.0 / (BEAMS - 1), time_increment=1e-4, scan_time=0.1, range_min=0.1, range_max=10.0,
            ranges=ranges.astype(np.float32), intensities=np.empty(0, np.float32),
        )  # fmt: skip

    def pose(self, x: float, yaw: float) -> Any:
        position = self.make("geometry_msgs/msg/Point", x=x, y=0.0, z=0.0)
        turned = self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternion(yaw=yaw), strict=True)))
        return self.make("geometry_msgs/msg/Pose", position=position, orientation=turned)

    def odometry(self, time: int, x: float, parent: str = "odom") -> Any:
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        return self.make(
            "nav_msgs/msg/Odometry", header=self.header(time, parent), child_frame_id="base_link",
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(x, 0.1), covariance=np.zeros(36)),
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance", covariance=np.zeros(36),
                twist=self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero),
            ),
        )  # fmt: skip

    def transform(self, time: int, parent: str, child: str, at: tuple, rotation: tuple) -> Any:
        return self.make(
            "geometry_msgs/msg/TransformStamped", header=self.header(time, parent), child_frame_id=child,
            transform=self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make("geometry_msgs/msg/Vector3", x=at[0], y=at[1], z=0.1),
                rotation=self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", rotation, strict=True))),
            ),
        )  # fmt: skip

    def transforms(self, *rows: tuple) -> Any:
        made = [self.transform(*row) for row in rows]
        return self.make("tf2_msgs/msg/TFMessage", transforms=made)


Rows = list[tuple[str, int, Any]]
"""Topic, time of recording and message."""


def drive(ros: RosMessages, *, roll: float = 0.0, pitch: float = 0.0) -> Rows:
    """1 m/s ahead, with odometry from before the first scan to after the last one."""
    mount = (START, "base_link", "/laser" if ros.store is ROS1 else "laser", MOUNT[:2])
    rows: Rows = [("/tf_static", START, ros.transforms((*mount, quaternion(roll, pitch, MOUNT[2]))))]
    rows += [("/odom", stamp(k), ros.odometry(stamp(k), 0.1 * k)) for k in range(-1, SCANS + 1)]
    rows += [("/scan", stamp(k), ros.scan(stamp(k))) for k in range(SCANS)]
    return rows


def write_ros1(path: Path, rows: Rows) -> Path:
    with Ros1Writer(path) as bag:
        connections: dict[str, Any] = {}
        for topic, time, message in rows:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=ROS1)
            bag.write(connections[topic], time, ROS1.serialize_ros1(message, kind))
    return path


def write_ros2(path: Path, rows: Rows, storage: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    with Ros2Writer(path, version=8, storage_plugin=storage) as bag:
        connections: dict[str, Any] = {}
        for topic, time, message in rows:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=ROS2)
            bag.write(connections[topic], time, ROS2.serialize_cdr(message, kind))
    return path


def _foxglove_scan(k: int) -> LaserScan:
    scan = LaserScan(frame_id="laser", start_angle=-1.5, end_angle=1.5, ranges=RANGES.tolist())
    scan.timestamp.FromNanoseconds(stamp(k))
    scan.pose.orientation.w = 1.0
    return scan


def _foxglove_transforms(k: int) -> FrameTransforms:
    rows = FrameTransforms()
    for parent, child, (x, y), yaw in (
        ("odom", "base_link", (0.1 * k, 0.0), 0.1),
        ("base_link", "laser", MOUNT[:2], MOUNT[2]),
    ):
        row = rows.transforms.add(parent_frame_id=parent, child_frame_id=child)
        row.timestamp.FromNanoseconds(stamp(k))
        row.translation.x, row.translation.y = x, y
        row.rotation.x, row.rotation.y, row.rotation.z, row.rotation.w = quaternion(yaw=yaw)
    return rows


def write_foxglove(path: Path, topic: str = "/scan") -> Path:
    """Scans and transforms, those of odometry among them, as protobuf."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channels = {
            name: writer.register_channel(
                name, "protobuf", writer.register_schema(f"foxglove.{kind.DESCRIPTOR.name}", "protobuf", b"")
            )
            for name, kind in ((topic, LaserScan), ("/tf", FrameTransforms))
        }
        for k in range(-1, SCANS + 1):
            writer.add_message(channels["/tf"], stamp(k), _foxglove_transforms(k).SerializeToString(), stamp(k))
            if 0 <= k < SCANS:
                writer.add_message(channels[topic], stamp(k), _foxglove_scan(k).SerializeToString(), stamp(k))
        writer.finish()
    return path


def write_json(path: Path) -> Path:
    """Scans as JSON, and a topic of another schema."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        scans = writer.register_channel(
            "/scan", "json", writer.register_schema("foxglove.LaserScan", "jsonschema", b"{}")
        )
        other = writer.register_channel("/other", "json", writer.register_schema("thing", "jsonschema", b"{}"))
        for k in range(SCANS):
            seconds, rest = divmod(stamp(k), SECOND)
            zero = {"x": 0.0, "y": 0.0, "z": 0.0}
            values = {
                "timestamp": {"sec": seconds, "nsec": rest}, "frame_id": "laser", "start_angle": -1.5, "end_angle": 1.5,
                "pose": {"position": zero, "orientation": zero | {"w": 1.0}}, "ranges": [*RANGES[:-1].tolist(), None],
            }  # fmt: skip
            writer.add_message(scans, stamp(k), json.dumps(values).encode(), stamp(k))
            writer.add_message(other, stamp(k), b"{}", stamp(k))
        writer.finish()
    return path
