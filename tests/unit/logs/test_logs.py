import csv
import fcntl
import json
import math
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_schemas import topics as t
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.plan import Path as TruckPath
from monstertruck_schemas.sensor import Attitude, Vector3
from monstertruckd.logs import export_csv, export_npz, info, open_log, recover, recover_directory
from monstertruckd.recorder.file import Entry, LogFile
from tests.unit.recorder.conftest import scan, steering
from tests.unit.replay_check.log_surgery import chunks


def compass(now, seq):
    field = Vector3(x=1.0, y=2.0, z=3.0) if seq % 2 else None
    return Attitude(stamp=now, received=now, seq=seq, heading=1.0, roll=0.0, pitch=0.0, magnetic_field=field)


def health(now, seq):
    row = ServiceHealth(name="lidar", state=ServiceState.READY, since=now)
    return HealthTable(stamp=now, received=now, seq=seq, services=(row,))


def path(now, seq):
    return TruckPath(stamp=now, received=now, seq=seq, poses=np.zeros(3 * (seq + 1)), directions=[], name="lap")


MAKERS = {t.CMD_STEERING: steering, t.SCAN: scan, t.COMPASS: compass, t.HEALTH: health, t.PATH: path}


def write(file: Path, messages=40, compression="lz4") -> list[tuple]:
    """A log with a chunk every ten messages; returns what is in it."""
    log = LogFile(file, compression, 1 << 20, {"config": {"a": 1}}, {"robot": "truck"}, SECOND)
    written = []
    for i in range(messages):
        for topic, make in MAKERS.items():
            now = SECOND + i * SECOND // 10
            message = make(now, i)
            log.add(Entry(topic, now, now, i, wire.encode(topic, message)))
            written.append((topic.name, now, message))
        if i % 10 == 9:
            log.flush()
    log.finish()
    return written


@pytest.fixture(scope="module")
def master(tmp_path_factory):
    file = tmp_path_factory.mktemp("master") / "run-000001-000.mcap"
    return file, write(file)


@pytest.fixture
def log(master, tmp_path):
    return Path(shutil.copy(master[0], tmp_path))


@pytest.fixture
def cut(log):
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.6)])
    return log


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
    assert "damaged after byte" in reader.damage
    assert str(cut.stat().st_size) in reader.damage


def test_flipped_byte_ends_the_reading_there(log, master):
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 0xFF
    log.write_bytes(data)
    reader = open_log(log)
    found = [(m.topic, m.log_time, m.decode()) for m in reader]
    assert found == master[1][: len(found)]
    assert len(found) < len(master[1])
    assert reader.damage is not None


@pytest.mark.parametrize("length", [1 << 40, 1 << 63])
def test_a_length_beyond_the_file_ends_the_reading_there(log, length):
    data = bytearray(log.read_bytes())
    place = data.index(b"application/json") + len(b"application/json")
    assert data[place + 8 : place + 9] == b"{"
    data[place : place + 8] = length.to_bytes(8, "little")
    log.write_bytes(data)
    reader = open_log(log)
    assert list(reader) == []
    assert "damaged after byte" in reader.damage


def test_a_damaged_index_is_told_and_mended(log, master):
    data = bytearray(log.read_bytes())
    data[data.rindex(b"jsonschema")] ^= 1
    log.write_bytes(data)
    reader = open_log(log)
    assert len(list(reader)) == len(master[1])
    assert reader.damage is None
    assert reader.fault == info(log)["damage"] == "has a damaged index"
    assert recover(log, log).damage == "has a damaged index"
    assert info(log)["damage"] is None


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_no_flipped_bit_changes_messages_untold(tmp_path, compression):
    source, damaged = tmp_path / "source.mcap", tmp_path / "damaged.mcap"
    write(source, 2, compression)
    whole, messages = source.read_bytes(), list(open_log(source))
    for place in range(8, len(whole), 11):
        damaged.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :])
        reader = open_log(damaged)
        assert list(reader) == messages or reader.damage is not None, place


