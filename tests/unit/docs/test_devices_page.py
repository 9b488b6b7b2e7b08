"""Every documented behaviour of a device names tests that are there."""

import re
from pathlib import Path

import pytest

from monstertruck_drivers.catalog import DEVICES

ROOT = Path(__file__).resolve().parents[3]
FILES = sorted((ROOT / "tests" / "unit" / "drivers" / "behaviours").glob("*.md"))
HEAD = "| behaviour | held by |"


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_named_test_exists_where_the_file_says(file: Path):
    text = file.read_text(encoding="utf-8")
    places = [ROOT / place for place in re.findall(r"`(tests/[\w/.]+)`", text)]
    assert places
    files = [file for place in places for file in (place.rglob("test_*.py") if place.is_dir() else [place])]
    there = set(re.findall(r"def (test_\w+)\(", "\n".join(file.read_text(encoding="utf-8") for file in files)))
    named = set(re.findall(r"`(test_\w+)`", text))
    assert named
    assert named <= there


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_row_has_a_test_or_says_why_not(file: Path):
    lines = file.read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines if line.startswith("|")]
    assert rows[0] == HEAD
    for row in rows[2:]:
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert len(cells) == 2
        assert "`test_" in cells[1] or cells[1].startswith("not emulated"), row


def test_every_kind_but_those_of_the_computer_has_its_behaviours():
    names = {file.stem for file in FILES}
    without = {kind.name for kind in DEVICES.values() if not {kind.name, kind.implementation.split(".")[1]} & names}
    assert without == {"link_quality", "host_health"}


def test_the_tests_that_the_page_names_are_there():
    page = (ROOT / "docs" / "devices.md").read_text(encoding="utf-8")
    tests = (ROOT / "tests" / "unit" / "drivers").rglob("test_*.py")
    there = set(re.findall(r"def (test_\w+)\(", "\n".join(file.read_text(encoding="utf-8") for file in tests)))
    named = set(re.findall(r"`(test_\w+)`", page))
    assert named
    assert named <= there
