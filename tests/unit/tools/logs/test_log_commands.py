"""The commands on logs, as a user types them."""

import fcntl
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from monstertruckd.tools.cli.main import app
from monstertruckd.tools.logs.messages import Selection

GOLDEN = max((Path(__file__).parents[3] / "data" / "golden").glob("*/run.mcap"))


def run(*arguments):
    return CliRunner().invoke(app, ["log", *map(str, arguments)])


def test_report_names_its_file_or_prints_its_figures(tmp_path):
    page = tmp_path / "page.html"
    assert run("report", GOLDEN, "--output", page).output.strip() == str(page)
    assert page.read_text().startswith("<!doctype html>")
    figures = json.loads(run("report", GOLDEN, "--output", page, "--json").stdout)
    assert figures["robot"] == "truck"


@pytest.mark.parametrize("form", ["csv", "npz", "ros2", "mcap"])
def test_export_lists_what_it_wrote(tmp_path, form):
    target = tmp_path / "out"
    done = run("export", GOLDEN, target, "--format", form, "--topic", "sensor/scan", "--start", 1, "--end", 2, "--json")
    assert done.exit_code == 0, done.output
    files = json.loads(done.stdout)
    assert files.keys() == {"sensor/scan"}
    assert Path(files["sensor/scan"]).exists()


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


def test_info_knows_a_log_that_is_being_written(tmp_path):
    log = tmp_path / "run.mcap"
    log.write_bytes(GOLDEN.read_bytes()[:-20])
    with log.open("rb") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        assert "it is being written" in run("info", log).output
    assert "`monstertruckd log recover` repairs it" in run("info", log).output


@pytest.mark.parametrize("form", ["csv", "npz", "ros2", "mcap"])
def test_an_interrupted_export_leaves_nothing_that_looks_whole(tmp_path, monkeypatch, form):
    whole = Selection.of

    def interrupted(*arguments):
        for number, row in enumerate(whole(*arguments)):
            if number == 500:
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
    assert form in ("csv", "npz") or not target.exists()


def test_tables_get_their_names_together(tmp_path, monkeypatch):
    write, written = np.savez_compressed, []

    def interrupted(file, **arrays):
        if written:
            raise KeyboardInterrupt
        written.append(file.name)
        write(file, **arrays)

    monkeypatch.setattr(np, "savez_compressed", interrupted)
    topics = ("--topic", "sensor/scan", "--topic", "state/odometry")
    assert run("export", GOLDEN, tmp_path, "--format", "npz", *topics).exit_code == 6
    assert written
    assert not list(tmp_path.iterdir())


def test_an_empty_export_is_reported(tmp_path):
    done = run("export", GOLDEN, tmp_path / "out", "--start", 5000)
    assert done.exit_code == 0
    assert "no message of these topics and times" in done.output
