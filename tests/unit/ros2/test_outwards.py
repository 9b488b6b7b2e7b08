"""Every message that the robot can publish becomes messages of ROS 2; RViz is configured to show them."""

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.yaml_files import read_yaml
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.body import LensConfig
from monstertruck_schemas.plan import ExplorationPhase, ExplorationState, GoalPhase, GoalState
from monstertruck_schemas.sensor import Battery, BatteryLevel, DriveFeedback, DriveMode, SteeringFeedback
from monstertruck_schemas.state import Grid, Ground, Peer, Peers
from monstertruck_schemas.zones import Zone, ZoneMask, Zones
from monstertruckd.config.load import load_truck
from monstertruckd.ros2 import convert
from monstertruckd.ros2.cdr import decode, encode
from monstertruckd.ros2.convert import RosNames
from monstertruckd.ros2.face import FaceOptions, RosFace
from monstertruckd.ros2.facts import RobotFacts, WheelJoints, renamed_links
from monstertruckd.ros2.serve import RVIZ
from tests.daemon.wall_kit import ROOT
from tests.unit.runtime import messages


class Recorder:
    """A node that keeps what is published, encoded and read back."""

    def __init__(self):
        self.topics = {}
        self.messages = []

    def publisher(self, topic, interface, qos):
        self.topics[topic] = interface, qos

        def publish(values):
            self.messages.append((topic, decode(interface, encode(interface, values))))

        return publish


def face(recorder, **options):
    facts = RobotFacts(0.4, 0.3, LensConfig(), '<robot><link name="base" /></robot>')
    return RosFace(None, recorder, None, facts, FaceOptions(**options), WallClock())


ROWS = {topic: number for number, (topic, _) in enumerate(face(Recorder())._rows())}


