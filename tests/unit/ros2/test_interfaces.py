"""Type hashes: those of rosidl, and those of independent programs."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from rosbags.typesys import Stores, get_typestore

from monstertruckd.ros2.interfaces import FILE, hash_of, installed_interface, interfaces, parsed, type_hash

HASHES = Path(__file__).parents[2] / "data" / "ros2" / "hashes.txt"
ROSIDL = dict(line.split() for line in HASHES.read_text().splitlines() if not line.startswith("#"))


@pytest.mark.parametrize("name", sorted(ROSIDL))
def test_a_hash_is_that_of_rosidl(name):
    assert type_hash(name) == ROSIDL[name]


STORES = (Stores.ROS2_IRON, Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_LYRICAL)


@pytest.mark.parametrize("store", STORES)
def test_messages_have_one_hash_from_iron_to_lyrical(store):
    types = get_typestore(store)
    # rosbags takes a char of ROS 2 for another type than rosidl does
    known = {name for name in interfaces() if name in types.fielddefs} - {"service_msgs/msg/ServiceEventInfo"}
    assert len(known) > 50
    assert {name: types.hash_rihs01(name) for name in known} == {name: type_hash(name) for name in known}


@pytest.mark.parametrize(
    ("name", "begins"),
    [
        ("nav2_msgs/action/NavigateToPose_SendGoal", "a4fcb3be"),
        ("nav2_msgs/action/NavigateToPose_GetResult", "c4079203"),
        ("nav2_msgs/action/NavigateToPose_FeedbackMessage", "9d1f6fa2"),
        ("nav2_msgs/action/NavigateToPose@lyrical_FeedbackMessage", "2c1b4ec1"),
        ("nav2_msgs/action/NavigateToPose@lyrical_SendGoal", "a4fcb3be"),
        ("nav2_msgs/action/NavigateThroughPoses_SendGoal", "5a590fa8e9a32b7b9c838fdf5939a2fb8858d6cfd25bdf2f"),
        ("nav2_msgs/action/NavigateThroughPoses_GetResult", "fdc12773de81ce69f7eeb4366702ea757d792ab5068bc461"),
        ("nav2_msgs/action/NavigateThroughPoses_FeedbackMessage", "073962415ad2a226b3de7245b142aeb414268a4d35ef1321"),
        ("nav2_msgs/action/FollowPath_SendGoal", "5b662aee1159e1d7e7b5f8fef21f556b8bc67c818c730a68"),
        ("nav2_msgs/action/FollowPath_GetResult", "8ab4c588c878f0e997316ec559f172bb56fc210b484c2f6b"),
        ("nav2_msgs/action/FollowPath_FeedbackMessage", "3f4008700ba56ac4c82b01ef2b7fdd3fc18dc194399c48e5"),
    ],
)
def test_an_actions_hashes_are_those_of_public_builds_of_nav2(name, begins):
    assert type_hash(name).removeprefix("RIHS01_").startswith(begins)


def test_a_services_hash_is_that_of_the_design_of_rmw_zenoh():
    service = "=== example_interfaces/srv/AddTwoInts\nint64 a\nint64 b\n---\nint64 sum\n"
    known = parsed(FILE.read_text() + service)
    assert hash_of("example_interfaces/srv/AddTwoInts", known).startswith("RIHS01_e118de6b")


def test_a_line_that_is_no_field_is_refused():
    with pytest.raises(ValueError, match="expected TYPE NAME"):
        parsed("=== std_msgs/msg/Wrong\nfloat64 x = 3\n")


def test_services_and_feedback_of_an_installed_action_are_those_of_its_implementation(monkeypatch):
    parts = SimpleNamespace(SendGoalService="send", GetResultService="result", FeedbackMessage="feedback")
    module = ModuleType("gone_msgs.action")
    module.Go = SimpleNamespace(Impl=parts)
    monkeypatch.setitem(sys.modules, "gone_msgs", ModuleType("gone_msgs"))
    monkeypatch.setitem(sys.modules, "gone_msgs.action", module)
    ends = ("_SendGoal", "_GetResult", "_FeedbackMessage")
    assert [installed_interface(f"gone_msgs/action/Go{end}") for end in ends] == ["send", "result", "feedback"]
    assert installed_interface("gone_msgs/action/Go@kilted_SendGoal") == "send"
    assert installed_interface("gone_msgs/action/Stay_SendGoal") is None
    assert installed_interface("absent_msgs/msg/Any") is None
