import contextlib
import json
import math
import struct
from functools import cache
from unittest import mock

import numpy as np
import pytest
from google.protobuf.message import Message as Proto
from google.protobuf.unknown_fields import UnknownFieldSet
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.records import Schema as McapSchema
from mcap_protobuf.decoder import DecoderFactory
from pydantic import BaseModel

from monstertruck_runtime import wire
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.wire import foxglove
from monstertruck_runtime.wire import layouts as foxglove_layouts
from monstertruck_runtime.wire import scan as foxglove_scan
from monstertruck_runtime.wire.protobuf import (
    DELIMITED,
    FIXED32,
    FIXED64,
    VARINT,
    Layout,
    delimited,
    read_varint,
    varint,
)
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.sensor import Attitude, Battery, BatteryLevel, CompressedImage, LaserScan
from monstertruck_schemas.state import Grid
from tests.unit.runtime import messages

modest = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
ALL = pytest.mark.parametrize("topic", t.TOPICS, ids=lambda topic: topic.name)
PROTOBUF = pytest.mark.parametrize("topic", messages.PROTOBUF, ids=lambda topic: topic.name)


@cache
def decoder(topic):
    schema = wire.schema(topic)
    return DecoderFactory().decoder_for("protobuf", McapSchema(1, schema.data, schema.encoding, schema.name))


def stock(topic, data=b"") -> Proto:
    """The topic's message as the stock MCAP decoder sees it."""
    return decoder(topic)(data)


def scan(**changes) -> LaserScan:
    values = {
        "stamp": 1_700_000_000_123_456_789,
        "received": 1_700_000_000_200_000_001,
        "seq": 300,
        "frame": "laser",
        "start_angle": -2.0,
        "end_angle": 2.0,
        "time_increment": 1e-4,
        "scan_time": 0.1,
        "range_min": 0.02,
        "range_max": 5.6,
        "ranges": [1.5, math.inf, 0.25],
        "codes": [255, 16, 255],
    }
    return LaserScan(**(values | changes))


def grid(**changes) -> Grid:
    values = {
        "stamp": 1,
        "received": 2,
        "seq": 3,
        "resolution": 0.05,
        "width": 2,
        "height": 3,
        "origin": Pose2D(x=1.0, y=2.0, yaw=0.5),
        "cells": [-1, 0, 100, 1, 2, 3],
    }
    return Grid(**(values | changes))


@ALL
@modest
@given(data=st.data())
def test_every_topic_round_trips(topic, data):
    message = data.draw(messages.of(topic))
    again = wire.decode(topic, wire.encode(topic, message))
    assert again == message
    assert all(
        not value.flags.writeable and value.flags.aligned
        for value in again.__dict__.values()
        if isinstance(value, np.ndarray)
    )


@PROTOBUF
@modest
@given(data=st.data())
def test_stock_protobuf_writes_what_we_read_and_reads_what_we_write(topic, data):
    ours = wire.encode(topic, data.draw(messages.of(topic)))
    theirs = stock(topic, ours)
    assert not list(UnknownFieldSet(theirs))
    assert wire.decode(topic, theirs.SerializeToString()) == wire.decode(topic, ours)


@modest
@given(message=messages.scans)
def test_the_scans_own_codec_writes_what_its_layout_says_and_reads_it_without_the_layout(message):
    data = wire.encode(t.SCAN, message)
    assert data == foxglove_layouts.LASER_SCAN.encode(vars(message))
    assert LaserScan.model_validate(foxglove_layouts.LASER_SCAN.decode(data)) == message
    if message.stamp >= 0:
        assert wire.decode(t.SCAN, data) == message  # which teaches the shape
        with mock.patch.object(foxglove_scan, "_decode_any", side_effect=AssertionError):
            known = wire.decode(t.SCAN, data)
        assert known == message
        assert list(vars(known)) == list(vars(message))
        assert known.model_fields_set == set(LaserScan.model_fields)
        assert not known.ranges.flags.writeable


