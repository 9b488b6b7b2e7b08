"""A robot's bus on one side, nodes of ROS 2 over Zenoh on the other."""

import asyncio
import json
import math
from functools import partial

import numpy as np
import pytest
import zenoh

from monstertruck_estimation.transforms import FIXED, mount, planar
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.errors import BusyError
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Grid, Transforms
from monstertruckd.ros2.actions import ActionGoal, CancelCode, GoalStatus, chosen
from monstertruckd.ros2.cdr import decode, encode
from monstertruckd.ros2.face import FaceOptions
from monstertruckd.ros2.rmw import RELIABLE, Attachment, data_key
from monstertruckd.ros2.zenoh_node import ZenohNode, session_settings
from monstertruckd.ros2.zenoh_node import free_endpoint as next_endpoint
from tests.bus_kit import odometry
from tests.ros2_kit import Reader, ServiceClient, asking, pose, scene

TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"


async def drive(node, scene, values, interface=TWIST, times=1):
    publish = node.publisher("cmd_vel", interface, RELIABLE)
    await asyncio.sleep(0.3)  # until the graph has it
    for _ in range(times):
        publish(values)
        await asyncio.sleep(0.05)


def twist(vx=0.1, wz=0.2, **linear):
    return {"linear": {"x": vx, **linear}, "angular": {"z": wz}}


async def test_a_twist_drives_under_the_name_of_its_node():
    async with scene() as found, found.node() as node:
        await drive(node, found, twist(), times=20)
        await found.until(lambda: found.requests.latest is not None)
        request = found.requests.latest
        assert (request.source, request.role, request.lease) == ("ros2:teleop", Role.STATION, 0.25)
        assert (request.twist.vx, request.twist.vy, request.twist.wz) == (0.1, 0.0, 0.2)
        assert found.operators.refused == 0


async def test_each_node_is_a_source_of_its_own_and_leaves_with_its_tokens():
    async with scene() as found:
        async with found.node("one") as one, found.node("two") as two:
            await asyncio.gather(drive(one, found, twist(), times=10), drive(two, found, twist(-0.1), times=10))
            await found.until(lambda: len(found.operators.sources) == 2)
            sources = {request.source for request in found.requests.drain()}
            assert sources == {"ros2:one", "ros2:two"}
        await found.until(lambda: not found.operators.sources)


async def test_a_number_that_is_none_reaches_the_gate_which_refuses_it_by_name():
    async with scene() as found, found.node() as node:
        await drive(node, found, twist(math.nan), times=10)
        await found.until(lambda: found.requests.latest is not None)
        assert math.isnan(found.requests.latest.twist.vx)


async def hostile(found, messages, *, gid=None):
    """Puts messages (values, sequence, age in s) with a gid of no token, or that of a node."""
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(found.ros, ""))))
    try:
        clock = WallClock()
        for values, sequence, age in messages:
            stamp = clock.now() + clock.real_offset() - round(age * SECOND)
            attachment = Attachment(sequence, stamp, gid or bytes(16)).packed()
            session.put(data_key(0, "/cmd_vel", TWIST), encode(TWIST, values), attachment=attachment)
            await asyncio.sleep(0.02)
        await asyncio.sleep(0.3)
    finally:
        await asyncio.to_thread(session.close)


async def test_an_unknown_publisher_is_refused():
    async with scene() as found:
        await hostile(found, [(twist(), number, 0.0) for number in range(1, 21)])
        assert found.requests.latest is None
        assert found.operators.refused == 20
        assert "no publisher of this topic" in found.texts[0]


