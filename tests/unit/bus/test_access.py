"""Access rules follow from the topic table."""

import json
from pathlib import Path

import pytest
from pydantic import ValidationError

from monstertruck_schemas.topics import TOPICS, Writer
from monstertruckd.bus.access import access_rules, in_groups, out_groups
from monstertruckd.bus.zenoh_config import TlsConfig, ZenohConfig, session_config


def test_every_group_goes_one_way():
    assert set(out_groups()) == {"sensor", "state", "plan", "cmd", "health", "event"}
    assert in_groups() == ("req",)
    for topic in TOPICS:
        assert (topic.group in in_groups()) == (topic.writer is Writer.OUTSIDE)


def test_put_leaves_with_state_and_enters_with_requests_only():
    rules = access_rules("rover")["rules"]
    for rule in rules:
        assert len(rule["flows"]) == 1
        if "put" in rule["messages"]:
            entering = [".".join(key.split("/")[2:3]) for key in rule["key_exprs"] if rule["flows"] == ["ingress"]]
            leaving = [".".join(key.split("/")[2:3]) for key in rule["key_exprs"] if rule["flows"] == ["egress"]]
            assert set(entering) <= {"req"}
            assert "req" not in leaving
    assert all(key.startswith("mt/rover/") for rule in rules for key in rule["key_exprs"])


def test_everything_else_is_denied():
    rules = access_rules("rover")
    assert rules["enabled"] is True
    assert rules["default_permission"] == "deny"


def test_pilots_and_observers_are_told_apart_by_certificate():
    rules = access_rules("rover", ["pilot"], ["observer"])
    policies = {policy["subjects"][0]: set(policy["rules"]) for policy in rules["policies"]}
    assert policies["observers"] == {"see-in", "see-out"}
    assert policies["pilots"] > policies["observers"]
    assert [subject["cert_common_names"] for subject in rules["subjects"]] == [["pilot"], ["observer"]]


def test_tls_without_a_pilot_is_refused():
    with pytest.raises(ValidationError, match="pilots"):
        TlsConfig.model_validate_json('{"ca": "ca.pem", "certificate": "t.pem", "key": "t.key", "pilots": []}')


def test_tls_means_access_control():
    tls = TlsConfig(ca=Path("ca.pem"), certificate=Path("t.pem"), key=Path("t.key"), pilots=("ann",))
    config = json.loads(session_config("rover", ZenohConfig(tls=tls)))
    assert config["access_control"] == access_rules("rover", ["ann"], [])
    assert config["transport"]["link"]["tls"]["enable_mtls"] is True
