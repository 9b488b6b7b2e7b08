"""The page on the command line tells the exit codes and keys there are."""

from pathlib import Path

from monstertruck_schemas.reasons import Reason
from monstertruckd.cli.teleop import SPEEDS, SteeringMode

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "command-line.md").read_text()


def test_every_reason_is_in_the_table_with_its_code():
    rows = [line for line in PAGE.splitlines() if line.startswith("| ") and "| `" in line]
    assert sorted(rows) == sorted(f"| {r.exit_code} | `{r.value}` | {r.text} |" for r in Reason)


def test_modes_and_speeds_of_the_keyboard_are_told():
    *first, last = (mode.value for mode in SteeringMode)
    assert f"{', '.join(first)} and {last} steering" in PAGE
    assert f"{', '.join(f'{speed:g}' for speed in SPEEDS)} m/s" in PAGE
