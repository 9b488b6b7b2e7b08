"""The minute before a trip, in a file of its own."""

import asyncio
import errno
import json
import os
import threading
from pathlib import Path
from types import MethodType

import pytest
from mcap.reader import make_reader

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, WallClock, run_virtual
from monstertruck_runtime.threads import inline
from monstertruck_schemas import topics as t
from monstertruck_schemas.event import Cause, Event, Severity, Stop
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import ClockOffset, GateMode
from monstertruckd.recorder import black_box as module
from monstertruckd.recorder.black_box import BlackBox, black_boxes
from monstertruckd.recorder.config import BlackBoxConfig, Compression
from monstertruckd.recorder.log_file import LogFile
from monstertruckd.recorder.reader import open_log
from tests.unit.recorder.conftest import steering
from tests.unit.tools.logs.log_kit import MAY_2026


def trip(now, reason=Reason.SCAN_STALE, number=1):
    cause = Cause(reason=reason, source="lidar", since=now, text=reason.text)
    return Stop(
        stamp=now,
        received=now,
        seq=0,
        number=number,
        reason=reason,
        text="stopped",
        mode=GateMode.STOPPING,
        causes=(cause,),
        ordered=False,
        quick=False,
        holder="ann",
        role=None,
        speed=0.1,
        stopping_distance=0.02,
    )


class Reported(list):
    """Collects events."""

    def __call__(self, reason, severity, source, text="", **values):
        self.append((reason, text, values))

    @property
    def reasons(self):
        return [reason for reason, *_ in self]


class Bench:
    """A black box on the virtual clock, fed with 50 Hz of commands."""

    def __init__(self, clock, folder, offload=inline, **config):
        self.clock = clock
        self.folder = folder
        self.reported = Reported()
        self.box = BlackBox(
            BlackBoxConfig(**config),
            folder,
            clock,
            self.reported,
            attachments={"config": {"robot": "truck"}, "versions": {"python": "3"}},
            metadata={"robot": "truck"},
            offload=offload,
            log=lambda: folder.parent / "run-000001-000.mcap",
        )
        self._seq = 0

    def put(self, topic, message):
        self.box.record(topic, message.stamp, wire.encode(topic, message))

    async def drive(self, seconds):
        for _ in range(round(seconds * 50)):
            self._seq += 1
            self.put(t.CMD_STEERING, steering(self.clock.now(), self._seq))
            await self.clock.sleep(0.02)

    def event(self, text):
        now = self.clock.now()
        self.put(
            t.EVENT,
            Event(stamp=now, received=now, seq=0, reason=Reason.OK, severity=Severity.INFO, source="x", text=text),
        )

    def trip(self, reason=Reason.SCAN_STALE, number=1):
        return self.box.trip(trip(self.clock.now(), reason, number))

    @property
    def files(self):
        return [box.path.name for box in black_boxes(self.folder)]


def on_bench(folder, scenario, **config):
    async def main(clock):
        bench = Bench(clock, folder, **config)
        async with bench.box:
            await scenario(bench)
        return bench

    return run_virtual(main)


def seconds(messages, topic="cmd/steering"):
    times = [m.log_time for m in messages if m.topic == topic]
    return times[0] / SECOND, times[-1] / SECOND


def test_a_trip_saves_the_minute_before_and_five_seconds_after(tmp_path: Path):
    async def scenario(bench):
        bench.put(t.CLOCK, ClockOffset(stamp=1, received=1, seq=0, offset=5))
        bench.event("long ago")
        await bench.drive(100)
        assert bench.trip() == "blackbox-000001-scan_stale.mcap"
        assert bench.reported == [], "it is not there yet"
        await bench.drive(4.9)
        assert bench.files == []
        await bench.drive(0.2)
        assert bench.files == ["blackbox-000001-scan_stale.mcap"]

    bench = on_bench(tmp_path, scenario)
    ((reason, text, values),) = bench.reported
    assert reason is Reason.BLACK_BOX_SAVED
    assert text == "the minute before stop 1 is in blackbox-000001-scan_stale.mcap"
    assert (values["file"], values["stop"]) == ("blackbox-000001-scan_stale.mcap", 1)
    reader = open_log(tmp_path / bench.files[0])
    messages = list(reader)
    assert reader.damage is None
    assert len(messages) == values["messages"]
    assert reader.metadata()["run"]["log"] == str(tmp_path.parent / "run-000001-000.mcap")
    first, last = seconds(messages)
    assert (first, last) == (pytest.approx(41.0, abs=0.1), pytest.approx(106.0, abs=0.1))
    assert [m.log_time for m in messages] == sorted(m.log_time for m in messages)
    assert messages[0].log_time / SECOND == pytest.approx(41.0, abs=0.1), "nothing is older"
    assert not [m for m in messages if m.topic == "event/event"]
    assert [m.decode().offset for m in messages if m.topic == "state/clock"] == [5], (
        "what is retained stands at its head"
    )
    assert json.loads(reader.attachments()["versions.json"]) == {"python": "3"}
    run = reader.metadata()["run"]
    assert (run["robot"], run["reason"], run["stops"], run["lost"]) == ("truck", "scan_stale", "1", "0")
    assert int(run["stopped_at_ns"]) / SECOND == pytest.approx(101.0, abs=0.1)
    assert run["text"] == "no fresh lidar scan"