async def test_messages_that_are_old_or_come_again_are_refused():
    async with scene() as found, found.node() as node:
        heard = []
        listener = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(found.ros, ""))))
        listener.declare_subscriber(data_key(0, "/cmd_vel", TWIST), heard.append)
        await drive(node, found, twist(), times=20)
        await found.until(lambda: found.requests.latest is not None and heard)
        gid = Attachment.parse(heard[0].attachment.to_bytes()).gid
        await asyncio.to_thread(listener.close)
        await asyncio.sleep(0.2)
        found.requests.drain()
        await hostile(found, [(twist(), number, 0.0) for number in range(1, 11)], gid=gid)
        await hostile(found, [(twist(), 1000 + number, 30.0) for number in range(10)], gid=gid)
        assert found.requests.drain() == []
        assert any("repeated or out of order" in text for text in found.texts)
        assert any("30.0 s behind this clock" in text for text in found.texts)


@pytest.mark.parametrize(
    ("interface", "values", "why"),
    [
        (TWIST, {"linear": {"x": 0.1, "z": 1.0}}, "linear.z: expected 0"),
        (STAMPED, {"header": {"frame_id": "laser"}, "twist": twist()}, "frame 'laser': expected base_link"),
        (STAMPED, {"header": {"stamp": {"sec": 5}}, "twist": twist()}, "stamp is"),
    ],
)
async def test_what_the_robot_could_misunderstand_is_refused(interface, values, why):
    async with scene() as found, found.node() as node:
        await drive(node, found, values, interface, times=3)
        await found.until(lambda: found.texts)
        assert why in found.texts[0]
        assert found.requests.latest is None


async def test_a_flood_of_garbage_costs_no_exception_and_is_counted():
    async with scene() as found, found.node() as node:
        session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(found.ros, ""))))
        key = data_key(0, "/cmd_vel", TWIST)
        for size in range(2000):
            session.put(key, bytes(size % 50), attachment=None if size % 2 else bytes(size % 40))
        session.close()
        await drive(node, found, twist(), times=20)
        await found.until(lambda: found.requests.latest is not None)
        assert found.requests.latest.source == "ros2:teleop"


async def call(found, service, interface="std_srvs/srv/Trigger", request=None, name=None):
    client = ServiceClient(found.ros, name)
    try:
        return await client.ask(service, interface, request)
    finally:
        await asyncio.to_thread(client.close)


async def test_everybody_may_stop_but_only_known_clients_arm():
    async with scene() as found:
        assert (await call(found, "/truck/estop"))["success"]
        refused = await call(found, "/truck/arm")
        assert not refused["success"]
        assert "no client of this service" in refused["message"]
        assert (await call(found, "/truck/arm", name="rqt"))["success"]
        assert [outcome["source"] for outcome in found.outcomes] == ["face", "ros2:rqt"]


@pytest.mark.parametrize("order", [Order.DISARM, Order.RESET, Order.STOP])
async def test_orders_are_given_under_the_name_of_the_client_s_node(order):
    async with scene() as found:
        assert (await call(found, f"/truck/{order.value}", name="rqt"))["success"]
        assert [(outcome["source"], outcome["order"]) for outcome in found.outcomes] == [("ros2:rqt", order)]


async def publish_often(node, topic, interface, values):
    """The first message opens the session of the node."""
    publish = node.publisher(topic, interface, RELIABLE)
    await asyncio.sleep(0.3)  # until the graph has it
    for _ in range(20):
        publish(values)
        await asyncio.sleep(0.05)


async def test_an_ackermann_drive_is_a_speed_and_the_angle_of_the_front_axle():
    async with scene() as found, found.node() as node:
        values = {"drive": {"speed": 0.125, "steering_angle": -0.25}}
        await publish_often(node, "ackermann_cmd", "ackermann_msgs/msg/AckermannDriveStamped", values)
        await found.until(lambda: found.requests.latest is not None)
        request = found.requests.latest
        assert (request.source, request.speed, request.front, request.rear) == ("ros2:teleop", 0.125, -0.25, 0.0)
        refused = {"header": {"frame_id": "laser"}, **values}
        await publish_often(node, "ackermann_cmd", "ackermann_msgs/msg/AckermannDriveStamped", refused)
        assert "frame 'laser': expected base_link" in found.texts[-1]


