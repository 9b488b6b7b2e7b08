"""Log files and their folder: topics as MCAP channels, one open file, numbered names."""

import fcntl
import json
import os
import re
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from monstertruck_runtime import wire
from monstertruck_runtime.clock import is_date
from monstertruck_runtime.small_files import DAMAGED, make_folder, sync_folder
from monstertruck_schemas.topics import Topic
from monstertruckd import __version__
from monstertruckd.recorder.config import Compression


class Channels:
    """Registers each topic with its schema when it is first requested.

    Args:
        writer: started writer of the file.
    """

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def of(self, topic: Topic[Any]) -> int:
        """Return the channel number of a topic."""
        return self._channels.get(topic.name) or self._register(topic)

    @property
    def numbers(self) -> dict[str, str]:
        """Topics of all channels so far, by number."""
        return {str(number): topic for topic, number in self._channels.items()}

    def _register(self, topic: Topic[Any]) -> int:
        schema = wire.schema(topic)
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        channel = self._writer.register_channel(
            topic.name, schema.message_encoding, self._schemas[schema.name], {"encoding": wire.encoding(topic)}
        )
        self._channels[topic.name] = channel
        return channel


NAME: Final = re.compile(r"run-(\d{6,})-(\d{3,})\.mcap")
"""Name of a log, with run and part."""
DAMAGED_NAME: Final = re.compile(re.escape(DAMAGED) + r"(-\d+)?$")
"""Name suffix of a damaged original; the second original of a log is NAME.damaged-2."""

_COMPRESSION: Final = {
    Compression.NONE: CompressionType.NONE,
    Compression.LZ4: CompressionType.LZ4,
    Compression.ZSTD: CompressionType.ZSTD,
}


TIMES: Final = "times"
"""Metadata record with the clocks of the file's times."""
LOG_OFFSET: Final = "log_offset_ns"
"""Entry of ``TIMES``: offset added to daemon times for the log times of the file (ns)."""


CHANNELS: Final = "channels"
"""Metadata record with the topic of every channel so far, by number; repeated at every sync, for ``log recover``."""


RUN_LOG: Final = "log"
"""Entry of a black box's metadata `run`: a log file of its run."""


def log_offset(now: int, real_offset: int) -> int:
    """Return the offset that a file starting now adds to daemon times to obtain log times (ns).

    Args:
        now: daemon time (ns).
        real_offset: real (UNIX) time minus daemon time (ns).

    Returns:
        ``real_offset``, or 0 while the computer does not know the date.
    """
    return real_offset if is_date(now + real_offset) else 0


class LogEntry(NamedTuple):
    """Message to log."""

    topic: Topic[Any]
    log_time: int
    """Daemon time of publication or reception (ns)."""
    stamp: int
    sequence: int
    """Message count of the topic; a gap is a message dropped on the way to the log."""
    payload: bytes


class LogFile:
    """Open MCAP file, locked against repair and removal.

    Log times are daemon times plus a constant offset; publish times are the stamps of the messages in daemon time.

    Args:
        path: file to create.
        compression: compression of the chunks.
        chunk_size: maximum chunk size (bytes).
        attachments: written first, each as ``<name>.json``.
        metadata: text about the run.
        start: start of the file in daemon time (ns).
        offset: offset added to daemon times for log times (ns).

    Raises:
        OSError: the file exists, or cannot be written.
    """

    def __init__(
        self,
        path: Path,
        compression: Compression,
        chunk_size: int,
        attachments: Mapping[str, Any],
        metadata: Mapping[str, str],
        start: int,
        offset: int = 0,
    ) -> None:
        self.path = path
        self.start = start
        self.offset = offset
        self.open_since: int | None = None
        """Daemon time of the oldest message that is not in the file yet (ns)."""
        self._named = False
        """Whether the file name is synced to the disk."""
        self._output = _Output(path)
        try:
            self._writer = Writer(
                self._output,  # type: ignore[arg-type]  # write, tell and flush are all it needs
                chunk_size=chunk_size,
                compression=_COMPRESSION[compression],
            )
            _pack_indexes(self._writer)
            self._channels = Channels(self._writer)
            self._writer.start(library=f"monstertruckd {__version__}")
            self._writer.add_metadata("run", dict(metadata))
            clocks = {"log_time": "UNIX" if offset else "daemon", "publish_time": "daemon", LOG_OFFSET: str(offset)}
            self._writer.add_metadata(TIMES, clocks)
            for name, value in attachments.items():
                data = json.dumps(value, indent=1, sort_keys=True).encode()
                self._writer.add_attachment(start + offset, start + offset, f"{name}.json", "application/json", data)
        except BaseException:
            self._output.close()
            raise

    @property
    def size(self) -> int:
        """File size (bytes)."""
        return self._output.size

    @property
    def removed(self) -> bool:
        """Whether the file has been removed: its content is lost when it is closed."""
        return self._output.removed

    def add(self, entry: LogEntry) -> None:
        """Add a message to the open chunk."""
        before = self._output.size
        self._writer.add_message(
            self._channels.of(entry.topic),
            entry.log_time + self.offset,
            entry.payload,
            max(0, entry.stamp),
            entry.sequence & 0xFFFFFFFF,
        )
        if self._output.size != before:
            self.open_since = None
        elif self.open_since is None:
            self.open_since = entry.log_time

    def flush(self) -> None:
        """Close the open chunk and pass it to the kernel, so that it survives the end of the process."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self.open_since = None

    def sync(self) -> None:
        """Wait until the data is on disk, so that it survives a power cut."""
        if self._channels.numbers:
            self._writer.add_metadata(CHANNELS, self._channels.numbers)
        self._settle()

    def _settle(self) -> None:
        self._output.sync()
        if not self._named:
            sync_folder(self.path.parent)
            self._named = True

    def finish(self) -> None:
        """Write the index and close the file."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._settle()
        finally:
            self._output.close()

    def abandon(self) -> None:
        """Close the file without an index; it is repaired at the next start."""
        self._output.close()