def test_events_reach_further_back_where_that_is_configured(tmp_path: Path):
    async def scenario(bench):
        bench.event("long ago")
        await bench.drive(20)
        bench.trip()
        await bench.drive(5.2)

    bench = on_bench(tmp_path, scenario, before=5.0, journal=30.0)
    messages = list(open_log(tmp_path / bench.files[0]))
    assert [m.decode().text for m in messages if m.topic == "event/event"] == ["long ago"]
    assert seconds(messages)[0] == pytest.approx(16.0, abs=0.1)


def test_two_virtual_runs_write_the_same_bytes(tmp_path: Path):
    async def scenario(bench):
        await bench.drive(3)
        bench.trip()
        await bench.drive(6)

    reported = [on_bench(tmp_path / name, scenario).reported for name in ("a", "b")]
    assert reported[0] == reported[1]
    first, second = (next((tmp_path / name).iterdir()).read_bytes() for name in ("a", "b"))
    assert first == second


def test_a_trip_soon_after_another_shares_its_box(tmp_path: Path):
    async def scenario(bench):
        await bench.drive(1)
        name = bench.trip(Reason.LEASE_EXPIRED)
        await bench.drive(2)
        assert bench.trip(Reason.ESTOP_REQUESTED, 2) == name
        await bench.drive(4)
        assert bench.files == [name]
        assert open_log(tmp_path / name).metadata()["run"]["stops"] == "1,2"

    on_bench(tmp_path, scenario)


def test_boxes_of_one_reason_are_rate_limited_but_every_trip_lies_in_one(tmp_path: Path):
    async def scenario(bench):
        names, instants = [], []
        for number in range(1, 6):
            await bench.drive(7)
            instants.append(bench.clock.now())
            names.append(bench.trip(Reason.TILT_STOP if number == 4 else Reason.SCAN_STALE, number))
        assert [name[9:-5] for name in names] == [
            "000001-scan_stale",
            *["000002-scan_stale"] * 2,
            "000003-tilt_stop",
            "000002-scan_stale",
        ]
        await bench.drive(36)
        assert len(bench.files) == 2, "the second waits"
        await bench.drive(2)
        assert len(bench.files) == 3
        stops = [open_log(tmp_path / name).metadata()["run"]["stops"] for name in bench.files]
        assert stops == ["1", "2,3,5", "4"]
        first, last = seconds(list(open_log(tmp_path / names[1])))
        assert first < instants[1] / SECOND < instants[4] / SECOND < last
        assert bench.trip(Reason.STOPPED) is None, "an order is no accident"

    bench = on_bench(tmp_path, scenario)
    assert [text for _, text, _ in bench.reported][-1] == "stops 2, 3, 5 are in blackbox-000002-scan_stale.mcap"


def test_no_trip_waits_until_the_minute_before_it_is_forgotten(tmp_path: Path):
    async def scenario(bench):
        bench.trip()
        await bench.drive(10)
        bench.trip(number=2)
        await bench.drive(21)
        assert len(bench.files) == 2

    on_bench(tmp_path, scenario, before=20.0, interval=3600.0)


def test_what_is_due_at_the_end_is_written_before_it(tmp_path: Path):
    async def scenario(bench):
        await bench.drive(1)
        bench.trip(Reason.ESTOP_REQUESTED)

        bench.box.freeze()
        await bench.drive(10)
        assert bench.files == [], "it has its content, and waits for the end"

    bench = on_bench(tmp_path, scenario)
    assert bench.reported.reasons == [Reason.BLACK_BOX_SAVED]
    assert len(list(open_log(tmp_path / bench.files[0]))) == 50


def test_a_box_is_complete_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "blackbox-000007-tilt_stop.mcap.part").write_bytes(b"of a run that was killed")
    seen = []

    class Watched(LogFile):
        def finish(self):
            seen.append(sorted(path.name for path in tmp_path.iterdir()))
            super().finish()

    monkeypatch.setattr(module, "LogFile", Watched)

    async def scenario(bench):
        await bench.drive(0.1)
        bench.trip()

    on_bench(tmp_path, scenario)
    assert seen == [["blackbox-000001-scan_stale.mcap.part"]]


