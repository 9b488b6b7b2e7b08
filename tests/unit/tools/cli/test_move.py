"""``move``: what is no move is refused before any robot is asked; what is one reaches the robot as settings."""

import math

import pytest
from typer.testing import CliRunner

from monstertruck_runtime import client
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli import runs
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.cli.runs import RunEnd


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "expected --length 0.5, or --radius 0 --angle 90"),
        (["--length", "1", "--angle", "1"], "expected either a length or an angle"),
        (["--angle", "1"], "an angle needs a radius: 0 turns on the spot"),
        (["--radius", "0", "--length", "1"], "radius is 0"),
        (["--length", "0"], "the length or angle is 0: the robot would not move"),
        (["--radius", "0", "--angle", "0"], "the length or angle is 0: the robot would not move"),
        (["--length", "1", "--speed", "-0.1"], "--speed: expected greater than 0"),
        (["--length", "1", "--bearing", "400"], "--bearing"),
        (
            ["--radius", "0", "--angle", "90", "--speed", "0.1"],
            "--speed does not apply to a turn on the spot",
        ),
        (
            ["--length", "1", "--turn-rate", "0.1"],
            "--turn-rate does not apply to a move that is not a turn",
        ),
    ],
)
def test_what_is_no_move_is_refused_at_once(options, said):
    result = CliRunner().invoke(app, ["move", *options])
    assert result.exit_code == Reason.BAD_INPUT.exit_code
    assert said in result.output


@pytest.mark.parametrize(
    ("options", "settings"),
    [
        (["--length", "-0.5"], {"length": -0.5}),
        (["--length", "1", "--bearing", "90"], {"length": 1.0, "bearing": pytest.approx(math.pi / 2)}),
        (
            ["--radius", "0", "--angle", "-1.5rad", "--turn-rate", "0.3", "--profile", "ramp"],
            {"radius": 0.0, "angle": -1.5, "turn_rate": 0.3, "profile": "ramp"},
        ),
        (
            ["--radius", "1", "--length", "1", "--acceleration", "0.2"],
            {"radius": 1.0, "length": 1.0, "acceleration": 0.2},
        ),
    ],
)
def test_a_move_reaches_the_robot_as_settings_of_the_behaviour(monkeypatch, options, settings):
    asked = {}

    class Robot:
        def __init__(self, *_, **__):
            pass

        async def __aenter__(self):
            return self

        async def __aexit__(self, *_):
            pass

    async def run(_, name, *, arm, settings):
        asked.update(name=name, arm=arm, settings=settings)
        return RunEnd(Reason.BEHAVIOUR_DONE, "0.5 m", {})

    monkeypatch.setattr(client, "TruckClient", Robot)
    monkeypatch.setattr(runs, "run_behaviour", run)
    result = CliRunner().invoke(app, ["move", *options, "--arm"])
    assert result.exit_code == 0, result.output
    assert asked == {"name": "move", "arm": True, "settings": settings}
    assert "0.5 m" in result.output
