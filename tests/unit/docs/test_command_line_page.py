"""The page on the command line tells the exit codes and keys there are."""

from pathlib import Path

import pytest

from monstertruckd.tools.cli.robot import reasons
from monstertruckd.tools.driving.modes import SPEEDS, SteeringMode

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "command-line.md").read_text()


def test_every_reason_is_in_the_table_with_its_code(capsys: pytest.CaptureFixture[str]):
    reasons(markdown=True)
    assert capsys.readouterr().out in PAGE, "put in what `monstertruckd reasons --markdown` prints"


def test_modes_and_speeds_of_the_keyboard_are_reported():
    *first, last = (mode.value for mode in SteeringMode if mode is not SteeringMode.TWIST)
    assert f"{', '.join(first)} and {last} steering" in PAGE
    assert "drive by twist" in PAGE
    assert f"{', '.join(f'{speed:g}' for speed in SPEEDS)} m/s" in PAGE
