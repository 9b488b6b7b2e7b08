"""The page "First day with the truck": every command line of it, by the command itself, on the emulated twin."""

import asyncio
import csv
import math
import shutil
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from monstertruck_estimation.slam.storage import load
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.yaml_files import read_yaml
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import GATE
from monstertruck_sim.world.obstacles import Box
from monstertruckd.config.load import load_truck
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.simulation.config import load_simulated, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.daemon.local_client import LocalClient
from tests.unit.docs.command_lines import FIRST_DAY, FOREIGN, INSTEAD, ROOT, Line, is_ours, lines_of, needs_truck

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(900)]

PAGE = ROOT / "docs" / "first-day.md"
TWIN = "configs/truck_emulated.yaml"
SIMULATE = f"monstertruckd simulate --run --config {TWIN}"
BY_HAND = "monstertruckd drive"
ANSWERS = {
    "monstertruckd calibrate drive --sign-only": ["--yes", "--answer", "forward=yes"],
    "monstertruckd calibrate steering --rough": ["--yes"],
}
"""What the operator answers to the wizards."""
AHEAD = 0.8
"""Distance of the box at which the operator drives, m."""
HELD = {"disarmed", "estopped"}
"""What holds a truck that works."""
MOVE = {"calibrate", "drive", "explore", "goto", "points"}
"""Commands that may move the truck."""


def lines() -> list[Line]:
    return lines_of(PAGE)


def here(line: Line) -> bool:
    """Whether the line is run by this file; the others are run by test_command_lines.py, or are no command of ours."""
    instead = INSTEAD.get(line.text)
    return is_ours(line) and (
        needs_truck(line) or line.text == SIMULATE or (instead is not None and instead.why == FIRST_DAY)
    )


def test_every_line_is_run_somewhere():
    assert len(lines()) > 30
    for line in lines():
        if not is_ours(line):
            assert line.text in FOREIGN, line.place
        elif not here(line):
            instead = INSTEAD.get(line.text)
            pulled = line.arguments[0] == "find-port"
            assert pulled or instead is None or instead.line is not None, f"{line.place}: run by no test"


class Pending(BaseException):
    """What a command would run on the wall clock."""

    def __init__(self, main: Callable[[Any], Coroutine[Any, Any, Any]]) -> None:
        self.main = main


