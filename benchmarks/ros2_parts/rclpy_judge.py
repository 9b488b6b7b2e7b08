"""Judges a face with nodes of real ``rclpy``; needs a Python with ROS 2's wheels, or a sourced ROS 2.

    python -m benchmarks.ros2_parts.rclpy_judge read SECONDS OUTPUT | late | drive | twists COUNT | hostile SECONDS

``read`` pickles the messages of all topics, by topic. The others print JSON on their last line: ``late`` the time until
a new node has map, static transforms and description; ``drive`` the results of driving an armed robot by twists, by a
goal pose and by Nav2's actions; ``twists`` and ``hostile`` print ``ready``, wait for a line, and print times of
sending.
"""

import importlib
import json
import math
import os
import pickle
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist, TwistStamped
from nav2_msgs.action import FollowPath, NavigateThroughPoses, NavigateToPose
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as RosPath
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_srvs.srv import Trigger

from benchmarks.ros2_parts.all_topics import BEST_EFFORT, LATCHED, TOPICS

LATCHING = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PROFILES = dict.fromkeys(BEST_EFFORT, qos_profile_sensor_data) | dict.fromkeys(LATCHED, LATCHING)
FIRST, STEP = 0.05, 1e-6
"""Speed of the first of timed twists, and between two, by which each is known again, m/s."""


def interface(name: str) -> Any:
    """Return the class of an interface."""
    package, group, own = name.split("/")
    return getattr(importlib.import_module(f"{package}.{group}"), own)


