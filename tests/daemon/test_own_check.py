"""The how-to of gate checks is followed to the letter: its bumper, from a package outside the tree."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.plugin_kit import ROOT, files_of, installed, run_with, written

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(180)]

SHOCK = """
from pathlib import Path

from monstertruck_schemas.sensor import Imu, Vector3
from monstertruck_schemas.topics import IMU
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from tests.unit.gate.rig import Rig, header, make_gate

config = load_config(Path({config!r}), SimulatedTruckConfig)[0]
rig = Rig()
rig.gate = make_gate(own=config.checks)
assert IMU in rig.gate.reads
rig.driving(speed=0.1)
still, shock = Vector3(x=0.0, y=0.0, z=0.0), Vector3(x=-7.0, y=0.0, z=9.8)
rig.gate.observe(Imu(**header(rig.now), angular_velocity=still, linear_acceleration=shock), IMU)
rig.tick()
stop = rig.trips[-1]
print(stop.reason, "|", stop.text)
"""


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's files, next to the configurations that they include."""
    folder = written(files_of("gate_check"), tmp_path_factory.mktemp("bumper"))
    (folder / "configs").symlink_to(ROOT / "configs")
    return folder


@pytest.fixture(scope="module")
def target(project: Path) -> Path:
    """Where its wheel is installed."""
    return installed(project, project / "site")


def test_its_bumper_stops_the_truck(project: Path, target: Path):
    code = SHOCK.format(config=str(project / "robot.yaml"))
    path = f"{target}:{ROOT}"
    ended = subprocess.run(
        [sys.executable, "-c", code], env={"PYTHONPATH": path}, cwd=ROOT, capture_output=True, text=True, check=False
    )
    text = "stopped: front: the bumper felt a shock (acceleration -7 m/s^2, limit 6 m/s^2)"
    assert ended.stdout == f"own_check | {text}\n", ended.stderr


def test_it_is_listed_and_its_settings_are_checked(project: Path, target: Path):
    rows = {row["name"]: row for row in json.loads(run_with(target, "plugins", "--json"))}
    assert (rows["bumper"]["origin"], rows["bumper"]["error"]) == ("truck-bumper 1.0", None)
    bad = project / "bad.yaml"
    bad.write_text((project / "robot.yaml").read_text().replace("shock:", "shok:"))
    with pytest.raises(AssertionError, match=r"bad\.yaml:4: checks\.front\.shok: unknown key \(did you mean shock\?\)"):
        run_with(target, "config", "show", str(bad))
