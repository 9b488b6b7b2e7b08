import errno
import json
import os
import signal
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, run_virtual, run_wall
from monstertruck_schemas import topics as t
from monstertruck_schemas.reasons import Reason
from monstertruckd.recorder import log_file as file_module
from monstertruckd.recorder import recorder as recorder_module
from monstertruckd.recorder import repair as repair_module
from monstertruckd.recorder.config import RecorderConfig
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.recorder import LogDigest, Recorder
from monstertruckd.recorder.repair import recover_directory
from tests.unit.recorder.conftest import drive, scan, steering


def record(config, seconds, failures, **options):
    """Record on the virtual clock; returns the recorder."""

    async def main(clock):
        async with Recorder(config, clock, failures, deterministic=True, **options) as recorder:
            await drive(recorder, clock, seconds)
        return recorder

    return run_virtual(main)


def logs(config: RecorderConfig) -> list[Path]:
    return sorted(Path(config.directory).glob("*.mcap"))


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_everything_is_in_a_finished_log(config, failures, compression):
    config = RecorderConfig.model_validate_json(json.dumps({"directory": config.directory, "compression": compression}))
    recorder = record(
        config,
        2.0,
        failures,
        attachments={"config": {"robot": "truck"}, "versions": {"python": "3"}},
        metadata={"robot": "truck"},
    )
    (path,) = logs(config)
    assert path.name == "run-000001-000.mcap"
    reader = open_log(path)
    messages = list(reader)
    assert reader.damage is None
    assert [m.topic for m in messages[:3]] == ["cmd/steering", "sensor/scan", "cmd/steering"]
    steer = [m for m in messages if m.topic == "cmd/steering"]
    assert [m.decode().seq for m in steer] == [m.sequence for m in steer] == list(range(100))
    assert [m.log_time for m in steer] == [m.stamp for m in steer]
    first_scan = messages[1]
    assert first_scan.log_time - first_scan.stamp == SECOND // 20
    assert first_scan.decode() == scan(first_scan.log_time, 0)
    assert json.loads(reader.attachments()["config.json"]) == {"robot": "truck"}
    assert reader.metadata()["run"] == {"robot": "truck", "real_offset_ns": "0"}
    assert (recorder.health(3).messages, recorder.health(3).drops, failures) == (120, 0, [])


def test_stock_reader_opens_the_log_and_decodes_scans(config, failures):
    record(config, 1.0, failures)
    with logs(config)[0].open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert {(s.name, s.encoding) for s in summary.schemas.values()} == {
            ("foxglove.LaserScan", "protobuf"),
            ("monstertruck.SteeringCommand", "jsonschema"),
        }
        assert {c.metadata["encoding"] for c in summary.channels.values()} == {
            wire.encoding(t.SCAN),
            wire.encoding(t.CMD_STEERING),
        }
        decoded = [d.decoded_message for d in reader.iter_decoded_messages(topics=["sensor/scan"])]
    assert len(decoded) == 10
    assert len(decoded[0].ranges) == 682


def chunks(path):
    with path.open("rb") as file:
        return [r for r in StreamReader(file, emit_chunks=True).records if type(r).__name__ == "Chunk"]


def test_chunks_are_closed_every_half_second(config, failures):
    record(config, 3.0, failures)
    spans = [c.message_end_time - c.message_start_time for c in chunks(logs(config)[0])]
    assert len(spans) == 6
    assert max(spans) <= 0.5 * SECOND


def test_chunks_are_closed_by_size(config, failures):
    record(config.model_copy(update={"chunk_size": 20_000}), 3.0, failures)
    assert max(c.uncompressed_size for c in chunks(logs(config)[0])) < 20_000 + 7000


def test_two_deterministic_runs_write_the_same_bytes(config, failures, tmp_path):
    digests, contents, health = [], [], []
    for folder in ("a", "b"):
        digest = LogDigest()
        here = config.model_copy(update={"directory": str(tmp_path / folder), "queue_size": 2})
        recorder = record(here, 3.0, failures, digest=digest)
        digests.append(digest.hexdigest())
        contents.append(logs(here)[0].read_bytes())
        health.append(recorder.health(0).model_dump(exclude={"stamp", "received"}))
        assert recorder.health(0).drops == 0
    assert digests[0] == digests[1]
    assert contents[0] == contents[1]
    assert health[0] == health[1]


