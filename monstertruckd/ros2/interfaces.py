"""ROS 2 interfaces by name: fields and type hashes.

``interfaces.txt`` lists them in the syntax of ``.msg``, ``.srv`` and ``.action`` files, without constants and defaults,
which are not part of a hash. The hash of a type is RIHS01: SHA-256 of its type description as JSON (REP 2016). Iron,
Jazzy, Kilted and Lyrical have the same hash for every interface here except for some actions of Nav2. Other editions of
those are marked, such as ``@kilted``: the same name on the wire, with the fields of that distribution.
"""

import hashlib
import importlib
import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

FILE: Final = Path(__file__).parent / "interfaces.txt"

PRIMITIVES: Final = {
    name: number
    for number, names in {
        2: "int8",
        3: "uint8 char",
        4: "int16",
        5: "uint16",
        6: "int32",
        7: "uint32",
        8: "int64",
        9: "uint64",
        10: "float32",
        11: "float64",
        15: "bool",
        16: "byte",
        17: "string",
    }.items()
    for name in names.split()
}
"""Type ids of ``type_description_interfaces/msg/FieldType``; a ``char`` of ROS 2 is a uint8."""
ARRAY, BOUNDED, UNBOUNDED = 48, 96, 144
"""Offsets of the type ids of arrays and of sequences with and without a maximum length."""

_FIELD: Final = re.compile(r"(?P<kind>[\w/@]+)(?P<many>\[(?P<limit><=)?(?P<count>\d*)\])? (?P<name>\w+)")

_PLACEHOLDER: Final = "uint8 structure_needs_at_least_one_member"
"""Field of an interface without fields."""


@dataclass(frozen=True, slots=True)
class RosField:
    """One field: a value, an array of ``count`` values, or a sequence of any number or of at most ``count``."""

    name: str
    kind: str
    """Primitive type, or full name of an interface such as ``std_msgs/msg/Header``."""
    many: int = 0
    """0 for one value, or ``ARRAY``, ``BOUNDED`` or ``UNBOUNDED``."""
    count: int = 0

    @property
    def nested(self) -> str | None:
        """Name of the interface, or None for a primitive."""
        return None if self.kind in PRIMITIVES else self.kind

    def described(self) -> dict[str, Any]:
        """The field in a type description, without its default value."""
        nested = 1  # type id of a field that is an interface itself
        number = (nested if self.nested else PRIMITIVES[self.kind]) + self.many
        kind = {"type_id": number, "capacity": self.count, "string_capacity": 0}
        return {"name": self.name, "type": kind | {"nested_type_name": wire_name(self.nested or "")}}


def _field(text: str) -> RosField:
    found = _FIELD.fullmatch(text)
    if found is None:
        raise ValueError(f"{text!r}: expected TYPE NAME")
    kind = found["kind"]
    if "/" in kind and kind.count("/") == 1:
        kind = kind.replace("/", "/msg/")
    if not found["many"]:
        return RosField(found["name"], kind)
    many = BOUNDED if found["limit"] else ARRAY if found["count"] else UNBOUNDED
    return RosField(found["name"], kind, many, int(found["count"] or 0))


def _fields(text: str) -> tuple[RosField, ...]:
    return tuple(_field(line) for line in text.strip().splitlines() or [_PLACEHOLDER])


def _service(name: str, request: str, response: str) -> Iterator[tuple[str, str]]:
    """Yield the types that ROS 2 derives from a service."""
    yield f"{name}_Request", request
    yield f"{name}_Response", response
    event = f"service_msgs/msg/ServiceEventInfo info\n{name}_Request[<=1] request\n{name}_Response[<=1] response"
    yield f"{name}_Event", event
    message = f"{name}_Request request_message\n{name}_Response response_message\n{name}_Event event_message"
    yield name, message


