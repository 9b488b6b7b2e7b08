"""The tables of plug-ins as a whole."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.plugins import Catalog, kind_of
from monstertruck_schemas.entry_points import OURS
from monstertruckd.assembly import catalogs
from monstertruckd.assembly.catalogs import TABLES
from monstertruckd.tools.cli.main import app
from tests.plugin_kit import install

__all__ = ["install"]

ROOT = Path(__file__).parents[3]
ROWS = [(table, name) for table in TABLES if isinstance(table, Catalog) for name in table if table.origin(name) == OURS]

TRACKER = """
from typing import Literal
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_runtime.plugins import Plugin

class OtherConfig(TrackerConfig):
    kind: Literal["other"]

OTHER = Plugin(name="other", settings="other:OtherConfig", implementation="other_missing:Other", doc="Not all there")
"""


@pytest.mark.parametrize(("table", "name"), ROWS, ids=lambda value: value if isinstance(value, str) else value.group)
def test_every_row_of_ours_loads(table, name):
    row = table[name]
    assert kind_of(row.settings_class()) == name
    assert callable(row.implementation_class())
    assert row.doc


def test_groups_are_kept_apart():
    assert len({table.group for table in TABLES}) == len(TABLES)


def test_plugins_are_listed_with_their_origin_and_what_is_wrong_with_them(install, monkeypatch):
    group = "monstertruck.trackers"
    install("other-trackers", "other", TRACKER, {f"{group}:other": "other:OTHER", f"{group}:gone": "other:GONE"})
    fresh = Catalog(group, *(table[name] for table, name in ROWS if table.group == group))
    monkeypatch.setattr(catalogs, "TABLES", (fresh,))
    rows = {row["name"]: row for row in json.loads(CliRunner().invoke(app, ["plugins", "--json"]).stdout)}
    assert (rows["mpc"]["origin"], rows["mpc"]["error"]) == (OURS, None)
    assert rows["other"]["origin"] == "other-trackers 1.0"
    assert rows["other"]["error"] == "kind other: other_missing:Other: No module named 'other_missing'"
    assert rows["gone"]["error"] == "AttributeError: module 'other' has no attribute 'GONE'"
    assert "No module named 'other_missing'" in CliRunner().invoke(app, ["plugins"]).stdout


PLUGINS = [(table, name) for table, name in ROWS if table is not catalogs.DEVICES]


@pytest.mark.parametrize(("table", "name"), PLUGINS, ids=lambda value: value if isinstance(value, str) else value.group)
def test_every_kind_of_ours_has_a_user(table, name):
    def named(pattern: str, *files: str) -> list[str]:
        paths = (path for glob in files for path in ROOT.glob(glob))
        return [path.name for path in paths if re.search(pattern, path.read_text())]

    word = rf"\b{name}\b"
    users = named(rf"\b(kind: {name})\b", "configs/**/*.yaml") + named(rf"`{word}`|kind: {word}", "docs/*.md")
    assert users, "no shipped configuration and no page uses it: it gets a user, or goes"
