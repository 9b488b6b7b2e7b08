"""Bags of ROS 1 and 2 by the package ``rosbags``, which comes with the extra ``logs``."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from monstertruck_runtime.outside import reading
from monstertruckd.tools.logs.bags import READERS, RawMessage

_ROS1: Final = get_typestore(Stores.ROS1_NOETIC)
_ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
_ROS2: Final = get_typestore(Stores.ROS2_JAZZY)


def ros_messages(path: Path, version: int) -> Iterator[RawMessage]:
    """Yield the messages of a bag of ROS 1 (file) or 2 (folder, or one database of it).

    Topics of other messages than those that are read are yielded once, without data.

    Raises:
        InputError: it cannot be read, or is damaged.
    """
    with reading(path, f"a bag of ROS {version}"):
        encoding = "ros1" if version == 1 else "cdr"
        with Ros1Reader(path) if version == 1 else Ros2Reader(path) as bag:
            read = [one for one in bag.connections if one.msgtype in READERS]
            for one in bag.connections:
                if one not in read:
                    yield RawMessage(one.topic, one.msgtype, encoding, 0, b"")
            if read:
                for one, time, data in bag.messages(connections=read):
                    yield RawMessage(one.topic, one.msgtype, encoding, time, bytes(data))


def parsed(encoding: str, schema: str, data: bytes) -> Any:
    """Decode a message.

    The layouts of what is read are the same in all versions of ROS, so the definitions in a bag are not needed.

    Args:
        encoding: ``ros1`` or ``cdr``.
        schema: name of its type.
        data: of the message.
    """
    if encoding == "ros1":
        return _ROS1.deserialize_ros1(data, "tf2_msgs/msg/TFMessage" if schema == "tf/msg/tfMessage" else schema)
    return _ROS2.deserialize_cdr(data, schema)
