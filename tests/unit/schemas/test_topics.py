"""The topic table is consistent: everything else is derived from it."""

import dataclasses

import pytest

from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import (
    BY_NAME,
    TOPICS,
    Topic,
    TopicTable,
    Writer,
    alive_key,
    rpc_key,
    sender_in,
    topics_of,
)
from tests.plugin_kit import install

__all__ = ["install"]


def test_names_are_unique_and_in_a_known_group():
    assert len(BY_NAME) == len(TOPICS)
    assert {topic.group for topic in TOPICS} == {"sensor", "state", "plan", "cmd", "health", "event", "req", "stand"}


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_rows(topic: Topic[Message]):
    assert topic.doc
    name = topic.name.replace("req/", "req/*/")
    if topic.place is not None:
        assert topic.key("truck") == topic.key("truck", "ann") == "mt/stand/sensor/pose_truck"
        return
    assert topic.key("truck") == f"mt/truck/{name}"
    assert topic.key("truck", "ann") == f"mt/truck/{name.replace('*', 'ann')}"
    assert issubclass(topic.model, Message)
    assert topic.rate is None or topic.rate > 0
    if topic.rate is not None and topic.stale_after is not None:
        assert topic.stale_after > 1 / topic.rate, "one late message is not an outage"
    assert topic.schema_name.startswith(("foxglove.", "monstertruck."))


def test_only_the_gate_writes_commands_and_only_outsiders_requests():
    assert {topic.writer for topic in topics_of("cmd")} == {Writer.GATE}
    assert {topic.writer for topic in topics_of("req")} == {Writer.OUTSIDE}
    assert all(topic.writer is not Writer.OUTSIDE for topic in TOPICS if topic.group != "req")


def test_every_request_carries_role_lease_and_nonce():
    for topic in topics_of("req"):
        assert {"source", "role", "lease", "nonce", "seq"} <= set(topic.model.model_fields)


def test_every_field_of_every_message_has_a_json_schema():
    for topic in TOPICS:
        assert topic.model.model_json_schema()["properties"]


SONAR = """
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import Topic, Writer

class Sonar(Message):
    distance: float

class Battery(Message):
    pass

SONAR = Topic("sensor/radar", Sonar, Writer.DRIVER, "Distance ahead", 10, 0.5)
AHEAD = Topic("sonar/ahead", Sonar, Writer.DRIVER, "No such group")
MOTOR = Topic("cmd/motor", Sonar, Writer.GATE, "Past the gate")
FORGED = Topic("sensor/forged", Sonar, Writer.GATE, "By the gate")
TAKEN = Topic("sensor/taken", Battery, Writer.DRIVER, "Named like a message that is known")
PLAIN = Topic("sensor/plain", dict, Writer.DRIVER, "No message")
"""


def test_another_distribution_adds_a_topic(install):
    group = BY_NAME.group
    places = {f"{group}:{t.lower()}": f"sonar:{n}" for t, n in (("sensor/radar", "SONAR"), ("sonar/ahead", "AHEAD"))}
    places |= {f"{group}:cmd/motor": "sonar:MOTOR", f"{group}:sensor/forged": "sonar:FORGED"}
    places |= {f"{group}:sensor/taken": "sonar:TAKEN", f"{group}:sensor/plain": "sonar:PLAIN"}
    install("sonar-driver", "sonar", SONAR, places | {f"{group}:sensor/scan": "sonar:SONAR"})
    table = TopicTable(group, TOPICS)
    assert list(table)[:-1] == list(BY_NAME)
    assert table["sensor/radar"].schema_name == "monstertruck.Sonar"
    assert table.origin("sensor/radar") == "sonar-driver 1.0"
    assert {broken.name: broken.error for broken in table.broken} == {
        "cmd/motor": "expected a name like sensor/radar, in one of the groups sensor, state, plan, health",
        "sensor/forged": "written by gate: expected driver",
        "sensor/plain": "model: expected a subclass of Message, found <class 'dict'>",
        "sensor/scan": "the name is taken by monstertruckd",
        "sensor/taken": "another message is called monstertruck.Battery",
        "sonar/ahead": "expected a name like sensor/radar, in one of the groups sensor, state, plan, health",
    }


def test_keys_that_are_no_topics():
    assert rpc_key("truck", "topics") == "mt/truck/rpc/topics"
    assert rpc_key("truck", "topics", "ann") == "mt/truck/rpc/topics/ann"
    assert alive_key("truck") == "mt/truck/alive"


def test_reasons_have_stable_exit_codes_and_texts():
    later = {
        Reason.KEEPOUT: Reason.OBSTACLE_STOP,
        Reason.DOCK_MISSED: Reason.GOAL_MISSED,
        Reason.DOCK_NOT_SEEN: Reason.INPUT_STALE,
        Reason.LIDAR_TURNED: Reason.TIME_OFFSET,
        Reason.MAP_CHANGED: Reason.OUTSIDE_MAP,
    }
    failing = [reason.exit_code for reason in Reason if reason.exit_code and reason not in later]
    assert len(failing) == len(set(failing))
    assert all(reason.exit_code == broader.exit_code for reason, broader in later.items())
    assert all(0 <= reason.exit_code < 126 and reason.text for reason in Reason)
    assert Reason("tilt_stop") is Reason.TILT_STOP
    assert Reason.BAD_CONFIG.exit_code == 2


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"foxglove": "foxglove.PointCloud"}, "foxglove"),
        ({"rate": "10"}, "rate"),
        ({"stale_after": -1.0}, "stale_after"),
    ],
)
def test_a_topic_of_another_distribution_that_the_recorder_could_not_write_is_refused(changes, complaint):
    row = dataclasses.replace(topics.COMPASS, name="sensor/radar", **changes)
    assert complaint in (topics.BY_NAME.fault(row) or "")


@pytest.mark.parametrize(
    ("key", "found"),
    [
        ("mt/truck/req/ann/drive", ("req/drive", "ann")),
        ("mt/truck/req/ann@laptop:12/control", ("req/control", "ann@laptop:12")),
        ("mt/truck/req/control", ("req/control", None)),
        (topics.estop_key("truck", "ann"), (topics.ESTOP_WAY, "ann")),
        ("mt/truck/rpc/arm/ann", ("arm", "ann")),
        ("mt/truck/rpc/arm", ("arm", None)),
        ("mt/rover/req/ann/drive", None),
        ("mt/truck/req/**", None),
        ("mt/truck/req/*/drive", None),
        ("mt/truck/req/ann:$*/drive", None),
        ("mt/truck/req/@ann/drive", None),
        ("mt/truck/req/" + 65 * "a" + "/drive", None),
        ("mt/truck/rpc/schema/state/pose", None),
        ("mt/truck/state/pose", None),
    ],
)
def test_the_sender_is_read_from_the_key(key, found):
    assert sender_in("truck", key) == found
