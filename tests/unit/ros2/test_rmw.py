"""Keys, tokens, identities and attachments of rmw_zenoh."""

import struct

import pytest

from monstertruck_runtime.errors import InputError
from monstertruckd.ros2.node import sole_publisher
from monstertruckd.ros2.rmw import (
    LATCHED,
    RELIABLE,
    SENSOR,
    Attachment,
    EntityKind,
    RosEntity,
    RosQos,
    data_key,
    gid_of,
    parsed_token,
    token_key,
)

SCAN_HASH = "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"


def test_a_topics_key_names_domain_topic_type_and_hash():
    key = data_key(5, "/truck1/scan", "sensor_msgs/msg/LaserScan")
    assert key == f"5/truck1/scan/sensor_msgs::msg::dds_::LaserScan_/{SCAN_HASH}"


def test_humble_has_a_constant_for_a_hash():
    key = data_key(0, "/scan", "sensor_msgs/msg/LaserScan", hashed=False)
    assert key == "0/scan/sensor_msgs::msg::dds_::LaserScan_/TypeHashNotSupported"


def test_a_service_has_its_own_name_and_the_hash_of_the_whole_service():
    key = data_key(0, "/truck/arm", "std_srvs/srv/Trigger")
    assert key.startswith("0/truck/arm/std_srvs::srv::dds_::Trigger_/RIHS01_")


def test_feedback_of_lyrical_differs_by_its_hash_alone():
    topic = "/navigate_to_pose/_action/feedback"
    jazzy, lyrical = (
        data_key(0, topic, f"nav2_msgs/action/NavigateToPose{mark}_FeedbackMessage").rpartition("/")
        for mark in ("", "@lyrical")
    )
    assert jazzy[0] == lyrical[0]
    assert jazzy[2] != lyrical[2]


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (RELIABLE, "::,10:,:,:,,"),
        (SENSOR, "2::,5:,:,:,,"),
        (LATCHED, ":1:,1:,:,:,,"),
        (RosQos(depth=42), "::,:,:,:,,"),
    ],
)
def test_quality_of_service_is_written_as_rmw_zenoh_does(qos, text):
    assert qos.text == text


NODE = RosEntity(EntityKind.NODE, "/truck1", "teleop", owner="aa/3")
PUBLISHER = RosEntity(EntityKind.PUBLISHER, "/", "teleop", "/cmd_vel", "geometry_msgs::msg::dds_::Twist_", "aa/3")


def test_tokens_of_nodes_and_publishers():
    assert token_key(0, "aa", (3, 3), NODE) == "@ros2_lv/0/aa/3/3/NN/%/%truck1/teleop"
    token = token_key(0, "aa", (3, 4), PUBLISHER, ("HASH", "::,10:,:,:,,"))
    assert token == "@ros2_lv/0/aa/3/4/MP/%/%/teleop/%cmd_vel/geometry_msgs::msg::dds_::Twist_/HASH/::,10:,:,:,,"


@pytest.mark.parametrize("entity", [NODE, PUBLISHER])
def test_a_token_is_read_back_with_what_newer_releases_append(entity):
    token = token_key(7, "aa", (3, 3 if entity is NODE else 4), entity, ("HASH", "::,10:,:,:,,"))
    assert parsed_token(token) == entity
    if entity is PUBLISHER:
        assert parsed_token(f"{token}/cpu") == entity


@pytest.mark.parametrize("key", ["", "@ros2_lv/0/aa/3/3/XX/%/%/n", "@ros2_lv/0/aa/3/4/MP/%/%/n/%t", "a/b"])
def test_another_key_is_no_token(key):
    with pytest.raises(InputError, match="expected a token of rmw_zenoh"):
        parsed_token(key)


def test_a_gid_is_the_token_s_xxh3_in_128_bits_low_half_first():
    # XXH3-128 of no bytes is 99aa06d3014798d86001c324468d497f (test vector of the xxHash specification)
    assert gid_of("").hex() == "7f498d4624c30160d8984701d306aa99"


def test_an_attachment_has_33_bytes_and_is_read_back():
    attachment = Attachment(1, 2, bytes(range(16)))
    data = attachment.packed()
    assert data.hex() == "0100000000000000" + "0200000000000000" + "10" + bytes(range(16)).hex()
    assert Attachment.parse(data) == attachment


@pytest.mark.parametrize("data", [None, b"", bytes(32), bytes(34), struct.pack("<qqB16s", 1, 2, 17, bytes(16))])
def test_other_attachments_are_refused(data):
    with pytest.raises(InputError, match="attachment"):
        Attachment.parse(data)


@pytest.mark.parametrize(
    ("found", "node"),
    [
        ([("/", "truck", b"a"), ("/", "slam_toolbox", b"b")], "/slam_toolbox"),
        ([("/t2", "truck", b"a")], "/t2/truck"),
        ([("/", "amcl", b"a"), ("/", "slam_toolbox", b"b")], None),
        ([("/", "truck", b"a")], None),
        ([("_NODE_NAMESPACE_UNKNOWN_", "_NODE_NAME_UNKNOWN_", b"a")], None),
    ],
)
def test_a_topic_has_a_known_publisher_if_it_has_one_besides_this_program(found, node):
    sender, identity = sole_publisher(found, "/", {"truck"})
    assert (sender.node if sender else None) == node
    assert identity == (found[-1][2] if node else b"")
