"""The command line starts soon: what a command needs beyond its options is loaded when it runs."""

import json
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from monstertruckd.tools.cli.entry import SUMMARIES
from monstertruckd.tools.cli.main import app
from tests.make_summaries import summaries

SLOW = "asyncio ssl uvloop numpy pydantic zenoh rich.console monstertruck_runtime.clock monstertruckd.config.truck"


def test_the_help_is_shown_without_what_takes_long_to_load():
    code = f"""
import sys
from monstertruckd.tools.cli.main import app
try:
    app(["--help"])
finally:
    print([name for name in {SLOW.split()} if name in sys.modules], file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Usage" in done.stdout
    assert done.stderr == "[]\n"


def loaded(*arguments: str) -> tuple[str, set[str]]:
    """Output of a command line, and the command modules that it has loaded."""
    code = """
import sys
from monstertruckd.__main__ import main
try:
    main()
finally:
    print(*(name for name in sys.modules if name.startswith("monstertruckd.tools.cli.")), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)
    return done.stdout, {name.rpartition(".")[2] for name in done.stderr.splitlines()[-1].split()}


def test_the_list_of_commands_loads_none_of_them_and_is_the_same():
    assert json.loads(SUMMARIES.read_text()) == summaries(), "run `python -m tests.make_summaries`"
    for option in ("--help", "-h"):
        text, modules = loaded(option)
        assert modules == {"entry", "output"}
        assert text == CliRunner().invoke(app, ["--help"], prog_name="-c").stdout


@pytest.mark.parametrize(("arguments", "module"), [(["zone", "--help"], "zones"), (["topics"], "robot")])
def test_a_command_loads_its_own_module(arguments: list[str], module: str):
    text, modules = loaded(*arguments)
    assert text
    assert module in modules
    assert not modules & {"main", "demo", "calibrate", "goto", "kinematics"}


def test_a_mistyped_command_is_answered_with_the_nearest_of_all():
    done = subprocess.run(
        [sys.executable, "-m", "monstertruckd", "zon"], capture_output=True, text=True, timeout=30, check=False
    )
    assert "Did you mean 'zone'?" in done.stderr