def test_digest_is_of_keys_stamps_and_payloads_in_order():
    def digest(*messages):
        it = LogDigest()
        for message in messages:
            it.update(*message)
        return it.hexdigest()

    base = digest(("a", 1, b"xy"), ("b", 2, b"z"))
    assert base == digest(("a", 1, b"xy"), ("b", 2, b"z"))
    assert len(base) == 64
    for other in (
        [("b", 2, b"z"), ("a", 1, b"xy")],
        [("a", 1, b"xy"), ("b", 3, b"z")],
        [("a", 1, b"xyz"), ("b", 2, b"")],
        [("ax", 1, b"y"), ("b", 2, b"z")],
    ):
        assert digest(*other) != base


def test_digest_covers_exactly_what_is_in_the_log(config, failures):
    digest, again = LogDigest(), LogDigest()
    record(config, 1.0, failures, digest=digest)
    for message in open_log(logs(config)[0]):
        again.update(message.topic, message.stamp, message.payload)
    assert again.hexdigest() == digest.hexdigest()


def test_rotation_by_duration_makes_files_that_stand_alone(config, failures):
    config = config.model_copy(update={"rotate_seconds": 1.0})
    record(config, 2.5, failures, attachments={"config": {}})
    assert [p.name for p in logs(config)] == [f"run-000001-00{i}.mcap" for i in range(3)]
    sequences = []
    for path in logs(config):
        reader = open_log(path)
        assert list(reader.attachments()) == ["config.json"]
        sequences += [m.decode().seq for m in reader if m.topic == "cmd/steering"]
        assert reader.damage is None
    assert sequences == list(range(125))


def test_a_rotated_file_begins_with_the_newest_retained_messages(config, failures):
    config = config.model_copy(update={"rotate_seconds": 1.0})

    async def main(clock):
        async with Recorder(config, clock, failures, deterministic=True) as recorder:
            for payload in (b"old", b"new"):
                recorder.record(t.CLOCK, clock.now(), payload)
            await drive(recorder, clock, 2.5)

    run_virtual(main)
    heads = [next((m.topic, m.payload) for m in open_log(path)) for path in logs(config)[1:]]
    assert heads == [("state/clock", b"new")] * 2


def test_rotation_by_size(config, failures):
    config = config.model_copy(update={"rotate_bytes": 40_000})
    record(config, 3.0, failures)
    assert len(logs(config)) >= 3
    assert all(p.stat().st_size < 40_000 + 60_000 for p in logs(config))
    assert sum(len(list(open_log(p))) for p in logs(config)) == 180


def test_quota_removes_the_oldest_files_only(config, failures):
    config = config.model_copy(update={"rotate_seconds": 0.5, "quota_bytes": 150_000})
    Path(config.directory).mkdir()
    (Path(config.directory) / "mine.mcap").write_bytes(b"x" * 200_000)
    (Path(config.directory) / "notes.txt").write_bytes(b"x" * 200_000)
    record(config, 4.0, failures)
    kept = [p for p in logs(config) if p.name != "mine.mcap"]
    assert sum(p.stat().st_size for p in kept) <= 150_000 + 40_000
    assert kept[-1].name == "run-000001-007.mcap"
    assert kept[0].name > "run-000001-002.mcap"
    assert (Path(config.directory) / "mine.mcap").exists()
    assert (Path(config.directory) / "notes.txt").exists()


def test_quota_removes_damaged_originals_in_their_order_and_says_so(config, failures, caplog):
    folder = Path(config.directory)
    folder.mkdir()
    names = (
        "run-000001-000.mcap",
        "run-000001-000.mcap.damaged",
        "run-000001-000.mcap.damaged-2",
        "run-000002-000.mcap",
    )
    for name in names:
        (folder / name).write_bytes(b"x" * 50_000)
    (folder / "mine.mcap.damaged").write_bytes(b"x" * 50_000)
    record(config.model_copy(update={"quota_bytes": 130_000}), 0.1, failures)
    kept = sorted(path.name for path in folder.iterdir())
    assert kept == ["mine.mcap.damaged", "run-000001-000.mcap", "run-000002-000.mcap", "run-000003-000.mcap"]
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert [
        f"{name}, the damaged original of a repaired log" in text for name, text in zip(names[1:3], said, strict=True)
    ]


