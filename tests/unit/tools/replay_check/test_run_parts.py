"""Runs that the recorder split into parts."""

import shutil
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.errors import InputError
from monstertruck_schemas.reasons import Reason
from monstertruckd.recorder.config import Compression, RecorderConfig
from monstertruckd.recorder.log_file import LogEntry
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.recorder import LogWriter
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.replay_check import parts_of
from monstertruckd.tools.replay_check.recorded import RunLog
from tests.unit.tools.replay_check.log_surgery import BY_NAME, LEVEL, attachments_of, chunks, computed_again, write


def split(folder, seconds=2.0, **metadata):
    """The parts the recorder makes of a stored run, heads of retained topics and all."""
    config = RecorderConfig(directory=str(folder), rotate_seconds=seconds, compression=Compression.ZSTD)
    attached = {name.removesuffix(".json"): value for name, value in attachments_of(LEVEL).items()}
    messages = list(open_log(LEVEL))
    with LogWriter(config, attached, {"real_offset_ns": "0"} | metadata, messages[0].log_time) as writer:
        for one in messages:
            writer.write(LogEntry(BY_NAME[one.topic], one.log_time, one.stamp, one.sequence, one.payload))
    return sorted(folder.iterdir())


@pytest.fixture
def parts(tmp_path):
    return split(tmp_path / "logs")


def test_a_run_reads_like_the_log_it_was_split_from(parts):
    assert len(parts) >= 3
    whole, run = list(open_log(LEVEL)), RunLog(parts[1])
    assert sum(len(list(open_log(part))) for part in parts) > len(whole)
    assert list(run) == whole == list(run)
    assert run.damage is None
    assert run.position == sum(part.stat().st_size for part in parts)


@pytest.mark.parametrize("number", [0, -1])
def test_any_part_stands_for_its_run(parts, number):
    check = computed_again(parts[number])
    assert check.parts == tuple(parts)
    assert check.agrees
    assert check.reason is Reason.OK
    assert check.lost == {}
    assert check.compared == computed_again(LEVEL).compared


def test_a_part_that_is_not_there_ends_the_run(parts):
    parts[1].unlink()
    check = computed_again(parts[2])
    assert check.reason is Reason.LOG_DAMAGED
    assert check.damage == f"{parts[1].name} is missing: the run is known only up to it"
    assert check.agrees  # as far as it goes
    assert 1.5 < check.duration < 2.5
    done = CliRunner().invoke(app, ["replay", str(parts[0]), "--check"])
    assert done.exit_code == Reason.LOG_DAMAGED.exit_code
    assert f"(a run of {len(parts) - 1} parts)" in done.output.replace("\n", " ")
    assert f"{parts[1].name} is missing" in done.output.replace("\n", " ")


def test_a_damaged_index_ends_no_run(parts):
    data = bytearray(parts[1].read_bytes())
    data[data.rindex(b"jsonschema")] ^= 1
    parts[1].write_bytes(data)
    check = computed_again(parts[0])
    assert check.agrees
    assert check.damage is None
    assert check.compared == computed_again(LEVEL).compared


def test_a_damaged_attachment_of_a_later_part_ends_no_run(parts):
    parts[1].write_bytes(parts[1].read_bytes().replace(b'"wheel_radius"', b'"wheel_radiuS"', 1))
    check = computed_again(parts[0])
    assert check.agrees
    assert check.compared == computed_again(LEVEL).compared


def test_without_its_first_part_a_run_cannot_be_computed(parts):
    parts[0].unlink()
    with pytest.raises(InputError, match=rf"{parts[0].name} is missing: expected the first part"):
        computed_again(parts[1])


def test_a_damaged_part_ends_the_run(parts):
    data = bytearray(parts[1].read_bytes())
    place = chunks(data)[0]
    data[place[len(place) // 2]] ^= 1
    parts[1].write_bytes(data)
    check = computed_again(parts[0])
    assert check.reason is Reason.LOG_DAMAGED
    assert check.damage.startswith(f"{parts[1].name} is damaged at byte")
    assert check.agrees


def test_parts_of_other_runs_do_not_mix(parts, tmp_path):
    stranger = split(tmp_path / "others", real_offset_ns="7")[1]
    shutil.copy(stranger, parts[1])
    with pytest.raises(InputError, match=rf"{parts[1].name}: is of another run than {parts[0].name}"):
        computed_again(parts[0])
    other = parts[0].with_name("run-000002-000.mcap")
    shutil.copy(LEVEL, other)
    assert parts_of(other) == [other]
    assert parts_of(parts[0]) == parts


def test_a_log_under_another_name_stands_for_itself(tmp_path):
    entries = [replace(one) for one in open_log(LEVEL)]
    log = write(tmp_path / "kept.mcap", entries, attachments_of(LEVEL))
    assert parts_of(log) == [log]
    assert computed_again(log).parts == (log,)
