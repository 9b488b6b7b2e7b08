"""The commands on logs, as a user types them."""

import base64
import errno
import fcntl
import json
import os
from pathlib import Path

import pandas as pd
import pytest
from mcap.writer import Writer as McapWriter
from typer.testing import CliRunner

from monstertruck_runtime.errors import NotFoundError
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.logs import export
from monstertruckd.tools.logs.messages import Selection
from tests.bus_kit import free_endpoint

GOLDEN = max((Path(__file__).parents[3] / "data" / "golden").glob("*/run.mcap"))


def run(*arguments):
    return CliRunner().invoke(app, ["log", *map(str, arguments)])


class RobotWithRecordings:
    """Client of a robot that has one recording."""

    DATA = bytes(range(256)) * 3
    LEFT_OUT = 0

    def __init__(self, *_, **__):
        pass

    async def __aenter__(self):
        return self

    async def __aexit__(self, *_):
        pass

    async def call(self, name, payload=None):
        if name == "recordings":
            row = {"name": "run-000001-000.mcap", "bytes": 768, "modified": 1.8e9, "kind": "run", "open": True}
            return {"recordings": [row], "left_out": self.LEFT_OUT}
        if payload["name"] != "run-000001-000.mcap":
            raise NotFoundError("recording: no such recording")
        data = self.DATA[payload["offset"] : payload["offset"] + 500]
        return {"data": base64.b64encode(data).decode(), "bytes": len(self.DATA)}


def test_recordings_of_a_robot_are_listed_and_fetched_and_a_file_of_something_else_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("monstertruck_runtime.client.TruckClient", RobotWithRecordings)
    assert "2027-01-15 08:00:00  0.00  run, being written  run-000001-000.mcap" in run("fetch").output
    assert "not listed" not in run("fetch").output
    monkeypatch.setattr(RobotWithRecordings, "LEFT_OUT", 12)
    assert "12 older logs are not listed" in run("fetch").stderr
    file = tmp_path / "run-000001-000.mcap"
    file.write_bytes(RobotWithRecordings.DATA[:100])
    assert json.loads(run("fetch", file.name, "--json").stdout)["bytes"] == 768
    assert file.read_bytes() == RobotWithRecordings.DATA
    assert run("fetch", "../other.mcap").exit_code == Reason.NOT_FOUND.exit_code
    assert not (tmp_path / "other.mcap").exists()
    file.write_bytes(b"x" * 1000)
    refused = run("fetch", file.name)
    assert refused.exit_code == 3
    assert "expected the beginning of run-000001-000.mcap, which has 768" in refused.output
    assert file.read_bytes() == b"x" * 1000


def test_report_names_its_file_or_prints_its_figures(tmp_path):
    page = tmp_path / "page.html"
    assert run("report", GOLDEN, "--output", page).output.strip() == str(page)
    assert page.read_text().startswith("<!doctype html>")
    figures = json.loads(run("report", GOLDEN, "--output", page, "--json").stdout)
    assert figures["robot"] == "truck"


@pytest.mark.parametrize("form", ["csv", "npz", "parquet", "ros2", "rosbag2", "mcap"])
def test_export_lists_what_it_wrote(tmp_path, form):
    target = tmp_path / "out"
    done = run("export", GOLDEN, target, "--format", form, "--topic", "sensor/scan", "--start", 1, "--end", 2, "--json")
    assert done.exit_code == 0, done.output
    files = json.loads(done.stdout)
    assert files.keys() == {"sensor/scan"}
    assert Path(files["sensor/scan"]).exists()


def test_a_data_set_is_one_folder_of_the_topics_that_it_needs(tmp_path):
    target = tmp_path / "set"
    done = run("export", GOLDEN, target, "--format", "lerobot", "--end", 10, "--json")
    assert done.exit_code == 0, done.output
    topics = ("state/odometry", "cmd/drive", "cmd/steering")
    assert json.loads(done.stdout) == dict.fromkeys(topics, str(target))
    frames = json.loads((target / "meta/info.json").read_text())["total_frames"]
    assert frames == len(pd.read_parquet(target / "data"))
    assert frames > 30
    refused = run("export", GOLDEN, target, "--format", "lerobot", "--topic", "sensor/scan")
    assert refused.exit_code == 3
    assert "omit the option --topic" in refused.output


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (("report", "gone.mcap"), 4, "gone.mcap: no such log"),
        (("export", GOLDEN, "out", "--topic", "sensor/nose"), 4, "no topic sensor/nose"),
        (("export", GOLDEN, "out", "--start", "2", "--end", "1"), 3, "expected an end after the start"),
        (("view", "gone.mcap", "--save", "x.rrd"), 4, "gone.mcap: no such log"),
    ],
)
def test_refusals_have_a_sentence_and_an_exit_code(tmp_path, monkeypatch, arguments, code, text):
    monkeypatch.chdir(tmp_path)
    done = run(*arguments)
    assert done.exit_code == code
    assert text in done.output


@pytest.mark.parametrize("arguments", [("report", "-o"), ("view", "--save")])
def test_no_page_and_no_recording_takes_the_place_of_a_log(tmp_path, arguments):
    log = tmp_path / "run.mcap"
    log.write_bytes(GOLDEN.read_bytes())
    command, option = arguments
    done = run(command, log, option, log)
    assert done.exit_code == 3
    assert "is a log, which is not overwritten" in done.output
    assert log.read_bytes() == GOLDEN.read_bytes()


@pytest.fixture
def damaged(tmp_path):
    """A log whose middle a power cut left as zeros."""
    log = tmp_path / "run.mcap"
    data = GOLDEN.read_bytes()
    log.write_bytes(data[:80_000] + bytes(30_000) + data[110_000:])
    return log


