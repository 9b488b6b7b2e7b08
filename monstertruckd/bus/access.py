"""Access rules: the permissions of each certificate over Zenoh.

Zenoh's access rules bind a name to a certificate: under ``req/<name>/...`` and ``rpc/.../<name>``, only requests with
that certificate arrive. The daemon looks up the grant for the name, so it can answer a source that requests more than
it may, and it drops a request under another name.

State groups may only leave the robot and requests may only enter it, so that no peer can forge the robot's state
towards other peers. A rule covers a declaration only if it contains the complete declared key expression.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final

from monstertruck_schemas.req import ControlRequest, DriveForm, DriveRequest, Order, Request, Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import KEY_ROOT, STAND_POSE, TOPICS, Writer, alive_key, rpc_key

FLEET_RULE: Final = "fleet-in"
_OTHER_FLOW: Final = {"ingress": "egress", "egress": "ingress"}

ANONYMOUS: Final = "anonymous"
"""Source of requests whose key names none."""

_SIDE_CHANNEL = "@adv/**"
"""Below a retained topic's key: history of its publisher; ``**`` alone never matches a part with an @."""
_DESCRIPTIONS: Final = ("topics", "schema/**")
"""Calls without a caller: meaning of the keys and their contents."""


@dataclass(frozen=True, slots=True)
class Grant:
    """Permissions of one source."""

    role: AccessRole
    rank: Role
    """Highest priority it may claim."""

    def capped(self, role: Role) -> Role:
        """Return ``role``, or the grant's rank if that is lower; only the receiver has the role of the hand."""
        order = list(Role)
        return max(Role.GAMEPAD if role is Role.HAND else role, self.rank, key=order.index)


EVERYTHING: Final = Grant(AccessRole.ENGINEER, Role.ESTOP)
OBSERVING: Final = Grant(AccessRole.OBSERVER, Role.STATION)


@dataclass(frozen=True, slots=True)
class Sender:
    """Sender of a request or a call, identified by its key."""

    source: str
    grant: Grant

    def may(self, needed: AccessRole) -> bool:
        """Return whether the sender's role covers ``needed``."""
        return self.grant.role.covers(needed)

    def refusal(self, needed: AccessRole) -> str:
        """Reason why the role of this sender does not include ``needed``."""
        hint = "; the key contains no source" if self.source == ANONYMOUS else ""
        return f"{self.source} has the role {self.grant.role}, but this needs {needed}{hint}"


def role_needed(request: Request) -> AccessRole:
    """Return the role that a request requires: any role for the emergency stop, engineer for shaft speeds."""
    if isinstance(request, DriveRequest) and request.form is DriveForm.SHAFTS:
        return AccessRole.ENGINEER
    estop = isinstance(request, ControlRequest) and request.order is Order.ESTOP
    return AccessRole.OBSERVER if estop else AccessRole.PILOT


def out_groups() -> tuple[str, ...]:
    """Groups that only leave the robot, in the order of the table."""
    return tuple(dict.fromkeys(topic.group for topic in TOPICS if not topic.inward))


def in_groups() -> tuple[str, ...]:
    """Groups that only enter the robot."""
    return tuple(dict.fromkeys(topic.group for topic in TOPICS if topic.writer is Writer.OUTSIDE))


def access_rules(robot: str, owners: Iterable[str] | None = None, routers: Iterable[str] = ()) -> dict[str, Any]:
    """Return the Zenoh ``access_control`` section for ``robot``.

    Zenoh's rules have no variables: each certificate has its own rules, subject and policy.

    Args:
        robot: name of the robot.
        owners: common names of the certificates that may see the robot and send requests under their own name; None if
            every client may, under any name.
        routers: common names of a fleet's routers. Their messages may carry the name of any owner, because the router
            has compared the name with the certificate (``router_rules``).
    """
    common = _common(robot)
    if owners is None:
        own = {"everybody": _own("everybody", *_all_keys(robot))}
        subjects: list[dict[str, Any]] = [{"id": "everybody"}]
    else:
        own = {owner: _own(owner, *_keys_of(robot, owner)) for owner in owners}
        subjects = [_subject(owner) for owner in own]
    passing = [rule["id"] for rule in chain(common, *own.values())]
    policies = [
        {"rules": [rule["id"] for rule in (*common, *rules)], "subjects": [owner]} for owner, rules in own.items()
    ]
    fleet = [] if owners is None else list(routers)
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [*common, *chain.from_iterable(own.values()), *([_fleet_rule()] if fleet else [])],
        "subjects": [*subjects, *map(_subject, fleet)],
        "policies": [*policies, *({"rules": [*passing, FLEET_RULE], "subjects": [router]} for router in fleet)],
    }