async def test_a_goal_pose_is_a_goal_and_an_initial_pose_is_refused_with_the_reason():
    async with scene() as found, found.node("rviz") as node:
        goals = node.publisher("goal_pose", "geometry_msgs/msg/PoseStamped", RELIABLE)
        initial = node.publisher("initialpose", "geometry_msgs/msg/PoseWithCovarianceStamped", RELIABLE)
        await asyncio.sleep(0.3)
        goals(pose(3.0, "odom"))
        await found.until(lambda: found.outcomes)
        asked = found.outcomes[0]
        assert (asked["source"], asked["frame"], asked["goal"]["x"]) == ("ros2:rviz", "odom", 3.0)
        initial({"header": {"frame_id": "map"}})
        await found.until(lambda: found.texts)
        assert "by its own scans" in found.texts[0]


async def test_a_face_that_does_not_drive_still_stops():
    async with scene(FaceOptions(drives=False)) as found, found.node() as node:
        await drive(node, found, twist(), times=5)
        assert (await call(found, "/truck/estop"))["success"]
        assert found.requests.latest is None
        assert not found.operators.sources


async def test_a_second_face_of_the_robot_is_refused():
    async with scene() as found:
        with pytest.raises(BusyError, match="already has a node /truck"):
            async with ZenohNode(("truck", "/"), 0, session_settings(found.ros, ""), WallClock()):
                pass


def scan(stamp):
    ranges, codes = np.array([1.0, np.inf, np.inf]), np.array([255, 2, 7], np.uint8)
    return LaserScan(
        stamp=stamp,
        received=stamp,
        seq=1,
        frame="lidar",
        start_angle=-1.0,
        end_angle=1.0,
        time_increment=0.001,
        scan_time=0.1,
        range_min=0.1,
        range_max=5.0,
        ranges=ranges,
        codes=codes,
    )


async def test_topics_have_ros_s_frames_stamps_and_values_and_reach_who_comes_late():
    async with scene(FaceOptions(prefix="t1/")) as found:
        put = {
            t.SCAN: scan(5 * SECOND),
            t.SCAN_2: scan(6 * SECOND).model_copy(update={"frame": "lidar_2"}),
            t.ODOMETRY: odometry(3).model_copy(update={"frame": "odom"}),
            t.TRANSFORMS: Transforms(
                stamp=9,
                received=9,
                seq=1,
                frame="map",
                transforms=(planar("map", "odom", 9, (1.0, 0.0, 0.0)), mount("lidar", (0.2, 0.0, 0.1))),
            ),
            t.MAP: Grid(
                stamp=9, received=9, seq=1, frame="map", resolution=0.5, width=2, height=2,
                origin=Pose2D(x=-1.0, y=-1.0, yaw=0.0), cells=np.array([0, 100, -1, 0], np.int8),
            ),
        }  # fmt: skip
        reader = Reader(found)
        try:
            for name in ("/scan", "/scan_2"):
                reader.follow(name, "sensor_msgs/msg/LaserScan")
            await asyncio.sleep(0.3)
            for topic, message in put.items():
                found.robot.bus.publisher(topic, topic.writer).put(message)
            await found.until(lambda: len(reader.messages) == 2)
            assert reader.messages["/scan_2"]["header"]["frame_id"] == "t1/laser_2"
            ros = reader.messages["/scan"]
            assert ros["header"] == {"stamp": {"sec": 1_000_005, "nanosec": 0}, "frame_id": "t1/laser"}
            assert ros["ranges"][:2].tolist() == [1.0, math.inf]
            assert math.isnan(ros["ranges"][2])
            for topic, interface in {
                "/map": "nav_msgs/msg/OccupancyGrid",
                "/tf_static": "tf2_msgs/msg/TFMessage",
                "/robot_description": "std_msgs/msg/String",
            }.items():
                reader.follow(topic, interface)
            await found.until(lambda: len(reader.messages) == 5)
            assert reader.messages["/map"]["data"].tolist() == [0, 100, -1, 0]
            frames = {
                (row["header"]["frame_id"], row["child_frame_id"])
                for row in reader.messages["/tf_static"]["transforms"]
            }
            assert frames == {("t1/base_link", "t1/laser"), ("t1/base_link", "t1/base_footprint")}
            assert 'name="t1/base_link"' in reader.messages["/robot_description"]["data"]
        finally:
            reader.close()


