"""Reads a face with ``zenoh-ros2-sdk``, with the interfaces of ``rosbags``, and stores the messages.

python -m benchmarks.ros2_parts.sdk_reader PORT SECONDS OUTPUT
"""

import os
import pickle
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from rosbags.typesys import Stores, get_typestore

from benchmarks.ros2_parts.all_topics import LATCHED, TOPICS

UPDATE = "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data\n"
FURTHER = {"map_msgs/msg/OccupancyGridUpdate": UPDATE}
"""Definitions that ``rosbags`` lacks."""


def write_definitions(folder: Path) -> None:
    """Write the ``.msg`` files of ROS 2 Jazzy from ``rosbags``."""
    store = get_typestore(Stores.ROS2_JAZZY)
    texts = {name: store.generate_msgdef(name, ros_version=2)[0] for name in store.fielddefs} | FURTHER
    for name, text in texts.items():
        package, _, own = name.split("/")
        file = folder / package / "msg" / f"{own}.msg"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text.split("=" * 80)[0])


def plain(value: object) -> object:
    """Return a message as dictionaries, lists and arrays."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"}
    return [plain(one) for one in value] if isinstance(value, list) else value


def main(port: int, seconds: float, output: Path) -> None:
    """Subscribe to all topics and store the messages, by topic."""
    with TemporaryDirectory() as folder:
        os.environ["HOME"] = folder  # the SDK writes into the configuration of git
        from zenoh_ros2_sdk import ROS2Subscriber  # noqa: PLC0415
        from zenoh_ros2_sdk.message_registry import get_registry  # noqa: PLC0415
        from zenoh_ros2_sdk.qos import QosDurability, QosProfile  # noqa: PLC0415

        write_definitions(Path(folder))
        get_registry(folder)
        found: dict[str, list[object]] = {topic: [] for topic in TOPICS}
        kept = []
        for topic, kind in TOPICS.items():
            qos = QosProfile(durability=QosDurability.TRANSIENT_LOCAL) if topic in LATCHED else None

            def take(message: object, rows: list[object] = found[topic]) -> None:
                rows.append(message)

            kept.append(ROS2Subscriber(topic, kind, take, router_port=port, qos=qos))
        time.sleep(seconds)
        output.write_bytes(pickle.dumps({topic: [plain(one) for one in rows] for topic, rows in found.items()}))
        os._exit(0)  # the SDK's threads do not end


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]), Path(sys.argv[3]))
