"""``map build`` and ``map localise`` on an npz log: trajectory, geometry, and what is assumed of it."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from monstertruck_runtime.map_files import WorldMap, save_map
from monstertruckd.config.load import load_truck
from monstertruckd.tools.cli.main import app
from tests.unit.estimation.slam.kit import BEAMS, LIDAR, ROOM, ranges, rounds

TRUTH = rounds(60, laps=0.5)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("log") / "room.npz"
    rng = np.random.default_rng(1)
    rows = np.array([ranges(ROOM, pose, noise=0.01, rng=rng) for pose in TRUTH])
    np.savez(file, t=500.0 + 0.1 * np.arange(60), ranges=rows, odom=TRUTH)
    return file


def test_a_trajectory_with_the_geometry_that_was_given(log: Path, tmp_path: Path):
    geometry = ["--start-angle", np.degrees(LIDAR.start_angle), "--angle-increment", np.degrees(LIDAR.angle_increment)]
    arguments = [log, "-o", tmp_path / "map", "--trajectory", tmp_path / "poses.txt", "--json", *geometry]
    result = CliRunner().invoke(
        app, ["map", "build", *map(str, arguments), "--range-max", "5.6", "--mount", "0", "0", "0"]
    )
    assert result.exit_code == 0, result.output
    assert "holds no range_min, time_increment" in result.stderr
    facts = json.loads(result.stdout)
    assert "60 poses" in facts["trajectory"]
    assert facts["poses"] in {"joint registration", "graph"}
    rows = np.loadtxt(tmp_path / "poses.txt")
    assert rows[:, 0] == pytest.approx(500.0 + 0.1 * np.arange(60))
    assert np.hypot(*(rows[:, 1:3] - TRUTH[:, :2]).T).max() < 0.05
    found = CliRunner().invoke(app, ["map", "localise", str(log), str(tmp_path / "map"), "--json", *map(str, geometry)])
    assert found.exit_code == 0, found.output
    assert json.loads(found.stdout)["localised"] > 10


@pytest.mark.parametrize(
    ("times", "ranges", "said"),
    [
        (np.arange(3.0), np.nan, "ranges: expected metres, got no finite value"),
        (np.arange(3.0), -1.0, "ranges: expected metres, got no finite value above 0"),
        (1e11 * np.arange(3.0), 1.0, "t: expected seconds, got a log of 2e+11 s"),
    ],
)
def test_bad_arrays_are_one_sentence(tmp_path: Path, times: np.ndarray, ranges: float, said: str):
    file = tmp_path / "bad.npz"
    np.savez(file, t=times, ranges=np.full((3, BEAMS), ranges))
    result = CliRunner().invoke(app, ["map", "build", str(file), "-o", str(tmp_path / "map")])
    assert result.exit_code != 0
    assert f"bad.npz: {said}" in result.output
    assert "Traceback" not in result.output


@pytest.mark.parametrize("command", ["build", "localise"])
def test_a_log_without_a_usable_scan_is_one_sentence(log: Path, tmp_path: Path, command: str):
    file, grid = tmp_path / "short.npz", tmp_path / "map.yaml"
    rows = np.full((3, BEAMS), np.inf)
    rows[:, 0] = 2.0
    np.savez(file, t=np.arange(3.0), ranges=rows)
    save_map(WorldMap(np.pad(np.zeros((40, 40), np.int8), 2, constant_values=100), 0.05, (0.0, 0.0)), grid)
    place = ["-o", str(tmp_path / "map")] if command == "build" else [str(grid)]
    result = CliRunner().invoke(app, ["map", command, str(file), *place])
    assert result.exit_code != 0
    assert f"none of its 3 scans can be used; the last one: only 0 of {BEAMS} beams" in result.output.replace("\n", " ")
    assert "Traceback" not in result.output
    assert not (tmp_path / "map").exists()


CONFIGS = Path(__file__).parents[4] / "configs"
CONFIG = CONFIGS / "slam.yaml"


def test_a_configuration_for_localisation_replaces_only_what_it_wrote_itself(tmp_path: Path):
    save_map(WorldMap(np.zeros((10, 10), np.int8), 0.05), tmp_path / "map.yaml")
    own, output = tmp_path / "own.yaml", tmp_path / "localise.yaml"
    own.write_text(f"include: {CONFIG}\nversion: 2\n")
    slam = tmp_path / "slam.yaml"
    slam.write_text(f"include: {CONFIG}\nversion: 2\nslam:\n  latency: 0.3\n")

    def load(config: Path, output: Path) -> Result:
        return CliRunner().invoke(
            app, ["map", "load", str(tmp_path / "map.yaml"), "-c", str(config), "-o", str(output)]
        )

    assert load(own, output).exit_code == 0
    assert load(own, output).exit_code == 0, "once more"
    for target in (own, slam, output):
        before = target.read_text()
        done = load(own if target != output else output, target)
        assert done.exit_code == 3
        said = f"{target}: is there already, and this command did not write it; name another file"
        assert done.stderr.splitlines()[-1] == said
        assert target.read_text() == before


def test_a_robot_that_explored_localises_in_what_it_has_saved(tmp_path: Path):
    save_map(WorldMap(np.zeros((10, 10), np.int8), 0.05), tmp_path / "map.yaml")
    output = tmp_path / "out.yaml"
    command = ["map", "load", str(tmp_path / "map.yaml"), "-c", str(CONFIGS / "explore.yaml"), "-o", str(output)]
    for _ in range(2):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 0, done.stderr
        assert f"`monstertruckd simulate --run --config {output}` localises in" in done.stderr
    config, _ = load_truck(output)
    assert config.explorer is None
    assert config.slam is not None
    assert config.slam.mode == "localisation"


@pytest.mark.parametrize(
    "base", ["version: 2\nrabbit: 1\n", f"include: {CONFIGS / 'robots' / 'sonar.yaml'}\nversion: 2\n"]
)
def test_a_configuration_that_is_refused_is_not_written(tmp_path: Path, base: str):
    save_map(WorldMap(np.zeros((10, 10), np.int8), 0.05), tmp_path / "map.yaml")
    (tmp_path / "bad.yaml").write_text(base)
    output = tmp_path / "out.yaml"
    done = CliRunner().invoke(
        app, ["map", "load", str(tmp_path / "map.yaml"), "-c", str(tmp_path / "bad.yaml"), "-o", str(output)]
    )
    assert done.exit_code == 2
    assert {file.name for file in tmp_path.iterdir()} == {"bad.yaml", "map.yaml", "map.png"}


def test_a_configuration_that_is_refused_leaves_the_former_one(tmp_path: Path):
    save_map(WorldMap(np.zeros((10, 10), np.int8), 0.05), tmp_path / "map.yaml")
    output, sonar = tmp_path / "out.yaml", CONFIGS / "robots" / "sonar.yaml"

    def load(config: Path) -> Result:
        return CliRunner().invoke(
            app, ["map", "load", str(tmp_path / "map.yaml"), "-c", str(config), "-o", str(output)]
        )

    assert load(CONFIG).exit_code == 0
    before = output.read_text()
    refused = load(sonar)
    assert refused.exit_code == 2
    assert str(output) in refused.stderr
    assert ".part" not in refused.stderr
    assert output.read_text() == before
    assert load(CONFIG).exit_code == 0


def test_a_folder_that_cannot_be_made_is_reported_before_the_map_is_built(log: Path, tmp_path: Path):
    (tmp_path / "file").touch()
    done = CliRunner().invoke(app, ["map", "build", str(log), "-o", str(tmp_path / "file")])
    assert done.exit_code == 3
    assert done.stderr.splitlines()[-1] == f"{tmp_path / 'file'}: File exists"
