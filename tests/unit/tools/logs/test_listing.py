"""The logs of a folder as a user sees them."""

import fcntl
import json
import os
import sys
from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import NotFoundError
from monstertruck_schemas.topics import CLOCK, GATE
from monstertruckd.recorder.reader import LogReader
from monstertruckd.tools.cli.main import main
from monstertruckd.tools.logs import summary
from monstertruckd.tools.logs.messages import real_offset
from monstertruckd.tools.logs.summary import LogState, LogSummary, list_logs
from tests.unit.tools.logs.log_kit import MAY_2026, Writer, clock, gate
from tests.unit.tools.logs.run_kit import flipped


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A finished log with and one without a date, one broken off, and no log at all."""
    (tmp_path / "box").mkdir()
    for name, dated in (("run-1.mcap", True), ("box/run-2.mcap", False)):
        writer = Writer(tmp_path / name, **({"config": {"robot": "lorry"}} if dated else {}))
        for number in range(4):
            writer.put(GATE, gate((1 + number) * SECOND, number))
        if dated:
            writer.put(CLOCK, clock(2 * SECOND))
        writer.log.finish()
    (tmp_path / "run-3.mcap").write_bytes((tmp_path / "run-1.mcap").read_bytes()[:-20])
    (tmp_path / "run-4.mcap").write_bytes(b"no log, but the end \x89MCAP0\r\n")
    for number, name in enumerate(("run-1.mcap", "run-4.mcap", "run-3.mcap", "box/run-2.mcap"), start=20_000):
        os.utime(tmp_path / name, (number * 86_400,) * 2)  # 2024: before the date in the first one
    return tmp_path


def test_every_log_says_when_whose_how_long_and_how_much_and_the_newest_is_last(folder: Path):
    foreign, broken, undated, dated = list_logs(folder)
    size = (folder / "run-1.mcap").stat().st_size
    assert dated == LogSummary(folder / "run-1.mcap", size, LogState.FINISHED, "lorry", "2026-05-01 01:46:41", 3.0, 5)
    assert (broken.path.name, broken.robot, undated.robot) == ("run-3.mcap", "lorry", None)
    assert (undated.path.name, undated.started, undated.messages) == ("run-2.mcap", None, 4)
    assert (broken.state, broken.messages, broken.duration) == (LogState.UNFINISHED, None, None)
    assert foreign.state is LogState.UNREADABLE


def test_a_log_being_written_is_distinguished_from_one_broken_off(folder: Path):
    with (folder / "run-3.mcap").open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert list_logs(folder)[1].state is LogState.WRITING
    assert list_logs(folder)[1].state is LogState.UNFINISHED


def test_a_log_without_its_end_has_its_date_from_its_beginning(tmp_path: Path):
    whole = tmp_path / "run-1.mcap"
    writer = Writer(whole, {"real_offset_ns": str(MAY_2026)})
    for number in range(4):
        writer.put(GATE, gate((1 + number) * SECOND, number))
    writer.log.finish()
    broken = tmp_path / "run-2.mcap"
    broken.write_bytes(whole.read_bytes()[:-20])
    (tmp_path / "run-3.mcap").write_bytes(whole.read_bytes()[:300])
    assert [log.started for log in list_logs(tmp_path)] == ["2026-05-01 01:46:41"] * 2 + [None]


def test_no_damage_of_one_log_hides_the_others(folder: Path):
    sound = folder / "run-1.mcap"
    whole = sound.read_bytes()
    index = int.from_bytes(whole[-28:-20], "little")
    damaged = folder / "run-5.mcap"
    damaged.write_bytes(whole)
    for place in range(index, len(whole) - 8, 9):
        with flipped(damaged, place, 0x80):
            *others, last = list_logs(folder)
            assert last.state is LogState.DAMAGED
            assert len(others) == 4
            assert real_offset(LogReader(damaged)) == MAY_2026


def test_what_dates_a_log_may_be_damaged_or_a_name_lead_nowhere(folder: Path):
    number = b"real_offset_ns\x01\x00\x00\x00"
    undated = folder / "box/run-2.mcap"
    undated.write_bytes(undated.read_bytes().replace(number + b"5", number + b"u"))
    (folder / "gone.mcap").symlink_to(folder / "nothing")
    assert [log.state for log in list_logs(folder)] == ["unreadable", "unfinished", "finished", "finished"]


def test_a_log_that_goes_meanwhile_does_not_hide_the_others(folder: Path, monkeypatch: pytest.MonkeyPatch):
    real = summary.is_finished

    def gone(path: Path) -> bool:
        if path.name == "run-1.mcap":
            path.unlink()
        return real(path)

    monkeypatch.setattr(summary, "is_finished", gone)
    assert [log.path.name for log in list_logs(folder)] == ["run-4.mcap", "run-3.mcap", "run-2.mcap"]


def test_no_folder_is_not_no_logs(tmp_path: Path):
    assert list_logs(tmp_path) == []
    with pytest.raises(NotFoundError, match="no such folder"):
        list_logs(tmp_path / "absent")


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["monstertruckd", "log", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_the_commands(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    assert run(monkeypatch, "list", str(folder)) == 0
    out, err = capsys.readouterr()
    assert out.splitlines()[-1].split() == [
        "2026-05-01", "01:46:41", "lorry", "3.0", "5", "0.01", "finished", str(folder / "run-1.mcap")
    ]  # fmt: skip
    assert "log recover FILE" in err
    assert run(monkeypatch, "recover", str(folder / "run-3.mcap"), "--json") == 0
    assert json.loads(capsys.readouterr().out)["messages"] == 5
    assert run(monkeypatch, "list", str(folder), "--json") == 0
    assert [row["state"] for row in json.loads(capsys.readouterr().out)] == ["unreadable"] + ["finished"] * 3
    assert run(monkeypatch, "info", str(folder / "run-3.mcap")) == 0
    assert capsys.readouterr().out.splitlines()[1].split() == ["topic", "schema", "messages", "Hz", "kB", "unpacked"]
    (folder / "none").mkdir()
    assert run(monkeypatch, "list", str(folder / "none")) == 0
    assert capsys.readouterr() == ("", f"{folder / 'none'}: no logs\n")
