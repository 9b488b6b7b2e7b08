"""``map build`` and ``map localise`` on an npz log: trajectory, geometry, and what is assumed of it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from monstertruck_kinematics.se2 import between
from monstertruck_runtime.map_files import WorldMap, save_map
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_truck
from monstertruckd.tools.cli.main import app
from tests.unit.estimation.slam.kit import BEAMS, LIDAR, ROOM, box, ranges, rounds
from tests.unit.tools.logs.bag_kit import ROS2, RosMessages, quaternion, stamp, write_ros2

DATA = Path(__file__).parents[3] / "data"
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
    expected = r"contains no range_min, time_increment; assuming returns from \S+ m on, \S+ s between beams"
    assert re.search(expected, " ".join(result.stderr.split()))
    facts = json.loads(result.stdout)
    assert "60 poses" in facts["trajectory"]
    assert facts["poses"] in {"joint registration", "graph"}
    rows = np.loadtxt(tmp_path / "poses.txt")
    assert rows[:, 0] == pytest.approx(500.0 + 0.1 * np.arange(60))
    assert np.hypot(*(rows[:, 1:3] - TRUTH[:, :2]).T).max() < 0.05
    found = CliRunner().invoke(app, ["map", "localise", str(log), str(tmp_path / "map"), "--json", *map(str, geometry)])
    assert found.exit_code == 0, found.output
    assert json.loads(found.stdout)["localised"] > 10


def test_a_lidar_that_is_not_mounted_as_given_is_reported(log: Path, tmp_path: Path):
    arguments = [log, "-o", tmp_path / "map", "--start-angle", np.degrees(LIDAR.start_angle), "--range-max", "5.6",
                 "--angle-increment", np.degrees(LIDAR.angle_increment), "--json"]  # fmt: skip
    right = CliRunner().invoke(app, ["map", "build", *map(str, arguments)])
    assert "the lidar is turned" not in right.stderr
    assert abs(json.loads(right.stdout)["lidar_yaw_off"]) < np.radians(1)
    wrong = CliRunner().invoke(app, ["map", "build", *map(str, arguments), "--mount", "0", "0", "5"])
    assert np.degrees(json.loads(wrong.stdout)["lidar_yaw_off"]) == pytest.approx(-5, abs=1)
    assert "odometry and scans differ by -" in wrong.stderr
    assert "the lidar is turned relative to its mount" in wrong.stderr
    assert "calibrate steering" in wrong.stderr


def arrays_of(log: Path) -> dict[str, np.ndarray]:
    with np.load(log) as arrays:
        return dict(arrays)


def test_the_summary_says_what_odometry_was_worth_and_why_scans_were_left_out(log: Path, tmp_path: Path):
    whole = arrays_of(log)
    rows, times, odom = (np.repeat(whole[name], 2, axis=0) for name in ("ranges", "t", "odom"))
    times[1::2] += 0.05
    times[21] = times[20]
    rows[31] = np.inf
    odom[60:] = np.nan
    np.savez(tmp_path / "log.npz", t=times, ranges=rows, odom=odom, start_angle=LIDAR.start_angle,
             angle_increment=LIDAR.angle_increment, range_max=5.6)  # fmt: skip
    done = CliRunner().invoke(app, ["map", "build", str(tmp_path / "log.npz"), "-o", str(tmp_path / "map"), "--json"])
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)
    assert facts["left_out"] == 2
    assert facts["left_out_by"] == {"stamp not later than the previous scan's": 1, "too few returns": 1}
    assert facts["odometry"]["used"] + facts["odometry"]["missing"] == pytest.approx(1.0)
    assert 0.3 < facts["odometry"]["missing"] < 0.5
    assert facts["lost_share"] == 0.0
    way = np.hypot(*np.diff(TRUTH[:, :2], axis=0).T).sum()
    assert facts["path_m"] == pytest.approx(way, rel=0.15)


def test_lost_poses_are_marked_and_the_exit_code_says_so(log: Path, tmp_path: Path):
    """The robot is carried to another room after a third of the path: nothing joins both rooms."""
    elsewhere = [*box(-2.0, -1.5, 2.4, 1.9), *box(0.6, 0.2, 1.1, 0.5), *box(-1.6, 0.9, -1.1, 1.9)]
    away, rng = rounds(90, 0.8, 0.9, 0.6), np.random.default_rng(2)
    rows = np.array([ranges(elsewhere, pose, noise=0.01, rng=rng) for pose in away])
    whole = arrays_of(log)
    np.savez(
        tmp_path / "log.npz", t=500.0 + 0.1 * np.arange(150), ranges=np.concatenate((whole["ranges"], rows)),
        odom=np.concatenate((TRUTH, away)), start_angle=LIDAR.start_angle,
        angle_increment=LIDAR.angle_increment, range_max=5.6,
    )  # fmt: skip
    poses = tmp_path / "poses.txt"
    done = CliRunner().invoke(
        app,
        ["map", "build", str(tmp_path / "log.npz"), "-o", str(tmp_path / "map"), "--trajectory", str(poses), "--json"],
    )
    assert done.exit_code == Reason.POSE_LOST.exit_code
    assert "path (limit" in done.stderr.splitlines()[-1]
    facts, lost = json.loads(done.stdout), np.loadtxt(tmp_path / "poses.lost.txt")
    assert facts["lost_share"] > 0.2
    assert facts["lost_poses"] == len(lost) > 60
    assert facts["rejected"] == sum(facts["rejected_by"].values()) > 0
    every = np.loadtxt(poses)
    assert len(every) == 150
    assert lost[:, 0] == pytest.approx(every[-len(lost) :, 0]), "from when it was carried on"
    assert CliRunner().invoke(app, ["map", "show", str(tmp_path / "map")]).exit_code == 0


def test_a_bag_becomes_a_map_with_a_graph_for_g2o_and_poses_for_kitti(tmp_path: Path):
    """A map of a log by another program: odometry and mount from the bag."""
    ros = RosMessages(ROS2)
    rng = np.random.default_rng(1)
    rows = []
    for k, (x, y, yaw) in enumerate(TRUTH.tolist()):
        at = ros.transform(stamp(k), "odom", "base_link", (x, y), quaternion(yaw=yaw))
        rows.append(("/tf", stamp(k), ros.make("tf2_msgs/msg/TFMessage", transforms=[at])))
        scan = ros.scan(stamp(k), ranges(ROOM, TRUTH[k], noise=0.01, rng=rng))
        scan.angle_min, scan.angle_increment, scan.range_max = LIDAR.start_angle, LIDAR.angle_increment, 5.6
        scan.header.frame_id, scan.time_increment = "base_link", 0.0
        rows.append(("/scan", stamp(k), scan))
    bag, place, poses = write_ros2(tmp_path / "bag", rows), tmp_path / "map", tmp_path / "poses.txt"
    done = CliRunner().invoke(
        app,
        ["map", "build", str(bag), "-o", str(place), "--topic", "/scan", "--trajectory", str(poses),
         "--trajectory-format", "kitti", "--json"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)
    assert facts["sources"] == {"scans": "/scan", "odometry": "transforms of base_link"}
    assert facts["lost_share"] == 0.0
    assert facts["odometry"]["used"] > 0.9
    matrices = np.loadtxt(poses).reshape(-1, 3, 4)
    assert np.hypot(*(matrices[:, :2, 3] - TRUTH[:, :2]).T).max() < 0.05
    graph = tmp_path / "graph.g2o"
    assert CliRunner().invoke(app, ["map", "show", str(place), "--g2o", str(graph)]).exit_code == 0
    lines = [line.split() for line in graph.read_text().splitlines()]
    vertices = {int(words[1]): [*map(float, words[2:])] for words in lines if words[0] == "VERTEX_SE2"}
    edges = [words for words in lines if words[0] == "EDGE_SE2"]
    assert len(edges) >= len(vertices) - 1 > 3
    for words in edges:
        measured = between(np.array(vertices[int(words[1])]), np.array(vertices[int(words[2])]))
        assert measured == pytest.approx([*map(float, words[3:6])], abs=0.02)
        assert len(words) == 12
        assert min(float(words[i]) for i in (6, 9, 11)) > 0, "diagonal of the information"


def test_a_log_by_another_program_becomes_a_map(tmp_path: Path):
    log = DATA / "foxglove_scans.mcap"
    done = CliRunner().invoke(app, ["map", "build", str(log), "-o", str(tmp_path / "map"), "--json"])
    assert done.exit_code == 0, done.output
    assert "contains no range_min, range_max, mount" in done.stderr
    assert json.loads(done.stdout)["scans"] == 50
    plain = tmp_path / "plain.yaml"
    save_map(WorldMap(np.zeros((10, 10), np.int8), 0.05), plain)
    refused = CliRunner().invoke(app, ["map", "show", str(plain), "--g2o", str(tmp_path / "graph.g2o")])
    assert refused.exit_code == 3
    assert "an occupancy grid without a pose graph" in refused.stderr


def test_a_log_whose_scans_all_have_one_stamp_is_lost_by_its_odometry(log: Path, tmp_path: Path):
    whole = arrays_of(log)
    np.savez(tmp_path / "log.npz", t=np.full(60, 500.0), ranges=whole["ranges"], odom=TRUTH)
    done = CliRunner().invoke(app, ["map", "build", str(tmp_path / "log.npz"), "-o", str(tmp_path / "map"), "--json"])
    assert done.exit_code == Reason.POSE_LOST.exit_code
    facts = json.loads(done.stdout)
    assert facts["lost_share"] == 1.0
    assert facts["left_out_by"] == {"stamp not later than the previous scan's": 59}


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
    assert f"none of its 3 scans is usable; the last one: only 0 of {BEAMS} beams" in result.output.replace("\n", " ")
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
        said = f"{target}: exists and was not written by this command; choose another file"
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