@pytest.mark.parametrize(("kept", "expected"), [(True, {"odom", "base_link"}), (False, set())])
async def test_who_publishes_the_moving_frames_is_chosen(kept, expected):
    async with scene(FaceOptions(map_to_odom=kept, odom_to_base=kept)) as found:
        children = set()
        reader = Reader(found)
        try:
            session = reader._session
            interface = "tf2_msgs/msg/TFMessage"

            def take(sample):
                rows = decode(interface, sample.payload.to_bytes())["transforms"]
                children.update(row["child_frame_id"] for row in rows)

            kept_alive = session.declare_subscriber(data_key(0, "/tf", interface), take)
            await asyncio.sleep(0.3)
            tree = Transforms(
                stamp=9, received=9, seq=1, frame="map", transforms=(planar("map", "odom", FIXED, (0.0, 0.0, 0.0)),)
            )
            found.robot.bus.publisher(t.TRANSFORMS, t.TRANSFORMS.writer).put(tree)
            moved = odometry(3).model_copy(update={"frame": "odom"})
            found.robot.bus.publisher(t.ODOMETRY, t.ODOMETRY.writer).put(moved)
            await asyncio.sleep(0.5)
            assert children == expected
            kept_alive.undeclare()
        finally:
            reader.close()


def test_of_a_port_that_is_taken_the_next_one_is_listened_at():
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert next_endpoint(f"tcp/127.0.0.1:{port}") == f"tcp/127.0.0.1:{port + 1}"


ACTION = "nav2_msgs/action/NavigateToPose"


async def send(client, number, goal, tree=""):
    request = {"goal_id": {"uuid": bytes([number]) * 16}, "goal": {"pose": goal, "behavior_tree": tree}}
    return await client.ask("/navigate_to_pose/_action/send_goal", f"{ACTION}_SendGoal", request)


async def result_of(client, number):
    request = {"goal_id": {"uuid": bytes([number]) * 16}}
    return await client.ask("/navigate_to_pose/_action/get_result", f"{ACTION}_GetResult", request)


async def test_a_goal_is_driven_with_feedback_for_jazzy_and_lyrical_and_a_result():
    async with scene() as found, asking(found) as client:
        reader = Reader(found)
        reader.follow("/navigate_to_pose/_action/feedback", f"{ACTION}_FeedbackMessage")
        lyrical = []
        key = data_key(0, "/navigate_to_pose/_action/feedback", f"{ACTION}@lyrical_FeedbackMessage")
        kept = client.session.declare_subscriber(key, lyrical.append)
        assert (await send(client, 1, pose(2.0)))["accepted"]
        assert await result_of(client, 1) == {"status": 4, "result": {"error_code": 0, "error_msg": ""}}
        feedback = reader.messages["/navigate_to_pose/_action/feedback"]
        assert bytes(feedback["goal_id"]["uuid"]) == bytes([1]) * 16
        assert lyrical
        kept.undeclare()
        reader.follow("/navigate_to_pose/_action/status", "action_msgs/msg/GoalStatusArray")
        await found.until(lambda: len(reader.messages) == 2)
        (row,) = reader.messages["/navigate_to_pose/_action/status"]["status_list"]
        assert row["status"] == 4
        reader.close()
        assert found.outcomes[0]["source"] == "ros2:nav"
        assert found.outcomes[0]["goal"] == {"x": 2.0, "y": 0.0, "yaw": 0.0}


