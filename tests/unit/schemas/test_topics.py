"""The topic table is consistent: everything else is derived from it."""

import pytest

from monstertruck_schemas.base import Message
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import BY_NAME, TOPICS, Topic, Writer, alive_key, rpc_key, topics_of


def test_names_are_unique_and_in_a_known_group():
    assert len(BY_NAME) == len(TOPICS)
    assert {topic.group for topic in TOPICS} == {"sensor", "state", "plan", "cmd", "health", "event", "req"}


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_rows(topic: Topic[Message]):
    assert topic.doc
    assert topic.key("truck") == f"mt/truck/{topic.name}"
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


def test_keys_beside_topics():
    assert rpc_key("truck", "topics") == "mt/truck/rpc/topics"
    assert alive_key("truck") == "mt/truck/alive"


def test_reasons_have_stable_exit_codes_and_texts():
    failing = [reason.exit_code for reason in Reason if reason.exit_code]
    assert len(failing) == len(set(failing))
    assert all(0 <= reason.exit_code < 126 and reason.text for reason in Reason)
    assert Reason("tilt_stop") is Reason.TILT_STOP
    assert Reason.BAD_CONFIG.exit_code == 2