@modest
@given(data=st.data())
def test_the_poses_own_writers_write_what_their_layouts_say(data):
    odometry = data.draw(messages.of(t.ODOMETRY))
    pose, twist = odometry.pose, odometry.twist
    values = vars(odometry) | {
        "pose": foxglove_layouts.planar_pose(pose.x, pose.y, pose.yaw),
        "pose2d": np.array([pose.x, pose.y, pose.yaw]),
        "twist2d": np.array([twist.vx, twist.vy, twist.wz]),
    }
    assert wire.encode(t.ODOMETRY, odometry) == foxglove_layouts.POSE_IN_FRAME.encode(values)
    tree = data.draw(messages.of(t.TRANSFORMS))
    rows = [
        vars(transform)
        | {
            "translation": dict(zip("xyz", transform.translation, strict=True)),
            "rotation": dict(zip("xyzw", transform.rotation, strict=True)),
        }
        for transform in tree.transforms
    ]
    assert wire.encode(t.TRANSFORMS, tree) == foxglove_layouts.FRAME_TRANSFORMS.encode(
        vars(tree) | {"transforms": rows}
    )


@pytest.mark.parametrize("bits", range(65))
def test_numbers_of_every_length_are_written_as_the_standard_says(bits):
    for value in {2**bits - 1, 2**bits - 1 & 0x5555_5555_5555_5555}:
        groups = [value >> shift & 0x7F for shift in range(0, max(bits, 1), 7)]
        while len(groups) > 1 and groups[-1] == 0:
            groups.pop()
        assert varint(value) == bytes([*(group | 0x80 for group in groups[:-1]), groups[-1]])
        assert read_varint(varint(value), 0) == (value, len(groups))


@pytest.mark.parametrize("padded", [b"\x12\x85\x00laser", b"\x12\x05laser" * 2])
def test_a_scan_in_unusual_protobuf_is_read_as_the_standard_says(padded):
    data = wire.encode(t.SCAN, scan()).replace(b"\x12\x05laser", padded)
    assert wire.decode(t.SCAN, data) == scan()


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        (struct.pack("<d", 0.125), struct.pack("<d", math.nan), "scan_time"),
        (struct.pack("<d", 0.125), struct.pack("<d", 0.0), "scan_time"),
        (struct.pack("<d", 0.0625), struct.pack("<d", -1.0), "range_min"),
        (struct.pack("<d", -2.0), struct.pack("<d", -math.inf), "start_angle"),
        (struct.pack("<d", 0.03125), struct.pack("<d", -0.5), "tilt"),
        (b"laser", b"Laser", "frame"),
        (varint(1_700_000_000), varint(2**35 - 1), "stamp"),
    ],
)
def test_values_beyond_the_limits_are_refused_in_a_known_shape(old, new, field):
    message = scan(scan_time=0.125, range_min=0.0625, tilt=0.03125)
    data = wire.encode(t.SCAN, message)
    assert wire.decode(t.SCAN, data) == wire.decode(t.SCAN, data) == message
    assert data.count(old) == 1, old
    assert len(old) == len(new)
    with pytest.raises(InputError, match=field):
        wire.decode(t.SCAN, data.replace(old, new))


def test_scans_of_several_devices_are_read_without_the_layout_once_each_is_known():
    devices = [scan(), scan(ranges=[1.0], codes=[255]), scan(range_max=30.0, tilt=0.5)]
    datas = [wire.encode(t.SCAN, message) for message in devices]
    assert [wire.decode(t.SCAN, data) for data in datas] == devices
    with mock.patch.object(foxglove_scan, "_decode_any", side_effect=AssertionError):
        assert [wire.decode(t.SCAN, data) for data in datas] == devices


