"""Topic reference, generated from the topic table: one page per group."""

from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import TOPICS, Topic, topics_of
from pages.markdown import Page, join, prose, table
from pages.models import Definitions, label, plain

GROUPS = {
    "sensor": "Sensor measurements.",
    "state": "State of the robot: pose, map, frames, gate.",
    "plan": "Output of the planners.",
    "cmd": "Commands from the gate to the actuators.",
    "health": "Health of the daemon, its services and the computer.",
    "event": "Events and their causes.",
    "req": "Requests from stations: the only keys that the robot receives.",
    "stand": "Measurements of a test stand; the robot records them and uses none.",
}
HEADER = frozenset(Message.model_fields)


def pages() -> list[Page]:
    """Return the overview and a page per group."""
    groups = dict.fromkeys(topic.group for topic in TOPICS)
    return [_overview(), *(_group(group) for group in groups)]


def _overview() -> Page:
    rows = [
        (
            f"[`{topic.name}`]({topic.group}.md#{anchor(topic)})",
            _hertz(topic),
            _seconds(topic),
            topic.writer.value,
            _kept(topic),
            topic.doc,
        )
        for topic in TOPICS
    ]
    header = Definitions(Message)
    text = join(
        "# Topics",
        "A key is `mt/<robot>/<name>`; a name is `<group>/<topic>`. Bus, recorder, health "
        "and access rules are derived from this table, and `monstertruckd topics` prints it. To use the topics in your "
        "own program, see [Zenoh](../zenoh.md).",
        table(("name", "Hz", "stale after s", "writer", "kept", "meaning"), rows),
        "Hz is the nominal rate, empty for topics published on change. A message older than *stale after* is "
        "invalid. *Logged* topics go to the log; *retained* topics reach late joiners at once.",
        "## Header",
        "Every message starts with these fields.",
        header.fields(header.root, lambda _: None),
    )
    return Page("topics/index.md", "All topics", text)


def _group(group: str) -> Page:
    shown: dict[type[Message], Topic[Message]] = {}
    parts = [f"# {group}", GROUPS[group]]
    for topic in topics_of(group):
        parts += [f"## {topic.name} {{ #{anchor(topic)} }}", f"{topic.doc}.", _facts(topic)]
        same = shown.setdefault(topic.model, topic)
        parts += [f"Same fields as [{same.name}](#{anchor(same)})."] if same is not topic else _fields(topic)
    return Page(f"topics/{group}.md", group, join(*parts))


def _facts(topic: Topic[Message]) -> str:
    form = f"protobuf `{topic.foxglove}`" if topic.foxglove else f"JSON `{topic.schema_name}`"
    rows = [
        ("key", f"`{topic.key('<robot>')}`"),
        ("message", f"`{topic.model.__module__}.{topic.model.__name__}`"),
        ("encoding", form),
        ("rate", f"{_hertz(topic)} Hz" if topic.rate else "on change"),
        ("stale after", f"{_seconds(topic)} s" if topic.stale_after else "never"),
        ("writer", topic.writer.value),
        ("kept", _kept(topic) or "no"),
    ]
    return table(("", " "), rows)


def _fields(topic: Topic[Message]) -> list[str]:
    models = Definitions(topic.model)
    here = anchor(topic)
    own = models.fields(models.root, lambda name: f"#{here}-{name.lower()}", HEADER)
    parts = [prose(topic.model.__doc__), own]
    waiting, seen = [models.root], set()
    while waiting:
        for field in waiting.pop(0).get("properties", {}).values():
            for name in models.models_in(field):
                if name in seen:
                    continue
                seen.add(name)
                inner = models[name]
                parts += [
                    f"### {label(inner, name)} {{ #{here}-{name.lower()} }}",
                    plain(inner.get("description", "")),
                    models.fields(inner, lambda other: f"#{here}-{other.lower()}"),
                ]
                waiting.append(inner)
    return parts


def anchor(topic: Topic[Message]) -> str:
    """Return the anchor of a topic on its group's page."""
    return topic.name.replace("/", "-").replace("_", "-")


def _hertz(topic: Topic[Message]) -> str:
    return "" if topic.rate is None else f"{topic.rate:g}"


def _seconds(topic: Topic[Message]) -> str:
    return "" if topic.stale_after is None else f"{topic.stale_after:g}"


def _kept(topic: Topic[Message]) -> str:
    return ", ".join(word for word, is_so in (("logged", topic.logged), ("retained", topic.retained)) if is_so)
