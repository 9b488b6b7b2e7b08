"""The pages on the command line and on the reasons name the exit codes and keys there are."""

from pathlib import Path

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.driving.modes import SPEEDS, SteeringMode

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "command-line.md").read_text()


def test_every_reason_is_in_the_table_with_its_code(site_module):
    text = site_module("reasons").page().text
    rows = [line for line in text.splitlines() if line.startswith("| ")][2:]
    assert rows == sorted(rows, key=lambda row: int(row.split("|")[1]))
    assert sorted(rows) == sorted(f"| {each.exit_code} | `{each.value}` | {each.text} |" for each in Reason)


def test_modes_and_speeds_of_the_keyboard_are_reported():
    *first, last = (mode.value for mode in SteeringMode if mode is not SteeringMode.TWIST)
    assert f"{', '.join(first)} and {last} steering" in PAGE
    assert "drive by twist" in PAGE
    assert f"{', '.join(f'{speed:g}' for speed in SPEEDS)} m/s" in PAGE
