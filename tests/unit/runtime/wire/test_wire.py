import contextlib
import json
import math
import struct
from functools import cache
from pathlib import Path as FilePath

import numpy as np
import pytest
from google.protobuf.message import Message as Proto
from google.protobuf.unknown_fields import UnknownFieldSet
from grpc_tools import protoc
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.records import Schema as McapSchema
from mcap_protobuf.decoder import DecoderFactory
from pydantic import BaseModel

from monstertruck_runtime import wire
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.wire import foxglove_fields_pb2
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.sensor import Attitude, Battery, BatteryLevel, CompressedImage, LaserScan
from monstertruck_schemas.state import Grid
from tests.unit.runtime import messages

modest = settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck))
ALL = pytest.mark.parametrize("topic", t.TOPICS, ids=lambda topic: topic.name)
PROTOBUF = pytest.mark.parametrize("topic", messages.PROTOBUF, ids=lambda topic: topic.name)


@cache
def decoder(topic):
    schema = wire.schema(topic)
    return DecoderFactory().decoder_for("protobuf", McapSchema(1, schema.data, schema.encoding, schema.name))


def stock(topic, data=b"") -> Proto:
    """The topic's message as the stock MCAP decoder sees it."""
    return decoder(topic)(data)


VARINT, FIXED64, DELIMITED, FIXED32 = 0, 1, 2, 5
"""Wire types of https://protobuf.dev/programming-guides/encoding/."""


def varint(value: int) -> bytes:
    groups = [value >> shift & 0x7F for shift in range(0, max(value.bit_length(), 1), 7)]
    return bytes([*(group | 0x80 for group in groups[:-1]), groups[-1]])


def delimited(body: bytes) -> bytes:
    return varint(len(body)) + body


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
def test_values_beyond_the_limits_are_refused(old, new, field):
    message = scan(scan_time=0.125, range_min=0.0625, tilt=0.03125)
    data = wire.encode(t.SCAN, message)
    assert wire.decode(t.SCAN, data) == message
    assert data.count(old) == 1, old
    assert len(old) == len(new)
    with pytest.raises(InputError, match=field):
        wire.decode(t.SCAN, data.replace(old, new))


def test_the_sign_of_zero_survives():
    for zero in (-0.0, 0.0):
        again = wire.decode(t.SCAN, wire.encode(t.SCAN, scan(start_angle=zero, ranges=[zero] * 3)))
        assert str(again.start_angle) == str(again.ranges[0].item()) == str(zero)


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


def test_the_generated_module_is_that_of_the_proto_file(tmp_path):
    generated = FilePath(foxglove_fields_pb2.__file__)
    name = foxglove_fields_pb2.DESCRIPTOR.name
    folder = generated.parents[len(FilePath(name).parts) - 1]
    assert protoc.main(["protoc", f"-I{folder}", f"--python_out={tmp_path}", name]) == 0

    def descriptor(module: FilePath) -> list[str]:
        return [line for line in module.read_text().splitlines() if line.startswith("DESCRIPTOR")]

    assert descriptor(generated) == descriptor(tmp_path / generated.relative_to(folder))


def test_own_fields_have_numbers_of_their_own():
    for name, message in foxglove_fields_pb2.DESCRIPTOR.message_types_by_name.items():
        assert min(message.fields_by_number) >= 1000, name


@PROTOBUF
@modest
@given(data=st.data())
def test_unknown_fields_are_skipped(topic, data):
    message = data.draw(messages.of(topic))
    unknown = (
        varint(5000 << 3 | VARINT) + varint(2**64 - 1),
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


def test_arrays_that_another_writer_split_are_read_whole():
    piece = varint(6 << 3 | DELIMITED) + delimited(np.array((7.0, 8.0)).tobytes())
    data = wire.encode(t.SCAN, scan(received=0, ranges=[6.0], codes=[1, 2, 3])) + piece
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


RECEIVED = varint(1000 << 3 | FIXED64) + b"12345678"


@pytest.mark.parametrize(
    ("data", "text"),
    [
        pytest.param(b"\x0b", "foxglove.LaserScan.*corrupt", id="group"),
        pytest.param(b"\x0a", "corrupt", id="truncated"),
        pytest.param(b"\x80\x80", "corrupt", id="truncated number"),
        pytest.param(b"\x20" + b"\xff" * 11, "corrupt", id="number of more than 64 bits"),
        pytest.param(b"\x12\x01\xff", "UTF-8", id="text"),
        pytest.param(b"\x32\x07abcdefg", "corrupt", id="doubles of 7 bytes"),
        pytest.param(RECEIVED + b"\x32\x07abcdefg", "of 7 bytes", id="doubles of 7 bytes by our writer"),
        pytest.param(b"", "frame", id="nothing"),
    ],
)
def test_invalid_scan_says_why(data, text):
    with pytest.raises(InputError, match=text):
        wire.decode(t.SCAN, data)


def test_a_scan_with_two_tilts_is_refused():
    message = stock(t.SCAN)
    message.tilt.extend([0.1, 0.2])
    with pytest.raises(InputError, match="sensor/scan: expected 1 numbers, got 2"):
        wire.decode(t.SCAN, message.SerializeToString())


def test_odometry_of_the_wrong_shape_is_refused():
    message = stock(t.ODOMETRY)
    message.twist2d.extend([1.0, 2.0])
    with pytest.raises(InputError, match="state/odometry: expected 3 numbers, got 2"):
        wire.decode(t.ODOMETRY, message.SerializeToString())


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
    with pytest.raises(InputError, match="x, y, yaw"):
        wire.encode(t.PATH, Path(stamp=0, received=0, seq=0, poses=[1, 2], directions=[]))


def test_bytes_that_are_no_text_travel_escaped():
    said = {"reason": Reason.OK, "severity": Severity.INFO, "source": "x"}
    event = Event(stamp=1, received=1, seq=1, text="map \udcffä\ud800", values={"file": "\udce9.mcap"}, **said)
    read = wire.decode(t.EVENT, wire.encode(t.EVENT, event))
    assert read.text == r"map \xffä\ud800"
    assert read.values == {"file": r"\xe9.mcap"}


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
