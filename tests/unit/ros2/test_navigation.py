"""Actions of Nav2 and its lifecycle managers, asked by a client with tokens over the wire of rmw_zenoh."""

import asyncio
import math
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from monstertruck_estimation.transforms import planar
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics as t
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import Transforms
from monstertruckd.ros2.actions import GoalStatus
from monstertruckd.ros2.cdr import decode
from monstertruckd.ros2.interfaces import action_edition
from monstertruckd.ros2.navigation import NavigateThroughPoses, path_in
from monstertruckd.ros2.rmw import RELIABLE, data_key
from tests.bus_kit import odometry
from tests.ros2_kit import FACTS, Reader, asking, pose, scene

THROUGH, FOLLOW = "nav2_msgs/action/NavigateThroughPoses", "nav2_msgs/action/FollowPath"


def uuid(number):
    return {"uuid": bytes([number]) * 16}


async def send(client, action, interface, number, goal):
    request = {"goal_id": uuid(number), "goal": goal}
    return await client.ask(f"/{action}/_action/send_goal", f"{interface}_SendGoal", request)


async def result_of(client, action, interface, number):
    return await client.ask(f"/{action}/_action/get_result", f"{interface}_GetResult", {"goal_id": uuid(number)})


async def cancel(client, action, number):
    request = {"goal_info": {"goal_id": uuid(number)}}
    return await client.ask(f"/{action}/_action/cancel_goal", "action_msgs/srv/CancelGoal", request)


class Feedback:
    """Feedback of an action by one of its editions."""

    def __init__(self, client, action, interface):
        self.rows = []
        key = data_key(0, f"/{action}/_action/feedback", f"{interface}_FeedbackMessage")

        def take(sample):
            self.rows.append(decode(f"{interface}_FeedbackMessage", sample.payload.to_bytes())["feedback"])

        self._kept = client.session.declare_subscriber(key, take)


@pytest.mark.parametrize(
    ("edition", "poses"),
    [
        (THROUGH, [pose(1.0), pose(2.0)]),
        (f"{THROUGH}@kilted", {"header": {"frame_id": "map"}, "goals": [pose(1.0, ""), pose(2.0, "")]}),
        (f"{THROUGH}@lyrical", {"header": {"frame_id": "map"}, "goals": [pose(1.0), pose(2.0)]}),
    ],
)
async def test_poses_are_driven_through_by_every_edition(edition, poses):
    async with scene() as found, asking(found) as client:
        feedback = Feedback(client, "navigate_through_poses", edition)
        assert (await send(client, "navigate_through_poses", edition, 1, {"poses": poses}))["accepted"]
        result = await result_of(client, "navigate_through_poses", edition, 1)
        assert (result["status"], result["result"]["error_msg"]) == (4, "")
        if edition != THROUGH:
            statuses = [row["waypoint_status"] for row in result["result"]["waypoint_statuses"]]
            assert statuses == [1, 1]
        asked = found.outcomes[0]
        assert asked["waypoints"] == [{"x": 1.0, "y": 0.0, "yaw": 0.0}]
        assert asked["goal"] == {"x": 2.0, "y": 0.0, "yaw": 0.0}
        assert asked["frame"] == "map"
        assert feedback.rows[0]["distance_remaining"] == 2.5
        assert feedback.rows[0]["number_of_recoveries"] == 1


async def test_poses_through_which_the_robot_cannot_drive_end_with_the_reason_and_cancelled_ones_with_theirs():
    async with scene() as found, asking(found) as client:
        far = {"poses": {"header": {"frame_id": "map"}, "goals": [pose(1.0), pose(200.0)]}}
        edition = f"{THROUGH}@kilted"
        assert (await send(client, "navigate_through_poses", edition, 1, far))["accepted"]
        result = await result_of(client, "navigate_through_poses", edition, 1)
        assert result["status"] == 6
        assert "a wall is in the way" in result["result"]["error_msg"]
        assert [row["waypoint_status"] for row in result["result"]["waypoint_statuses"]] == [3, 3]
        assert (await send(client, "navigate_through_poses", THROUGH, 2, {"poses": [pose(60.0)]}))["accepted"]
        await found.until(lambda: len(found.outcomes) == 2)
        assert (await cancel(client, "navigate_through_poses", 2))["return_code"] == 0
        assert (await result_of(client, "navigate_through_poses", THROUGH, 2))["status"] == 5
        assert found.outcomes[-1]["own"] is True