def test_devices_whose_scans_are_of_one_size_are_told_apart():
    devices = [scan(), scan(range_max=30.0), scan(frame="other"), scan(start_angle=-0.0), scan(start_angle=0.0)]
    for message in devices * 2:
        again = wire.decode(t.SCAN, wire.encode(t.SCAN, message))
        assert again == message
        assert str(again.start_angle) == str(message.start_angle)


def test_stock_reader_sees_the_standard_scan():
    message = stock(t.SCAN, wire.encode(t.SCAN, scan()))
    assert (message.timestamp.seconds, message.timestamp.nanos) == (1_700_000_000, 123_456_789)
    assert message.frame_id == "laser"
    assert list(message.ranges) == [1.5, math.inf, 0.25]
    assert (message.start_angle, message.end_angle) == (-2.0, 2.0)
    assert message.pose.orientation.w == 1.0
    assert message.codes == bytes([255, 16, 255])
    assert message.received == 1_700_000_000_200_000_001


def test_stock_reader_sees_the_standard_grid():
    message = stock(t.MAP, wire.encode(t.MAP, grid()))
    assert (message.column_count, message.row_stride, message.cell_stride) == (2, 2, 1)
    assert (message.cell_size.x, message.cell_size.y) == (0.05, 0.05)
    assert [(f.name, f.offset, f.type) for f in message.fields] == [("occupancy", 0, 2)]
    assert (message.pose.position.x, message.pose.position.y) == (1.0, 2.0)
    assert 2 * math.asin(message.pose.orientation.z) == pytest.approx(0.5)


def test_stock_reader_sees_every_pose_of_a_path():
    path = Path(stamp=0, received=0, seq=0, poses=[1, 2, 0.5, 3, 4, -0.5], directions=[], name="lap")
    message = stock(t.PATH, wire.encode(t.PATH, path))
    assert [(p.position.x, p.position.y, p.position.z) for p in message.poses] == [(1, 2, 0), (3, 4, 0)]
    assert [2 * math.atan2(p.orientation.z, p.orientation.w) for p in message.poses] == pytest.approx([0.5, -0.5])


def test_standard_poses_count_where_a_writer_knows_only_those():
    message = stock(t.PATH)
    message.frame_id = "map"
    pose = message.poses.add()
    pose.position.x, pose.position.y = 1.0, 2.0
    pose.orientation.z, pose.orientation.w = math.sin(0.15), math.cos(0.15)
    path = wire.decode(t.PATH, message.SerializeToString())
    assert path.poses.tolist() == pytest.approx([1.0, 2.0, 0.3])
    assert path.frame == "map"


@PROTOBUF
def test_layouts_agree_with_the_published_descriptors(topic):
    """Names, numbers and types of standard fields are the publisher's, ours are 1000 and up."""

    def check(layout: Layout, descriptor):
        published = {f.number: f for f in descriptor.fields}
        assert {row.number for row in layout.fields} == set(published)
        for row in layout.fields:
            field = published[row.number]
            assert (row.name, row.kind.descriptor_type) == (field.name, field.type)
            repeated = field.is_repeated if hasattr(field, "is_repeated") else field.label == 3
            assert repeated == (row.repeated or row.kind.packed)
            if row.kind.layout is not None:
                assert row.kind.layout.name == field.message_type.full_name
                check(row.kind.layout, field.message_type)

    check(foxglove.BINDINGS[topic.model].layout, stock(topic).DESCRIPTOR)


@PROTOBUF
@modest
@given(data=st.data())
def test_unknown_fields_are_skipped(topic, data):
    message = data.draw(messages.of(topic))
    unknown = (
        varint(5000 << 3 | VARINT) + varint(-1),
        varint(5001 << 3 | FIXED64) + b"12345678",
        varint(5002 << 3 | FIXED32) + b"1234",
        varint(5003 << 3 | DELIMITED) + delimited(b"x" * 200),
        varint(1000 << 3 | DELIMITED) + delimited(b"another type than we know"),
    )
    extra = b"".join(data.draw(st.permutations(unknown)))
    assert wire.decode(topic, extra + wire.encode(topic, message) + extra) == message


