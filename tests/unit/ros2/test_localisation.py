"""Localisation and map from ROS 2 nodes: what is sent to the robot, and what is refused."""

import asyncio
import math
import zlib
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics as t
from monstertruckd.ros2.cdr import decode, encode
from monstertruckd.ros2.convert import RosNames, prefixed
from monstertruckd.ros2.localisation import RosLocalisation
from monstertruckd.ros2.node import RosArrival, RosSender
from monstertruckd.ros2.rmw import LATCHED
from tests.bus_kit import odometry
from tests.ros2_kit import FACTS, scene

OFFSET = 10**18
"""Real time minus the robot's, ns."""


class Bench:
    """A node, a clock and operators in one: corrections sent, by sender, and refusals."""

    def __init__(self, prefix=""):
        self.time, self.takes, self.sent, self.refused = 0, {}, [], []
        names = RosNames(OFFSET, prefixed(prefix))
        self.localisation = RosLocalisation(self, self, lambda: names, self)
        self.prefix = prefix

    def now(self):
        return self.time

    def subscribe(self, topic, interface, take, qos=None):
        self.takes[topic] = interface, take

    def accepted(self, what, arrival, check):
        try:
            check(0)
        except InputError as error:
            self.refused.append(str(error))
            return None
        return arrival.sender

    def drive(self, sender, what, order):
        asyncio.run(order(self))
        self.sent[-1] = sender.node, *self.sent[-1]

    async def localise(self, correction):
        self.sent.append(tuple(round(number, 6) for number in correction))

    def arrive(self, topic, node, values):
        interface, take = self.takes[topic]
        take(RosArrival(decode(interface, encode(interface, values)), RosSender(node, node), b"", 1, 0))

    def drive_straight(self, seconds):
        """Own odometry: 0.1 m/s along x, 50 times a second."""
        for _ in range(round(50 * seconds)):
            self.time += SECOND // 50
            at = self.time / SECOND
            self.localisation.observe(odometry(1, 0.1 * at).model_copy(update={"stamp": self.time}))

    def tf(self, x, y, node="/amcl"):
        transform = {"translation": {"x": x, "y": y}, "rotation": {"z": math.sqrt(0.5), "w": math.sqrt(0.5)}}
        header = {"frame_id": f"{self.prefix}map"}
        row = {"header": header, "child_frame_id": f"{self.prefix}odom", "transform": transform}
        self.arrive("/tf", node, {"transforms": [row]})

    def estimate(self, x, y, frame="odom", child="base_link", ago=0.0):
        seconds, rest = divmod(self.time - round(ago * SECOND) + OFFSET, SECOND)
        header = {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": self.prefix + frame}
        place = {"pose": {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}}}
        values = {"header": header, "child_frame_id": self.prefix + child, "pose": place}
        self.arrive("odometry/filtered", "/ekf", values)


def test_a_transform_is_sent_at_most_ten_times_a_second():
    bench = Bench()
    for _ in range(50):
        bench.drive_straight(0.02)
        bench.tf(1.0, 2.0)
    assert bench.sent == [("/amcl", 1.0, 2.0, 1.570796)] * 10


def test_an_estimate_in_odom_replaces_the_robots_odometry_at_the_time_of_its_stamp():
    bench = Bench("t1/")
    bench.drive_straight(1.0)
    bench.estimate(0.05, 0.3, ago=0.5)  # the robot's own odometry said (0.05, 2) then
    assert bench.sent == [("/ekf", 0.0, -1.7, 0.0)]
    bench.drive_straight(0.02)
    bench.estimate(0.05, 0.3)
    assert len(bench.sent) == 1  # ten a second
    bench.drive_straight(0.1)
    bench.tf(5.0, 0.0)  # now odom of the estimator has a place in map, turned by a quarter
    assert len(bench.sent) == 1
    bench.estimate(0.112, 2.5)
    assert bench.sent[1:] == [("/ekf", 4.5, 0.0, 1.570796)]
    bench.drive_straight(1.1)
    bench.estimate(0.222, 2.5)  # the transform ended: lost
    assert len(bench.sent) == 2


def test_an_estimate_in_map_localises_alone_and_a_silent_estimator_leaves_the_transform():
    bench = Bench()
    bench.drive_straight(1.0)
    bench.estimate(4.1, 3.0, "map", "base_footprint")
    assert bench.sent == [("/ekf", 4.0, 1.0, 0.0)]
    bench.drive_straight(0.1)
    bench.estimate(0.1, 2.0)
    bench.drive_straight(1.1)
    bench.tf(1.0, 2.0)
    assert [row[0] for row in bench.sent] == ["/ekf", "/ekf", "/amcl"]


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"frame": "world"}, "frame 'world': expected map or odom"),
        ({"child": "imu"}, "frame 'imu': expected base_link or base_footprint"),
        ({"ago": 5.0}, "its header's stamp is older than 2 s, for which the robot's odometry is kept"),
        ({"ago": -1.0}, "its header's stamp is older than 2 s, for which the robot's odometry is kept"),
    ],
)
def test_an_estimate_that_cannot_be_placed_is_refused(fields, text):
    bench = Bench()
    bench.drive_straight(1.0)
    bench.estimate(0.0, 0.0, **fields)
    assert (bench.sent, bench.refused) == ([], [text])


async def test_a_latched_map_of_ros_2_is_sent_to_the_robot_which_publishes_none():
    async with scene(facts=replace(FACTS, localised=False, mapped=False)) as found, found.node("mapper") as node:
        maps = found.robot.bus.subscribe(t.REQ_MAP, latest())
        origin = {"position": {"x": -1.0, "y": -2.0}, "orientation": {"w": 1.0}}
        info = {"resolution": 0.05, "width": 3, "height": 2, "origin": origin}
        publish = node.publisher("map", "nav_msgs/msg/OccupancyGrid", LATCHED)
        publish({"header": {"frame_id": "world"}, "info": info, "data": np.zeros(6, np.int8)})
        await found.until(lambda: found.texts)
        assert found.texts == ["map of /mapper refused: frame 'world': expected map"]
        turned = info | {"origin": origin | {"orientation": {"z": 1.0}}}
        publish({"header": {"frame_id": "map"}, "info": turned, "data": np.zeros(6, np.int8)})
        await found.until(lambda: len(found.texts) == 2)
        assert "rotated by 3.142 rad" in found.texts[1]
        publish({"header": {"frame_id": "map"}, "info": info, "data": np.array([0, 100, -1, 5, 6, 7], np.int8)})
        await found.until(lambda: maps.latest is not None)
        request = maps.latest
        assert (request.source, request.width, request.height) == ("ros2:mapper", 3, 2)
        assert (request.resolution, request.origin.x, request.origin.y) == (pytest.approx(0.05), -1.0, -2.0)
        assert zlib.decompress(request.packed) == bytes([0, 100, 255, 5, 6, 7])