@pytest.mark.parametrize(
    ("goal", "why"),
    [
        ({"poses": []}, "expected at least one"),
        ({"poses": [pose(1.0), pose(2.0, "odom")]}, "expected one frame"),
        ({"poses": [pose(1.0, "laser")]}, "expected map or odom"),
        ({"poses": [pose(1.0)], "behavior_tree": "a.xml"}, "the robot plans itself"),
    ],
)
async def test_poses_that_mean_something_else_are_not_accepted(goal, why):
    async with scene() as found, asking(found) as client:
        assert not (await send(client, "navigate_through_poses", THROUGH, 1, goal))["accepted"]
        assert why in found.texts[0]
        assert not found.outcomes


def test_passed_poses_are_completed_in_the_statuses():
    action = NavigateThroughPoses.__new__(NavigateThroughPoses)
    action._pose_in = lambda row: ((row["pose"]["position"]["x"], 0.0, 0.0), "map")
    work = action.read({"behavior_tree": "", "poses": [pose(1.0), pose(2.0), pose(3.0)]})
    work.passed = 1
    for status, rest in ((GoalStatus.CANCELED, 0), (GoalStatus.ABORTED, 3), (GoalStatus.SUCCEEDED, 1)):
        rows = action.result(work, status)["waypoint_statuses"]
        assert [row["waypoint_status"] for row in rows] == [1, rest, rest]


# Paths


@asynccontextmanager
async def tracking(found, *, refuses=False):
    """A tracker that follows every path to its end, but those that begin beyond x = 50."""
    bus = found.robot.bus
    paths, states = bus.publisher(t.PATH, t.Writer.PLANNER), bus.publisher(t.TRACKER, t.Writer.PLANNER)
    places, events = bus.publisher(t.ODOMETRY, t.Writer.ESTIMATION), bus.event_sink()
    received = []

    def state(path, along, outcome):
        fields = {"cross_track": 0.01, "heading_error": 0.0, "along": along, "length": 2.0, "outcome": outcome}
        states.put(TrackerState(stamp=1, received=1, seq=states.next_seq(), path=path.name, **fields))

    async def follow():
        async for request in bus.subscribe(t.REQ_PATH, latest()):
            received.append(request)
            if refuses:
                events(Reason.BUSY, Severity.WARNING, request.source, "path refused: it drives")
                continue
            paths.put(request.path.model_copy(update={"seq": paths.next_seq()}))
            if not request.path.halts:
                await asyncio.sleep(0.1)
                places.put(odometry(places.next_seq()))
                state(request.path, 0.5, Reason.DRIVING)
                await asyncio.sleep(0.1)
                state(request.path, 0.7, Reason.DRIVING)
                if request.path.poses[0] < 50.0:
                    state(request.path, 2.0, Reason.GOAL_REACHED)

    task = asyncio.create_task(follow())
    await asyncio.sleep(0)
    try:
        yield received
    finally:
        task.cancel()


def line(x=0.0, frame="map"):
    return {"path": {"header": {"frame_id": frame}, "poses": [pose(x + step / 4) for step in range(9)]}}


@pytest.mark.parametrize("edition", [FOLLOW, f"{FOLLOW}@lyrical"])
async def test_a_path_is_followed_with_feedback_and_a_result(edition):
    async with scene() as found, asking(found) as client, tracking(found) as received:
        feedback = Feedback(client, "follow_path", edition)
        assert (await send(client, "follow_path", edition, 1, line()))["accepted"]
        result = await result_of(client, "follow_path", edition, 1)
        assert (result["status"], result["result"]["error_code"]) == (4, 0)
        path = received[0].path
        assert path.frame == "map"
        assert received[0].source == "ros2:nav"
        assert path.poses.reshape(-1, 3)[:, 0].tolist() == [step / 4 for step in range(9)]
        rows = [row.get("tracking_feedback", row) for row in feedback.rows]
        assert rows
        assert 0.0 <= rows[-1]["distance_to_goal"] <= 1.5