async def test_a_goal_without_a_route_ends_with_its_reason():
    async with scene() as found, asking(found) as client:
        assert (await send(client, 2, pose(200.0)))["accepted"]
        result = await result_of(client, 2)
        assert result["status"] == 6
        assert "no_map" in result["result"]["error_msg"]
        assert "a wall is in the way" in result["result"]["error_msg"]


async def test_a_goal_is_cancelled_once():
    async with scene() as found, asking(found) as client:
        assert (await send(client, 3, pose(70.0)))["accepted"]
        await found.until(lambda: found.outcomes)
        request = {"goal_info": {"goal_id": {"uuid": bytes([3]) * 16}}}
        cancel = partial(client.ask, "/navigate_to_pose/_action/cancel_goal", "action_msgs/srv/CancelGoal", request)
        answer = await cancel()
        assert (answer["return_code"], len(answer["goals_canceling"])) == (0, 1)
        assert (await result_of(client, 3))["status"] == 5
        assert (await cancel())["return_code"] == 3
        assert found.outcomes[-1]["own"] is True


@pytest.mark.parametrize(
    ("goal", "tree", "why"),
    [(pose(1.0, "laser"), "", "expected map or odom"), (pose(1.0), "tree.xml", "behavior_tree: expected none")],
)
async def test_a_goal_that_means_something_else_is_not_accepted(goal, tree, why):
    async with scene() as found, asking(found) as client:
        assert not (await send(client, 4, goal, tree))["accepted"]
        assert why in found.texts[0]
        assert (await result_of(client, 4))["status"] == 0


@pytest.mark.parametrize(
    ("number", "stamp", "code", "meant"),
    [
        (bytes(16), 0, CancelCode.NONE, [b"a", b"b"]),
        (bytes(16), 15, CancelCode.NONE, [b"a"]),
        (b"b" * 16, 15, CancelCode.NONE, [b"a", b"b"]),
        (b"c" * 16, 0, CancelCode.TERMINATED, []),
        (b"x" * 16, 0, CancelCode.UNKNOWN_GOAL, []),
        (bytes(16), 5, CancelCode.REJECTED, []),
    ],
)
def test_a_cancel_request_means_one_goal_all_or_all_until_a_time(number, stamp, code, meant):
    goals = {name * 16: ActionGoal(name * 16, at, None) for name, at in ((b"a", 10), (b"b", 20), (b"c", 30))}
    goals[b"c" * 16].status = GoalStatus.SUCCEEDED
    found, chosen_goals = chosen(goals, number, stamp)
    assert (found, [goal.number[:1] for goal in chosen_goals]) == (code, meant)


async def test_live_settings_are_parameters():
    name, kind = "gate.limits.speed", "rcl_interfaces/srv"
    async with scene() as found, asking(found, "rqt") as client:
        listed = await client.ask("/truck/list_parameters", f"{kind}/ListParameters")
        assert listed["result"]["names"] == [name]
        names = {"names": [name, "nothing"]}
        types = await client.ask("/truck/get_parameter_types", f"{kind}/GetParameterTypes", names)
        assert types["types"].tolist() == [3, 0]
        described = await client.ask("/truck/describe_parameters", f"{kind}/DescribeParameters", names)
        row = described["descriptors"][0]
        assert (row["description"], row["floating_point_range"][0]["to_value"]) == ("Speed, m/s", 0.3)
        value = {"type": 3, "double_value": 0.2}
        change = {"parameters": [{"name": name, "value": value}]}
        changed = await client.ask("/truck/set_parameters", f"{kind}/SetParameters", change)
        assert changed["results"] == [{"successful": True, "reason": ""}]
        got = await client.ask("/truck/get_parameters", f"{kind}/GetParameters", names)
        assert [row["double_value"] for row in got["values"]] == [0.2, 0.0]
        assert found.outcomes[-1]["source"] == "ros2:rqt"
        value["double_value"] = 9.0
        refused = await client.ask("/truck/set_parameters_atomically", f"{kind}/SetParametersAtomically", change)
        assert not refused["result"]["successful"]
        assert "expected at most 0.3" in refused["result"]["reason"]
