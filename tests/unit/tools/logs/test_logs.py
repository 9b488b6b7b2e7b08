import csv
import errno
import fcntl
import json
import math
import shutil
import threading

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_schemas import topics as t
from monstertruckd.recorder import repair
from monstertruckd.recorder.log_file import LogEntry, LogFile
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.repair import recover, recover_directory
from monstertruckd.tools.logs.export import export_csv, export_npz
from monstertruckd.tools.logs.replay import _rpc
from monstertruckd.tools.logs.summary import info
from tests.unit.tools.logs.run_kit import MAKERS, write


def test_reading_gives_what_was_written(log, master):
    reader = open_log(str(log))
    assert [(m.topic, m.log_time, m.decode()) for m in reader] == master[1]
    assert reader.damage is None
    assert len(list(reader)) == len(master[1])


def test_unfinished_log_is_read_up_to_its_end(cut, master):
    reader = open_log(cut)
    found = [(m.topic, m.log_time, m.decode()) for m in reader]
    assert 0 < len(found) < len(master[1])
    assert found == master[1][: len(found)]
    place = f" of {cut.stat().st_size} (EndOfFile), cannot be read in 1 place, has no end"
    assert f"{place}: an unknown number lost (from " in reader.damage
    assert reader.damage.endswith(" s on after its start)")


def test_a_flipped_byte_costs_its_chunk_alone(log, master):
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 0xFF
    log.write_bytes(data)
    reader = open_log(log)
    found = [(m.topic, m.log_time, m.decode()) for m in reader]
    assert found[0] == master[1][0]
    assert found[-1] == master[1][-1]
    missing = [message for message in master[1] if message not in found]
    assert len(found) + len(missing) == len(master[1])
    first = (missing[0][1] - SECOND) / SECOND
    assert f"{len(missing)} lost ({first:.1f} to " in reader.damage
    assert (reader.verdict.lost, reader.verdict.counted) == (len(missing), True)
    assert (info(log)["lost"], info(log)["spans"]) == (len(missing), [list(span) for span in reader.verdict.spans])


@pytest.mark.parametrize("use", [open_log, info, lambda p: recover(p, p), lambda p: export_csv(p, p.parent / "out")])
def test_errors_name_the_file(tmp_path, use):
    with pytest.raises(NotFoundError, match=r"gone\.mcap: no such log"):
        use(tmp_path / "gone.mcap")
    (tmp_path / "text.mcap").write_text("hello, I am not a log")
    with pytest.raises(InputError, match=r"text\.mcap: not an MCAP log$"):
        use(tmp_path / "text.mcap")
    (tmp_path / "folder.mcap").mkdir()
    with pytest.raises(InputError, match=r"folder\.mcap: a folder; `monstertruckd log list"):
        use(tmp_path / "folder.mcap")


@pytest.mark.parametrize(
    ("head", "named"),
    [
        (b"#ROSBAG V2.0\n", "not an MCAP log but a ROS 1 bag; `monstertruckd map build` reads its scans"),
        (b"SQLite format 3\x00", "not an MCAP log but the database of a ROS 2 bag"),
        (b"PAR1", "not an MCAP log but a Parquet table"),
        (b"\x1f\x8b\x08", "not an MCAP log but compressed with gzip: decompress it first"),
    ],
)
def test_a_log_of_another_format_is_named(tmp_path, head, named):
    file = tmp_path / "log"
    file.write_bytes(head + bytes(300))
    with pytest.raises(InputError, match=named):
        open_log(file)


def test_log_that_died_at_birth_reads_as_empty(tmp_path):
    file = tmp_path / "run.mcap"
    file.touch()
    reader = open_log(file)
    assert list(reader) == []
    assert reader.damage is not None
    assert recover(file, file).messages == 0
    assert open_log(file).attachments() == {}
    assert info(file)["damage"] is None


@pytest.mark.parametrize("size", [7, 4096, 3_000_000])
def test_a_log_of_zeros_reads_as_empty_and_is_repaired(tmp_path, size):
    """What a power cut leaves of a log that was never synced."""
    file = tmp_path / "run.mcap"
    file.write_bytes(bytes(size))
    reader = open_log(file)
    assert list(reader) == []
    assert "(zeros)" in reader.damage
    (done,) = recover_directory(tmp_path)
    assert (done.messages, done.original) == (0, tmp_path / "run.mcap.damaged")
    assert done.original.read_bytes() == bytes(size)
    assert info(file)["damage"] is None


