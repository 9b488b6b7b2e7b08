"""Judges a face by a node of real ``rclpy``; needs a Python with ROS 2's wheels or a sourced ROS 2.

    python benchmarks/ros2_parts/rclpy_judge.py SECONDS OUTPUT

Reads topics, arms by the service, drives by Twist and by TwistStamped, sends a goal, and ends with an emergency stop.
"""

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as RosPath
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import BatteryState, Imu, JointState, LaserScan
from std_msgs.msg import String
from std_srvs.srv import Trigger

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = {
    "/scan": (LaserScan, qos_profile_sensor_data),
    "/odom": (Odometry, 10),
    "/pose": (PoseWithCovarianceStamped, 10),
    "/battery_state": (BatteryState, 10),
    "/compass": (Imu, qos_profile_sensor_data),
    "/joint_states": (JointState, 10),
    "/map": (OccupancyGrid, LATCHED),
    "/plan": (RosPath, LATCHED),
    "/robot_description": (String, LATCHED),
}


def plain(value: object) -> object:
    """A message as dictionaries and lists."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, list):
        return [plain(one) for one in value]
    return list(value) if hasattr(value, "typecode") or hasattr(value, "tolist") else value


class Judge:
    """One node."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node("judge")
        self.found: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
        for topic, (kind, qos) in TOPICS.items():
            self.node.create_subscription(kind, topic, self.found[topic].append, qos)

    def spin(self, seconds: float) -> None:
        """Take messages for a while."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            rclpy.spin_once(self.node, timeout_sec=0.02)

    def call(self, name: str) -> tuple[bool, str]:
        """Call a service of the robot."""
        client = self.node.create_client(Trigger, f"/truck/{name}")
        if not client.wait_for_service(5.0):
            return False, "no such service"
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=10.0)
        return future.result().success, future.result().message

    def place(self, topic: str) -> tuple[float, float]:
        """Newest x and y of a topic, m."""
        position = self.found[topic][-1].pose.pose.position
        return position.x, position.y

    def driven(self, stamped: bool) -> float:
        """Drive forward at 0.1 m/s for 3 s; returns the distance by odometry, m."""
        kind = TwistStamped if stamped else Twist
        publisher = self.node.create_publisher(kind, "/cmd_vel", 1)
        self.spin(1.0)
        begin = self.place("/odom")
        for _ in range(60):
            message = kind()
            if stamped:
                message.header.stamp = self.node.get_clock().now().to_msg()
                message.header.frame_id = "base_link"
            (message.twist if stamped else message).linear.x = 0.1
            publisher.publish(message)
            self.spin(0.05)
        self.spin(1.0)
        self.node.destroy_publisher(publisher)
        self.spin(0.5)
        return math.dist(begin, self.place("/odom"))

    def reached(self, ahead: float, seconds: float) -> float:
        """Send a goal straight ahead; returns the distance from it at the end, m."""
        publisher = self.node.create_publisher(PoseStamped, "/goal_pose", 1)
        self.spin(1.0)
        newest = self.found["/pose"][-1].pose.pose
        yaw = 2.0 * math.atan2(newest.orientation.z, newest.orientation.w)
        goal = PoseStamped()
        goal.header.frame_id = "map"
        goal.header.stamp = self.node.get_clock().now().to_msg()
        goal.pose.position.x = newest.position.x + ahead * math.cos(yaw)
        goal.pose.position.y = newest.position.y + ahead * math.sin(yaw)
        goal.pose.orientation = newest.orientation
        publisher.publish(goal)
        target = goal.pose.position.x, goal.pose.position.y
        until = time.monotonic() + seconds
        while time.monotonic() < until and math.dist(target, self.place("/pose")) > 0.05:
            self.spin(0.2)
        self.spin(1.0)
        return math.dist(target, self.place("/pose"))


def main(seconds: float, output: Path) -> None:
    """Judge, and store what came."""
    judge = Judge()
    judge.spin(seconds)
    read = {topic: [plain(message) for message in rows] for topic, rows in judge.found.items()}
    armed = judge.call("arm")
    figures: dict[str, object] = {"armed": armed}
    figures["twist_m"] = judge.driven(stamped=False)
    judge.call("arm")
    figures["stamped_m"] = judge.driven(stamped=True)
    judge.call("arm")
    figures["goal_m"] = judge.reached(0.6, 40.0)
    figures["estop"] = judge.call("estop")
    figures["refused"] = judge.call("arm")
    figures["reset"] = judge.call("reset")
    output.write_text(json.dumps({"topics": read, "figures": figures}, default=list))


if __name__ == "__main__":
    main(float(sys.argv[1]), Path(sys.argv[2]))