@pytest.mark.parametrize(
    "arguments",
    [
        ("info",),
        ("info", "--json"),
        ("report", "-o", "page.html"),
        ("export", "tables"),
        ("export", "arrays", "-f", "npz"),
        ("export", "columns", "-f", "parquet"),
        ("export", "bag", "-f", "ros2"),
        ("export", "poses", "-f", "tum"),
        ("export", "set", "-f", "lerobot"),
        ("export", "dated.mcap", "-f", "mcap"),
        ("view", "--save", "view.rrd"),
    ],
)
def test_a_damaged_log_is_used_as_far_as_it_is_whole_and_has_an_exit_code(damaged, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    done = run(arguments[0], damaged, *arguments[1:])
    assert done.exit_code == Reason.LOG_DAMAGED.exit_code
    if arguments[0] == "info":
        assert done.stderr == ""
    else:
        assert done.stderr.count("\n") == 1
        assert f"{damaged}: is damaged at byte" in done.stderr
        assert len(done.stderr) < 300
        assert len(list(tmp_path.iterdir())) == 2


def test_a_log_that_is_being_written_is_not_damaged(tmp_path):
    log = tmp_path / "run.mcap"
    log.write_bytes(GOLDEN.read_bytes()[:-20])
    with log.open("rb") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        assert run("info", log).exit_code == 0
        assert run("report", log).exit_code == 0
    assert run("report", log).exit_code == Reason.LOG_DAMAGED.exit_code


@pytest.mark.parametrize("arguments", [("report", "-o"), ("view", "--save")])
def test_what_cannot_be_written_leaves_what_was_there(tmp_path, monkeypatch, arguments):
    command, option = arguments
    target = tmp_path / "before"
    target.write_text("precious")
    done = run(command, GOLDEN, option, "/dev/full")
    assert (done.exit_code, done.stderr) == (3, "/dev/full: cannot be written: Not a regular file\n")

    def replace(path, _):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(Path, "replace", replace)
    assert run(command, GOLDEN, option, target).exit_code == 3
    assert [path.name for path in tmp_path.iterdir()] == ["before"]
    assert target.read_text() == "precious"


@pytest.mark.parametrize("command", [("log", "info"), ("map", "build"), ("track",), ("map", "show"), ("log", "report")])
@pytest.mark.parametrize("what", ["/dev/zero", "pipe", "folder", "loop", "name-too-long"])
def test_what_is_no_file_is_named_and_not_read(tmp_path, monkeypatch, command, what):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("monstertruck_runtime.client.TruckClient", Planless)
    file = {"name-too-long": "x" * 300}.get(what, what)
    done = CliRunner().invoke(app, [*command, file])
    assert done.exit_code in (3, 4)
    assert file in done.stderr
    assert done.stderr.count("\n") == 1


class Planless:
    """A robot that is there."""

    def __init__(self, *_, **__):
        pass

    async def __aenter__(self):
        return self

    async def __aexit__(self, *_):
        pass

    async def call(self, _):
        return {}


def test_info_knows_a_log_that_is_being_written(tmp_path):
    log = tmp_path / "run.mcap"
    log.write_bytes(GOLDEN.read_bytes()[:-20])
    with log.open("rb") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        assert "the recorder is writing it" in run("info", log).output
    assert "`monstertruckd log recover` repairs it" in run("info", log).output


@pytest.mark.parametrize("form", ["csv", "npz", "parquet", "ros2", "mcap", "tum", "kitti", "lerobot"])
def test_an_interrupted_export_leaves_nothing_that_looks_whole(tmp_path, monkeypatch, form):
    whole = Selection.of

    def interrupted(*arguments):
        for number, row in enumerate(whole(*arguments)):
            if number == 50:
                raise KeyboardInterrupt
            yield row

    monkeypatch.setattr(Selection, "of", interrupted)
    target = tmp_path / "out"
    if form == "csv":
        target.mkdir()
        (target / "sensor_scan.csv").write_text("of an earlier run")
    assert run("export", GOLDEN, target, "--format", form).exit_code == 6
    left = [path for path in target.rglob("*") if path.is_file() and path.suffix != ".jpeg"] if target.exists() else []
    assert [path.read_text() for path in left] == (["of an earlier run"] if form == "csv" else [])
    assert form not in ("ros2", "mcap", "lerobot") or not target.exists()


def test_tables_get_their_names_together(tmp_path, monkeypatch):
    write, written = export._write_npz, []

    def interrupted(file, arrays):
        if written:
            raise KeyboardInterrupt
        written.append(file.name)
        write(file, arrays)

    monkeypatch.setattr(export, "_write_npz", interrupted)
    topics = ("--topic", "sensor/scan", "--topic", "state/odometry")
    assert run("export", GOLDEN, tmp_path, "--format", "npz", *topics).exit_code == 6
    assert written
    assert not list(tmp_path.iterdir())


def test_an_empty_export_is_reported(tmp_path):
    done = run("export", GOLDEN, tmp_path / "out", "--start", 5000)
    assert done.exit_code == 0
    assert "no message of these topics and times" in done.output


def test_a_log_of_another_program_is_called_so(tmp_path):
    """Its times and topics are not to blame, and nothing was replayed."""
    log = tmp_path / "other.mcap"
    with log.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channel = writer.register_channel("/odom", "json", writer.register_schema("nav.Odom", "jsonschema", b"{}"))
        for i in range(3):
            writer.add_message(channel, 10**9 + i, b"{}", 10**9 + i)
        writer.finish()
    said = "other.mcap: no message of a topic known to this version"
    assert said in run("export", log, tmp_path / "out").output
    done = CliRunner().invoke(app, ["replay", str(log), "--endpoint", free_endpoint()])
    assert (done.exit_code, said in done.output) == (Reason.BAD_INPUT.exit_code, True)
