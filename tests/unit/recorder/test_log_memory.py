"""A recording takes little memory however long it lasts, and its index is whole."""

import tracemalloc
from pathlib import Path

from mcap.reader import make_reader

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.log_file import LogEntry, LogFile

TOPICS = [topic for topic in BY_NAME.values() if topic.logged][:30]
CHUNKS = 400


def test_the_index_of_a_long_recording_is_kept_in_few_bytes_and_written_whole(tmp_path: Path) -> None:
    tracemalloc.start()
    try:
        writer = LogFile(tmp_path / "long.mcap", "zstd", 1 << 18, {}, {}, SECOND)
        before = 0
        for chunk in range(CHUNKS):
            for number, topic in enumerate(TOPICS):
                time = SECOND * (1 + chunk) + number
                writer.add(LogEntry(topic=topic, log_time=time, stamp=time, sequence=chunk, payload=b"x"))
            writer.flush()
            if chunk == CHUNKS // 10:
                before = tracemalloc.get_traced_memory()[0]
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 0.9 * CHUNKS * (100 + 14 * len(TOPICS)), f"{grown / CHUNKS:.0f} bytes a chunk"
    writer.finish()
    with (tmp_path / "long.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) == CHUNKS
        assert {len(index.message_index_offsets) for index in summary.chunk_indexes} == {len(TOPICS)}
        assert summary.statistics is not None
        assert summary.statistics.message_count == CHUNKS * len(TOPICS)
        assert sum(1 for _ in make_reader(file).iter_messages()) == CHUNKS * len(TOPICS)
