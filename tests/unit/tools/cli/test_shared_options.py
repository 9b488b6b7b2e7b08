"""Options that many commands have are the same in all of them."""

from collections import defaultdict

import pytest
import typer

from monstertruckd.tools.cli.main import app


def commands(command, path=()):
    """Every command with its words."""
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, (*path, name))
    if not hasattr(command, "commands"):
        yield " ".join(path), command


@pytest.mark.parametrize("option", ["--robot", "--endpoint", "--config"])
def test_an_option_has_the_same_short_name_everywhere(option: str):
    short = defaultdict(list)
    for name, command in commands(typer.main.get_command(app)):
        for parameter in command.params:
            if option in parameter.opts:
                short[tuple(sorted(parameter.opts))].append(name)
    assert len(short) == 1, dict(short)
    assert sum(map(len, short.values())) > 3
