"""docs/devices.md names tests that are there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "devices.md").read_text(encoding="utf-8")
SECTIONS = {section.partition("\n")[0]: section for section in PAGE.split("\n## ")[1:]}


@pytest.mark.parametrize("title", SECTIONS)
def test_every_named_test_exists_where_the_section_says(title: str):
    section = SECTIONS[title]
    places = [ROOT / place for place in re.findall(r"`(tests/[\w/.]+)`", section)]
    assert places
    files = [file for place in places for file in (place.rglob("test_*.py") if place.is_dir() else [place])]
    there = set(re.findall(r"def (test_\w+)\(", "\n".join(file.read_text(encoding="utf-8") for file in files)))
    named = set(re.findall(r"`(test_\w+)`", section))
    assert named
    assert named <= there


def test_every_row_of_a_table_has_a_test_or_says_why_not():
    rows = [line for line in PAGE.splitlines() if line.startswith("|") and not line.startswith("|--")]
    tables = rows[rows.index("| what it does | held by |") :]
    for row in tables:
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        if len(cells) == 2 and cells[1] != "held by":
            assert "`test_" in cells[1] or cells[1].startswith("not emulated"), row
