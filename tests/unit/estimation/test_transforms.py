import asyncio
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_estimation.transforms import (
    FrameTree,
    TransformService,
    compose,
    invert,
    mount,
    multiply,
    planar,
    quaternion_from_rpy,
    quaternion_from_yaw,
    rotate,
    wrap_angle,
    yaw_of,
)
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.state import Odometry
from tests.unit.estimation.kit import looked_up

angle = st.floats(-3.1, 3.1)
metre = st.floats(-5, 5)


@given(st.floats(-50, 50))
@settings(max_examples=50)
def test_wrapped_angles_point_the_same_way(value):
    wrapped = wrap_angle(value)
    assert abs(wrapped) <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(value), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(value), abs=1e-9)


@given(angle)
@settings(max_examples=30)
def test_yaw_survives_its_quaternion(yaw):
    assert yaw_of(quaternion_from_yaw(yaw)) == pytest.approx(yaw)
    assert quaternion_from_rpy(0, 0, yaw) == pytest.approx(quaternion_from_yaw(yaw))


def test_axes_turn_by_the_right_hand_rule():
    quarter = math.pi / 2
    assert rotate(quaternion_from_rpy(quarter, 0, 0), (0, 1, 0)) == pytest.approx((0, 0, 1), abs=1e-12)
    assert rotate(quaternion_from_rpy(0, quarter, 0), (1, 0, 0)) == pytest.approx((0, 0, -1), abs=1e-12)  # nose down
    assert rotate(quaternion_from_rpy(0, 0, quarter), (1, 0, 0)) == pytest.approx((0, 1, 0), abs=1e-12)


@given(angle, angle, angle)
@settings(max_examples=30)
def test_rpy_is_x_then_y_then_z(roll, pitch, yaw):
    parts = multiply(
        quaternion_from_rpy(0, 0, yaw), multiply(quaternion_from_rpy(0, pitch, 0), quaternion_from_rpy(roll, 0, 0))
    )
    assert quaternion_from_rpy(roll, pitch, yaw) == pytest.approx(parts)


@given(metre, metre, metre, angle, angle, angle)
@settings(max_examples=30)
def test_there_and_back_is_nothing(x, y, z, roll, pitch, yaw):
    there = mount("camera", (x, y, z), (roll, pitch, yaw))
    nothing = compose(there, invert(there))
    assert nothing.translation == pytest.approx((0, 0, 0), abs=1e-9)
    assert nothing.rotation == pytest.approx((0, 0, 0, 1), abs=1e-9)
    assert (nothing.parent, nothing.child) == ("base", "base")


def tree():
    return FrameTree(
        [
            planar("map", "odom", 0, (0.0, 0.0, 0.0)),
            planar("odom", "base", 70, (1.0, 2.0, math.pi / 2)),
            mount("lidar", (0.14, 0.0, 0.2)),
            mount("compass", (0.0, 0.0, 0.3), (math.pi, 0.0, 0.0)),
        ]
    )


def test_lookup_goes_up_down_and_across():
    frames = tree()
    lidar = frames.lookup("map", "lidar")
    assert (lidar.parent, lidar.child, lidar.stamp) == ("map", "lidar", 70)
    assert lidar.translation == pytest.approx((1.0, 2.14, 0.2))
    assert yaw_of(lidar.rotation) == pytest.approx(math.pi / 2)
    assert frames.lookup("lidar", "map").translation == pytest.approx((-2.14, 1.0, -0.2))
    across = frames.lookup("compass", "lidar")
    assert (across.parent, across.child) == ("compass", "lidar")
    assert across.translation == pytest.approx((0.14, 0.0, 0.1))
    assert frames.lookup("base", "base").rotation == (0, 0, 0, 1)


def test_unknown_frames_are_named():
    for ends in (("map", "camera"), ("camera", "map"), ("camera", "camera")):
        with pytest.raises(NotFoundError, match=r"camera.*known frames are base, compass, lidar, map, odom"):
            tree().lookup(*ends)
    with pytest.raises(NotFoundError, match="none"):
        FrameTree().lookup("map", "odom")


def test_only_trees_are_accepted():
    frames = tree()
    with pytest.raises(InputError, match="'lidar' already has the parent 'base'"):
        frames.put(mount("lidar", (0, 0, 0), parent="odom"))
    with pytest.raises(InputError, match="loop"):
        frames.put(mount("map", (0, 0, 0), parent="lidar"))
    with pytest.raises(InputError, match="loop"):
        frames.put(mount("wheel", (0, 0, 0), parent="wheel"))


def test_newer_transforms_replace_older_ones():
    frames = tree()
    frames.put(planar("odom", "base", 90, (3.0, 0.0, 0.0)))
    assert frames.lookup("map", "base").translation == pytest.approx((3.0, 0.0, 0.0))


def test_service_publishes_the_whole_tree_ten_times_a_second():
    class Inbox:
        latest = None

    class Outbox(list):
        def next_seq(self):
            return len(self)

        put = list.append

    inbox, out = Inbox(), Outbox()

    async def main(clock):
        service = TransformService([mount("lidar", (0.14, 0.0, 0.2))], clock, inbox, out)
        task = asyncio.create_task(service.run(lambda: None))
        await clock.sleep(0.15)
        inbox.latest = Odometry(
            stamp=clock.now(),
            received=clock.now(),
            seq=0,
            frame="odom",
            pose=Pose2D(x=1.0, y=0.0, yaw=0.0),
            twist=Twist2D(vx=0.0, vy=0.0, wz=0.0),
            pose_covariance=np.zeros(9),
            twist_covariance=np.zeros(9),
            age=0.0,
        )
        assert looked_up(service, "map", "lidar").translation == pytest.approx((1.14, 0.0, 0.2))
        await clock.sleep(0.9)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    run_virtual(main)
    assert len(out) == pytest.approx(11, abs=1)
    assert np.diff([message.stamp for message in out[1:]]) == pytest.approx(SECOND // 10, abs=1000)
    assert [t.child for t in out[0].transforms] == ["odom", "lidar"]
    assert [t.child for t in out[-1].transforms] == ["odom", "lidar", "base"]
    assert out[-1].transforms[1].stamp == out[-1].stamp
    assert out[-1].transforms[2].stamp < out[-1].stamp