class _PackedIndex:
    """Index of a chunk, stored as its bytes at the end of the file.

    Args:
        index: index created by the writer.
    """

    __slots__ = ("_record",)

    def __init__(self, index: ChunkIndex) -> None:
        builder = RecordBuilder()
        index.write(builder)
        self._record: bytes = builder.end()  # type: ignore[no-untyped-call]

    def write(self, builder: RecordBuilder) -> None:
        """Write the index to the summary."""
        builder.write(self._record)


class _PackedIndexes(list[_PackedIndex]):
    """Chunk indexes, packed when they are appended.

    With two chunks per second and forty channels each, the writer's objects grow by 0.34 MB per minute until the
    recording ends; packed indexes grow by 0.06 MB per minute.
    """

    def append(self, index: Any) -> None:
        """Append the bytes of an index."""
        super().append(_PackedIndex(index))


def _pack_indexes(writer: Writer) -> None:
    """Make a writer keep its chunk indexes packed until it writes them."""
    name = "_Writer__chunk_indices"  # the writer offers no other way
    assert getattr(writer, name) == []
    setattr(writer, name, _PackedIndexes())


class _Output:
    """Unbuffered file: written data is already in the kernel, so an error leaves nothing to flush."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        fcntl.flock(self._fd, fcntl.LOCK_EX)
        self.size = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            written = os.write(self._fd, rest)
            self.size += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        """Do nothing, as nothing is buffered."""

    @property
    def removed(self) -> bool:
        return os.fstat(self._fd).st_nlink == 0

    def sync(self) -> None:
        os.fsync(self._fd)

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class LogFolder:
    """Numbered log files in one folder: ``run-<run>-<part>.mcap``, in order of age."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        make_folder(directory)
        self._run = (
            max(
                (int(name[1]) for name in (NAME.fullmatch(path.name) for path in directory.iterdir()) if name),
                default=0,
            )
            + 1
        )
        self._part = 0

    def next_path(self) -> Path:
        """Return the path of the next file of this run."""
        path = self.directory / f"run-{self._run:06d}-{self._part:03d}.mcap"
        self._part += 1
        return path

    def next_run(self) -> None:
        """Switch to the next run number because another process uses this one."""
        self._run += 1
        self._part = 0

    def finished(self, current: Path) -> dict[Path, int]:
        """Return the size of every log except ``current``, oldest first; each log follows its damaged originals.

        ``repair`` keeps these originals. Entries that are not regular files are ignored.
        """
        found = []
        for path in self.directory.iterdir():
            name = NAME.fullmatch(DAMAGED_NAME.sub("", path.name))
            if name is None or path == current:
                continue
            with suppress(FileNotFoundError):  # removed meanwhile
                status = path.lstat()
                if stat.S_ISREG(status.st_mode):
                    repaired = path.name == name[0]
                    found.append((int(name[1]), int(name[2]), repaired, path, status.st_size))
        return {path: size for _, _, _, path, size in sorted(found)}
