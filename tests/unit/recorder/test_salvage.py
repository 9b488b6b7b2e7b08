"""Every message whose chunk is whole survives any damage of its log; the original is never touched."""

import errno
import os
import random
import subprocess
import sys
import zlib
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from benchmarks.durability_parts.damage import CHUNKS, PER_CHUNK, Made, damaged, made, read, wrong
from monstertruck_runtime.errors import InputError
from monstertruckd.recorder import salvage
from monstertruckd.recorder.config import Compression
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.repair import recover, recover_directory

ZEROS = Path(__file__).parents[2] / "data" / "zeros4k.mcap"


@pytest.fixture(autouse=True, scope="module")
def quick():
    """Do not wait for the disk: hundreds of files are repaired here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> dict[tuple[Compression, bool], Made]:
    folder = tmp_path_factory.mktemp("made")
    return {(kind, done): made(folder, kind, finished=done) for kind in Compression for done in (True, False)}


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize("compression", list(Compression))
def test_every_message_whose_chunk_is_whole_survives(tmp_path, logs, compression, finished):
    log = logs[compression, finished]
    file, fixed = tmp_path / "broken.mcap", tmp_path / "fixed.mcap"
    for seed in range(60):
        broken = damaged(log.data, random.Random(seed))
        fixed.unlink(missing_ok=True)
        file.write_bytes(broken)
        assert wrong(log, broken, file, fixed) is None, seed


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize("lost", range(CHUNKS))
def test_a_lost_chunk_takes_no_other_with_it(tmp_path, logs, lost, finished):
    log = logs[Compression.LZ4, finished]
    begin = log.data.index(log.chunks[lost][0])
    file = tmp_path / "run-000001-000.mcap"
    broken = log.data[: begin + 9] + bytes(200) + log.data[begin + 209 :]
    file.write_bytes(broken)
    done = recover(file, file)
    rows = [row for number, (_, rows) in enumerate(log.chunks) if number != lost for row in rows]
    assert read(file) == rows, "topics, too: channels introduced in a lost chunk are known otherwise"
    assert (done.messages, done.lost) == (len(rows), 2 * PER_CHUNK)
    assert done.counted is finished
    assert done.original == tmp_path / "run-000001-000.mcap.damaged"
    assert done.original.read_bytes() == broken
    start, end = lost * 1.0, lost + 0.9
    span = done.spans[0]
    assert span[0] == pytest.approx(max(start if finished else start - 0.1, 0.0), abs=1e-6) or lost == 0
    if finished:
        assert span == pytest.approx((start, end))
    with file.open("rb") as stream:
        notes = {one.name: one.metadata for one in make_reader(stream).iter_metadata()}["recovered"]
    assert notes["log"] == file.name
    assert notes["kept"] == str(len(rows))
    assert "cannot be read in 1 place" in notes["damage"]


def test_the_case_of_the_hole(tmp_path):
    file = tmp_path / "zeros4k.mcap"
    file.write_bytes(ZEROS.read_bytes())
    done = recover(file, file)
    assert (done.messages, done.lost, done.counted) == (240, 160, True)
    assert len(read(file)) == 240
    assert str(done) == (
        f"{file}: 240 messages kept, 160 lost (0.8 to 1.6 s after its start); it cannot be read in 1 place, "
        f"contains 240 of 400 messages; the original is {file}.damaged"
    )
    assert Path(f"{file}.damaged").read_bytes() == ZEROS.read_bytes()
    assert recover(file, file) == replace(done, messages=240, lost=0, spans=(), damage=None, original=None)


def test_the_process_of_the_daemon_reports_and_logs_nothing_itself(tmp_path):
    (tmp_path / "log.mcap").write_bytes(ZEROS.read_bytes()[:-100])
    command = [sys.executable, "-m", "monstertruckd.recorder.repair", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout.startswith('"repaired '), done.stderr) == (True, ""), "the journal would give it no priority"


def test_an_original_is_kept_beside_those_of_earlier_repairs(tmp_path):
    file = tmp_path / "log.mcap"
    (tmp_path / "log.mcap.damaged").write_bytes(b"of an earlier one")
    file.write_bytes(ZEROS.read_bytes())
    assert recover(file, file).original == tmp_path / "log.mcap.damaged-2"
    assert (tmp_path / "log.mcap.damaged").read_bytes() == b"of an earlier one"


def test_a_repair_that_was_cut_off_is_made_again(tmp_path):
    file, kept = tmp_path / "log.mcap", tmp_path / "log.mcap.damaged"
    file.write_bytes(ZEROS.read_bytes())
    kept.hardlink_to(file)
    assert recover(file, file).original == kept
    assert kept.read_bytes() == ZEROS.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.mcap", "log.mcap.damaged"]


def test_the_repair_of_a_start_keeps_the_original_and_says_what_is_lost(tmp_path, logs, caplog):
    log = logs[Compression.LZ4, False]
    file = tmp_path / "run-000001-000.mcap"
    begin = log.data.index(log.chunks[3][0])
    file.write_bytes(log.data[: begin + 20] + bytes(60) + log.data[begin + 80 :])
    (done,) = recover_directory(tmp_path)
    assert (done.messages, done.lost, done.counted) == (140, 20, False)
    assert (tmp_path / "run-000001-000.mcap.damaged").exists()
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert "140 messages kept, at least 20 lost (2.9 to 4.0 s, from 7.9 s on after its start)" in record.getMessage()
    assert recover_directory(tmp_path) == []


def test_a_repair_that_may_have_lost_messages_is_a_warning(tmp_path, logs, caplog):
    log = logs[Compression.LZ4, False]
    (tmp_path / "run-000001-000.mcap").write_bytes(log.data[: log.data.index(log.chunks[-1][0])])
    (done,) = recover_directory(tmp_path)
    assert (done.lost, done.counted) == (0, False)
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_a_chunk_that_is_there_twice_is_kept_once(tmp_path, logs):
    log = logs[Compression.ZSTD, True]
    file = tmp_path / "log.mcap"
    chunk = log.chunks[2][0]
    end = log.data.index(chunk) + len(chunk)
    file.write_bytes(log.data[:end] + chunk + log.data[end:])
    reader = open_log(file)
    assert [(one.topic, one.payload) for one in reader] == [
        (topic, data) for _, rows in log.chunks for topic, _, data in rows
    ]
    assert reader.fault == "has a damaged index, contains 1 chunk twice"
    done = recover(file, file)
    assert read(file) == [row for _, rows in log.chunks for row in rows]
    assert done.repeated == 1
    assert done.damage == "contains 1 chunk twice, has a damaged index"


def test_sectors_that_the_disk_refuses_are_a_hole(tmp_path, logs, monkeypatch):
    log = logs[Compression.NONE, True]
    file = tmp_path / "log.mcap"
    file.write_bytes(log.data)
    bad, pread = log.data.index(log.chunks[4][0]) + 100, os.pread

    def refusing(descriptor, size, begin):
        if begin < (bad // 4096 + 1) * 4096 and bad // 4096 * 4096 < begin + size:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return pread(descriptor, size, begin)

    monkeypatch.setattr(salvage.os, "pread", refusing)
    done = recover(file, tmp_path / "fixed.mcap")
    found = read(tmp_path / "fixed.mcap")
    begin = bad // 4096 * 4096
    whole = [
        rows
        for chunk, rows in log.chunks
        if log.data.index(chunk) >= begin + 4096 or log.data.index(chunk) + len(chunk) <= begin
    ]
    assert found == [row for rows in whole for row in rows]
    assert done.lost == 160 - len(found) > 0


@pytest.mark.parametrize("chunking", [True, False])
def test_logs_of_others_without_chunks_or_checksums(tmp_path, chunking):
    file = tmp_path / "log.mcap"
    with file.open("wb") as output:
        writer = Writer(output, 400, CompressionType.NONE, use_chunking=chunking, enable_crcs=False)
        writer.start()
        channel = writer.register_channel("/a", "json", writer.register_schema("A", "jsonschema", b"{}"))
        for number in range(200):
            writer.add_message(channel, number, b"x%03d" % number, number)
        writer.finish()
    data = file.read_bytes()
    at = data.index(b"x100")
    file.write_bytes(data[: at - 30] + bytes(300) + data[at + 270 :])
    done = recover(file, file)
    kept = [int(payload[1:]) for _, _, payload in read(file)]
    assert kept == sorted(kept)
    assert len(kept) == done.messages
    assert 170 <= len(kept) < 200
    assert {0, 80, 120, 199} <= set(kept)


def test_what_was_never_a_log_is_refused(tmp_path):
    file = tmp_path / "log.mcap"
    file.write_bytes(b"something else " * 100)
    with pytest.raises(InputError, match=r"log\.mcap: not an MCAP log"):
        recover(file, file)
    assert [path.name for path in tmp_path.iterdir()] == ["log.mcap"]


def bomb(compression: str, size: int, says: int) -> bytes:
    """A log with one chunk of zeros that unpacks to ``size`` bytes and says ``says``."""
    content = bytes(size)
    packed = zstandard.compress(content) if compression == "zstd" else lz4.frame.compress(content)
    out = BytesIO()
    writer = Writer(out)
    writer.start()
    head = out.getvalue()
    chunk = (
        (0).to_bytes(8, "little") * 2
        + says.to_bytes(8, "little")
        + zlib.crc32(content).to_bytes(4, "little")
        + len(compression).to_bytes(4, "little")
        + compression.encode()
        + len(packed).to_bytes(8, "little")
        + packed
    )
    return head + bytes([Opcode.CHUNK]) + len(chunk).to_bytes(8, "little") + chunk


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize(
    ("says", "text"),
    [
        (300_000_000, "a chunk of 300 MB: expected at most 128 MB"),
        (1000, "a chunk of more than the 1000 bytes in its header"),
    ],
)
def test_a_chunk_is_bounded_before_it_is_unpacked(tmp_path, compression, says, text):
    file = tmp_path / "bomb.mcap"
    file.write_bytes(bomb(compression, 300_000_000, says))
    assert file.stat().st_size < 2_000_000
    reader = open_log(file)
    before = peak()
    assert list(reader) == []
    assert text in str(reader.damage)
    recover(file, tmp_path / "fixed.mcap")
    assert peak() - before < 50_000, "kB"


def peak() -> int:
    """Greatest memory so far, kB."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.split("VmHWM:")[1].split()[0])
