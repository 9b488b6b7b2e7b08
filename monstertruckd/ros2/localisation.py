"""Localisation and map from ROS 2 nodes, for a robot with ``slam.mode: ros2``."""

import zlib
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np

from monstertruck_estimation.transforms import yaw_of
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import compose, inverse
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.threads import in_thread
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import Odometry
from monstertruckd.ros2.cdr import RosMessage
from monstertruckd.ros2.convert import FOOTPRINT, RosNames
from monstertruckd.ros2.node import RosArrival, RosNode, RosSender
from monstertruckd.ros2.operators import Operators, frame_in, stamp_of
from monstertruckd.ros2.rmw import LATCHED

CORRECTION_PERIOD: Final = SECOND // 10
"""Minimum interval between two corrections sent to the robot (ns)."""
CORRECTION_LEASE: Final = SECOND
"""Maximum age of a correction (ns)."""


def pose_in(pose: RosMessage) -> Array:
    """Return the planar part of a ``geometry_msgs/msg/Pose``, shape (3,): m, m, rad."""
    place, turn = pose["position"], pose["orientation"]
    return np.array((place["x"], place["y"], yaw_of((turn["x"], turn["y"], turn["z"], turn["w"]))))


class RosLocalisation:
    """Sends the robot the pose of its odom frame in map, as estimated by amcl, slam_toolbox or robot_localization.

    - ``/tf``: the transform from map to odom. amcl stamps it in the future, so only the send time is checked.
    - ``odometry/filtered``: pose of the base from a ROS 2 estimator. In frame map it localises the robot by itself; in
      frame odom it is composed with the transform. Without a publisher of the transform, odom is map.

    Args:
        node: node of ROS 2.
        operators: sessions of the nodes.
        names: returns the current conversion of stamps and frames.
        clock: time.
    """

    def __init__(self, node: RosNode, operators: Operators, names: Callable[[], RosNames], clock: Clock) -> None:
        self._operators, self._names, self._clock = operators, names, clock
        self._odometry: deque[tuple[int, Array]] = deque(maxlen=128)
        """Stamps (ns) and poses of the robot's odometry during the last 2.5 s at 50 Hz."""
        self._odom: tuple[int, Array] | None = None
        """Arrival time (ns) of the latest pose of odom in map on ``/tf``, and the pose."""
        self._estimated_at: int | None = None
        """Arrival time of the latest pose in odom on ``odometry/filtered`` (ns)."""
        self._sent_at: int | None = None
        node.subscribe("/tf", "tf2_msgs/msg/TFMessage", self._tf)
        node.subscribe("odometry/filtered", "nav_msgs/msg/Odometry", self._estimate)

    def observe(self, odometry: Odometry) -> None:
        """Process the robot's own odometry."""
        self._odometry.append((odometry.stamp, np.array((odometry.pose.x, odometry.pose.y, odometry.pose.yaw))))

    def _tf(self, arrival: RosArrival) -> None:
        names = self._names()
        ends = names.frame("map"), names.frame("odom")
        rows = [
            row["transform"]
            for row in arrival.message["transforms"]
            if (row["header"]["frame_id"].lstrip("/"), row["child_frame_id"].lstrip("/")) == ends
        ]
        now = self._clock.now()
        if not rows or (self._odom is not None and now - self._odom[0] < CORRECTION_PERIOD):
            return
        sender = self._operators.accepted("/tf", arrival, lambda _: None)
        if sender is None:
            return
        self._odom = now, pose_in({"position": rows[-1]["translation"], "orientation": rows[-1]["rotation"]})
        if self._estimated_at is None or now - self._estimated_at > CORRECTION_LEASE:
            self._send(sender, "/tf", self._odom[1], now)

    def _estimate(self, arrival: RosArrival) -> None:
        now, names = self._clock.now(), self._names()
        if self._sent_at is not None and now - self._sent_at < CORRECTION_PERIOD:
            return
        message, corrections = arrival.message, []

        def check(_: int) -> None:
            corrections.append(self._correction(message, names))

        sender = self._operators.accepted("odometry/filtered", arrival, check)
        if sender is None:
            return
        correction = corrections[0]
        if message["header"]["frame_id"].lstrip("/") != names.frame("map"):
            self._estimated_at = now
            if self._odom is not None:
                since, odom = self._odom
                if now - since > CORRECTION_LEASE:
                    return  # lost, like without the estimator
                correction = compose(odom, correction)
        self._send(sender, "odometry/filtered", correction, now)

    def _correction(self, message: RosMessage, names: RosNames) -> Array:
        """Return the pose of the robot's odom frame in the frame of an estimate.

        Raises:
            InputError: the frames are wrong, or the stamp is older than the stored odometry.
        """
        frame_in(message["header"], (names.frame("map"), names.frame("odom")))
        frame_in({"frame_id": message["child_frame_id"]}, (names.frame("base"), names.frame(FOOTPRINT)))
        stamp = stamp_of(message["header"]["stamp"]) - names.offset
        if not self._odometry or not self._odometry[0][0] <= stamp <= self._odometry[-1][0] + SECOND // 2:
            raise InputError("its header's stamp is older than 2 s, for which the robot's odometry is kept")
        own = min(self._odometry, key=lambda row: abs(row[0] - stamp))[1]
        return compose(pose_in(message["pose"]["pose"]), inverse(own))

    def _send(self, sender: RosSender, what: str, correction: Array, now: int) -> None:
        self._sent_at = now
        x, y, yaw = correction.tolist()
        self._operators.drive(sender, what, lambda client: client.localise((x, y, yaw)))


class RosMaps:
    """Sends the robot the latched map of slam_toolbox or map_server.

    A map may be of any age, but not from an unknown publisher.

    Args:
        node: node of ROS 2.
        operators: sessions of the nodes.
        names: returns the current conversion of stamps and frames.
    """

    def __init__(self, node: RosNode, operators: Operators, names: Callable[[], RosNames]) -> None:
        self._operators, self._names = operators, names
        node.subscribe("map", "nav_msgs/msg/OccupancyGrid", self._take, LATCHED)

    def _take(self, arrival: RosArrival) -> None:
        sender, message, info = arrival.sender, arrival.message, arrival.message["info"]
        if sender is None:
            self._operators.refuse("an unknown publisher", "map", "the graph has no publisher of it with its identity")
            return
        try:
            frame_in(message["header"], (self._names().frame("map"),))
            x, y, yaw = pose_in(info["origin"]).tolist()
            if yaw != 0.0:
                raise InputError(f"info.origin is rotated by {yaw:.3f} rad: expected no rotation")
        except InputError as error:
            self._operators.refuse(sender.node, "map", str(error))
            return
        cells = np.asarray(message["data"], np.int8)

        async def send(client: TruckClient) -> None:
            packed = await in_thread(partial(zlib.compress, cells.tobytes(), 1))
            size = info["width"], info["height"]
            await client.send_map(packed, size, info["resolution"], Pose2D(x=x, y=y, yaw=0.0))

        self._operators.ask(sender, "map", send)
