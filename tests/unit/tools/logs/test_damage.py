"""No flipped bit loses or makes a message unreported."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_schemas import topics as t
from monstertruckd.recorder.log_file import LogEntry, LogFile
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.repair import recover
from monstertruckd.tools.logs.summary import info
from tests.unit.tools.logs.run_kit import compass, flipped, write
from tests.unit.tools.replay_check.log_surgery import chunks


@pytest.mark.parametrize("length", [1 << 40, 1 << 63])
def test_a_length_beyond_the_file_costs_its_own_record_alone(log, master, length):
    data = bytearray(log.read_bytes())
    place = data.index(b"application/json") + len(b"application/json")
    assert data[place + 8 : place + 9] == b"{"
    data[place : place + 8] = length.to_bytes(8, "little")
    log.write_bytes(data)
    reader = open_log(log)
    assert len(list(reader)) == len(master[1])
    assert reader.damage is None
    assert reader.fault.startswith("is damaged at byte ")
    assert reader.fault.endswith("), cannot be read in 1 place, lacks an attachment or metadata")
    reader = open_log(log)
    assert list(reader.before_damage()) == []
    assert reader.damage == reader.damage.partition(",")[0]


def test_a_damaged_index_is_reported_and_mended(log, master):
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
def test_no_flipped_bit_changes_messages_unreported(tmp_path, compression):
    log = tmp_path / "log.mcap"
    write(log, 2, compression)
    messages = list(open_log(log))
    for place in range(8, log.stat().st_size, 37):
        with flipped(log, place, 1 << place % 8):
            reader = open_log(log)
            found = list(reader)
            assert found == messages or (reader.damage is not None and {*map(repr, found)} <= {*map(repr, messages)}), (
                place
            )


def test_no_damage_of_an_index_makes_messages(tmp_path):
    log = tmp_path / "log.mcap"
    write(log, 1)
    whole, messages = log.read_bytes(), list(open_log(log))
    for place in range(int.from_bytes(whole[-28:-20], "little"), len(whole)):
        with flipped(log, place, (0x01, 0x80)[place % 2]):
            reader = open_log(log)
            assert list(reader) == messages
            assert reader.fault == "has a damaged index"


def test_what_turned_into_an_end_is_none(tmp_path):
    file = tmp_path / "log.mcap"
    log = LogFile(file, "none", 1 << 20, {}, {}, 0)
    log.add(LogEntry(t.COMPASS, 0, 0, 0, wire.encode(t.COMPASS, compass(0, 0))))
    log.finish()
    data = bytearray(file.read_bytes())
    (chunk,) = chunks(data)
    assert data[chunk.start - 9] == Opcode.CHUNK
    assert data[chunk.start : chunk.start + 4] == bytes(4)  # as if it were no checksum
    data[chunk.start - 9] = Opcode.DATA_END
    file.write_bytes(data)
    reader = open_log(file)
    assert list(reader) == []
    assert "1 lost (0.0 to 0.0 s after its start)" in reader.damage


@pytest.mark.parametrize("opcode", [0x86, Opcode.MESSAGE_INDEX, Opcode.SUMMARY_OFFSET, 0x46])
def test_a_lost_chunk_is_counted(log, master, opcode):
    data = bytearray(log.read_bytes())
    _, chunk, *_ = chunks(data)
    data[chunk.start - 9] = opcode
    log.write_bytes(data)
    reader = open_log(log)
    kept, whole = len(list(reader)), len(master[1])
    assert 0 < kept < whole
    assert f"contains {kept} of {whole} messages: {whole - kept} lost (" in reader.damage
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
    assert reader.fault.startswith(f"is damaged at byte {place} of ")
    assert reader.fault.endswith("cannot be read in 1 place, lacks an attachment or metadata")
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


def test_a_damaged_attachment_is_reported_kept_and_not_used(log, master):
    assert open_log(log).config() == {"a": 1}
    log.write_bytes(log.read_bytes().replace(b'"a": 1', b'"a": 2', 1))
    reader = open_log(log)
    assert len(list(reader)) == len(master[1])
    assert (reader.damage, reader.fault) == (None, "contains a damaged config.json")
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
    with pytest.raises(ConfigError, match=r"config\.json: expected an object"):
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
def test_fuzz_of_any_damage_all_is_read_that_a_repair_keeps(tmp_path_factory, compression, data):
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
    (folder / "fixed.mcap").unlink(missing_ok=True)
    fixed = recover(damaged, folder / "fixed.mcap")
    kept = [(m.topic, m.payload) for m in open_log(folder / "fixed.mcap")]
    assert found == kept
    assert fixed.messages == len(kept)
    payloads = [payload for _, payload in kept]
    assert [payload for _, payload in whole if payload in payloads] == payloads
    assert info(damaged)["messages"] == len(found)
