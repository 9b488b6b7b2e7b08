"""CDR: bytes of rclpy, and random messages against an independent encoder."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruckd.ros2.cdr import decode, encode
from monstertruckd.ros2.convert import RosNames
from monstertruckd.ros2.interfaces import ARRAY, PRIMITIVES, interfaces

STORE = get_typestore(Stores.ROS2_JAZZY)
SHARED = sorted(set(interfaces()) & set(STORE.fielddefs))

SCAN = {
    "header": {"stamp": {"sec": 7, "nanosec": 5}, "frame_id": "laser"},
    "angle_min": -1.5,
    "angle_max": 1.5,
    "range_max": 5.5,
    "ranges": [1.0, math.inf, 2.5],
}
STATUS = {"level": 1, "name": "gate", "values": [{"key": "a", "value": "bc"}]}


@pytest.mark.parametrize(
    ("name", "message", "rclpy"),
    [
        (
            "sensor_msgs/msg/LaserScan",
            SCAN,
            "000100000700000005000000060000006c617365720000000000c0bf0000c03f000000000000000000000000000000000000b040"
            "030000000000803f0000807f0000204000000000",
        ),
        (
            "diagnostic_msgs/msg/DiagnosticArray",
            {"status": [STATUS]},
            "0001000000000000000000000100000000000000010000000100000005000000676174650000000001000000000000000100000000"
            "00000001000000020000006100000003000000626300",
        ),
    ],
)
def test_a_message_has_the_bytes_that_rclpy_gives_it(name, message, rclpy):
    assert encode(name, message).hex() == rclpy


@pytest.mark.parametrize(
    ("name", "rclpy", "found"),
    [
        (
            "geometry_msgs/msg/TwistStamped",
            "0001000000000000000000000a000000626173655f6c696e6b00d045000000000000d03f00000000000000000000000000000000"
            "00000000000000000000000000000000000000000000e0bf",
            {
                "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "base_link"},
                "twist": {"linear": {"x": 0.25, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": -0.5}},
            },
        ),
        ("std_srvs/srv/Trigger_Response", "0001000001560000030000006f6b00", {"success": True, "message": "ok"}),
        ("std_srvs/srv/Trigger_Request", "0001000000560000", {"structure_needs_at_least_one_member": 0}),
    ],
)
def test_what_rclpy_wrote_is_read_whatever_it_pads_with(name, rclpy, found):
    assert decode(name, bytes.fromhex(rclpy)) == found


def values(name):
    """Random messages of an interface."""
    return st.fixed_dictionaries({field.name: value(field) for field in interfaces()[name]})


NUMBERS = {
    "bool": st.booleans(),
    "string": st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
    "byte": st.integers(0, 127),  # rosbags takes it for signed
    "char": st.integers(0, 255),
} | {
    f"{sign}int{bits}": st.integers(0 if sign else -(2 ** (bits - 1)), 2**bits - 1 if sign else 2 ** (bits - 1) - 1)
    for bits in (8, 16, 32, 64)
    for sign in ("", "u")
}


def value(field):
    one = NUMBERS[field.kind] if field.kind in PRIMITIVES else values(field.kind)
    if not field.many:
        return one
    least, most = (field.count, field.count) if field.many == ARRAY else (0, field.count or 3)
    many = st.lists(one, min_size=least, max_size=most)
    return (
        many if field.nested or field.kind == "string" else many.map(lambda found: np.array(found, TYPES[field.kind]))
    )


TYPES = {"byte": np.uint8, "char": np.uint8, "bool": np.bool_} | {
    kind: np.dtype(kind) for kind in PRIMITIVES if kind not in ("byte", "char", "bool", "string")
}


def rosbags_message(name, message):
    fields = {}
    for field in interfaces()[name]:
        found = message[field.name]
        if field.nested:
            found = [rosbags_message(field.nested, one) for one in found] if field.many else None
            found = rosbags_message(field.nested, message[field.name]) if found is None else found
        fields[field.name] = found
    return STORE.types[name](**fields)


def plain(message):
    if isinstance(message, dict):
        return {key: plain(one) for key, one in message.items()}
    return [plain(one) for one in message] if isinstance(message, list | tuple | np.ndarray) else message


@pytest.mark.parametrize("name", SHARED)
def test_messages_are_encoded_as_by_rosbags_and_read_back(name):
    @settings(max_examples=5, deadline=None, database=None)
    @given(values(name))
    def check(message):
        data = encode(name, message)
        assert data == bytes(STORE.serialize_cdr(rosbags_message(name, message), name))
        assert plain(decode(name, data)) == plain(message)

    check()


@settings(max_examples=300, deadline=None, database=None)
@given(st.sampled_from(sorted(interfaces())), st.binary(max_size=200))
def test_bytes_from_anybody_are_read_or_refused(name, data):
    for text in (data, b"\x00\x01\x00\x00" + data):
        try:
            decode(name, text)
        except InputError:
            continue


def test_a_message_cut_anywhere_is_refused():
    data = encode("sensor_msgs/msg/LaserScan", SCAN)
    for length in range(len(data)):
        with pytest.raises(InputError):
            decode("sensor_msgs/msg/LaserScan", data[:length])


def test_a_sequence_longer_than_its_message_is_refused_before_it_takes_memory():
    data = bytes.fromhex("00010000" + "ffffffff")
    with pytest.raises(InputError, match="4294967295 values in 0 bytes"):
        decode("tf2_msgs/msg/TFMessage", data)


@pytest.mark.parametrize(
    ("message", "match"),
    [({"covariances": []}, "no field covariances"), ({"covariance": [0.0] * 9}, "expected 36 values, found 9")],
)
def test_a_mistake_of_ours_is_noticed(message, match):
    with pytest.raises(ValueError, match=match):
        encode("geometry_msgs/msg/PoseWithCovariance", message)


def test_other_byte_orders_are_refused_by_name():
    with pytest.raises(InputError, match="little-endian CDR, found 00000000"):
        decode("std_msgs/msg/String", bytes(8))


@pytest.mark.parametrize("value", [1e300, -1e300, math.inf, -math.inf])
def test_a_number_beyond_32_bits_is_infinite_alone_and_in_arrays(value: float):
    single = decode("sensor_msgs/msg/Range", encode("sensor_msgs/msg/Range", {"range": value}))
    assert single["range"] == math.copysign(math.inf, value)
    scan = decode("sensor_msgs/msg/LaserScan", encode("sensor_msgs/msg/LaserScan", {"ranges": np.array([value, 1.0])}))
    assert scan["ranges"].tolist() == [math.copysign(math.inf, value), 1.0]


@pytest.mark.parametrize(("stamp", "sec"), [(-5, 0), (3 * SECOND, 3), (2**31 * SECOND, 2**31 - 1), (2**62, 2**31 - 1)])
def test_a_stamp_stays_within_the_range_of_its_field(stamp: int, sec: int):
    time = RosNames().time(stamp)
    assert time["sec"] == sec
    assert decode("builtin_interfaces/msg/Time", encode("builtin_interfaces/msg/Time", time)) == time
