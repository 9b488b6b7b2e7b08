"""A node of ROS 2 in the place of Nav2 and amcl: it localises the robot, drives it to a goal by cmd_vel, and dies."""

import asyncio
import math
import os
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.health import LocalisationStatus
from monstertruck_schemas.req import Role
from monstertruck_schemas.state import GateMode
from monstertruckd.ros2.rmw import LATCHED, RELIABLE
from monstertruckd.ros2.zenoh_node import ZenohNode, session_settings
from tests.daemon.wall_kit import ROOT, end, free_endpoint, kept_armed, robot

pytestmark = [pytest.mark.wall, pytest.mark.timeout(180)]

OFFSET = (5.0, 3.0)
"""Odom in map, m: what only the node knows."""


class Nav2:
    """``/amcl`` localises by odometry, ``/nav2`` steers straight at a goal in map, each 20 times a second."""

    def __init__(self, node: ZenohNode, amcl: ZenohNode) -> None:
        self.goal = (0.0, 0.0)
        self.odom: tuple[float, float, float] | None = None
        self._cmd_vel = node.publisher("cmd_vel", "geometry_msgs/msg/Twist", RELIABLE)
        self._tf = amcl.publisher("/tf", "tf2_msgs/msg/TFMessage", RELIABLE)
        self._map = amcl.publisher("map", "nav_msgs/msg/OccupancyGrid", LATCHED)
        self.children: set[str] = set()
        """Moving frames that the face publishes."""
        node.subscribe("odom", "nav_msgs/msg/Odometry", self._take)
        node.subscribe("/tf", "tf2_msgs/msg/TFMessage", self._see)

    def _take(self, arrival) -> None:
        pose = arrival.message["pose"]["pose"]
        yaw = 2.0 * math.atan2(pose["orientation"]["z"], pose["orientation"]["w"])
        self.odom = pose["position"]["x"], pose["position"]["y"], yaw

    def _see(self, arrival) -> None:
        if arrival.sender is not None and arrival.sender.node == "/truck":
            self.children.update(row["child_frame_id"] for row in arrival.message["transforms"])

    @property
    def left(self) -> float:
        """Distance to the goal, m."""
        assert self.odom is not None
        return math.dist((self.odom[0] + OFFSET[0], self.odom[1] + OFFSET[1]), self.goal)

    def map(self) -> None:
        info = {"resolution": 0.05, "width": 400, "height": 300, "origin": {"orientation": {"w": 1.0}}}
        self._map({"header": {"frame_id": "map"}, "info": info, "data": np.zeros(120_000, np.int8)})

    def localise(self) -> None:
        transform = {"translation": {"x": OFFSET[0], "y": OFFSET[1]}, "rotation": {"w": 1.0}}
        row = {"header": {"frame_id": "map"}, "child_frame_id": "odom", "transform": transform}
        self._tf({"transforms": [row]})

    def drive(self) -> None:
        assert self.odom is not None
        x, y, yaw = self.odom
        bearing = math.atan2(self.goal[1] - OFFSET[1] - y, self.goal[0] - OFFSET[0] - x)
        turn = max(min(math.remainder(bearing - yaw, math.tau), 0.2), -0.2)
        self._cmd_vel({"linear": {"x": 0.2}, "angular": {"z": turn}})


OVERLAY = {
    "slam": {"mode": "ros2"},
    "planner": {"mode": "ros2"},
    "path": None,
    "tracker": None,
    "map": None,
    "gate": {"remote_trackers": ["ros2:nav2"]},
}
"""A robot that Nav2, slam_toolbox and robot_localization plan, map and localise for."""
ROS2_PYTHON = os.environ.get("ROS2_PYTHON")
"""Python with ``rclpy`` and what ``benchmarks/ros2_parts/build_messages.py`` needs."""


