"""The how-to of drivers is followed to the letter: its package, installed outside the tree, is one of the robot's."""

import asyncio
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from monstertruck_runtime.yaml_files import yaml_text
from tests.daemon.wall_kit import end
from tests.plugin_kit import ROOT, files_of, installed, run_with, written

pytestmark = pytest.mark.timeout(180)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's files, next to the configurations that they include."""
    folder = written(files_of("driver"), tmp_path_factory.mktemp("sonar"))
    (folder / "configs").symlink_to(ROOT / "configs")
    return folder


@pytest.fixture(scope="module")
def target(project: Path) -> Path:
    """Where its wheel is installed."""
    return installed(project, project / "site")


def messages(log: Path, topic: str) -> list[dict[str, Any]]:
    with log.open("rb") as file:
        return [json.loads(message.data) for _, _, message in make_reader(file).iter_messages(topics=[topic])]


@pytest.mark.virtual
def test_it_is_driven_and_recorded(project: Path, target: Path, tmp_path: Path):
    points = (ROOT / "configs" / "paths" / "loop.csv").read_text().splitlines()
    (tmp_path / "begin.csv").write_text("\n".join(points[:41]) + "\n")
    config = tmp_path / "begin.yaml"
    path = {"file": str(tmp_path / "begin.csv"), "closed": False}
    config.write_text(yaml_text({"include": str(project / "robot.yaml"), "version": 1, "path": path}))
    out = run_with(target, "demo", "--fast", "-c", str(config), "-o", str(tmp_path / "run"))
    assert "sensor/ranger" in out
    (log,) = (tmp_path / "run" / "logs").glob("*.mcap")
    found = messages(log, "sensor/ranger")
    seconds = (found[-1]["stamp"] - found[0]["stamp"]) / 1e9
    assert len(found) / seconds == pytest.approx(1 / 0.134, rel=0.05)
    assert {message["frame"] for message in found} == {"ranger"}
    distances = [message["distance"] for message in found if "distance" in message]
    assert len(distances) > 0.9 * len(found), "a single beam may fail"
    assert max(distances) - min(distances) > 1.0, "the truck drove"
    rows = [row for table in messages(log, "health/services") for row in table["services"] if row["name"] == "ranger"]
    assert "ready" in {row["state"] for row in rows}


@pytest.mark.virtual
def test_it_is_listed_and_checked(project: Path, target: Path):
    assert "sensor/ranger" in run_with(target, "topics")
    listed = run_with(target, "plugins", "--json")
    assert {"mb7360", "sensor/ranger"} <= {row["name"] for row in json.loads(listed) if "truck-sonar" in row["origin"]}
    shown = run_with(target, "config", "show", str(project / "robot.yaml"))
    assert "9600" in shown, "its own baud rate"
    bad = project / "bad.yaml"
    bad.write_text((project / "robot.yaml").read_text().replace("  ranger:", "  rangger:"))
    with pytest.raises(AssertionError, match=r"bad\.yaml:5: devices\.rangger: unknown key \(did you mean ranger\?\)"):
        run_with(target, "config", "show", str(bad))
    with pytest.raises(AssertionError, match=r"devices\.ranger: unknown key; expected one of .*lidar"):
        run_with(project, "config", "show", str(project / "robot.yaml"))


@pytest.mark.wall
async def test_its_emulator_answers_its_probe(target: Path, tmp_path: Path):
    link = tmp_path / "ranger"
    environment, pipe = os.environ | {"PYTHONPATH": str(target)}, asyncio.subprocess.PIPE
    emulator = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "monstertruckd", "emulate", "ranger", "--link", str(link)),
        cwd=ROOT,
        env=environment,
        stdin=pipe,
        stdout=pipe,
        stderr=pipe,
    )
    try:
        assert emulator.stderr is not None
        assert "ranger" in (await emulator.stderr.readline()).decode()
        probed = json.loads(await asyncio.to_thread(run_with, target, "probe", "ranger", "--port", str(link), "--json"))
        assert probed["device"] == "MaxBotix MB7360 ultrasonic range finder"
        assert 300 <= probed["distance_mm"] <= 5000
    finally:
        await end(emulator)


def test_the_page_is_what_the_linters_want(project: Path):
    """So that whoever copies it starts clean."""
    for command in (("format", "--check"), ("check",)):
        ended = subprocess.run(
            [
                sys.executable,
                "-m",
                "ruff",
                *command,
                "--config",
                str(ROOT / "pyproject.toml"),
                str(project / "truck_sonar"),
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        assert ended.returncode == 0, ended.stdout