def test_arrays_written_one_number_at_a_time_are_read():
    unpacked = b"".join(varint(6 << 3 | FIXED64) + np.float64(x).tobytes() for x in (7.0, 8.0))
    data = wire.encode(t.SCAN, scan(ranges=[6.0], codes=[1, 2, 3])) + unpacked
    assert wire.decode(t.SCAN, data).ranges.tolist() == [6.0, 7.0, 8.0]


@ALL
@modest
@given(data=st.data())
def test_fuzz_damaged_bytes_decode_or_raise_input_error(topic, data):
    good = bytearray(wire.encode(topic, data.draw(messages.of(topic))))
    for _ in range(data.draw(st.integers(1, 4))):
        if good:
            good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    damaged = bytes(good[: data.draw(st.integers(0, len(good)))])
    for candidate in (damaged, data.draw(st.binary(max_size=60))):
        with contextlib.suppress(InputError):
            assert isinstance(wire.decode(topic, candidate), topic.model)


@pytest.mark.parametrize("cut", range(1, 80, 7))
def test_truncated_scan_is_refused(cut):
    with pytest.raises(InputError, match="sensor/scan"):
        wire.decode(t.SCAN, wire.encode(t.SCAN, scan())[:-cut])


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"\x0b", "not protobuf 3"),
        (b"\x0a", "truncated"),
        (b"\x80\x80", "truncated"),
        (b"\x20" + b"\xff" * 11, "64 bits"),
        (b"\x12\x01\xff", "UTF-8"),
        (b"\x32\x07abcdefg", "multiple of 8"),
        (b"", "frame"),
    ],
)
def test_invalid_scan_says_why(data, text):
    with pytest.raises(InputError, match=text):
        wire.decode(t.SCAN, data)


def test_odometry_of_the_wrong_shape_is_refused():
    data = foxglove_layouts.POSE_IN_FRAME.encode({"twist2d": np.array([1.0, 2.0])})
    with pytest.raises(InputError, match="state/odometry: expected 3 numbers, got 2"):
        wire.decode(t.ODOMETRY, data)


@pytest.mark.parametrize("changes", [{"cells": [1, 2]}, {"width": 4}])
def test_grid_that_contradicts_itself_is_refused_before_it_travels(changes):
    with pytest.raises(InputError, match="cells"):
        wire.encode(t.MAP, grid(**changes))


@pytest.mark.parametrize("field", [{"row_stride": 3}, {"column_count": 0}, {"cell_stride": 4}, {"data": b"12345"}])
def test_foreign_grid_layout_is_refused(field):
    message = stock(t.MAP, wire.encode(t.MAP, grid()))
    for name, value in field.items():
        setattr(message, name, value)
    with pytest.raises(InputError, match="whole rows"):
        wire.decode(t.MAP, message.SerializeToString())


def test_path_of_incomplete_rows_is_refused():
    with pytest.raises(InputError, match="rows of"):
        wire.encode(t.PATH, Path(stamp=0, received=0, seq=0, poses=[1, 2], directions=[]))


def test_message_of_another_topic_is_refused():
    with pytest.raises(InputError, match="state/map: expected Grid, got LaserScan"):
        wire.encode(t.MAP, scan())


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["speed", "front", "rear"])
def test_non_finite_request_reaches_the_gate(field, value):
    values = {"speed": 0.0, "front": 0.0, "rear": 0.0} | {field: value}
    request = DriveRequest(stamp=1, received=1, seq=1, source="me", role=Role.KEYBOARD, lease=0.3, nonce="n", **values)
    again = wire.decode(t.REQ_DRIVE, wire.encode(t.REQ_DRIVE, request))
    assert repr(getattr(again, field)) == repr(value)