def test_a_full_disk_costs_the_box_and_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    class Full(LogFile):
        def finish(self):
            raise OSError(errno.ENOSPC, "No space left on device")

    async def scenario(bench):
        await bench.drive(0.1)
        with monkeypatch.context() as patch:
            patch.setattr(module, "LogFile", Full)
            bench.trip()
            await bench.drive(6)
        assert bench.reported == [
            (Reason.DISK_FULL, "blackbox-000001-scan_stale.mcap is lost: No space left on device", {})
        ]
        assert list(tmp_path.iterdir()) == [], "no half of it is left"
        bench.trip(Reason.TILT_STOP)
        await bench.drive(6)

    bench = on_bench(tmp_path, scenario)
    assert bench.files == ["blackbox-000002-tilt_stop.mcap"], "it goes on"


def test_a_folder_that_cannot_be_made_is_reported_and_tried_again(tmp_path: Path):
    blocked = tmp_path / "file"
    blocked.touch()

    async def scenario(bench):
        assert bench.reported.reasons == [Reason.RECORDING_FAILED]
        blocked.unlink()
        bench.trip()

    assert on_bench(blocked, scenario).files == ["blackbox-000001-scan_stale.mcap"]


def test_a_box_of_an_earlier_run_is_never_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The folder came too late to be read at the start."""
    scan = module.BlackBoxFolder.scan

    def too_early(folder):
        raise OSError(errno.EIO, "Input/output error")

    async def scenario(bench):
        (tmp_path / "blackbox-000001-scan_stale.mcap").write_bytes(b"the only one of a crash")
        (tmp_path / "blackbox-000008-tilt_stop.mcap").write_bytes(b"another")
        bench.trip()
        await bench.drive(6)

    monkeypatch.setattr(module.BlackBoxFolder, "scan", too_early)
    bench = on_bench(tmp_path, scenario)
    assert (tmp_path / "blackbox-000001-scan_stale.mcap").read_bytes() == b"the only one of a crash"
    assert bench.files[-1] == "blackbox-000009-scan_stale.mcap"
    reason, text, values = bench.reported[-1]
    assert (reason, values["file"]) == (Reason.BLACK_BOX_SAVED, "blackbox-000009-scan_stale.mcap")
    assert "blackbox-000009" in text
    monkeypatch.setattr(module.BlackBoxFolder, "scan", scan)


def test_a_box_is_dated_by_what_the_computer_knows_when_it_is_written(tmp_path: Path):
    async def scenario(bench):
        await bench.drive(5)
        bench.clock.step_real(MAY_2026 / SECOND)
        bench.trip()
        await bench.drive(6)

    (name,) = on_bench(tmp_path, scenario).files
    with (tmp_path / name).open("rb") as file:
        in_file = [message.log_time for _, _, message in make_reader(file).iter_messages()]
    assert in_file == [message.log_time + MAY_2026 for message in open_log(tmp_path / name)]
    assert in_file[0] // SECOND == 1_777_600_001


def test_a_box_that_another_daemon_writes_stays(tmp_path: Path):
    part = tmp_path / "blackbox-000001-scan_stale.mcap.part"
    other = LogFile(part, Compression.ZSTD, 1000, {}, {}, 0)

    async def scenario(bench):
        bench.trip()
        await bench.drive(6)

    assert on_bench(tmp_path, scenario).files == ["blackbox-000002-scan_stale.mcap"]
    other.finish()
    assert open_log(part).metadata()["run"] == {}


def test_what_cannot_be_removed_costs_no_box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog):
    (tmp_path / "blackbox-000003-scan_stale.mcap").write_bytes(b"old")
    (tmp_path / "blackbox-000004-tilt_stop.mcap").mkdir()
    (tmp_path / "blackbox-000005-tilt_stop.mcap").symlink_to(tmp_path / "nowhere")
    (tmp_path / "blackbox-000006-tilt_stop.mcap.part").mkdir()
    remove = Path.unlink

    def unlink(path, missing_ok=False):
        if path.name.startswith("blackbox-000003") or path.is_dir():
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM), str(path))
        remove(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", unlink)

    async def scenario(bench):
        bench.trip()
        await bench.drive(6)

    bench = on_bench(tmp_path, scenario, quota_bytes=1)
    assert bench.reported.reasons == [Reason.BLACK_BOX_SAVED]
    assert bench.files == ["blackbox-000003-scan_stale.mcap", "blackbox-000004-scan_stale.mcap"]
    assert sum("cannot be removed" in record.getMessage() for record in caplog.records) == 2


def test_a_bug_while_writing_is_reported_and_ends_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog):
    async def scenario(bench):
        monkeypatch.setattr(module, "LogFile", lambda *_: 1 / 0)
        bench.trip()
        await bench.drive(6)

    assert on_bench(tmp_path, scenario).reported.reasons == [Reason.INTERNAL]
    assert "ZeroDivisionError" in caplog.text


def test_the_oldest_boxes_go_but_the_newest_of_each_reason_stays(tmp_path: Path):
    tmp_path.joinpath("notes.txt").write_text("not ours")

    async def scenario(bench):
        for number, reason in enumerate(
            (Reason.TILT_STOP, Reason.SCAN_STALE, Reason.SCAN_STALE, Reason.DRIVE_STALE, Reason.SCAN_STALE), 1
        ):
            bench.trip(reason, number)
            await bench.drive(6)

    bench = on_bench(tmp_path, scenario, interval=0.0, quota_bytes=1)
    assert [name[9:-5] for name in bench.files] == ["000001-tilt_stop", "000004-drive_stale", "000005-scan_stale"]
    assert (tmp_path / "notes.txt").exists()
    another = on_bench(tmp_path, scenario, quota_bytes=10**9)
    assert another.files[-1][9:15] == "000009", "numbers go on over runs"


def test_it_is_written_in_a_thread_with_pauses_and_without_them_at_the_end(tmp_path: Path):
    async def main():
        bench = Bench(WallClock(), tmp_path, offload=module.in_daemon_thread, after=0.05)
        writing = []
        original = bench.box._write

        def write(*arguments):
            writing.append(threading.current_thread())
            original(*arguments)

        bench.box._write = write
        bench.box._hurry = pauses = Pauses()
        async with bench.box:
            for seq in range(640):
                bench.put(t.CMD_STEERING, steering(bench.clock.now(), seq))
            bench.trip()
            while not bench.reported:
                await asyncio.sleep(0.01)
        assert writing
        assert threading.main_thread() not in writing
        assert pauses.count == 640 // module.BATCH
        assert len(list(open_log(tmp_path / bench.files[0]))) == 640

    asyncio.run(main())


class Pauses(threading.Event):
    """Counts the pauses."""

    count = 0

    def wait(self, timeout=None):
        self.count += 1
        return super().wait(timeout)


def test_on_the_loop_itself_nothing_waits(tmp_path: Path):
    async def scenario(bench):
        bench.box._hurry = pauses = Pauses()
        await bench.drive(1)
        bench.trip()
        await bench.drive(6)
        assert len(bench.files) == 1
        assert pauses.count == 0

    on_bench(tmp_path, scenario)


class Disk:
    """Holds up everything that is written until it is released."""

    def __init__(self):
        self.released = asyncio.Event()

    async def __call__(self, function):
        if not isinstance(function, MethodType):
            await self.released.wait()
        return function()


def test_a_box_holds_what_was_there_when_it_was_due_however_long_the_one_before_took(tmp_path: Path):
    async def main(clock):
        disk = Disk()
        bench = Bench(clock, tmp_path, offload=disk)
        async with bench.box:
            bench.trip(number=1)
            await bench.drive(6)
            bench.trip(Reason.TILT_STOP, 2)
            await bench.drive(100)
            assert bench.files == []
            disk.released.set()
            await bench.drive(0.1)
            first, last = seconds(list(open_log(tmp_path / bench.files[1])))
            assert (first, last) == (pytest.approx(1.0, abs=0.1), pytest.approx(12.0, abs=0.1))

    run_virtual(main)


def test_boxes_do_not_pile_up_before_a_slow_disk(tmp_path: Path):
    async def main(clock):
        disk = Disk()
        bench = Bench(clock, tmp_path, offload=disk)
        async with bench.box:
            for reason in (Reason.SCAN_STALE, Reason.TILT_STOP, Reason.DRIVE_STALE, Reason.BATTERY_CRITICAL):
                bench.trip(reason)
                await bench.drive(6)
            assert bench.reported == [
                (Reason.RECORDING_FAILED, "blackbox-000004-battery_critical.mcap is lost: the disk is too slow", {})
            ]
            disk.released.set()

    run_virtual(main)


def test_a_disk_that_hangs_does_not_hold_up_the_end(tmp_path: Path, caplog):
    async def main(clock):
        bench = Bench(clock, tmp_path, offload=Disk())
        async with bench.box:
            bench.trip()
            ended = clock.now()
        assert (clock.now() - ended) / SECOND == pytest.approx(module.LAST_SECONDS, abs=0.01)

    run_virtual(main)
    assert "took longer than 5 s" in caplog.text


def test_a_box_that_is_given_up_leaves_nothing_behind(tmp_path: Path):
    async def scenario(bench):
        await bench.drive(1)
        bench.box._given_up.set()
        bench.trip()
        await bench.drive(6)
        assert bench.reported.reasons == [Reason.RECORDING_FAILED]
        assert list(tmp_path.iterdir()) == []

    on_bench(tmp_path, scenario)