def plain(value: Any) -> Any:
    """Return a message as dictionaries and lists."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(one) for one in value] if isinstance(value, list) else value


def position(message: Any) -> tuple[float, float]:
    """Return x and y, m."""
    place = message.pose.pose.position
    return place.x, place.y


class Judge:
    """One node in a separate participant, with one interface for each topic."""

    def __init__(self, name: str = "judge") -> None:
        context = Context()
        context.init()
        self.node = rclpy.create_node(name, context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)

    def follow(self, topic: str, kind: Any, qos: Any = 10) -> list[Any]:
        """Return a growing list of a topic's messages."""
        found: list[Any] = []
        self.node.create_subscription(kind, topic, found.append, qos)
        return found

    def spin(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Receive messages for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not until():
            self._executor.spin_once(timeout_sec=0.02)

    def done(self, future: Any, seconds: float) -> Any:
        """Wait for the result of a future."""
        self._executor.spin_until_future_complete(future, timeout_sec=seconds)
        return future.result()

    def now(self) -> Any:
        """Return the current time as a stamp."""
        return self.node.get_clock().now().to_msg()


def read(seconds: float, output: Path) -> None:
    """Store the received messages of all topics."""
    judge = Judge()
    found = {topic: judge.follow(topic, interface(kind), PROFILES.get(topic, 100)) for topic, kind in TOPICS.items()}
    judge.spin(seconds)
    output.write_bytes(pickle.dumps({topic: [plain(one) for one in rows] for topic, rows in found.items()}))


def late() -> float:
    """Return the time (ms) from the first subscription until the latched topics are received."""
    judge = Judge("late")
    begin = time.monotonic()
    wanted = ("/map", "/tf_static", "/robot_description")
    found = [judge.follow(topic, interface(TOPICS[topic]), LATCHING) for topic in wanted]
    judge.spin(5.0, lambda: all(found))
    return 1e3 * (time.monotonic() - begin) if all(found) else math.inf


def twist(kind: Any, speed: float, stamp: Any = None) -> Any:
    """Return a forward twist, stamped if its type is."""
    message = kind()
    if kind is TwistStamped:
        message.header.frame_id = "base_link"
        message.header.stamp = stamp
        message.twist.linear.x = speed
    else:
        message.linear.x = speed
    return message


def begin_at_a_line() -> None:
    """Wait for the benchmark's start line."""
    print("ready", flush=True)
    sys.stdin.readline()


def twists(count: int) -> list[tuple[float, int]]:
    """Drive at 20 Hz; return speeds and times of sending."""
    judge, sent = Judge("driver"), []
    publisher = judge.node.create_publisher(Twist, "/cmd_vel", 1)
    judge.spin(2.0)
    publisher.publish(twist(Twist, 0.0))  # opens the session
    begin_at_a_line()
    for number in range(count):
        speed = FIRST + number * STEP
        message = twist(Twist, speed)
        sent.append((speed, time.time_ns()))
        publisher.publish(message)
        judge.spin(0.05)
    judge.spin(1.0)
    return sent


def hostile(seconds: float) -> int:
    """Send stamped twists half a minute old, and twists beside another publisher; return their number."""
    judges, sent = {kind: Judge(f"hostile_{kind.__name__.lower()}") for kind in (TwistStamped, Twist)}, 0
    begin_at_a_line()
    for kind, judge in judges.items():
        publisher = judge.node.create_publisher(kind, "/cmd_vel", 1)
        judge.spin(1.0)
        end = time.monotonic() + seconds / 2.0
        while time.monotonic() < end:
            stamp = judge.now()
            stamp.sec -= 30
            publisher.publish(twist(kind, 0.2, stamp))
            sent += 1
    return sent


class Drive:
    """Commands of a node to an armed robot."""

    def __init__(self) -> None:
        self.judge = Judge()
        self.odometry = self.judge.follow("/odom", Odometry)
        self.poses = self.judge.follow("/pose", PoseWithCovarianceStamped)
        self.judge.spin(3.0)

    def call(self, name: str) -> tuple[bool, str]:
        """Call a service of the robot."""
        client = self.judge.node.create_client(Trigger, f"/truck/{name}")
        if not client.wait_for_service(10.0):
            return False, "no such service"
        answer = self.judge.done(client.call_async(Trigger.Request()), 20.0)
        return answer.success, answer.message

    def twisted(self, kind: Any) -> float:
        """Drive at 0.1 m/s for 3 s; return the distance by odometry, m."""
        publisher = self.judge.node.create_publisher(kind, "/cmd_vel", 1)
        self.judge.spin(1.0)
        begin = position(self.odometry[-1])
        for _ in range(60):
            publisher.publish(twist(kind, 0.1, self.judge.now()))
            self.judge.spin(0.05)
        self.judge.spin(1.0)
        self.judge.node.destroy_publisher(publisher)
        self.judge.spin(0.5)
        return math.dist(begin, position(self.odometry[-1]))

    def ahead(self, *distances: float) -> list[PoseStamped]:
        """Return poses at these distances ahead of the robot, m."""
        newest = self.poses[-1].pose.pose
        yaw = 2.0 * math.atan2(newest.orientation.z, newest.orientation.w)
        rows = []
        for distance in distances:
            row = PoseStamped()
            row.header.frame_id = "map"
            row.header.stamp = self.judge.now()
            row.pose.position.x = newest.position.x + distance * math.cos(yaw)
            row.pose.position.y = newest.position.y + distance * math.sin(yaw)
            row.pose.orientation = newest.orientation
            rows.append(row)
        return rows

    def goal_pose(self, seconds: float) -> float:
        """Send a goal 0.5 m ahead; return the final distance from it, m."""
        publisher = self.judge.node.create_publisher(PoseStamped, "/goal_pose", 1)
        self.judge.spin(1.0)
        (goal,) = self.ahead(0.5)
        publisher.publish(goal)
        target = goal.pose.position.x, goal.pose.position.y
        self.judge.spin(seconds, lambda: math.dist(target, position(self.poses[-1])) < 0.05)
        self.judge.spin(1.0)
        return math.dist(target, position(self.poses[-1]))

    def action(self, kind: Any, name: str, goal: Any, cancel_after: float | None = None) -> tuple[int, str, int]:
        """Execute an action; return its status, its text, and the number of feedback messages."""
        self.call("arm")
        feedbacks: list[Any] = []
        client = ActionClient(self.judge.node, kind, name)
        assert client.wait_for_server(10.0)
        handle = self.judge.done(client.send_goal_async(goal, feedbacks.append), 20.0)
        assert handle.accepted
        result = handle.get_result_async()
        if cancel_after is not None:
            self.judge.spin(cancel_after)
            self.judge.done(handle.cancel_goal_async(), 10.0)
        answer = self.judge.done(result, 120.0)
        return answer.status, answer.result.error_msg, len(feedbacks)

    def actions(self) -> dict[str, tuple[int, str, int]]:
        """Test goals reached, cancelled and refused, poses driven through, and a path followed backward."""
        near, far, away = self.ahead(0.5, 0.9, 500.0)
        to_pose = NavigateToPose, "navigate_to_pose"
        found = {
            "driven": self.action(*to_pose, NavigateToPose.Goal(pose=near)),
            "cancelled": self.action(*to_pose, NavigateToPose.Goal(pose=far), 1.5),
            "refused": self.action(*to_pose, NavigateToPose.Goal(pose=away)),
        }
        through = NavigateThroughPoses.Goal(poses=[near, far])
        found["through"] = self.action(NavigateThroughPoses, "navigate_through_poses", through)
        path = RosPath(header=near.header, poses=self.ahead(*(-0.05 * step for step in range(10))))
        found["followed"] = self.action(FollowPath, "follow_path", FollowPath.Goal(path=path))
        return found


def drive() -> dict[str, object]:
    """Return the results of driving an armed robot."""
    order = Drive()
    figures: dict[str, object] = {"armed": order.call("arm"), "twist_m": order.twisted(Twist)}
    order.call("arm")
    figures["stamped_m"] = order.twisted(TwistStamped)
    order.call("arm")
    figures["goal_m"] = order.goal_pose(60.0)
    figures["actions"] = actions = order.actions()
    ends = [status for status, _, _ in actions.values()]
    wanted = [GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_ABORTED]
    figures["actions_right"] = ends == [*wanted, *wanted[:1], *wanted[:1]]
    figures["estop"] = order.call("estop")
    figures["refused"] = order.call("arm")
    figures["reset"] = order.call("reset")
    return figures


def main(what: str, *words: str) -> None:
    """Run one part."""
    if what == "read":
        read(float(words[0]), Path(words[1]))
        return
    parts: dict[str, Callable[[], object]] = {
        "late": late,
        "drive": drive,
        "twists": lambda: twists(int(words[0])),
        "hostile": lambda: hostile(float(words[0])),
    }
    print(json.dumps(parts[what]()), flush=True)
    os._exit(0)  # threads of the middleware may not end


if __name__ == "__main__":
    main(*sys.argv[1:])