def test_message_without_its_channel_counts_as_damage(tmp_path):
    file = tmp_path / "odd.mcap"
    with file.open("wb") as output:
        writer = Writer(output, use_chunking=False)
        writer.start()
        writer.add_message(7, 1, b"x", 1)
    reader = open_log(file)
    assert [(message.topic, message.payload) for message in reader] == [("unknown/channel-7", b"x")]
    assert "message of an unknown channel" in reader.damage


def test_versions_that_are_none_do_not_keep_a_log_from_being_replayed(tmp_path):
    attached = {"config": {"robot": "digger"}, "versions": ["odd"]}
    LogFile(tmp_path / "run.mcap", "lz4", 1 << 16, attached, {}, SECOND).finish()
    rpc = _rpc(WallClock(), open_log(tmp_path / "run.mcap"))
    assert (rpc.serves("config"), rpc.serves("versions")) == (True, False)


def test_foreign_topic_is_readable_but_not_decoded(tmp_path):
    file = tmp_path / "foreign.mcap"
    with file.open("wb") as output:
        writer = Writer(output)
        writer.start()
        writer.add_message(writer.register_channel("/chatter", "json", 0), 1, b"{}", 1)
        writer.add_message(writer.register_channel("sensor/scan", "json", 0), 2, b"{}", 2)
        writer.finish()
    for message in open_log(file):
        assert message.payload == b"{}"
        with pytest.raises(NotFoundError, match=message.topic):
            message.decode()
    assert export_csv(file, tmp_path / "out") == {}
    assert info(file)["topics"]["/chatter"]["rate"] is None