def test_quota_is_kept_while_one_file_grows(config, failures):
    folder = Path(config.directory)
    folder.mkdir()
    (folder / "run-000001-000.mcap").write_bytes(b"x" * 50_000)

    async def main(clock):
        limits = {"quota_bytes": 60_000, "fsync_seconds": 1.0}
        async with Recorder(config.model_copy(update=limits), clock, failures, deterministic=True) as recorder:
            await drive(recorder, clock, 3.0)

    run_virtual(main)
    assert [p.name for p in logs(config)] == ["run-000002-000.mcap"]


def test_quota_never_removes_a_file_somebody_else_is_writing(config, failures):
    folder = Path(config.directory)
    folder.mkdir()
    other = file_module.LogFile(folder / "run-000001-000.mcap", "lz4", 1000, {"big": "x" * 100_000}, {}, 0)
    record(config.model_copy(update={"quota_bytes": 1000}), 1.0, failures)
    assert [p.name for p in logs(config)] == ["run-000001-000.mcap", "run-000002-000.mcap"]
    other.finish()
    assert open_log(logs(config)[0]).attachments()


def test_the_oldest_log_is_the_one_with_the_lowest_numbers(config, failures):
    folder = Path(config.directory)
    folder.mkdir()
    for name in ("run-000001-999", "run-000001-1000", "run-999999-000", "run-1000000-000"):
        (folder / f"{name}.mcap").write_bytes(b"x" * 50_000)
    record(config.model_copy(update={"quota_bytes": 130_000}), 0.1, failures)
    assert {p.name for p in logs(config)} == {"run-999999-000.mcap", "run-1000000-000.mcap", "run-1000001-000.mcap"}


def test_what_only_has_a_logs_name_does_not_stop_the_recording(config, failures):
    folder = Path(config.directory)
    folder.mkdir()
    (folder / "run-000001-000.mcap").mkdir()
    (folder / "run-000002-000.mcap").symlink_to(folder / "nowhere")
    os.mkfifo(folder / "run-000003-000.mcap")
    (folder / "folder.mcap").mkdir()
    recorder = record(config.model_copy(update={"quota_bytes": 1000}), 1.0, failures)
    assert failures == []
    assert recorder.health(0).messages == 60
    assert sum(1 for _ in open_log(folder / "run-000004-000.mcap")) == 60


