"""Messages of ROS 1 and 2 by the package ``rosbags``, which comes with the extra ``logs``."""

from typing import Any, Final

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

_ROS1: Final = get_typestore(Stores.ROS1_NOETIC)
_ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
_ROS2: Final = get_typestore(Stores.ROS2_JAZZY)


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