async def test_a_path_is_cancelled_by_a_stop_and_withdrawn():
    async with scene() as found, asking(found) as client, tracking(found) as received:
        assert (await send(client, "follow_path", FOLLOW, 1, line(60.0)))["accepted"]
        await found.until(lambda: received)
        await asyncio.sleep(0.3)
        assert (await cancel(client, "follow_path", 1))["return_code"] == 0
        assert (await result_of(client, "follow_path", FOLLOW, 1))["status"] == 5
        assert [outcome["order"] for outcome in found.outcomes] == [Order.STOP]
        assert received[-1].path.halts


async def test_a_path_that_the_robot_refuses_ends_with_the_reason():
    async with scene() as found, asking(found) as client, tracking(found, refuses=True):
        assert (await send(client, "follow_path", FOLLOW, 1, line()))["accepted"]
        result = await result_of(client, "follow_path", FOLLOW, 1)
        assert result["status"] == 6
        assert "busy" in result["result"]["error_msg"]


def read_pose(row):
    place, turn = row["pose"]["position"], row["pose"]["orientation"]
    return (place["x"], 0.0, 2.0 * math.atan2(turn.get("z", 0.0), turn.get("w", 1.0))), "map"


def heading(x, yaw):
    row = pose(x)
    row["pose"]["orientation"] = {"z": math.sin(yaw / 2.0), "w": math.cos(yaw / 2.0)}
    return row


@pytest.mark.parametrize(
    ("rows", "directions"),
    [
        ([heading(0.0, 0.0), heading(1.0, 0.0)], [1.0, 1.0]),
        ([heading(0.0, math.pi), heading(1.0, math.pi), heading(2.0, math.pi)], [-1.0, -1.0, -1.0]),
        # orientations that the planner did not set, but for the goal's
        ([heading(0.0, 0.0), heading(-1.0, 0.0), heading(-2.0, 3.0)], [1.0, 1.0, 1.0]),
        ([heading(0.0, 0.1), heading(1.0, 0.1), heading(0.5, 0.1)], [1.0, 1.0, -1.0]),
    ],
)
def test_a_path_is_driven_backward_where_its_poses_face_away_from_it(rows, directions):
    path = path_in({"header": {}, "poses": rows}, read_pose, 0)
    assert path.directions.tolist() == directions


@pytest.mark.parametrize("count", [0, 1, 5001])
def test_a_path_too_short_or_too_long_is_refused(count):
    with pytest.raises(InputError, match="expected 2 to 5000"):
        path_in({"header": {}, "poses": [pose(0.0)] * count}, read_pose, 0)


# Editions and lifecycle


@pytest.mark.parametrize(
    ("action", "editions"),
    [
        ("nav2_msgs/action/NavigateToPose", ["@humble", "", "", "@lyrical"]),
        (THROUGH, ["@humble", "", "@kilted", "@lyrical"]),
        (FOLLOW, ["@humble", "", "", "@lyrical"]),
    ],
)
def test_each_distribution_has_one_edition_of_an_action(action, editions):
    names = ["humble", "jazzy", "kilted", "lyrical"]
    assert [action_edition(action, name) for name in names] == [f"{action}{mark}" for mark in editions]


async def manage(client, command, manager="navigation"):
    request = {"command": command}
    service = f"/lifecycle_manager_{manager}/manage_nodes"
    return (await client.ask(service, "nav2_msgs/srv/ManageLifecycleNodes", request))["success"]


async def active(client, manager="navigation"):
    return (await client.ask(f"/lifecycle_manager_{manager}/is_active", "std_srvs/srv/Trigger"))["success"]


