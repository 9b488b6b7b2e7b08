"""ROS 2 bags: standard ROS messages where they exist, otherwise JSON text in ``std_msgs/String``.

Topics keep their names (``/sensor/scan``), except transforms (``/tf``) and pictures (``/sensor/camera/compressed``).
Stamps are real time. Frames and units already follow REP 103 and 105.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message
from monstertruck_schemas.state import Transforms
from monstertruck_schemas.topics import BY_NAME, Topic
from monstertruckd.recorder.reader import LogReader, open_log
from monstertruckd.ros2 import convert
from monstertruckd.ros2.cdr import encode
from monstertruckd.ros2.convert import RosNames, RosValues
from monstertruckd.tools.logs.export import removed_on_failure
from monstertruckd.tools.logs.messages import ALL, Progress, Selection, real_offset

_STORE: Final = get_typestore(Stores.ROS2_JAZZY)
_NEVER: Final = QosTime(9_223_372_036, 854_775_807)


def export_ros2(
    path: str | Path | LogReader, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> dict[str, Path]:
    """Write a ROS 2 bag (MCAP storage, CDR).

    Returns:
        For every exported topic of the log, the path of the bag. No bag is created if no message is selected.

    Raises:
        NotFoundError: no such log.
        InputError: ``path`` is not a log or contains an invalid message, or ``output`` exists or cannot be written.
    """
    reader = open_log(path)
    offset = real_offset(reader)
    names = RosNames(offset)
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
                name, kind, values_of = CONVERTERS.get(topic, (f"/{topic.name}", TEXT, _text))
                if name not in connections:
                    qos = [_qos(topic)]
                    connections[name] = bag.add_connection(name, kind, typestore=_STORE, offered_qos_profiles=qos)
                    topics[entry.topic] = directory
                data = encode(kind, values_of(message, names))
                bag.write(connections[name], max(0, entry.log_time + offset), data)
        if not topics:
            shutil.rmtree(directory)
    except WriterError as error:
        raise InputError(f"{directory}: the bag cannot be created: {error}") from error
    except OSError as error:
        raise InputError(f"{directory}: cannot be written: {error.strerror}") from error
    return topics


def _qos(topic: Topic[Any]) -> Qos:
    """Return the quality of service: late subscribers of a replay receive retained topics as well."""
    durability = QosDurability.TRANSIENT_LOCAL if topic.retained else QosDurability.VOLATILE
    liveliness = QosLiveliness.AUTOMATIC
    depth = 1 if topic.retained else 10
    return Qos(
        QosHistory.KEEP_LAST, depth, QosReliability.RELIABLE, durability, _NEVER, _NEVER, liveliness, _NEVER, False
    )


def _text(message: Message, names: RosNames) -> RosValues:
    """Return the message as JSON; its stamps stay daemon time, with ``real_offset`` (ns) to convert to real time."""
    values = message.model_dump(mode="json", exclude_none=True) | {"real_offset": names.offset}
    return {"data": json.dumps(values)}


def _transforms(tree: Transforms, names: RosNames) -> RosValues:
    return convert.transforms(tree.transforms, names)


Converter = Callable[[Any, RosNames], RosValues]
"""Converts a message to the values of the ROS message."""

TEXT: Final = "std_msgs/msg/String"

CONVERTERS: Final[dict[Topic[Any], tuple[str, str, Converter]]] = {
    t.SCAN: ("/sensor/scan", "sensor_msgs/msg/LaserScan", convert.scan),
    t.SCAN_2: ("/sensor/scan_2", "sensor_msgs/msg/LaserScan", convert.scan),
    t.CAMERA: ("/sensor/camera/compressed", "sensor_msgs/msg/CompressedImage", convert.image),
    t.BATTERY: ("/sensor/battery", "sensor_msgs/msg/BatteryState", convert.battery),
    t.ODOMETRY: ("/state/odometry", "nav_msgs/msg/Odometry", convert.odometry),
    t.POSE: ("/state/pose", "nav_msgs/msg/Odometry", convert.odometry),
    t.TRANSFORMS: ("/tf", "tf2_msgs/msg/TFMessage", _transforms),
    t.MAP: ("/state/map", "nav_msgs/msg/OccupancyGrid", convert.grid),
    t.PATH: ("/plan/path", "nav_msgs/msg/Path", convert.path),
}
"""ROS topic, interface and converter of the topics with a ROS message."""
