"""Logs and configurations of every release, read by this version: the upgrade path.

A failure here means that somebody's old logs or configuration no longer load: mend the code, not the data.
"""

import json
import shutil
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from monstertruckd.config.load import load_truck
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.repair import recover
from monstertruckd.tools.demo.runs import free_endpoint
from monstertruckd.tools.logs.arrow import export_parquet
from monstertruckd.tools.logs.export import export_csv, export_mcap, export_npz
from monstertruckd.tools.logs.replay import replay_log
from monstertruckd.tools.logs.report import report
from monstertruckd.tools.logs.ros2 import export_ros2
from monstertruckd.tools.logs.summary import info

RELEASES = sorted((Path(__file__).parents[3] / "data" / "golden").iterdir())
pytestmark = pytest.mark.parametrize("release", RELEASES, ids=lambda folder: folder.name)


@pytest.fixture
def log(release):
    return release / "run.mcap"


@pytest.fixture
def expected(release):
    return json.loads((release / "expected.json").read_text())


def test_golden_files_are_small(release):
    assert sum(file.stat().st_size for file in release.iterdir()) < 200_000


def test_every_message_is_read_and_decoded(log, expected):
    reader = open_log(log)
    counts = {}
    for message in reader:
        decoded = message.decode()
        assert decoded.stamp == message.stamp
        counts[message.topic] = counts.get(message.topic, 0) + 1
    assert reader.damage is None
    assert counts == expected["topics"]


def test_summary(log, expected):
    summary = info(log)
    assert summary["duration"] == pytest.approx(expected["duration"])
    assert {name: row["messages"] for name, row in summary["topics"].items()} == expected["topics"]
    assert {"config.json", "calibration.json", "versions.json"} <= summary["attachments"].keys()


def test_report(log, expected, tmp_path):
    figures = report(log, tmp_path / "page.html").figures()
    assert figures["distance_m"] == pytest.approx(expected["distance"])
    assert (figures["robot"], figures["lost"], figures["damage"]) == ("truck", 0, None)
    assert figures["driving_s"] > 0


def test_recovery_of_its_first_half(log, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    done = recover(cut, cut)
    assert 0 < done.messages < sum(json.loads((log.parent / "expected.json").read_text())["topics"].values())
    with cut.open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_count == done.messages


@pytest.mark.parametrize("export", [export_csv, export_npz, export_parquet, export_ros2])
def test_exports(log, expected, tmp_path, export):
    assert export(log, tmp_path / "out").keys() == expected["topics"].keys()


def test_bag_and_dated_log_hold_every_message(log, expected, tmp_path):
    export_ros2(log, tmp_path / "bag")
    count = sum(expected["topics"].values())
    with AnyReader([tmp_path / "bag"]) as bag:
        assert bag.message_count == count
    export_mcap(log, tmp_path / "dated.mcap")
    assert info(tmp_path / "dated.mcap")["messages"] == count


def test_replay(log, expected):
    heard = {name: count for name, count in expected["topics"].items() if not name.startswith("req/")}
    assert replay_log(log, "golden", free_endpoint(), 1000.0, None) == sum(heard.values())


def test_configuration_loads(release, tmp_path):
    folder = Path(shutil.copytree(release, tmp_path / "robot"))
    config, _ = load_truck(folder / "truck.yaml")
    assert config.robot == "truck"
    assert config.geometry.drive_ratio == 644.0
    assert config.devices.stabiliser is not None