def test_info_sums_up(log, master):
    summary = info(log)
    assert json.loads(json.dumps(summary)) == summary
    assert summary["path"] == str(log)
    assert summary["size"] == log.stat().st_size
    assert (summary["damage"], summary["messages"]) == (None, len(master[1]))
    assert (summary["start"], summary["end"], summary["duration"]) == (SECOND, SECOND + 39 * SECOND // 10, 3.9)
    scans = summary["topics"]["sensor/scan"]
    assert (scans["messages"], scans["rate"], scans["schema"]) == (40, pytest.approx(10), "foxglove.LaserScan")
    assert scans["bytes"] > 40 * 682 * 8
    assert summary["attachments"].keys() == {"config.json"}
    assert summary["metadata"]["run"] == {"robot": "truck"}


def test_info_of_a_damaged_log_says_so(cut):
    assert info(cut)["damage"]
    assert 0 < info(cut)["messages"] < 200


def test_recovered_log_opens_everywhere_and_the_original_stays(cut, tmp_path):
    before = cut.read_bytes()
    expected = list(open_log(cut))
    recovery = recover(cut, tmp_path / "fixed.mcap")
    assert cut.read_bytes() == before
    assert recovery.damage
    assert recovery.messages == len(expected)
    assert list(open_log(recovery.path)) == expected
    with recovery.path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_summary().statistics.message_count == len(expected)
        assert [a.name for a in reader.iter_attachments()] == ["config.json"]
        assert {m.name: m.metadata for m in reader.iter_metadata()}["run"] == {"robot": "truck"}
        assert {c.topic: c.message_encoding for c in reader.get_summary().channels.values()} == {
            topic.name: wire.schema(topic).message_encoding for topic in MAKERS
        }


def test_a_sound_log_is_left_as_it_is(tmp_path):
    log = tmp_path / "run.mcap"
    write(log, 20)
    before, place = log.read_bytes(), log.stat().st_ino
    assert recover(log, log).damage is None
    assert (log.read_bytes(), log.stat().st_ino) == (before, place)
    assert list(tmp_path.iterdir()) == [log]


def test_recovery_takes_no_other_files_place(cut, tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("notes")
    with pytest.raises(InputError, match=r"precious\.txt: already exists"):
        recover(cut, precious)
    assert precious.read_text() == "notes"


def test_recovery_leaves_the_original_when_it_cannot_write(cut, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        recover(cut, tmp_path / "nowhere" / "fixed.mcap")
    assert cut.exists()


@pytest.mark.parametrize("head", [b"\0", b"\x89"])
def test_a_log_whose_begin_is_damaged_is_read(log, master, head):
    """A bit of its mark has flipped, or the disk lost its first block."""
    data = log.read_bytes()
    log.write_bytes(head + bytes(7) + data[8:])
    reader = open_log(log)
    assert len(list(reader)) == len(master[1])
    assert reader.damage is None
    assert reader.fault.startswith("is damaged at byte 0 of ")


def test_a_repair_on_a_disk_that_takes_nothing_names_the_log(cut, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(repair.os, "fsync", refuse)
    monkeypatch.setattr(repair.Path, "unlink", refuse)
    with pytest.raises(InputError, match=rf"{cut.name}: cannot be written: Read-only file system"):
        recover(cut, cut)


def test_abandoned_recovery_leaves_the_original_and_no_rest(cut):
    stop = threading.Event()
    stop.set()
    before = cut.read_bytes()
    with pytest.raises(InputError, match="abandoned"):
        recover(cut, cut, stop)
    assert cut.read_bytes() == before
    assert [p.name for p in cut.parent.iterdir()] == [cut.name]
    assert recover_directory(cut.parent, stop) == []


def test_folder_is_repaired_where_it_needs_to_be(cut, master):
    folder = cut.parent
    sound = folder / "sound.mcap"
    shutil.copy(master[0], sound)
    stamp = sound.stat().st_mtime_ns
    (folder / "text.mcap").write_text("no log at all")
    (recovery,) = recover_directory(folder)
    assert recovery.path == cut
    assert sound.stat().st_mtime_ns == stamp
    assert (folder / "text.mcap").read_text() == "no log at all"
    assert open_log(cut).damage is None
    assert recover_directory(folder) == []


def test_log_being_written_is_not_repaired(cut):
    before = cut.read_bytes()
    with cut.open("rb") as recorder:
        fcntl.flock(recorder, fcntl.LOCK_EX)
        assert recover_directory(cut.parent) == []
        with pytest.raises(InputError, match="is being written"):
            recover(cut, cut)
    assert cut.read_bytes() == before


def test_csv_has_a_row_per_message_and_a_column_per_field(log, tmp_path):
    files = export_csv(log, tmp_path / "deep" / "csv")
    assert {topic: file.name for topic, file in files.items()} == {
        topic.name: topic.name.replace("/", "_") + ".csv" for topic in MAKERS
    }
    with files["sensor/compass"].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 40
    assert rows[0]["magnetic_field.x"] == ""
    assert (rows[1]["magnetic_field.x"], rows[1]["magnetic_field.z"]) == ("1.0", "3.0")
    assert (rows[1]["log_time"], rows[1]["heading"], rows[1]["tilt_valid"]) == ("1100000000", "1.0", "True")
    with files["sensor/scan"].open(newline="") as file:
        assert len(json.loads(next(csv.DictReader(file))["ranges"])) == 682
    with files["health/services"].open(newline="") as file:
        (service,) = json.loads(next(csv.DictReader(file))["services"])
    assert (service["name"], service["state"]) == ("lidar", "ready")


def test_npz_has_an_array_per_field(log, tmp_path):
    files = export_npz(log, tmp_path / "npz")
    with np.load(files["sensor/scan"], allow_pickle=False) as table:
        assert table["ranges"].shape == (40, 682)
        assert table["codes"].dtype == np.uint8
        assert table["stamp"].tolist() == [SECOND + i * SECOND // 10 for i in range(40)]
        assert table["frame"].tolist() == ["laser"] * 40
    with np.load(files["sensor/compass"], allow_pickle=False) as table:
        x = table["magnetic_field.x"]
        assert math.isnan(x[0])
        assert x[1] == 1.0
        assert table["tilt_valid"].dtype == bool
    with np.load(files["plan/path"], allow_pickle=False) as table:
        assert table["poses.lengths"].tolist() == [3 * (i + 1) for i in range(40)]
        assert table["poses"].shape == (sum(range(3, 123, 3)),)
    with np.load(files["health/services"], allow_pickle=False) as table:
        assert json.loads(table["services"][0])[0]["name"] == "lidar"


def test_invalid_message_in_a_log_is_named(tmp_path):
    file = tmp_path / "bad.mcap"
    log = LogFile(file, "none", 1000, {}, {}, 0)
    log.add(LogEntry(t.COMPASS, 0, 0, 0, b'{"stamp": 1}'))
    log.finish()
    with pytest.raises(InputError, match=r"bad\.mcap: message 1: sensor/compass: received: Field required"):
        export_npz(file, tmp_path / "out")


def test_export_folder_that_cannot_be_made_is_named(log, tmp_path):
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(InputError, match="out: cannot be created"):
        export_csv(log, tmp_path / "out")