def test_a_log_that_cannot_be_removed_stays_and_is_reported_once(config, failures, monkeypatch, caplog):
    folder = Path(config.directory)
    folder.mkdir()
    for run in (1, 2):
        (folder / f"run-{run:06d}-000.mcap").write_bytes(b"x" * 50_000)
    stuck = folder / "run-000001-000.mcap"
    remove = Path.unlink

    def unlink(path, missing_ok=False):
        if path == stuck:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM), str(path))
        remove(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", unlink)
    limits = {"quota_bytes": 1000, "rotate_seconds": 0.2, "fsync_seconds": 0.2}
    record(config.model_copy(update=limits), 1.0, failures)
    assert failures == []
    assert [p.name for p in logs(config)] == ["run-000001-000.mcap", "run-000003-004.mcap"]
    assert sum("run-000001-000.mcap cannot be removed" in r.getMessage() for r in caplog.records) == 1


def test_an_unreadable_log_does_not_stop_the_recording(config, failures, monkeypatch, caplog):
    folder = Path(config.directory)
    folder.mkdir()
    (folder / "other.mcap").write_bytes(b"x")

    def is_finished(path):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    def no_process(*_, **__):
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(repair_module, "is_finished", is_finished)
    monkeypatch.setattr(subprocess, "Popen", no_process)
    recorder = record(config, 1.0, failures)
    assert (failures, recorder.health(0).messages) == ([], 60)
    assert "unfinished logs are not repaired" in caplog.text
    assert recover_directory(folder) == []
    assert "not repaired" in caplog.text
    assert "other.mcap" in caplog.text


def test_run_number_taken_meanwhile_is_skipped(config, failures, monkeypatch):
    folder = file_module.LogFolder(Path(config.directory))
    (Path(config.directory) / "run-000001-000.mcap").touch()
    monkeypatch.setattr(recorder_module, "LogFolder", lambda _: folder)
    record(config, 0.1, failures)
    assert (Path(config.directory) / "run-000002-000.mcap").exists()


def test_topics_of_one_schema_share_it(config, failures):
    async def main(clock):
        async with Recorder(config, clock, failures) as recorder:
            recorder.record(t.ODOMETRY, 1, b"a")
            recorder.record(t.POSE, 2, b"b")

    run_virtual(main)
    with logs(config)[0].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert len(summary.schemas) == 1
    assert {c.topic for c in summary.channels.values()} == {"state/odometry", "state/pose"}


def test_disk_is_synced_every_few_seconds(config, failures, monkeypatch):
    synced = []
    monkeypatch.setattr(file_module.os, "fsync", lambda file: synced.append(os.fstat(file).st_mode))
    record(config.model_copy(update={"fsync_seconds": 1.0}), 3.5, failures)
    folders = [mode for mode in synced if stat.S_ISDIR(mode)]
    assert len(synced) - len(folders) == 3 + 1
    assert len(folders) == 1 + 1, "that of the logs in its own, and the log in that of the logs"


def test_a_file_that_is_removed_while_it_is_written_is_noticed_and_followed_by_another(config, failures, caplog):
    config = config.model_copy(update={"fsync_seconds": 1.0, "queue_size": 64})

    async def main(clock):
        async with Recorder(config, clock, failures, deterministic=True) as recorder:
            await drive(recorder, clock, 6.0)
            (first,) = logs(config)
            first.unlink()
            await drive(recorder, clock, 12.0)
        return first

    first = run_virtual(main)
    (path,) = logs(config)
    assert path.name == "run-000001-001.mcap"
    assert len(list(open_log(path))) > 300
    assert f"{first} was removed while it was being written: its content is lost" in caplog.messages
    assert failures == []


def test_topics_that_are_not_logged_are_ignored(config, failures):
    async def main(clock):
        quiet = t.Topic("state/quiet", t.GATE.model, t.Writer.GATE, "not logged", logged=False)
        async with Recorder(config, clock, failures) as recorder:
            recorder.record(quiet, 1, b"x")
        return recorder

    assert run_virtual(main).health(0).messages == 0


def test_full_queue_drops_and_counts_without_waiting(config, failures, monkeypatch):
    gate = threading.Event()
    write = recorder_module.LogWriter.write
    monkeypatch.setattr(recorder_module.LogWriter, "write", lambda self, entry: gate.wait(10) and write(self, entry))

    async def main(clock):
        async with Recorder(config.model_copy(update={"queue_size": 5}), clock, failures) as recorder:
            for seq in range(20):
                recorder.record(t.CMD_STEERING, seq, wire.encode(t.CMD_STEERING, steering(seq, seq)))
            drops = recorder.health(0).drops
            gate.set()
        return drops

    drops = run_virtual(main)
    assert 14 <= drops <= 15
    sequences = [m.sequence for m in open_log(logs(config)[0])]
    assert sequences == list(range(20 - drops))


@pytest.mark.parametrize(
    ("code", "reason"),
    [(errno.ENOSPC, Reason.DISK_FULL), (errno.EDQUOT, Reason.DISK_FULL), (errno.EIO, Reason.RECORDING_FAILED)],
)
@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("allowed", [0, 20_000])
def test_write_error_stops_the_recording_loudly_and_nothing_else(
    config, failures, monkeypatch, code, reason, deterministic, allowed
):
    written = 0
    write = os.write

    def failing(fd, data):
        nonlocal written
        written += len(data)
        if written > allowed and Path(f"/proc/self/fd/{fd}").readlink().is_relative_to(config.directory):
            raise OSError(code, os.strerror(code))
        return write(fd, data)

    monkeypatch.setattr(file_module.os, "write", failing)

    async def main(clock):
        async with Recorder(
            config.model_copy(update={"queue_size": 50}), clock, failures, deterministic=deterministic
        ) as recorder:
            await drive(recorder, clock, 5.0)
            while not failures:
                await clock.sleep(0.01)
            before = recorder.health(0)
            recorder.record(t.CMD_STEERING, 0, b"late")
            return before, recorder.health(1)

    before, after = run_virtual(main)
    ((reported, text),) = failures
    assert reported is reason
    assert os.strerror(code) in text
    assert (before.recording, before.reason) == (False, reason)
    assert after.drops == before.drops + 1


def test_error_while_finishing_is_reported_and_does_not_hang(config, failures, monkeypatch):
    def fail(self):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(file_module.LogFile, "finish", fail)
    record(config, 0.2, failures)
    assert [reason for reason, _ in failures] == [Reason.DISK_FULL]


def test_folder_that_cannot_be_made_is_reported(config, failures, tmp_path):
    (tmp_path / "logs").write_text("a file is here")
    recorder = record(config, 0.2, failures)
    assert [reason for reason, _ in failures] == [Reason.RECORDING_FAILED]
    assert recorder.path is None


def test_bug_in_the_thread_is_reported(config, failures):
    record(config, 0.2, failures, attachments={"config": object()})
    ((reason, text),) = failures
    assert reason is Reason.INTERNAL
    assert "JSON serializable" in text


def test_idle_recorder_closes_its_chunk_on_the_wall_clock(config, failures):
    async def main(clock):
        async with Recorder(config.model_copy(update={"chunk_seconds": 0.1}), clock, failures) as recorder:
            recorder.record(t.CMD_STEERING, 0, wire.encode(t.CMD_STEERING, steering(0, 0)))
            async with clock.deadline(5):
                while recorder.path is None or not list(open_log(recorder.path)):
                    await clock.sleep(0.02)
            assert recorder.health(0).path == str(recorder.path)
            assert recorder.health(0).recording

    run_wall(main)


def test_unfinished_logs_are_repaired_at_start(config, failures):
    record(config, 2.0, failures)
    (path,) = logs(config)
    whole = list(open_log(path))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])

    said = []

    async def main(clock):
        async with Recorder(config, clock, failures, on_repair=said.append), clock.deadline(30):
            while not said:
                await clock.sleep(0.02)

    run_wall(main)
    assert said[0].startswith(f"repaired {path}: ")
    assert said[0].endswith(f"; the original is {path}.damaged")
    saved = list(open_log(path))
    assert len(whole) > len(saved) > len(whole) // 3
    assert saved == whole[: len(saved)]
    assert len(logs(config)) == 2


