"""Who may do what over Zenoh, derived from the topic table.

Groups out of the robot may only leave it and requests may only enter it, so that no other peer can forge the robot's
state to the others. A rule covers a declaration only if it contains the whole declared key expression.
"""

from collections.abc import Sequence
from typing import Any

from monstertruck_schemas.topics import KEY_ROOT, TOPICS, Writer, alive_key, rpc_key

_SIDE_CHANNEL = "@adv/**"
"""Below a retained topic's key: history of its publisher; ``**`` alone never matches a part with an @."""


def out_groups() -> tuple[str, ...]:
    """Groups that only leave the robot, in the table's order."""
    return tuple(dict.fromkeys(topic.group for topic in TOPICS if topic.writer is not Writer.OUTSIDE))


def in_groups() -> tuple[str, ...]:
    """Groups that only enter the robot."""
    return tuple(dict.fromkeys(topic.group for topic in TOPICS if topic.writer is Writer.OUTSIDE))


def access_rules(
    robot: str, pilots: Sequence[str] | None = None, observers: Sequence[str] | None = None
) -> dict[str, Any]:
    """Zenoh ``access_control`` section for ``robot``.

    Args:
        robot: name of the robot.
        pilots: certificate common names that may see, ask and request; None = everybody who can connect.
        observers: certificate common names that may only see.
    """
    seen = [f"{KEY_ROOT}/{robot}/{group}/**" for group in out_groups()]
    history = [f"{KEY_ROOT}/{robot}/{group}/*/{_SIDE_CHANNEL}" for group in out_groups()]
    asked = [rpc_key(robot, "**")]
    requested = [f"{KEY_ROOT}/{robot}/{group}/**" for group in in_groups()]
    see = [
        _rule(
            "see-in",
            "ingress",
            ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query"],
            [*seen, *history, alive_key(robot)],
        ),
        _rule(
            "see-out",
            "egress",
            ["put", "delete", "liveliness_token", "declare_queryable", "reply"],
            [*seen, *history, alive_key(robot)],
        ),
    ]
    steer = [
        _rule("request-in", "ingress", ["put"], requested),
        _rule("request-out", "egress", ["declare_subscriber"], requested),
        _rule("ask-in", "ingress", ["query"], asked),
        _rule("ask-out", "egress", ["declare_queryable", "reply"], asked),
    ]
    subjects: list[dict[str, Any]] = (
        [{"id": "pilots"}]
        if pilots is None
        else [{"id": "pilots", "link_protocols": ["tls"], "cert_common_names": list(pilots)}]
    )
    policies = [{"rules": [rule["id"] for rule in (*see, *steer)], "subjects": ["pilots"]}]
    if observers:
        subjects.append({"id": "observers", "link_protocols": ["tls"], "cert_common_names": list(observers)})
        policies.append({"rules": [rule["id"] for rule in see], "subjects": ["observers"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [*see, *steer],
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
