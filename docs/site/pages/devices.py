"""Device reference: a page per kind, from the catalog, the settings and the docstrings of driver and emulator."""

import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_type_hints

from monstertruck_drivers.catalog import DEVICES, DeviceKind, Duty
from monstertruck_runtime.plugins import load
from monstertruck_runtime.yaml_files import yaml_text
from monstertruck_schemas.topics import Topic
from monstertruckd.config.load import load_tree
from pages.markdown import Page, join, prose, raised, section, table
from pages.models import Definitions, label, plain
from pages.topics import anchor

ROOT = Path(__file__).resolve().parents[3]
CONFIG = ROOT / "configs" / "truck.yaml"
BEHAVIOURS = ROOT / "tests" / "unit" / "drivers" / "behaviours"
"""Documented behaviours and the tests that hold them: one file a kind, a package of drivers, or a subject."""

LINE_FAULTS = """\
Faults of the cable: `unplug`, `plug`, `power-cycle`,
`line stalled|deaf|delay|chunk|flip_rate|drop_rate|lose_rate|double_rate|garbage VALUE`.
Faults of a signal (a reported value or a received command): `signal NAME FAULT [VALUE]`,
`signal NAME off`; `signal help` lists both.
[`emulate`](../commands/emulate.md) and [`simulate`](../commands/simulate.md) take faults on standard input."""


def pages() -> Iterator[Page]:
    """Yield a page per kind, and one of the behaviours that all devices share."""
    yield from map(_page, DEVICES.values())
    shared = [(BEHAVIOURS / f"{name}.md").read_text(encoding="utf-8") for name in ("ports", "usb", "common")]
    title = "Ports, USB and emulators"
    text = join(
        f"# {title}", "Behaviours that all devices share, and the tests that hold them.", *map(_lowered, shared)
    )
    yield Page("devices/shared.md", title, text)


def _page(kind: DeviceKind) -> Page:
    driver, identify = kind.implementation_class(), load(kind.identity)
    emulator = get_type_hints(kind.callable_at(kind.emulator))["return"]
    models = Definitions(kind.settings_class())
    text = join(
        f"# {kind.doc}",
        f"Driver, settings and emulated faults of `{kind.name}`.",
        _facts(kind),
        "Set-up and wiring: [devices](../devices.md).",
        "## Driver",
        prose(driver.__doc__),
        "These errors end a session; the restart policy starts the next:",
        table(("error", "when"), [(f"`{name}`", when) for name, when in raised(driver.run.__doc__)]),
        "## Settings",
        _example(kind),
        *_settings(models),
        "## Probe",
        f"`monstertruckd probe {kind.name}{PROBED[kind.opens]}`: {prose(identify.__doc__)}",
        section(identify.__doc__, "Returns"),
        "## Emulator",
        prose(sys.modules[emulator.__module__].__doc__).partition("\n\n")[2],
        _without_faults(emulator.__doc__),
        "## Faults",
        _faults(emulator),
        LINE_FAULTS if kind.opens in ("serial", "i2c") else "",
        *_held(kind),
    )
    return Page(f"devices/{kind.name}.md", f"{kind.role.name}: {kind.name}", text)


PROBED = {"serial": " --port /dev/...", "i2c": " --port /dev/i2c-1", "video": " --port '/dev/video*'", "computer": ""}


def _facts(kind: DeviceKind) -> str:
    rows = [
        ("place in the configuration", f"`{_group(kind)}.{kind.role.name}`"),
        ("`kind`", f"`{kind.name}`"),
        ("publishes", _topics(kind.role.writes)),
        ("reads", _topics(kind.role.reads)),
        ("line", "" if kind.baud is None else f"{kind.baud} baud"),
        ("code", f"`{kind.implementation.partition('.driver:')[0]}`"),
    ]
    return table(("", " "), [row for row in rows if row[1]])


def _group(kind: DeviceKind) -> str:
    return "monitors" if kind.role.duty is Duty.MONITOR else "devices"


def _held(kind: DeviceKind) -> Iterator[str]:
    """Yield the behaviours of a kind or of its package, if a file holds them."""
    package = kind.implementation.split(".")[1]
    for name in (kind.name, package):
        if (file := BEHAVIOURS / f"{name}.md").is_file():
            yield "## Behaviours"
            yield file.read_text(encoding="utf-8").partition("\n\n")[2]
            return


def _lowered(markdown: str) -> str:
    return markdown.replace("# ", "## ", 1).strip()


def _topics(ends: Mapping[str, Topic[Any]]) -> str:
    return ", ".join(f"[`{topic.name}`](../topics/{topic.group}.md#{anchor(topic)})" for topic in ends.values())


def _example(kind: DeviceKind) -> str:
    """Return the section of the thesis author's truck as an example."""
    group, role = _group(kind), kind.role.name
    said = load_tree(CONFIG).data.get(group, {}).get(role)
    if said is None:
        return ""
    text = yaml_text({group: {role: said}})
    return f"In [truck.yaml](../../configs/truck.yaml):\n\n```yaml\n{text}```"


def _settings(models: Definitions) -> list[str]:
    def link(name: str) -> str:
        return f"#{name.lower()}"

    parts = [plain(models.root.get("description", "")), models.fields(models.root, link)]
    held: dict[str, list[str]] = {}
    waiting = [models.root]
    while waiting:
        for key, field in waiting.pop(0)["properties"].items():
            for name in models.models_in(field):
                waiting += [] if name in held else [models[name]]
                held.setdefault(name, []).append(f"`{key}`")
    for name, keys in held.items():
        heading = f"### {', '.join(keys)}: {label(models[name], name)} {{ #{name.lower()} }}"
        parts += [heading, plain(models[name].get("description", "")), models.fields(models[name], link)]
    return parts


FAULTS = re.compile(r"\s*Faults \(`inject`\): (.*?)(?=\n\n|\Z)", re.DOTALL)


def _without_faults(docstring: str | None) -> str:
    return FAULTS.sub("", prose(docstring))


def _faults(emulator: Any) -> str:
    """Return the faults listed in the docstring of an emulator or of its ``inject``.

    Raises:
        ValueError: Neither docstring lists them.
    """
    in_class = FAULTS.search(prose(emulator.__doc__))
    if in_class is not None:
        return in_class[1]
    said = prose(emulator.inject.__doc__).partition("\n\n")[2]
    if not said:
        raise ValueError(f"{emulator.__name__}: neither the class nor `inject` lists its faults")
    return said