def test_no_damage_of_an_index_makes_messages(tmp_path):
    source, damaged = tmp_path / "source.mcap", tmp_path / "damaged.mcap"
    write(source, 1)
    whole = source.read_bytes()
    messages = list(open_log(source))
    for place in range(int.from_bytes(whole[-28:-20], "little"), len(whole)):
        for bit in (0x01, 0x80):
            damaged.write_bytes(whole[:place] + bytes([whole[place] ^ bit]) + whole[place + 1 :])
            reader = open_log(damaged)
            assert list(reader) == messages
            assert reader.fault == "has a damaged index"


def test_what_turned_into_an_end_is_none(tmp_path):
    file = tmp_path / "log.mcap"
    log = LogFile(file, "none", 1 << 20, {}, {}, 0)
    log.add(Entry(t.COMPASS, 0, 0, 0, wire.encode(t.COMPASS, compass(0, 0))))
    log.finish()
    data = bytearray(file.read_bytes())
    (chunk,) = chunks(data)
    assert data[chunk.start - 9] == Opcode.CHUNK
    assert data[chunk.start : chunk.start + 4] == bytes(4)  # as if it were no checksum
    data[chunk.start - 9] = Opcode.DATA_END
    file.write_bytes(data)
    reader = open_log(file)
    assert list(reader) == []
    assert "damaged after byte" in reader.damage


@pytest.mark.parametrize("opcode", [0x86, Opcode.MESSAGE_INDEX, Opcode.SUMMARY_OFFSET, 0x46])
def test_a_lost_chunk_is_counted(log, master, opcode):
    data = bytearray(log.read_bytes())
    _, chunk, *_ = chunks(data)
    data[chunk.start - 9] = opcode
    log.write_bytes(data)
    reader = open_log(log)
    kept, whole = len(list(reader)), len(master[1])
    assert 0 < kept < whole
    assert reader.damage == f"holds {kept} of {whole} messages"
    assert recover(log, log).messages == kept


@pytest.mark.parametrize(("opcode", "content"), [(Opcode.ATTACHMENT, b"config.json"), (Opcode.METADATA, b"robot")])
def test_a_lost_attachment_costs_no_message(log, master, opcode, content):
    data = bytearray(log.read_bytes())
    place = data.rindex(bytes([opcode]), 0, data.index(content) - 8)
    data[place] ^= 0x40
    log.write_bytes(data)
    reader = open_log(log)
    assert len(list(reader)) == len(master[1])
    assert reader.damage is None
    assert reader.fault == f"holds a damaged record at byte {place}, lacks an attachment or metadata"
    assert open_log(log).attachments().keys() <= {"config.json"}  # nothing else is blamed


def test_records_of_others_are_no_damage(log, master):
    """Opcodes from 0x80 on are free for anybody's use."""
    private = bytes([0x80]) + (4).to_bytes(8, "little") + b"ours"
    data = log.read_bytes()
    first, *_ = chunks(bytearray(data))
    head = 8 + 9 + int.from_bytes(data[9:17], "little")
    log.write_bytes(data[:head] + private + data[head : first.start - 9] + private + data[first.start - 9 :])
    reader = open_log(log)
    assert len(list(reader)) == len(master[1])
    assert reader.fault == "has a damaged index"  # it was moved, and so it is one
    assert reader.config() == {"a": 1}


def test_a_damaged_attachment_is_told_kept_and_not_used(log, master):
    assert open_log(log).config() == {"a": 1}
    log.write_bytes(log.read_bytes().replace(b'"a": 1', b'"a": 2', 1))
    reader = open_log(log)
    assert len(list(reader)) == len(master[1])
    assert (reader.damage, reader.fault) == (None, "holds a damaged config.json")
    for _ in range(2):
        with pytest.raises(InputError, match=rf"{log.name}: config\.json in it is damaged"):
            open_log(log).config()
        assert b'"a": 2' in open_log(log).attachments()["config.json.damaged"]
        assert recover(log, log).messages == len(master[1])
    assert info(log)["damage"] is None


