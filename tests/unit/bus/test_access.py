"""Access rules follow from the topic table, grants from the certificates' names."""

import json
from pathlib import Path

import pytest
from pydantic import ValidationError

from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import TOPICS, Writer
from monstertruckd.bus.access import EVERYTHING, OBSERVING, Grant, access_rules, in_groups, out_groups, role_needed
from monstertruckd.bus.zenoh_config import TlsConfig, ZenohConfig, listeners, session_config

FILES = {"ca": Path("ca.pem"), "certificate": Path("t.pem"), "key": Path("t.key")}


def test_every_group_goes_one_way():
    assert set(out_groups()) == {"sensor", "state", "plan", "cmd", "health", "event"}
    assert in_groups() == ("req",)
    for topic in TOPICS:
        assert (topic.group in in_groups()) == (topic.writer is Writer.OUTSIDE)


@pytest.mark.parametrize("owners", [None, ["ann"]])
def test_put_leaves_with_state_and_enters_with_requests_only(owners):
    seen = "mt/stand/sensor/pose_rover"
    rules = access_rules("rover", owners)["rules"]
    assert [rule["id"] for rule in rules if seen in rule["key_exprs"]] == ["requests-out", "stand-in"]
    rules = [{**rule, "key_exprs": [key for key in rule["key_exprs"] if key != seen]} for rule in rules]
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


def test_each_certificate_asks_under_its_own_name_only():
    rules = access_rules("rover", ["ann", "bob"])
    assert [subject["cert_common_names"] for subject in rules["subjects"]] == [["ann"], ["bob"]]
    by_id = {rule["id"]: rule for rule in rules["rules"]}
    for owner in ("ann", "bob"):
        (policy,) = [policy for policy in rules["policies"] if policy["subjects"] == [owner]]
        own = [
            by_id[name]
            for name in policy["rules"]
            if name not in ("see-in", "see-out", "requests-out", "calls-out", "stand-in")
        ]
        assert {(rule["flows"][0], *rule["messages"]): rule["key_exprs"] for rule in own} == {
            ("ingress", "put"): [f"mt/rover/req/{owner}/**", f"mt/rover/req/{owner}:$*/**"],
            ("ingress", "query"): [f"mt/rover/rpc/*/{owner}", f"mt/rover/rpc/*/{owner}:$*"],
        }


@pytest.mark.parametrize(
    ("names", "text"),
    [
        ({}, "pilots or engineers"),
        ({"observers": ("bob",)}, "pilots or engineers"),
        ({"pilots": ("ann", "bob"), "observers": ("bob",)}, "bob: expected one role"),
        ({"pilots": ("ann",), "ranks": {"cy": Role.GAMEPAD}}, "cy: expected names"),
        ({"pilots": ("ann",), "ranks": {"ann": Role.ESTOP}}, "ranks"),
        *(({"pilots": (name,)}, "pilots") for name in ("a/b", "a*", "a$b", "@a", "", "a:b", "a b", "x" * 33)),
    ],
)
def test_names_that_make_no_sense_are_refused(names, text):
    with pytest.raises(ValidationError, match=text):
        TlsConfig(**FILES, **names)


def test_tls_means_access_control():
    tls = TlsConfig(**FILES, pilots=("ann",), observers=("bob",))
    config = ZenohConfig(tls=tls)
    (stations, local) = listeners(config)
    written = json.loads(session_config("rover", config, stations))
    assert written["access_control"] == access_rules("rover", ["ann", "bob"])
    assert written["transport"]["link"]["tls"]["enable_mtls"] is True
    assert json.loads(session_config("rover", config, local))["access_control"] == access_rules("rover")


def test_what_each_name_may_do():
    tls = TlsConfig(
        **FILES,
        pilots=("ann",),
        observers=("bob",),
        engineers=("cy",),
        ranks={"ann": Role.GAMEPAD, "cy": Role.KEYBOARD},
    )
    stations, local = listeners(ZenohConfig(tls=tls))
    assert stations.grant("ann") == stations.grant("ann:laptop-7") == Grant(AccessRole.PILOT, Role.GAMEPAD)
    assert stations.grant("bob") == Grant(AccessRole.OBSERVER, Role.STATION)
    assert stations.grant("cy") == Grant(AccessRole.ENGINEER, Role.KEYBOARD)
    assert stations.grant("eve") == stations.grant("anna") == OBSERVING
    assert local.grant("whoever") == EVERYTHING
    assert listeners(ZenohConfig())[0].grant("whoever") == EVERYTHING


@pytest.mark.parametrize(
    ("rank", "claimed", "granted"),
    [
        (Role.STATION, Role.GAMEPAD, Role.STATION),
        (Role.STATION, Role.ESTOP, Role.STATION),
        (Role.KEYBOARD, Role.STATION, Role.STATION),
        (Role.GAMEPAD, Role.GAMEPAD, Role.GAMEPAD),
        (Role.GAMEPAD, Role.TRACKER, Role.TRACKER),
        (Role.ESTOP, Role.ESTOP, Role.ESTOP),
    ],
)
def test_nobody_claims_more_than_its_rank(rank, claimed, granted):
    assert Grant(AccessRole.PILOT, rank).capped(claimed) is granted


def test_roles_include_those_before_them():
    observer, pilot, engineer = AccessRole
    assert [role.covers(pilot) for role in (observer, pilot, engineer)] == [False, True, True]
    assert all(role.covers(observer) for role in AccessRole)


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "udp/192.168.1.5:7447", "ws/truck.local:80", "quic/0.0.0.0:1"]
)
def test_a_network_without_certificates_must_be_asked_for_by_name(endpoint):
    with pytest.raises(ValidationError, match=r"anyone on the network could drive.*security init.*insecure: true"):
        ZenohConfig(listen=("tcp/127.0.0.1:7447", endpoint))
    assert ZenohConfig(listen=(endpoint,), insecure=True).open_endpoints == (endpoint,)
    with pytest.raises(ValidationError, match=r"anyone on the network could drive.*security init.*insecure: true"):
        ZenohConfig(connect=(endpoint,))
    assert ZenohConfig(connect=(endpoint,), insecure=True).open_endpoints == (endpoint,)


def test_this_machine_alone_is_no_network():
    listen = ("tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:7448", "unixsock-stream//run/x.sock")
    assert ZenohConfig(listen=listen, connect=listen).open_endpoints == ()


@pytest.mark.parametrize(
    "settings",
    [
        {"listen": ("tls/0.0.0.0:7447",)},
        {"listen_pilots": ("tls/0.0.0.0:7448",)},
        {"connect": ("tls/fleet.example:7447",)},
        {"listen_pilots": ("tls/0.0.0.0:7448",), "tls": TlsConfig(**FILES, pilots=("ann",))},
        {"listen_pilots": ("tcp/0:1",), "tls": TlsConfig(**FILES, pilots=("ann",), pilots_ca=Path("p.pem"))},
    ],
)
def test_endpoints_that_need_certificates_are_refused_without_them(settings):
    with pytest.raises(ValidationError, match=r"zenoh\.tls"):
        ZenohConfig(**settings)


def test_shaft_speeds_are_for_engineers():
    header = {"stamp": 1, "received": 1, "seq": 1, "source": "a", "role": Role.STATION, "lease": 0.3, "nonce": "n"}
    asked = {"speed": 0.0, "front": 0.0}
    assert role_needed(DriveRequest(**header, **asked)) is AccessRole.PILOT
    assert role_needed(DriveRequest(**header, **asked, shafts=(1.0, 1.0))) is AccessRole.ENGINEER