CHILD = """
import sys
from monstertruck_runtime.clock import run_wall
from monstertruckd.recorder.recorder import Recorder
from monstertruckd.recorder.config import RecorderConfig
from tests.unit.recorder.conftest import steering
from monstertruck_runtime import wire
from monstertruck_schemas import topics as t

async def main(clock):
    config = RecorderConfig(directory=sys.argv[1])
    async with Recorder(config, clock, print, attachments={"config": {"a": 1}}) as recorder:
        seq = 0
        while True:
            now = clock.now()
            recorder.record(t.CMD_STEERING, now, wire.encode(t.CMD_STEERING, steering(now, seq)))
            print(now, flush=True)
            seq += 1
            await clock.sleep(0.01)

run_wall(main)
"""


@pytest.mark.wall
def test_kill_9_loses_less_than_a_second_and_the_file_opens_after_repair(config):
    process = subprocess.Popen(
        [sys.executable, "-c", CHILD, config.directory], stdout=subprocess.PIPE, text=True, cwd=Path.cwd()
    )
    assert process.stdout is not None
    with process.stdout:
        first = int(process.stdout.readline())
        now = first
        while now - first < 1.7 * SECOND:
            now = int(process.stdout.readline())
        (path,) = logs(config)
        assert recover_directory(Path(config.directory)) == []  # in use: left alone
        process.send_signal(signal.SIGKILL)
        process.wait()
        rest = process.stdout.read().split("\n")
    last = max([now, *(int(line) for line in rest[:-1])])

    (recovery,) = recover_directory(Path(config.directory))
    assert recovery.path == path
    with path.open("rb") as file:
        messages = [m for _, _, m in make_reader(file, validate_crcs=True).iter_messages()]
    assert [m.sequence for m in messages] == list(range(len(messages)))
    assert len(messages) == recovery.messages > 0
    assert last - messages[-1].log_time <= SECOND
    assert open_log(path).attachments().keys() == {"config.json"}


def test_a_disk_can_be_made_to_refuse(config, failures):
    async def main(clock):
        async with Recorder(config, clock, failures, deterministic=True) as recorder:
            recorder.refuse(OSError(errno.ENOSPC, "No space left on device"))
            await drive(recorder, clock, 2.0)
        return recorder.health(0)

    health = run_virtual(main)
    assert not health.recording
    assert health.reason is Reason.DISK_FULL