@pytest.mark.parametrize("attached", ["text", [1]])
def test_a_configuration_is_an_object(tmp_path, attached):
    file = tmp_path / "log.mcap"
    LogFile(file, "lz4", 1 << 20, {"config": attached}, {}, SECOND).finish()
    with pytest.raises(InputError, match=r"config\.json: expected an object"):
        open_log(file).config()
    LogFile(tmp_path / "bare.mcap", "lz4", 1 << 20, {}, {}, SECOND).finish()
    assert open_log(tmp_path / "bare.mcap").config() == {}


def test_a_log_that_is_removed_is_read_to_its_end(log, master):
    reader = open_log(log)
    messages = iter(reader)
    next(messages)
    log.unlink()
    assert len(list(messages)) == len(master[1]) - 1
    assert reader.fault is None


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_fuzz_any_damage_reads_a_prefix(tmp_path_factory, compression, data):
    folder = tmp_path_factory.getbasetemp() / f"fuzz-{compression}"
    folder.mkdir(exist_ok=True)
    source = folder / "source.mcap"
    if not source.exists():
        write(source, 20, compression)
    whole = [(m.topic, m.payload) for m in open_log(source)]
    content = bytearray(source.read_bytes())
    for _ in range(data.draw(st.integers(0, 2))):
        content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
    damaged = folder / "damaged.mcap"
    damaged.write_bytes(content[: data.draw(st.integers(8, len(content)))])
    found = [(m.topic, m.payload) for m in open_log(damaged)]
    assert len(found) <= len(whole)
    (folder / "fixed.mcap").unlink(missing_ok=True)
    fixed = recover(damaged, folder / "fixed.mcap")
    assert [(m.topic, m.payload) for m in open_log(folder / "fixed.mcap")] == found
    assert fixed.messages == len(found)
    assert info(damaged)["messages"] == len(found)


@pytest.mark.parametrize("use", [open_log, info, lambda p: recover(p, p), lambda p: export_csv(p, p.parent / "out")])
def test_errors_name_the_file(tmp_path, use):
    with pytest.raises(NotFoundError, match=r"gone\.mcap: no such log"):
        use(tmp_path / "gone.mcap")
    (tmp_path / "text.mcap").write_text("hello, I am not a log")
    with pytest.raises(InputError, match=r"text\.mcap: not an MCAP log"):
        use(tmp_path / "text.mcap")
    (tmp_path / "folder.mcap").mkdir()
    with pytest.raises(InputError, match=r"folder\.mcap: cannot be read: Is a directory"):
        use(tmp_path / "folder.mcap")


def test_log_that_died_at_birth_reads_as_empty(tmp_path):
    file = tmp_path / "run.mcap"
    file.touch()
    reader = open_log(file)
    assert list(reader) == []
    assert reader.damage is not None
    assert recover(file, file).messages == 0
    assert open_log(file).attachments() == {}
    assert info(file)["damage"] is None


def test_message_without_its_channel_counts_as_damage(tmp_path):
    file = tmp_path / "odd.mcap"
    with file.open("wb") as output:
        writer = Writer(output, use_chunking=False)
        writer.start()
        writer.add_message(7, 1, b"x", 1)
    reader = open_log(file)
    assert list(reader) == []
    assert "message of an unknown channel" in reader.damage


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
    assert summary["metadata"] == {"run": {"robot": "truck"}}


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
        assert [m.metadata for m in reader.iter_metadata()] == [{"robot": "truck"}]
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
    with pytest.raises(InputError, match=r"precious\.txt: exists already"):
        recover(cut, precious)
    assert precious.read_text() == "notes"


def test_recovery_leaves_the_original_when_it_cannot_write(cut, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        recover(cut, tmp_path / "nowhere" / "fixed.mcap")
    assert cut.exists()


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
    log.add(Entry(t.COMPASS, 0, 0, 0, b'{"stamp": 1}'))
    log.finish()
    with pytest.raises(InputError, match=r"bad\.mcap: message 1: sensor/compass: received: Field required"):
        export_npz(file, tmp_path / "out")


def test_export_folder_that_cannot_be_made_is_named(log, tmp_path):
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(InputError, match="out: cannot be made"):
        export_csv(log, tmp_path / "out")