def test_json_ignores_unknown_fields_at_every_depth_and_names_the_bad_one():
    text = {
        "stamp": 1,
        "received": 1,
        "seq": 1,
        "source": "me",
        "role": "station",
        "lease": 0.5,
        "nonce": "n",
        "new": 1,
        "goal": {"x": 1.0, "y": 2.0, "yaw": 0.0, "z": 3.0},
    }
    assert wire.decode(t.REQ_GOAL, json.dumps(text).encode()).goal == Pose2D(x=1.0, y=2.0, yaw=0.0)
    text["goal"]["x"] = "far"
    with pytest.raises(InputError, match=r"req/goal: goal\.x: .*number"):
        wire.decode(t.REQ_GOAL, json.dumps(text).encode())
    with pytest.raises(InputError, match="req/goal: Invalid JSON"):
        wire.decode(t.REQ_GOAL, b"{")


def test_absent_values_are_absent_on_the_wire_but_event_values_stay():
    battery = Battery(stamp=1, received=1, seq=1, raw_voltage=7.0, cells=2, level=BatteryLevel.SENSOR_FAULT)
    assert b"null" not in wire.encode(t.BATTERY, battery)
    event = Event(
        stamp=1, received=1, seq=1, reason=Reason.OK, severity=Severity.INFO, source="x", values={"speed": None}
    )
    assert wire.decode(t.EVENT, wire.encode(t.EVENT, event)).values == {"speed": None}


@ALL
def test_what_may_be_none_may_be_missing(topic):
    """Or a message that left it out could not be read back."""
    for name, field in topic.model.model_fields.items():
        if field.annotation is not None and type(None) in getattr(field.annotation, "__args__", ()):
            assert not field.is_required(), name


@ALL
def test_encoding_names_schema_and_version(topic):
    media, name, version = wire.encoding(topic).split(";")
    assert media == ("application/protobuf" if topic.foxglove else "application/json")
    assert name == topic.schema_name == wire.schema(topic).name
    assert version == "v=1"


@pytest.mark.parametrize("topic", [x for x in t.TOPICS if x.foxglove is None], ids=lambda topic: topic.name)
def test_json_schema_is_plain_enough_for_log_viewers(topic):
    schema = wire.schema(topic)
    assert (schema.encoding, schema.message_encoding) == ("jsonschema", "json")
    root = json.loads(schema.data)
    assert set(root["properties"]) == set(topic.model.model_fields)

    def check(node):
        assert "$ref" not in node
        assert "anyOf" not in node
        assert node["type"] in {"object", "array", "string", "number", "integer", "boolean"}
        for child in node["properties"].values() if node["type"] == "object" else ():
            check(child)
        if node["type"] == "array":
            check(node["items"])

    check(root)


def test_json_schema_tells_what_nested_and_optional_values_are():
    properties = json.loads(wire.schema(t.COMPASS).data)["properties"]
    assert properties["temperature"]["type"] == "number"
    assert set(properties["acceleration"]["properties"]) == {"x", "y", "z"}
    assert "degree" in properties["temperature"]["description"]
    assert issubclass(Attitude, BaseModel)


def test_stock_reader_sees_the_standard_picture():
    picture = CompressedImage(
        stamp=2_000_000_003, received=5, seq=6, frame="camera", data=b"\xff\xd8\xff\xd9", sequence=7
    )
    message = stock(t.CAMERA, wire.encode(t.CAMERA, picture))
    assert (message.timestamp.seconds, message.timestamp.nanos) == (2, 3)
    assert (message.frame_id, message.format, message.data) == ("camera", "jpeg", b"\xff\xd8\xff\xd9")
    assert message.sequence == 7


def test_a_picture_survives_json_too():
    picture = CompressedImage(stamp=1, received=1, seq=1, data=bytes(range(256)), sequence=7)
    assert CompressedImage.model_validate_json(picture.model_dump_json()) == picture
