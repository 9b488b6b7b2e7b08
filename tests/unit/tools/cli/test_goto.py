"""Sending the truck somewhere from the command line."""

import pytest
from typer.testing import CliRunner

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.main import app


class Unplanned:
    """A robot that drives paths and nothing else."""

    def __init__(self, *_, **__):
        pass

    async def __aenter__(self):
        return self

    async def __aexit__(self, *_):
        pass

    async def call(self, rpc):
        assert rpc == "config"
        return {"planner": None}


def test_a_robot_without_a_planner_is_reported(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("monstertruck_runtime.client.TruckClient", Unplanned)
    done = CliRunner().invoke(app, ["goto", "1", "0", "0"])
    assert done.exit_code == Reason.NOT_FOUND.exit_code
    assert done.output == "robot 'truck' has no planner: expected a section `planner` in its configuration\n"