def _action(name: str, goal: str, result: str, feedback: str) -> Iterator[tuple[str, str]]:
    """Yield the types that ROS 2 derives from an action."""
    number = "unique_identifier_msgs/msg/UUID goal_id"
    yield from ((f"{name}_Goal", goal), (f"{name}_Result", result), (f"{name}_Feedback", feedback))
    accepted = "bool accepted\nbuiltin_interfaces/msg/Time stamp"
    yield from _service(f"{name}_SendGoal", f"{number}\n{name}_Goal goal", accepted)
    yield from _service(f"{name}_GetResult", number, f"int8 status\n{name}_Result result")
    yield f"{name}_FeedbackMessage", f"{number}\n{name}_Feedback feedback"


def parsed(text: str) -> dict[str, tuple[RosField, ...]]:
    """Parse fields by interface name; services and actions include the types that ROS 2 derives from them."""
    found: dict[str, tuple[RosField, ...]] = {}
    for part in text.split("=== ")[1:]:
        name, _, body = part.partition("\n")
        sections = re.split(r"^---\n", body, flags=re.MULTILINE)
        rows: Iterable[tuple[str, str]] = [(name, body)]
        if "/srv/" in name:
            rows = _service(name, *sections)
        elif "/action/" in name:
            rows = _action(name, *sections)
        found |= {own: _fields(fields) for own, fields in rows}
    return found


@cache
def interfaces() -> dict[str, tuple[RosField, ...]]:
    """Return the fields of every interface of the file by its full name, such as ``nav_msgs/msg/Odometry``."""
    return parsed(FILE.read_text(encoding="utf-8"))


def _needed(name: str, known: dict[str, tuple[RosField, ...]]) -> set[str]:
    needed: set[str] = set()
    waiting = [name]
    while waiting:
        nested = {field.nested for field in known[waiting.pop()] if field.nested}
        waiting += nested - needed
        needed |= nested
    return needed


DISTRIBUTIONS: Final = ("humble", "jazzy", "kilted", "lyrical")
"""Distributions of ROS 2 by age; an edition without a mark belongs to Jazzy."""


def action_edition(action: str, distribution: str) -> str:
    """Return the edition of an action in a distribution, e.g. ``nav2_msgs/action/FollowPath@lyrical``."""
    newest = DISTRIBUTIONS.index(distribution)
    marks = DISTRIBUTIONS[min(newest, 1) : newest + 1]  # 1: no later distribution has Humble's editions
    found = (f"{action}@{mark}" for mark in reversed(marks))
    return next((edition for edition in found if f"{edition}_Goal" in interfaces()), action)


def wire_name(name: str) -> str:
    """Return an interface name without the mark of a distribution."""
    return re.sub("@[a-z]+", "", name)


_OF_ACTIONS: Final = {
    "_SendGoal": "SendGoalService",
    "_GetResult": "GetResultService",
    "_FeedbackMessage": "FeedbackMessage",
}
"""Attributes of an action's ``Impl`` by name suffix: Python packages do not export the types that ROS 2 derives."""


def installed_interface(name: str) -> Any:
    """Return the class that ROS 2 generated for an interface, or None if its package or the interface is missing."""
    package, group, own = wire_name(name).split("/")
    try:
        module = importlib.import_module(f"{package}.{group}")
    except ModuleNotFoundError:
        return None
    for end, part in _OF_ACTIONS.items() if group == "action" else ():
        if own.endswith(end):
            action = getattr(module, own.removesuffix(end), None)
            return None if action is None else getattr(action.Impl, part)
    return getattr(module, own, None)


def hash_of(name: str, known: dict[str, tuple[RosField, ...]]) -> str:
    """Return the type hash of an interface, ``RIHS01_`` and 64 hexadecimal digits."""

    def described(own: str) -> dict[str, Any]:
        return {"type_name": wire_name(own), "fields": [field.described() for field in known[own]]}

    description = {
        "type_description": described(name),
        "referenced_type_descriptions": [described(other) for other in sorted(_needed(name, known), key=wire_name)],
    }
    return f"RIHS01_{hashlib.sha256(json.dumps(description).encode()).hexdigest()}"


@cache
def type_hash(name: str) -> str:
    """Return the type hash of an interface of the file."""
    return hash_of(name, interfaces())