def router_rules(fleet: Mapping[str, Iterable[str]]) -> dict[str, Any]:
    """Return the Zenoh ``access_control`` section for a router between robots and stations.

    A robot publishes only its own state and receives only requests addressed to it. A station observes and calls, under
    its own name, the robots that know it; it may watch for all robots, and finds these.

    Args:
        fleet: common names of the stations that each robot knows, by the robot's name, which is the common name of its
            certificate.
    """
    rules: list[dict[str, Any]] = [_fleet_rule()]
    policies: list[dict[str, Any]] = []
    seen_by: dict[str, list[str]] = {}
    for robot, owners in fleet.items():
        # The robot's end of its link, seen from the other end: messages that leave there enter here.
        behind = [
            _renamed(rule, f"{robot}-{rule['id']}", _OTHER_FLOW[rule["flows"][0]])
            for rule in (*_common(robot), *_own("fleet", *_all_keys(robot)))
        ]
        policies.append({"rules": [rule["id"] for rule in behind], "subjects": [robot]})
        common = [_renamed(rule, f"{rule['id']}-of-{robot}", rule["flows"][0]) for rule in _common(robot)]
        rules += [*behind, *common]
        for owner in owners:
            own = [
                _renamed(rule, f"{rule['id']}-of-{robot}", rule["flows"][0])
                for rule in _own(owner, *_keys_of(robot, owner))
            ]
            rules += own
            seen_by.setdefault(owner, []).extend(rule["id"] for rule in (*common, *own))
    policies += [{"rules": [*names, FLEET_RULE], "subjects": [owner]} for owner, names in seen_by.items()]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [_subject(name) for name in (*fleet, *seen_by)],
        "policies": policies,
    }


def _common(robot: str) -> list[dict[str, Any]]:
    """Permissions of every certificate that may see the robot."""
    seen = [f"{KEY_ROOT}/{robot}/{group}/**" for group in out_groups()]
    history = [f"{KEY_ROOT}/{robot}/{group}/*/{_SIDE_CHANNEL}" for group in out_groups()]
    descriptions = [rpc_key(robot, name) for name in _DESCRIPTIONS]
    requests, calls = _all_keys(robot)
    return [
        _rule(
            "see-in",
            "ingress",
            ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query"],
            [*seen, *history, *descriptions, alive_key(robot)],
        ),
        _rule(
            "see-out",
            "egress",
            ["put", "delete", "liveliness_token", "declare_queryable", "reply"],
            [*seen, *history, alive_key(robot)],
        ),
        _rule("requests-out", "egress", ["declare_subscriber"], [*requests, STAND_POSE.key(robot)]),
        # Every client may publish an observed pose of the robot: no part of the robot reads it.
        _rule("stand-in", "ingress", ["put"], [STAND_POSE.key(robot)]),
        _rule("calls-out", "egress", ["declare_queryable", "reply"], calls),
    ]


def _all_keys(robot: str) -> tuple[list[str], list[str]]:
    """Keys of all requests, and of all calls."""
    return [f"{KEY_ROOT}/{robot}/{group}/**" for group in in_groups()], [rpc_key(robot, "**")]


def _fleet_rule() -> dict[str, Any]:
    """Rule for the discovery of robots: one expression covers all robots, so no rule for a single robot contains it."""
    return _rule(FLEET_RULE, "ingress", ["declare_liveliness_subscriber", "liveliness_query"], [alive_key("*")])


def _renamed(rule: dict[str, Any], name: str, flow: str) -> dict[str, Any]:
    return {**rule, "id": name, "flows": [flow]}


def _subject(name: str) -> dict[str, Any]:
    return {"id": name, "link_protocols": ["tls"], "cert_common_names": [name]}


def _keys_of(robot: str, owner: str) -> tuple[list[str], list[str]]:
    """Keys of the requests and calls from an owner's programs."""
    sources = (owner, f"{owner}:$*")
    requests = [f"{KEY_ROOT}/{robot}/{group}/{source}/**" for group in in_groups() for source in sources]
    return requests, [rpc_key(robot, "*", source) for source in sources]


def _own(owner: str, requests: list[str], calls: list[str]) -> list[dict[str, Any]]:
    return [
        _rule(f"request-{owner}", "ingress", ["put"], requests),
        _rule(f"call-{owner}", "ingress", ["query"], calls),
    ]


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
