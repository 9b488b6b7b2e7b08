"""ROS 2 bags: standard messages where ROS has them, JSON text in ``std_msgs/String`` for everything else.

Topics keep their names (``/sensor/scan``), but for transforms (``/tf``) and pictures (``/sensor/camera/compressed``).
Stamps are real time. Frames and units are those of REP 103 and 105 already.
"""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from monstertruck_estimation.transforms import quaternion_from_yaw
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message, Pose2D
from monstertruck_schemas.plan import Path as TruckPath
from monstertruck_schemas.sensor import Battery, CompressedImage, LaserScan
from monstertruck_schemas.state import Grid, Odometry, Transforms
from monstertruck_schemas.topics import BY_NAME, Topic
from monstertruckd.recorder.reader import LogReader, open_log
from monstertruckd.ros2.convert import full_covariance
from monstertruckd.tools.logs.export import removed_on_failure
from monstertruckd.tools.logs.messages import ALL, Progress, Selection, real_offset

_STORE: Final = get_typestore(Stores.ROS2_JAZZY)
_NEVER: Final = QosTime(9_223_372_036, 854_775_807)


def export_ros2(
    path: str | Path | LogReader, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> dict[str, Path]:
    """Write a ROS 2 bag (MCAP storage, CDR).

    Returns:
        The bag by topic of the log; it is not made if no message is selected.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, a message in it is invalid, or ``output`` exists or cannot be written.
    """
    reader = open_log(path)
    offset = real_offset(reader)
    directory = Path(output)
    topics: dict[str, Path] = {}
    try:
        # 8: version of the bag's metadata: the older one that the writer supports
        with (
            removed_on_failure() as made,
            Writer(directory, version=8, storage_plugin=StoragePlugin.MCAP) as bag,
        ):
            made.append(directory)
            connections: dict[str, Any] = {}
            for entry, message in selection.of(reader, progress):
                topic = BY_NAME[entry.topic]
                name, convert = CONVERTERS.get(topic, (f"/{topic.name}", _text))
                ros = convert(message, offset)
                kind = ros.__msgtype__
                if name not in connections:
                    qos = [_qos(topic)]
                    connections[name] = bag.add_connection(name, kind, typestore=_STORE, offered_qos_profiles=qos)
                    topics[entry.topic] = directory
                bag.write(connections[name], max(0, entry.log_time + offset), _STORE.serialize_cdr(ros, kind))
        if not topics:
            shutil.rmtree(directory)
    except WriterError as error:
        raise InputError(f"{directory}: no bag can be made there: {error}") from error
    except OSError as error:
        raise InputError(f"{directory}: cannot be written: {error.strerror}") from error
    return topics


def _qos(topic: Topic[Any]) -> Qos:
    """Retained topics reach late subscribers of a replay too."""
    durability = QosDurability.TRANSIENT_LOCAL if topic.retained else QosDurability.VOLATILE
    liveliness = QosLiveliness.AUTOMATIC
    depth = 1 if topic.retained else 10
    return Qos(
        QosHistory.KEEP_LAST, depth, QosReliability.RELIABLE, durability, _NEVER, _NEVER, liveliness, _NEVER, False
    )


def _ros(kind: str, **values: Any) -> Any:
    """A ROS message, e.g. ``nav_msgs/msg/Odometry``."""
    return _STORE.types[kind](**values)


def _time(stamp: int, offset: int) -> Any:
    seconds, nanoseconds = divmod(max(0, stamp + offset), SECOND)
    return _ros("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def _header(stamp: int, frame: str, offset: int) -> Any:
    return _ros("std_msgs/msg/Header", stamp=_time(stamp, offset), frame_id=frame)


def _vector(x: float = 0.0, y: float = 0.0, z: float = 0.0, kind: str = "Vector3") -> Any:
    return _ros(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def _rotation(x: float, y: float, z: float, w: float) -> Any:
    return _ros("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _pose(pose: Pose2D) -> Any:
    position, rotation = _vector(pose.x, pose.y, kind="Point"), _rotation(*quaternion_from_yaw(pose.yaw))
    return _ros("geometry_msgs/msg/Pose", position=position, orientation=rotation)


def _scan(scan: LaserScan, offset: int) -> Any:
    return _ros(
        "sensor_msgs/msg/LaserScan",
        header=_header(scan.stamp, scan.frame, offset),
        angle_min=scan.start_angle,
        angle_max=scan.end_angle,
        angle_increment=scan.angle_increment,
        time_increment=scan.time_increment,
        scan_time=scan.scan_time,
        range_min=scan.range_min,
        range_max=scan.range_max,
        ranges=scan.ranges.astype(np.float32),
        intensities=np.empty(0, np.float32) if scan.intensities is None else scan.intensities.astype(np.float32),
    )


def _odometry(odometry: Odometry, offset: int) -> Any:
    twist = odometry.twist
    velocity = _ros("geometry_msgs/msg/Twist", linear=_vector(twist.vx, twist.vy), angular=_vector(z=twist.wz))
    covariances = full_covariance(odometry.pose_covariance), full_covariance(odometry.twist_covariance)
    return _ros(
        "nav_msgs/msg/Odometry",
        header=_header(odometry.stamp, odometry.frame, offset),
        child_frame_id=odometry.child,
        pose=_ros("geometry_msgs/msg/PoseWithCovariance", pose=_pose(odometry.pose), covariance=covariances[0]),
        twist=_ros("geometry_msgs/msg/TwistWithCovariance", twist=velocity, covariance=covariances[1]),
    )


def _transforms(tree: Transforms, offset: int) -> Any:
    def stamped(row: Any) -> Any:
        transform = _ros(
            "geometry_msgs/msg/Transform", translation=_vector(*row.translation), rotation=_rotation(*row.rotation)
        )
        header = _header(row.stamp, row.parent, offset)
        return _ros("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=row.child, transform=transform)

    return _ros("tf2_msgs/msg/TFMessage", transforms=[stamped(row) for row in tree.transforms])


def _image(image: CompressedImage, offset: int) -> Any:
    return _ros(
        "sensor_msgs/msg/CompressedImage",
        header=_header(image.stamp, image.frame, offset),
        format=image.format,
        data=np.frombuffer(image.data, np.uint8),
    )


def _grid(grid: Grid, offset: int) -> Any:
    info = _ros(
        "nav_msgs/msg/MapMetaData",
        map_load_time=_time(grid.stamp, offset),
        resolution=grid.resolution,
        width=grid.width,
        height=grid.height,
        origin=_pose(grid.origin),
    )
    return _ros(
        "nav_msgs/msg/OccupancyGrid", header=_header(grid.stamp, grid.frame, offset), info=info, data=grid.cells
    )


def _path(path: TruckPath, offset: int) -> Any:
    header = _header(path.stamp, path.frame, offset)
    poses = [
        _ros("geometry_msgs/msg/PoseStamped", header=header, pose=_pose(Pose2D(x=x, y=y, yaw=yaw)))
        for x, y, yaw in path.poses.reshape(-1, 3).tolist()
    ]
    return _ros("nav_msgs/msg/Path", header=header, poses=poses)


def _battery(battery: Battery, offset: int) -> Any:
    def known(value: float | None) -> float:
        return math.nan if value is None else value

    kind = "sensor_msgs/msg/BatteryState"
    capacity, share = known(battery.capacity_ah), known(battery.charge)
    return _ros(
        kind,
        header=_header(battery.stamp, battery.frame, offset),
        voltage=known(battery.voltage),
        temperature=math.nan,
        current=math.nan,
        charge=capacity * share,
        capacity=math.nan,
        design_capacity=capacity,
        percentage=share,
        power_supply_status=_STORE.types[kind].POWER_SUPPLY_STATUS_DISCHARGING,  # type: ignore[attr-defined]
        power_supply_health=_STORE.types[kind].POWER_SUPPLY_HEALTH_UNKNOWN,  # type: ignore[attr-defined]
        power_supply_technology=_STORE.types[kind].POWER_SUPPLY_TECHNOLOGY_UNKNOWN,  # type: ignore[attr-defined]
        present=True,
        cell_voltage=np.empty(0, np.float32),
        cell_temperature=np.empty(0, np.float32),
        location="",
        serial_number="",
    )


def _text(message: Message, offset: int) -> Any:
    """The message as JSON; its stamps stay daemon time, ``real_offset`` (ns) leads to the calendar."""
    values = message.model_dump(mode="json", exclude_none=True) | {"real_offset": offset}
    return _ros("std_msgs/msg/String", data=json.dumps(values))


Converter = Callable[[Any, int], Any]
"""Converts a message, by the offset (ns) of its times, to the ROS message."""

CONVERTERS: Final[dict[Topic[Any], tuple[str, Converter]]] = {
    t.SCAN: ("/sensor/scan", _scan),
    t.CAMERA: ("/sensor/camera/compressed", _image),
    t.BATTERY: ("/sensor/battery", _battery),
    t.ODOMETRY: ("/state/odometry", _odometry),
    t.POSE: ("/state/pose", _odometry),
    t.TRANSFORMS: ("/tf", _transforms),
    t.MAP: ("/state/map", _grid),
    t.PATH: ("/plan/path", _path),
}
"""ROS topic and conversion of the topics that ROS has a message for."""
