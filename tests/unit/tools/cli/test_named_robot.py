"""Every command that gives an order says to which robot, and on which computer."""

import re
import socket
from typing import Any, Self

import pytest
import typer
from typer.testing import CliRunner

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import NotFoundError
from monstertruckd.tools.cli.main import app
from tests.unit.tools.cli.test_shared_options import commands

LINES = {
    "goto": "goto 1 2 0",
    "track": "track configs/paths/bend.csv",
    "path": "path lap",
    "move": "move --length 1",
    "set": "set gate.speed_limit 0.1",
    "explore": "explore",
    "doctor": "doctor --drive --yes",
    "behave start": "behave start wall_left",
    "behave stop": "behave stop",
    "mission run": "mission run configs/missions/rooms.yaml",
    "mission stop": "mission stop",
    "dock": "dock",
    "undock": "undock charger",
    "study circle": "study circle",
    "study straight": "study straight",
    "tune wall": "tune wall",
    "points goto": "points goto door",
    "points mark": "points mark door",
    "points remove": "points remove door",
    "zone add": "zone add stairs 0,0 1,0 1,1",
    "zone off": "zone off stairs",
    "zone on": "zone on stairs",
    "zone remove": "zone remove stairs",
}
"""A line of each."""
OTHERWISE = {"arm", "disarm", "estop", "reset", "drive", "calibrate all"}
"""They say it with the outcome (``test_orders.py``), on their screen, or once for each wizard."""
READ = {
    "status",
    "echo",
    "get",
    "usb",
    "behave list",
    "calibrate show",
    "log fetch",
    "map save",
    "points list",
    "points export",
    "zone list",
}
"""They change nothing."""
SERVE = {"plan-server", "replay", "stand run", "security check"}
"""They serve a robot, or probe it, and order nothing."""


class Gone:
    """A robot that is there, and answers nothing."""

    source = "ann"

    def __init__(self, robot: str, endpoint: str, *, clock: Clock, timeout: float = 1.0) -> None:
        self.robot, self.endpoint = robot, endpoint

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        raise NotFoundError("gone")


def test_no_command_is_left_out():
    words = {
        name
        for name, command in commands(typer.main.get_command(app))
        if any("--endpoint" in parameter.opts for parameter in command.params)
    }
    wizards = {name for name in words if name.startswith("calibrate ")} - {"calibrate all", "calibrate show"}
    assert words - wizards == {*LINES} | OTHERWISE | READ | SERVE


@pytest.mark.parametrize("line", [*LINES.values(), "calibrate steering", "calibrate steering --undo"])
def test_it_says_to_which_robot(line: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("monstertruck_runtime.client.TruckClient", Gone)
    said = CliRunner().invoke(app, [*line.split(), "--endpoint", "tcp/127.0.0.1:7450"])
    assert re.search(rf"^robot: \w+ on {re.escape(socket.gethostname())}$", said.output, re.MULTILINE), said.output