async def test_the_panel_of_nav2_sees_the_planner_and_pauses_it():
    async with scene() as found, asking(found) as client:
        health = found.robot.bus.publisher(t.HEALTH, t.Writer.DAEMON)
        assert not await active(client)
        ready = [ServiceHealth(name=name, state=ServiceState.READY, since=0) for name in ("goals", "slam")]
        health.put(HealthTable(stamp=1, received=1, seq=1, services=tuple(ready)))
        await asyncio.sleep(0.3)
        assert await active(client)
        assert await active(client, "localization")
        go = partial(send, client, "navigate_through_poses", THROUGH)
        assert (await go(1, {"poses": [pose(60.0)]}))["accepted"]
        await found.until(lambda: found.outcomes)
        assert await manage(client, 1)  # pause
        assert not await active(client)
        assert (await result_of(client, "navigate_through_poses", THROUGH, 1))["status"] == 5
        assert not (await go(2, {"poses": [pose(1.0)]}))["accepted"]
        assert "navigation is paused" in found.texts[-1]
        assert await manage(client, 2)  # resume
        assert await active(client)
        assert (await go(3, {"poses": [pose(1.0)]}))["accepted"]
        assert not await manage(client, 1, "localization")
        assert await manage(client, 2, "localization")
        assert not await manage(client, 99)


def test_positions_in_the_order_of_the_message():
    path = path_in({"header": {}, "poses": [heading(0.0, 0.0), heading(1.0, 0.0)]}, read_pose, 5)
    assert np.array_equal(path.poses, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    assert path.stamp == 5


# ROS 2 in the robot's place


def map_to_odom(x, parent="map", child="odom"):
    row = {"translation": {"x": x}, "rotation": {"w": 1.0}}
    return {"transforms": [{"header": {"frame_id": parent}, "child_frame_id": child, "transform": row}]}


async def publish_tf(node, rows):
    publish = node.publisher("/tf", "tf2_msgs/msg/TFMessage", RELIABLE)
    await asyncio.sleep(0.3)  # until the graph has it
    for row in rows:
        publish(row)
        await asyncio.sleep(0.11)


async def test_a_robot_that_ros_2_localises_gets_map_to_odom_and_publishes_none():
    facts = replace(FACTS, localised=False)
    async with scene(facts=facts) as found, found.node("amcl") as node:
        corrections = found.robot.bus.subscribe(t.REQ_LOCALISATION, fifo(100))
        reader = Reader(found)
        reader.follow("/tf", "tf2_msgs/msg/TFMessage")
        tree = Transforms(
            stamp=9, received=9, seq=1, frame="map", transforms=(planar("map", "odom", 9, (7.0, 0.0, 0.0)),)
        )
        found.robot.bus.publisher(t.TRANSFORMS, t.TRANSFORMS.writer).put(tree)
        foreign = [map_to_odom(9.0, "map", "other"), map_to_odom(9.0, "world", "odom")]
        await publish_tf(node, [*foreign, *(map_to_odom(step / 10) for step in range(1, 9))])
        await found.until(lambda: corrections.latest is not None)
        received = corrections.drain()
        assert {request.source for request in received} == {"ros2:amcl"}
        assert received[-1].correction.x == pytest.approx(0.8)
        assert 9.0 not in {request.correction.x for request in received}
        sent = reader.messages.get("/tf", {"transforms": []})["transforms"]
        assert 7.0 not in {row["transform"]["translation"]["x"] for row in sent}
        reader.close()


async def test_where_nav2_plans_no_goal_is_taken_from_ros_2():
    async with scene(facts=replace(FACTS, plans=False)) as found, found.node("rviz") as node, asking(found) as client:
        publish = node.publisher("goal_pose", "geometry_msgs/msg/PoseStamped", RELIABLE)
        await asyncio.sleep(0.3)
        publish(pose(1.0))
        tokens = await asyncio.to_thread(lambda: list(client.session.liveliness().get("@ros2_lv/0/**", timeout=0.5)))
        served = [str(reply.ok.key_expr) for reply in tokens if "/truck/" in str(reply.ok.key_expr)]
        assert any("%cmd_vel" in key for key in served)
        assert not any("navigate" in key or "lifecycle" in key or "goal_pose" in key for key in served)
        assert not found.outcomes
