"""What stock viewers see in a recorded log: the published foxglove types, field by field, and every message decoded."""

import json
from importlib import import_module
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from monstertruck_runtime import wire
from monstertruck_schemas.topics import BY_NAME, TOPICS

FIRST_OWN_FIELD = 1000
GOLDEN = sorted((Path(__file__).parents[3] / "data" / "golden").glob("*/run.mcap"))
FOXGLOVE = [topic for topic in TOPICS if topic.foxglove is not None]


def files_of(data: bytes) -> dict[str, FileDescriptorProto]:
    return {file.name: file for file in FileDescriptorSet.FromString(data).file}


def published(name: str) -> dict[str, FileDescriptorProto]:
    """Files of a type and everything it needs, as the foxglove package publishes them."""
    found: dict[str, FileDescriptorProto] = {}

    def take(file) -> None:
        proto = FileDescriptorProto()
        file.CopyToProto(proto)
        found[file.name] = proto
        for dependency in file.dependencies:
            take(dependency)

    take(import_module(f"foxglove_schemas_protobuf.{name.removeprefix('foxglove.')}_pb2").DESCRIPTOR)
    return found


def check(name: str, data: bytes) -> None:
    """The type of ``data`` is the published one, plus fields of our own above all of theirs."""
    mine, theirs = files_of(data), published(name)
    assert mine.keys() == theirs.keys()
    for file, proto in theirs.items():
        if (own := mine[file]) == proto:
            continue
        (ours,) = (message for message in own.message_type if f"foxglove.{message.name}" == name)
        extra = [field for field in ours.field if field.number >= FIRST_OWN_FIELD]
        (standard,) = (message for message in proto.message_type if message.name == ours.name)
        assert not {field.name for field in extra} & {field.name for field in standard.field}
        assert max(field.number for field in standard.field) < FIRST_OWN_FIELD
        for field in extra:
            ours.field.remove(field)
        assert own == proto, f"{name}: a standard field differs"


@pytest.mark.parametrize("topic", FOXGLOVE, ids=lambda topic: topic.name)
def test_every_foxglove_topic_has_the_published_type(topic):
    check(topic.schema_name, wire.schema(topic).data)


def test_a_changed_standard_field_would_be_found():
    topic = FOXGLOVE[0]
    files = FileDescriptorSet.FromString(wire.schema(topic).data)
    message = next(m for file in files.file for m in file.message_type if f"foxglove.{m.name}" == topic.schema_name)
    message.field[1].name = "frame"
    with pytest.raises(AssertionError, match="a standard field differs"):
        check(topic.schema_name, files.SerializeToString())


@pytest.mark.parametrize("log", GOLDEN, ids=lambda log: log.parent.name)
def test_schemas_in_a_log_are_complete_and_published(log):
    with log.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    protobuf = [schema for schema in summary.schemas.values() if schema.encoding == "protobuf"]
    assert {schema.name for schema in protobuf} >= {
        "foxglove.LaserScan",
        "foxglove.PoseInFrame",
        "foxglove.FrameTransforms",
    }
    for schema in protobuf:
        check(schema.name, schema.data)
        pool = DescriptorPool()
        for proto in FileDescriptorSet.FromString(schema.data).file:
            pool.Add(proto)
        assert pool.FindMessageTypeByName(schema.name).fields_by_name
    for schema in summary.schemas.values():
        assert schema.encoding in {"protobuf", "jsonschema"}
        if schema.encoding == "jsonschema":
            assert json.loads(schema.data)["type"] == "object"


@pytest.mark.parametrize("log", GOLDEN, ids=lambda log: log.parent.name)
def test_stock_readers_decode_every_message(log):
    counts = {"protobuf": 0, "json": 0}
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        factory = DecoderFactory()
        for schema, channel, message in reader.iter_messages():
            counts[channel.message_encoding] += 1
            if channel.message_encoding == "json":
                assert json.loads(message.data)["stamp"] == message.publish_time
                continue
            decoded = factory.decoder_for(channel.message_encoding, schema)(message.data)
            mine = wire.decode(BY_NAME[channel.topic], message.data)
            stamp = decoded.timestamp if hasattr(decoded, "timestamp") else decoded.transforms[-1].timestamp
            assert abs(stamp.seconds * 10**9 + stamp.nanos - mine.stamp) <= 10**9
            if schema.name == "foxglove.LaserScan":
                assert list(decoded.ranges) == mine.ranges.tolist()
            if schema.name == "foxglove.PoseInFrame":
                assert (decoded.pose.position.x, decoded.pose.position.y) == (mine.pose.x, mine.pose.y)
    assert min(counts.values()) > 100