class Day:
    """The twin, and an operator who types commands.

    A command is run again for each thing that it waits for. That is awaited here, on the virtual clock, and handed to
    the next run.
    """

    def __init__(self, rig: VirtualRig, clock: VirtualClock, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rig, self.clock = rig, clock
        self._outcomes: list[Any] = []
        self._next = 0
        self._programs = 0
        monkeypatch.setattr("monstertruck_runtime.clock.run_wall", self._run)
        monkeypatch.setattr(
            "monstertruck_runtime.robots.local_endpoints", lambda **_: []
        )  # of other robots on this computer
        for module in ("monstertruck_runtime.client", "monstertruckd.tools.status.watch"):
            monkeypatch.setattr(f"{module}.TruckClient", self._client)
        monkeypatch.setattr("monstertruck_drivers.computer.Machine", rig.computer.usb.machine)

    def _client(self, *_: Any, **__: Any) -> LocalClient:
        self._programs += 1
        return LocalClient(self.rig.daemon, self.clock, f"ann:{self._programs}")

    def _run(self, main: Callable[[Any], Coroutine[Any, Any, Any]]) -> Any:
        if self._next == len(self._outcomes):
            raise Pending(main)
        outcome = self._outcomes[self._next]
        self._next += 1
        if isinstance(outcome, TruckError):
            raise outcome
        return outcome

    async def type(self, *arguments: str) -> Result:
        """One command to its end."""
        self._outcomes = []
        while True:
            self._next = 0
            try:
                return CliRunner().invoke(app, list(arguments))
            except Pending as pending:
                try:
                    self._outcomes.append(await pending.main(self.clock))
                except TruckError as error:
                    self._outcomes.append(error)

    async def follow(self, line: Line) -> None:
        """Do what the page says."""
        if line.text == SIMULATE:
            return  # it is the rig
        if line.text == BY_HAND:
            await self._drive_at_a_box()
            return
        if line.arguments[0] == "find-port":
            await self._find_port(line)
            return
        instead = INSTEAD.get(line.text)
        text = instead.line if instead is not None and instead.line is not None else line.text
        done = await self.type(*Line(line.place, text).arguments, *ANSWERS.get(line.text, []))
        assert done.exit_code == 0, f"{line.place}: {line.text}: {done.output} {done.exception}"
        await self._settle()

    async def _find_port(self, line: Line) -> None:
        """Pull the cable, and plug it in again."""
        role = line.arguments[1]
        before = read_yaml(Path("configs/truck.yaml"))["devices"][role]["port"]

        async def hand() -> None:
            await self.clock.sleep(3.0)
            self.rig.computer.ports[role].unplug()
            await self.clock.sleep(2.0)
            self.rig.computer.ports[role].plug()

        pulling = asyncio.create_task(hand())
        done = await self.type(*line.arguments)
        await pulling
        assert done.exit_code == 0, f"{line.place}: {done.output}"
        found = read_yaml(Path("configs/truck.yaml"))["devices"][role]["port"]
        assert (found["hub"], found["port"]) == (before["hub"], before["port"])
        await self._settle()

    async def _drive_at_a_box(self) -> None:
        """Put a box before the truck, and hold the key until the gate stops it."""
        client, (x, y, yaw) = self._client(), self.rig.truth.array()[-1, 1:4]
        box = Box(x + AHEAD * math.cos(yaw), y + AHEAD * math.sin(yaw), 0.3, 0.3, yaw)
        self.rig.world.add(self.clock.now(), box)
        await client.arm()
        with client.subscribe(GATE, latest()) as gate:
            async with self.clock.deadline(30.0):
                while (state := gate.latest) is None or Reason.OBSTACLE_STOP not in state.reasons:
                    await client.drive(0.12, 0.0)
                    await self.clock.sleep(0.1)
        assert math.dist((x, y), self.place()) > 0.1, "it did not drive"
        await client.disarm()
        await client.drive(0.0, 0.0)
        self.rig.world.remove(self.clock.now(), box)
        await self._settle()

    async def _settle(self) -> None:
        """Until the devices work again, and the truck stands."""
        client = self._client()
        with client.subscribe(GATE, latest()) as gate:
            async with self.clock.deadline(60.0):
                while (state := gate.latest) is None or state.mode.moving or set(state.hindrances) - HELD:
                    await self.clock.sleep(0.5)

    def place(self) -> tuple[float, float]:
        """Where the truck really is, m."""
        x, y = self.rig.truth.array()[-1, 1:3]
        return float(x), float(y)


def spend(folder: Path, monkeypatch: pytest.MonkeyPatch, wanted: Callable[[Line], bool]) -> Day:
    """The day, by the lines that are wanted of those that are run here."""
    shutil.copytree(ROOT / "configs", folder / "configs")
    monkeypatch.chdir(folder)
    # On the loop the planners take no time of worker processes; what they compute is the same.
    config = with_overlay(load_simulated(Path(TWIN)), {"placement": {"planner": "loop", "explorer": "loop"}})
    days = []

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        day = Day(rig, clock, monkeypatch)
        days.append(day)
        async with rig.running():
            await clock.sleep(6.0)
            for line in filter(wanted, filter(here_or_pulled, lines())):
                before = day.place()
                await day.follow(line)
                if line.arguments[0] not in MOVE:
                    assert math.dist(before, day.place()) < 0.005, f"{line.place}: {line.text} moved the truck"

    run_virtual(main, start=SECOND)
    assert not days[0].rig.truth.array()[:, 5].any(), "collided"
    return days[0]


def here_or_pulled(line: Line) -> bool:
    return here(line) or (is_ours(line) and line.arguments[0] == "find-port")


def takes_minutes(line: Line) -> bool:
    """Of the truck's time, or it needs what such a line leaves behind."""
    return line.arguments[0] in ("explore", "points", "goto", "map") or line.arguments[:2] == ["calibrate", "steering"]


@pytest.mark.long
def test_from_unpacking_to_driving_by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    spend(tmp_path, monkeypatch, lambda line: not takes_minutes(line))
    load_truck(Path("configs/truck.yaml"))  # with the ports that were found


@pytest.mark.long
def test_the_day_ends_with_a_map_and_all_tags_at_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    day = spend(tmp_path, monkeypatch, lambda line: takes_minutes(line) or line.arguments[0] == "disarm")
    truth = day.rig.truth.array()
    assert math.dist(truth[-1, 1:3], (0.0, 0.0)) < 0.3, "not at home"
    saved = load(tmp_path / "runs" / "map")
    assert saved.graph is not None
    assert (tmp_path / "first.yaml").is_file()
    with (tmp_path / "tags.csv").open(newline="") as stream:
        places = {row["name"]: (float(row["x_m"]), float(row["y_m"])) for row in csv.DictReader(stream)}
    tags = {f"tag-{tag.tag}": (tag.x, tag.y) for tag in day.rig.config.sim.world.tags}
    assert places.keys() == tags.keys()
    origin = truth[0, 1:3]
    for name, place in places.items():
        assert math.dist(place, tags[name] - origin) < 0.1, name
