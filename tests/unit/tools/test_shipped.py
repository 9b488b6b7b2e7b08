"""Files that come with the program beside its modules."""

import re
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.errors import ConfigError
from monstertruckd.config.load import load_config
from monstertruckd.tools import shipped as places
from monstertruckd.tools.cli.demo import DEMO_CONFIG
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

ROOT = Path(__file__).resolve().parents[3]


def test_a_file_is_looked_for_in_the_package_and_in_the_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package, checkout = tmp_path / "package", tmp_path
    monkeypatch.setattr(places, "PLACES", (package, checkout))
    assert places.shipped("configs/a.yaml") == checkout / "configs" / "a.yaml"
    for folder in (checkout, package):
        (folder / "configs").mkdir(parents=True)
        (folder / "configs" / "a.yaml").touch()
        assert places.shipped("configs/a.yaml") == folder / "configs" / "a.yaml"


def test_a_bundled_configuration_is_found_by_name_in_every_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    goals, mecanum = ROOT / "configs/goals.yaml", ROOT / "configs/robots/mecanum.yaml"
    assert {places.configuration(Path(name)) for name in ("goals", "configs/goals.yaml")} == {goals}
    found = {places.configuration(Path(name)) for name in ("mecanum", "robots/mecanum", "configs/robots/mecanum.yaml")}
    assert found == {mecanum}
    assert places.configuration(Path("truck")) == ROOT / "configs/truck.yaml", "before that of robots"
    assert {"goals", "robots/mecanum"} <= {*places.names()}
    for name in places.names():
        assert places.configuration(Path(name)).is_file()


def test_a_file_comes_before_a_bundled_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    own = Path("configs/goals.yaml")
    own.parent.mkdir()
    own.touch()
    assert places.configuration(own) == own
    Path("goals").mkdir()
    assert places.configuration(Path("goals")) == ROOT / "configs/goals.yaml", "a folder is no configuration"


def test_an_unknown_name_is_refused_with_the_nearest_or_with_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        ConfigError, match=r"^gaols: neither a file nor a bundled configuration; did you mean 'goals'\?$"
    ):
        places.configuration(Path("gaols"))
    with pytest.raises(ConfigError, match=r"expected a file or one of .*explore, .*robots/mecanum"):
        places.configuration(Path("zzz"))
    assert places.configuration(Path("mine.yaml")) == Path("mine.yaml"), "the reader says that it is missing"
    assert places.configuration(tmp_path / "goals.yaml") == tmp_path / "goals.yaml", "an absolute name is a file's"


def test_commands_take_a_bundled_configuration_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    shown = CliRunner().invoke(app, ["config", "show", "mecanum", "--key", "robot"])
    assert (shown.exit_code, "mecanum" in shown.stdout) == (0, True), shown.output
    refused = CliRunner().invoke(app, ["simulate", "--robots", "mecanum,gaols"])
    assert "gaols: neither a file nor a bundled configuration" in refused.output


def test_the_demos_configuration_is_there():
    assert DEMO_CONFIG.is_file()


def test_the_wheel_holds_all_configurations_and_the_files_of_the_service(tmp_path: Path):
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    with ZipFile(wheel) as archive:
        held = set(archive.namelist())
    listed = subprocess.run(["git", "ls-files", "configs", "systemd"], cwd=ROOT, capture_output=True, text=True)
    files = listed.stdout.split() or [
        str(path.relative_to(ROOT)) for path in (ROOT / "configs").rglob("*") if path.is_file()
    ]
    assert len(files) > 20
    assert {f"monstertruckd/{name}" for name in files} <= held


def test_shipped_configurations_write_below_the_folder_they_are_used_in_and_say_how_they_are_tried():
    texts = {file: file.read_text() for file in (ROOT / "configs").rglob("*.yaml")}
    assert not {
        file.name for file, text in texts.items() if re.search(r"^ *(save|directory): *\.\.", text, re.MULTILINE)
    }
    tried = [
        (file.name, line)
        for file, text in texts.items()
        for line in re.findall(r"^#.* simulate .*, then .*", text, re.MULTILINE)
    ]
    orders = [row for row in tried if "then monstertruckd" in row[1]]
    assert len(orders) >= 5
    assert [row for row in orders if "--run" not in row[1]] == [], "without it no daemon runs"


@pytest.mark.parametrize("name", ["goals", "explore", "points", "as-published", "slam", "fusion", "kiss"])
def test_where_the_robot_really_is_comes_with_every_configuration_that_drives_or_maps_by_itself(name: str):
    config = load_config(ROOT / "configs" / f"{name}.yaml", SimulatedTruckConfig)[0]
    assert config.stand == "simulator"
    assert (config.sim.stand.position_noise, config.sim.stand.heading_noise) == (0.0, 0.0)
