"""The generated reference explains every key of the configuration, every field of a topic, and every option."""

import re
from pathlib import Path
from typing import Any

import pytest

from monstertruck_schemas.topics import TOPICS
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from tests.unit.docs.command_lines import PAGES, ROOT, commands_of, resolve


@pytest.fixture
def definitions(site_module):
    return site_module("models").Definitions


def unexplained(found: Any) -> set[str]:
    """Return the fields without a meaning; small records may explain all their fields in the class."""
    models = [found.root, *found.root.get("$defs", {}).values()]
    names = set()
    for model in models:
        fields = {name: field for name, field in model.get("properties", {}).items() if "const" not in field}
        without = {name for name, field in fields.items() if not found.meaning(field)}
        if without != fields.keys() or not model.get("description"):
            names |= {f"{model['title']}.{name}" for name in without}
    return names


def test_every_key_of_a_configuration_is_explained(definitions):
    assert unexplained(definitions(SimulatedTruckConfig)) == set()


def test_every_field_of_a_topic_is_explained(definitions):
    assert {name for topic in TOPICS for name in unexplained(definitions(topic.model))} == set()
    assert [topic.name for topic in TOPICS if not topic.doc] == []


def test_every_command_and_option_is_explained():
    commands = {" ".join(name): resolve(list(name))[0] for name in commands_of(app)}
    assert [name for name, command in commands.items() if not command.help] == []
    options = [(name, each.name) for name, command in commands.items() for each in command.params if not each.help]
    assert options == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_cells_of_tables_are_short(page: Path):
    rows = [line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    cells = [cell.strip() for row in rows for cell in re.sub(r"\]\([^)]*\)", "]", row).strip("|").split("|")]
    assert [cell for cell in cells if len(cell) > 200] == [], "make a long cell a section"