@pytest.mark.long
@pytest.mark.skipif(ROS2_PYTHON is None, reason="needs ROS2_PYTHON, an interpreter with rclpy")
async def test_a_node_of_rclpy_maps_localises_and_drives_the_robot(tmp_path: Path):
    path = ":".join(str(ROOT / part) for part in ("", "drivers", "planners", "schemas"))
    environment = os.environ | {"ROS_DOMAIN_ID": "78", "PYTHONPATH": path}
    async with robot(tmp_path, OVERLAY) as made:
        await made.start_simulator()
        await made.start_daemon()
        words = ("-m", "monstertruckd", "ros2", "--robot", f"truck@{made.endpoint}", "--face", "rclpy")
        async with made.client() as client, kept_armed(client):
            gates = client.subscribe(topics.GATE, fifo(10_000))
            healths = client.subscribe(topics.SLAM, fifo(10_000))
            maps = client.subscribe(topics.MAP, fifo(100))
            face = await asyncio.create_subprocess_exec(ROS2_PYTHON, *words, env=environment)
            node = await asyncio.create_subprocess_exec(ROS2_PYTHON, RCLPY_NAV2, env=environment)
            try:
                async with asyncio.timeout(120):
                    assert await node.wait() == 0
                    known = await maps.next()
            finally:
                await end(node)
                await end(face)
            holders = {(state.holder, state.role) for state in gates.drain() if state.holder is not None}
            assert holders == {("ros2:nav2", Role.TRACKER)}
            assert (known.width, known.height, known.frame) == (400, 300, "map")
            assert LocalisationStatus.LOCALISED in {health.standing for health in healths.drain()}


RCLPY_NAV2 = ROOT / "benchmarks" / "ros2_parts" / "rclpy_nav2.py"


async def test_a_node_localises_and_drives_the_robot_as_its_planner_and_mapper(tmp_path: Path):
    async with robot(tmp_path, OVERLAY) as made:
        await made.start_simulator()
        await made.start_daemon()
        ros = free_endpoint()
        async with made.client() as client:
            face = await made.spawn("ros2", "--robot", f"truck@{made.endpoint}", "--listen", ros)
            try:
                await drive_by_nodes(client, ros)
            finally:
                await end(face)


@asynccontextmanager
async def ros_node(name: str, ros: str) -> AsyncIterator[ZenohNode]:
    """A node, once the face listens."""
    async with AsyncExitStack() as stack:
        async with asyncio.timeout(30):
            while True:
                with suppress(NotFoundError):
                    node = ZenohNode((name, "/"), 0, session_settings(ros, ""), WallClock())
                    await stack.enter_async_context(node)
                    break
                await asyncio.sleep(0.5)
        yield node


async def drive_by_nodes(client, ros: str) -> None:
    gates = client.subscribe(topics.GATE, fifo(1000))
    health, poses = client.subscribe(topics.SLAM, latest()), client.subscribe(topics.POSE, latest())
    async with ros_node("nav2", ros) as node, ros_node("amcl", ros) as amcl:
        nav = Nav2(node, amcl)
        async with asyncio.timeout(30):
            while nav.odom is None or health.latest is None:
                await asyncio.sleep(0.05)
        assert health.latest.standing is LocalisationStatus.SEARCHING
        x, y, yaw = nav.odom
        nav.goal = x + OFFSET[0] + 0.8 * math.cos(yaw), y + OFFSET[1] + 0.8 * math.sin(yaw)
        nav.map()
        localising = asyncio.create_task(every(0.05, nav.localise))
        try:
            async with asyncio.timeout(20):
                while health.latest.standing is not LocalisationStatus.LOCALISED:
                    await asyncio.sleep(0.05)
            async with asyncio.timeout(60):
                while nav.left > 0.15:
                    if gates.latest is None or gates.latest.mode is GateMode.DISARMED:
                        with suppress(RequestRefusedError):
                            await client.arm()
                    nav.drive()
                    await asyncio.sleep(0.05)
        finally:
            localising.cancel()
        place = poses.latest.pose
        assert math.dist((place.x, place.y), nav.goal) < 0.35
        holders = {(state.holder, state.role) for state in gates.drain() if state.holder is not None}
        assert holders == {("ros2:nav2", Role.TRACKER)}
        known = await client.get_retained(topics.MAP)
        assert (known.width, known.height, known.frame) == (400, 300, "map")
        assert nav.children == {"base_link"}
        async with asyncio.timeout(20):  # without a driver and without corrections
            while health.latest.standing is not LocalisationStatus.LOST or gates.latest.mode.moving:
                await asyncio.sleep(0.05)


async def every(seconds: float, do) -> None:
    while True:
        do()
        await asyncio.sleep(seconds)