@pytest.mark.parametrize("topic", ROWS, ids=lambda topic: topic.name)
def test_every_message_of_a_topic_is_converted(topic):
    @settings(max_examples=5, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(messages.of(topic))
    def check(message):
        recorder = Recorder()
        (*_, take) = [take for row, take in face(recorder)._rows() if row is topic]
        take(message)
        for name, values in recorder.messages:
            assert name
            assert values is not None

    check()


def published():
    """Interface and quality of service by topic, of one message of each."""
    recorder = Recorder()
    own = face(recorder)
    own._describe()

    @settings(max_examples=1, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(st.tuples(*(messages.of(topic) for topic in ROWS)))
    def publish(all_of_them):
        for (_, take), message in zip(own._rows(), all_of_them, strict=True):
            take(message)

    publish()
    return recorder.topics


KINDS = {
    "RobotModel": "std_msgs/msg/String",
    "Map": "nav_msgs/msg/OccupancyGrid",
    "LaserScan": "sensor_msgs/msg/LaserScan",
    "Path": "nav_msgs/msg/Path",
    "Odometry": "nav_msgs/msg/Odometry",
    "PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
}


def test_displays_of_rviz_read_topics_as_the_face_publishes_them():
    found = published()
    shown = 0
    for display in read_yaml(RVIZ)["Visualization Manager"]["Displays"]:
        topic = display.get("Topic") or display.get("Description Topic")
        if topic is None or topic["Value"] == "/gate":  # once a second, by the gate's state
            continue
        interface, qos = found[topic["Value"].strip("/")]
        shown += 1
        assert interface == KINDS[display["Class"].rpartition("/")[2]]
        assert (topic["Durability Policy"] == "Transient Local") == qos.latched
        assert (topic["Reliability Policy"] == "Best Effort") == (not qos.reliable)
    assert shown == 8


def grid(x, y, width, height):
    cells = np.arange(width * height, dtype=np.int8)
    origin = Pose2D(x=x, y=y, yaw=0.0)
    header = {"stamp": 1, "received": 1, "seq": 1, "frame": "map"}
    return Grid(**header, resolution=0.5, width=width, height=height, origin=origin, cells=cells)


def test_a_tile_is_placed_on_the_map_and_what_lies_beside_it_is_left_out():
    whole = grid(-1.0, -1.0, 4, 4)
    update = convert.grid_update(grid(0.0, -1.5, 3, 3), whole, convert.RosNames())
    assert [update[name] for name in ("x", "y", "width", "height")] == [2, 0, 2, 2]
    assert update["data"].tolist() == [3, 4, 6, 7]
    assert convert.grid_update(grid(9.0, 0.0, 2, 2), whole, convert.RosNames()) is None


@pytest.mark.parametrize(("current", "status"), [(None, 2), (-1.5, 2), (0.8, 1)])
def test_a_battery_has_its_current_and_whether_it_is_charged(current, status):
    header = {"stamp": 1, "received": 1, "seq": 1}
    battery = Battery(**header, raw_voltage=11.1, cells=3, level=BatteryLevel.NORMAL, current=current)
    values = convert.battery(battery, RosNames())
    assert values["power_supply_status"] == status
    assert values["current"] == pytest.approx(math.nan if current is None else current, nan_ok=True)


def test_a_map_is_published_again_only_when_it_has_changed():
    recorder = Recorder()
    own = face(recorder)
    for message in (grid(0.0, 0.0, 2, 2), grid(0.0, 0.0, 2, 2).model_copy(update={"stamp": 5, "seq": 2})):
        own._whole_map(message)
    own._whole_map(grid(0.5, 0.0, 2, 2))
    assert [topic for topic, _ in recorder.messages] == ["map", "map"]


def test_wheels_point_along_the_circle_that_the_truck_drives():
    chassis = load_truck(ROOT / "configs" / "demo.yaml")[0].chassis()
    servos = chassis.servos(0.2, -0.2)
    header = {"stamp": 1, "received": 1, "seq": 1}
    steering = SteeringFeedback(**header, front=servos[0], rear=servos[1])
    drive = DriveFeedback(**header, position=644.0, velocity=0.0, mode=DriveMode.ENABLED)
    angles = WheelJoints(chassis, 0.3, 644.0).angles(steering, drive)
    inner, outer = angles["front_left_steer"], angles["front_right_steer"]
    assert inner > 0.2 > outer > 0.0
    bicycle = chassis.bicycle
    centres = [
        bicycle.l_f / math.tan(angle) + side * 0.15 for angle, side in ((inner, 1.0), (outer, -1.0))
    ]  # where the wheels' axles meet, m to the left of the truck
    assert centres[0] == pytest.approx(centres[1], abs=1e-3)
    assert angles["rear_left_steer"] == pytest.approx(-inner, abs=1e-6)
    assert angles["front_left_spin"] == 1.0


def test_links_of_the_description_have_the_frames_of_ros():
    links = '<link name="base"/><link name="lidar"/>'
    urdf = f'<robot name="r">{links}<joint name="lidar"><parent link="base"/></joint></robot>'
    text = renamed_links(urdf, convert.prefixed("t1/"))
    assert '<link name="t1/base_link" />' in text
    assert '<link name="t1/laser" />' in text
    assert '<joint name="lidar"><parent link="t1/base_link" />' in text
    assert t.SCAN in ROWS


def known_ground(tilt):
    fields = {"resolution": 0.1, "width": len(tilt), "height": 1, "origin": Pose2D(x=0.0, y=0.0, yaw=0.0)}
    cells = np.array(tilt, np.uint8)
    return Ground(stamp=1, received=1, seq=1, frame="map", **fields, tilt=cells, roughness=cells)


def test_the_tilt_of_the_ground_is_in_degrees_and_unknown_ground_stays_unknown():
    cells = convert.ground(known_ground([0, 35, 254, 255]), RosNames())["data"]
    assert cells.tolist() == [0, 10, 73, -1]  # 35 * 0.005 rad are 10 degrees


def test_the_goal_the_next_frontier_and_robots_heard_lately_are_marked():
    header = {"stamp": 10 * SECOND, "received": 0, "seq": 0, "frame": "map"}
    there = Pose2D(x=1.0, y=2.0, yaw=0.0)
    goal = GoalState(**header, goal=there, phase=GoalPhase.DRIVING)
    exploration = ExplorationState(**header, target=there, phase=ExplorationPhase.DRIVING, frontiers=3)
    still = {"pose": there, "twist": Twist2D(vx=0.0, vy=0.0, wz=0.0)}
    peers = [Peer(robot=name, heard=heard * SECOND, **still) for name, heard in (("ann", 9), ("bob", 5))]
    values = convert.task_markers(goal, exploration, Peers(**header, peers=tuple(peers)), RosNames())
    encode("visualization_msgs/msg/MarkerArray", values)
    first, *markers = values["markers"]
    assert first["action"] == 3
    assert [row["ns"] for row in markers] == ["goal", "frontier", "frontier", "peers", "peers"]
    assert [row["text"] for row in markers if "text" in row] == ["3 frontiers", "ann"]
    assert markers[0]["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 0.0}
    ended = goal.model_copy(update={"phase": GoalPhase.IDLE})
    assert len(convert.task_markers(ended, None, None, RosNames())["markers"]) == 1


def test_zones_are_polygons_with_their_names_and_grey_while_off():
    corners = ((0.0, 0.0), (2.0, 0.0), (1.0, 3.0))
    mask = ZoneMask(resolution=0.1, width=1, height=1, x=0.0, y=0.0, limits=(0.0,), runs=(1, 1))
    zones = (
        Zone(name="stairs", kind="keepout", corners=corners),
        Zone(name="keepout_mask", kind="keepout", mask=mask),
        Zone(name="hall", kind="speed", corners=corners, limit=0.1, off_until=5),
    )
    markers = convert.zone_markers(Zones(stamp=0, received=0, seq=0, zones=zones), RosNames())["markers"]
    assert [one["ns"] for one in markers] == ["zones"] * 5
    assert len({one.get("id") for one in markers}) == 5
    keepout, words, speed = markers[1], markers[2], markers[3]
    assert [(at["x"], at["y"]) for at in keepout["points"]] == [*corners, corners[0]]
    assert words["text"] == "stairs"
    assert words["pose"]["position"] == {"x": 1.0, "y": 1.0, "z": 0.0}
    assert markers[4]["text"] == "hall 0.1 m/s"
    assert speed["color"]["r"] == speed["color"]["g"] == speed["color"]["b"]
    assert keepout["color"]["r"] > keepout["color"]["g"]
