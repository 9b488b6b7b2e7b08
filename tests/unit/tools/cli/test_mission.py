"""``mission check|list|run``: mistakes by line, lists, and what is run."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.main import app

GOOD = """version: 2
name: round
steps:
  - { do: goto, x: 1, y: 2, yaw: 0, via: [[0, 1]], on_failure: continue }
  - { do: return, retries: 2, limit: 30 }
"""
BAD = GOOD + "  - { do: fly }\n  - { do: wait, seconds: -1 }\n"


def test_check_prints_the_steps_and_their_policies(tmp_path: Path):
    file = tmp_path / "round.yaml"
    file.write_text(GOOD)
    done = CliRunner().invoke(app, ["mission", "check", str(file)])
    assert done.exit_code == 0, done.output
    _, first, second = done.stdout.splitlines()
    assert first.split() == ["1", "0", "-", "continue", "goto", "1", "2", "0", "via", "0,1"]
    assert second.split() == ["2", "2", "30", "abort", "return"]


def test_mistakes_are_named_by_line(tmp_path: Path):
    file = tmp_path / "bad.yaml"
    file.write_text(BAD)
    done = CliRunner().invoke(app, ["mission", "check", str(file)])
    assert done.exit_code == Reason.BAD_CONFIG.exit_code
    assert "bad.yaml:6: steps.2" in done.output
    assert "bad.yaml:7: steps.3.seconds" in done.output


def test_steps_that_are_all_wrong_are_not_called_missing(tmp_path: Path):
    file = tmp_path / "bad.yaml"
    file.write_text("version: 2\nname: round\nsteps:\n  - { do: wait, seconds: -1 }\n")
    said = CliRunner().invoke(app, ["mission", "check", str(file)]).stderr
    assert said == f"{file}:4: steps.0.seconds: input should be greater than 0, found -1\n"
    file.write_text("version: 2\nname: round\nsteps: []\n")
    said = CliRunner().invoke(app, ["mission", "check", str(file)]).stderr
    assert said == f"{file}:3: steps: expected at least 1 in number\n"


def test_list_names_missions_and_what_is_wrong(tmp_path: Path):
    (tmp_path / "a.yaml").write_text(GOOD)
    (tmp_path / "b.yaml").write_text(BAD)
    done = CliRunner().invoke(app, ["mission", "list", str(tmp_path)])
    assert done.exit_code == 0
    assert "round" in done.stdout
    _, good, bad = done.stdout.splitlines()
    assert good.split() == ["a.yaml", "round", "2"]
    assert bad.split()[:4] == ["b.yaml", "line", "6:", "steps.2:"], "steps that cannot be read are not counted"
    assert CliRunner().invoke(app, ["mission", "list", str(tmp_path / "no")]).exit_code == Reason.NOT_FOUND.exit_code


@pytest.mark.parametrize("arguments", [[], ["x.yaml", "--resume"]])
def test_run_takes_a_file_or_the_interrupted_one(arguments: list[str]):
    done = CliRunner().invoke(app, ["mission", "run", *arguments])
    assert done.exit_code == Reason.BAD_INPUT.exit_code
