"""Log times of the file are real time where the computer knows the date; what reads logs counts in daemon time."""

from pathlib import Path

import pytest
from mcap.reader import make_reader

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruckd.recorder.log_file import log_offset
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.recorder import Recorder
from monstertruckd.recorder.repair import recover
from monstertruckd.tools.logs.export import export_csv, export_mcap
from monstertruckd.tools.logs.summary import info, list_logs
from tests.unit.recorder.conftest import drive
from tests.unit.tools.logs.log_kit import MAY_2026


def recorded(config, failures, *drives: tuple[float, float]) -> list[Path]:
    """Logs of drives: each one's seconds, and the step of the computer's clock before it, s."""

    async def main(clock: VirtualClock) -> None:
        async with Recorder(config, clock, failures, deterministic=True) as recorder:
            for seconds, step in drives[1:]:
                await drive(recorder, clock, seconds)
                clock.step_real(step)
            await drive(recorder, clock, 2.0)

    async def begin(clock: VirtualClock) -> None:
        clock.step_real(drives[0][1])
        await main(clock)

    run_virtual(begin)
    assert not failures
    return sorted(Path(config.directory).glob("*.mcap"))


def in_file(path: Path) -> list[tuple[int, int]]:
    """Log and publish times as they are in the file, by a stock reader."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [(message.log_time, message.publish_time) for _, _, message in reader.iter_messages()]


def test_stock_readers_see_real_dates_and_our_reader_daemon_time(config, failures):
    (log,) = recorded(config, failures, (0, MAY_2026 / SECOND))
    reader = open_log(log)
    messages = list(reader)
    assert [message.log_time // SECOND for message in messages][:1] == [1]
    assert in_file(log) == [(message.log_time + MAY_2026, message.stamp) for message in messages]
    clocks = {"log_time": "UNIX", "publish_time": "daemon", "log_offset_ns": str(MAY_2026)}
    assert reader.metadata()["times"] == clocks
    assert reader.metadata()["run"]["real_offset_ns"] == str(MAY_2026)


def test_without_a_date_log_times_are_daemon_time(config, failures):
    (log,) = recorded(config, failures, (0, 100.0))
    messages = list(open_log(log))
    assert in_file(log) == [(message.log_time, message.stamp) for message in messages]
    assert open_log(log).metadata()["times"] == {
        "log_time": "daemon", "publish_time": "daemon", "log_offset_ns": "0"
    }  # fmt: skip
    assert log_offset(SECOND, 0) == 0


@pytest.mark.parametrize("before", [0.0, MAY_2026 / SECOND + 3600])
def test_a_step_of_the_clock_begins_the_next_part(config, failures, before):
    """The date is learnt late, or was an hour off; daemon time runs on."""
    step = MAY_2026 / SECOND - before
    first, second = recorded(config, failures, (0, before), (15.0, step))
    offsets = [open_log(log).metadata()["times"]["log_offset_ns"] for log in (first, second)]
    assert offsets == [str(round(before * SECOND)), str(MAY_2026)]
    messages = [message for log in (first, second) for message in open_log(log)]
    times = [message.log_time for message in messages if message.topic == "cmd/steering"]
    assert times == sorted(times)
    assert times[-1] - times[0] == pytest.approx(16.98 * SECOND, abs=1e4), "without a gap"
    assert {log.metadata()["run"]["real_offset_ns"] for log in map(open_log, (first, second))} == {
        str(round(before * SECOND))
    }, "all parts say the same of their run"


def test_steps_do_not_flood_the_folder(config, failures):
    steps = [(0.5, 60.0)] * 30
    logs = recorded(config, failures, (0, MAY_2026 / SECOND), *steps)
    assert len(logs) == 2, "17 s: one file in 10 s"


def test_drift_begins_no_part(config, failures):
    assert len(recorded(config, failures, (0, MAY_2026 / SECOND), (15.0, 0.4))) == 1


def test_dated_logs_are_listed_repaired_and_exported(config, failures, tmp_path):
    (log,) = recorded(config, failures, (0, MAY_2026 / SECOND))
    (listed,) = list_logs(log.parent)
    assert (listed.started, listed.duration) == ("2026-05-01 01:46:41", pytest.approx(1.98, abs=0.01))
    found = info(log)
    assert (found["start"] // SECOND, found["topics"]["sensor/scan"]["start"] // SECOND) == (1, 1)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-3000])
    repaired = tmp_path / "repaired.mcap"
    recover(cut, repaired)
    kept = [message.log_time for message in open_log(repaired)]
    assert kept == [message.log_time for message in open_log(log)][: len(kept)]
    rows = export_csv(log, tmp_path / "csv")["cmd/steering"].read_text().splitlines()
    assert rows[1].startswith("10000")
    assert "2026-05-01T01:46:41" in rows[1]
    dated = tmp_path / "dated.mcap"
    export_mcap(log, dated)
    assert [at for at, _ in in_file(dated)] == [at for at, _ in in_file(log)]
    assert min(stamp for _, stamp in in_file(dated)) > MAY_2026, "stamps inside the messages, too"
    assert [message.log_time for message in open_log(dated)] == [at for at, _ in in_file(log)]
    assert "times" not in open_log(dated).metadata()


def test_an_offset_that_is_no_number_is_damage(config, failures):
    (log,) = recorded(config, failures, (0, MAY_2026 / SECOND))
    number = str(MAY_2026).encode()
    where = log.read_bytes().index(b"log_offset_ns") + len(b"log_offset_ns") + 4
    data = bytearray(log.read_bytes())
    assert data[where : where + len(number)] == number
    data[where] = ord("x")
    log.write_bytes(data)
    reader = open_log(log)
    assert all(message.log_time > MAY_2026 for message in reader), "of the clock that nothing says any longer"
    assert "is damaged at byte" in reader.fault
    assert "is damaged at byte" in info(log)["damage"]
