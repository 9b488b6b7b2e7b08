"""Logs that cannot be computed again, and the command as a user types it."""

import json

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.errors import ConfigError, InputError, NotFoundError
from monstertruck_schemas.reasons import Reason
from monstertruckd.recorder.reader import open_log
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.replay_check import check_log
from tests.unit.tools.replay_check.log_surgery import LEVEL, SLAM, attachments_of, changed, digit, flip, write


def some(log, count=400):
    return [entry for entry, _ in zip(open_log(log), range(count), strict=False)]


def test_no_log(tmp_path):
    with pytest.raises(NotFoundError, match="no such log"):
        check_log(tmp_path / "gone.mcap")
    (tmp_path / "text.mcap").write_text("not a log")
    with pytest.raises(InputError, match="not an MCAP log"):
        check_log(tmp_path / "text.mcap")


def test_a_log_without_messages(tmp_path):
    with pytest.raises(InputError, match="contains no messages"):
        check_log(write(tmp_path / "log.mcap", [], attachments_of(LEVEL)))


def test_a_log_without_configuration(tmp_path):
    log = write(tmp_path / "log.mcap", some(LEVEL), {})
    with pytest.raises(InputError, match=r"config\.json is not attached"):
        check_log(log)


@pytest.mark.parametrize(
    ("attached", "match"),
    [
        ({"version": 1, "wheels": 5}, r"log\.mcap: config\.json: wheels: Extra inputs are not permitted"),
        ([1, 2], r"log\.mcap: config\.json: expected an object"),
    ],
)
def test_a_log_whose_configuration_is_refused(tmp_path, attached, match):
    with pytest.raises(ConfigError, match=match):
        check_log(write(tmp_path / "log.mcap", some(LEVEL), {"config.json": attached}))


def test_a_log_without_sensors(tmp_path):
    entries = [entry for entry in some(LEVEL) if not entry.topic.startswith("sensor/")]
    with pytest.raises(InputError, match="no sensor messages"):
        check_log(write(tmp_path / "log.mcap", entries, attachments_of(LEVEL)))


def test_a_log_without_outputs(tmp_path):
    entries = [entry for entry in some(LEVEL) if entry.topic.startswith("sensor/")]
    with pytest.raises(InputError, match="no outputs of estimation"):
        check_log(write(tmp_path / "log.mcap", entries, attachments_of(LEVEL)))


def test_a_later_part_of_a_run(tmp_path):
    entries = list(open_log(LEVEL))[1500:]
    with pytest.raises(InputError, match=r"starts with number [0-9]+: expected the first part of a run"):
        check_log(write(tmp_path / "log.mcap", entries, attachments_of(LEVEL)))


def test_the_saved_map_is_gone(tmp_path):
    config = attachments_of(SLAM)["config.json"]
    config["slam"] |= {"mode": "localisation", "map": str(tmp_path / "hall")}
    with pytest.raises(NotFoundError, match=r"slam\.map: .*hall: no such folder"):
        check_log(changed(SLAM, tmp_path / "log.mcap", **{"config.json": config}))


def test_nothing_is_saved(tmp_path):
    config = attachments_of(SLAM)["config.json"]
    config["slam"]["save"] = str(tmp_path / "hall")
    check_log(changed(SLAM, tmp_path / "log.mcap", **{"config.json": config}))
    assert not (tmp_path / "hall").exists()


def run(*arguments):
    return CliRunner().invoke(app, ["replay", *map(str, arguments)])


@pytest.mark.parametrize("name", ["gone.yaml", "wrong.yaml"])
def test_an_unknown_configuration(tmp_path, name):
    (tmp_path / "wrong.yaml").write_text("version: 1\nwheels: 5\n")
    done = run(LEVEL, "--check", "--config", tmp_path / name)
    assert done.exit_code == Reason.BAD_CONFIG.exit_code
    assert name in done.output


def test_the_table_says_what_came_again():
    done = run(LEVEL, "--check", "--tolerance", "1e-6")
    assert done.exit_code == 0, done.output
    assert "outputs identical" in done.output
    assert "state/odometry" in done.output


def test_the_table_says_how_far_and_when(tmp_path):
    log = changed(LEVEL, tmp_path / "log.mcap", flip("sensor/compass", 100, digit("heading", 1), bit=4))
    done = run(log, "--check", "--tolerance", "1e-6")
    assert done.exit_code == Reason.REPLAY_DIFFERS.exit_code
    assert "° at " in done.output
    assert "first difference: state/" in done.output
    assert Reason.REPLAY_DIFFERS.text in done.output


def test_json_says_the_same(tmp_path):
    log = changed(LEVEL, tmp_path / "log.mcap", flip("sensor/compass", 100, digit("heading", 1), bit=4))
    done = run(log, "--check", "--json", "--tolerance", "1e-6")
    assert done.exit_code == Reason.REPLAY_DIFFERS.exit_code
    figures = json.loads(done.stdout)
    assert figures["reason"] == "replay_differs"
    assert figures["compared"] > figures["equal"] > 500
    assert figures["first_difference"] == figures["topics"]["state/odometry"]["first_difference"]
    assert figures["topics"]["state/odometry"]["greatest"]["rad"]["value"] > 0


@pytest.mark.parametrize("option", [("--config", "x.yaml"), ("--tolerance", "1"), ("--json",)])
def test_options_of_a_check_need_it(option):
    done = run(LEVEL, *option)
    assert done.exit_code == 2
    assert "--check" in done.output
