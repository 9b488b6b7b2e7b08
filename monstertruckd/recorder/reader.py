"""Reading MCAP logs front to back, finished or not, with every checksum verified."""

import itertools
import json
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Metadata, Schema, Statistics
from mcap.records import Message as McapMessage

from monstertruck_runtime import wire
from monstertruck_runtime.errors import ConfigError, InputError, NotFoundError
from monstertruck_runtime.outside import MEGABYTE, MOST_UNPACKED
from monstertruck_runtime.small_files import require_file
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.chunks import LIMIT, records_in, unpacked
from monstertruckd.recorder.log_file import DAMAGED, LOG_OFFSET, TIMES

MAGIC: Final = b"\x89MCAP0\r\n"

DAMAGE: Final = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    RuntimeError,
    LookupError,
    MemoryError,
    OverflowError,
    OSError,
)
"""What the libraries raise on bytes that are no MCAP record (lz4: RuntimeError; bad checksums: ValueError)."""

_END: Final = struct.Struct("<BQQQI8s")
"""Footer and magic: opcode, length, where the summary and its offsets begin, checksum."""

_FOOTER_LENGTH: Final = struct.calcsize("<QQI")
_UNSUMMED: Final = struct.calcsize("<I8s")
_HEAD: Final = struct.Struct("<BQ")
"""Head of a record: opcode, length of the content."""
CHECKSUM: Final = struct.Struct("<I")
_PIECE: Final = 1 << 20


def is_finished(path: Path) -> bool:
    """Whether the file ends as a finished log does."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(-min(size, len(MAGIC)), os.SEEK_END)
        return size > len(MAGIC) and file.read() == MAGIC


def index_is_sound(file: BinaryIO) -> bool:
    """Whether a log is finished, and its index at the end, if it has one, is what the checksum says.

    Args:
        file: of the log; its position is another one afterwards.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(-min(size, _END.size), os.SEEK_END)
    end = file.read()
    if len(end) < _END.size:
        return False
    opcode, length, start, _, checksum, magic = _END.unpack(end)
    if (opcode, length, magic) != (Opcode.FOOTER, _FOOTER_LENGTH, MAGIC) or start > size - _END.size:
        return False
    return not (start and checksum) or _checksum(file, start, size - _UNSUMMED) == checksum


def _checksum(file: BinaryIO, begin: int, end: int) -> int:
    """Of the bytes from ``begin`` up to ``end``, which may be more than fit into memory."""
    file.seek(begin)
    value = 0
    for at in range(begin, end, _PIECE):
        value = zlib.crc32(file.read(min(_PIECE, end - at)), value)
    return value


def read_frame(file: BinaryIO, size: int) -> tuple[int, bytes, bytes]:
    """Opcode, head and content of the next record of a file of ``size`` bytes.

    Raises:
        EndOfFile: it is not all there.
        McapError: it is longer than ``MOST_UNPACKED``.
    """
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise EndOfFile
    opcode, length = _HEAD.unpack(head)
    if length > size - file.tell():
        raise EndOfFile
    if length > MOST_UNPACKED:
        raise McapError(f"a record of {length / MEGABYTE:.0f} MB: {LIMIT}")
    return opcode, head, file.read(length)


def read_statistics(file: BinaryIO, size: int) -> Statistics | None:
    """Of a sound index that begins where ``file`` stands; None if it has none."""
    while True:
        opcode, _, content = read_frame(file, size)
        if opcode == Opcode.STATISTICS:
            found: Statistics = Statistics.read(ReadDataStream(BytesIO(content)))
            return found
        if opcode == Opcode.FOOTER:
            return None


CONFIG: Final = "config.json"
"""The attachment with the daemon's configuration."""

PRIVATE: Final = 0x80
"""Opcodes from here on are private ones; unknown ones below are damage."""
_PLAIN: Final[dict[int, Any]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
}


def checked_attachment(record: Attachment, content: bytes) -> Attachment:
    """Return an attachment, renamed if its checksum, which mcap does not verify, is wrong.

    Args:
        record: the attachment.
        content: of its record in the file.
    """
    (expected,) = CHECKSUM.unpack(content[-CHECKSUM.size :])
    if expected in (0, zlib.crc32(content[: -CHECKSUM.size])):
        return record
    return replace(record, name=record.name + DAMAGED, media_type="application/octet-stream")


def spare_log(output: Path) -> None:
    """Refuse to overwrite a log.

    Raises:
        InputError: there is a log under that name.
    """
    if output.is_file():
        with output.open("rb") as file:
            if file.read(len(MAGIC)) == MAGIC:
                raise InputError(f"{output}: is a log, which is not overwritten; name another file")


def open_file(path: Path) -> BinaryIO:
    """Open a log for reading, whatever is in it.

    Raises:
        NotFoundError: no such file.
        InputError: it is a folder, or cannot be read.
    """
    try:
        require_file(path)
        return path.open("rb")
    except FileNotFoundError:
        raise NotFoundError(f"{path}: no such log") from None
    except IsADirectoryError:
        raise InputError(f"{path}: a folder; `monstertruckd log list {path}` lists the logs in it") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


@dataclass(frozen=True, slots=True)
class LogMessage:
    """One message of a log."""

    topic: str
    """Name in the topic table, e.g. ``sensor/scan``."""
    log_time: int
    """Daemon time of recording, ns, whatever clock the file's log times are of."""
    stamp: int
    """The message's own stamp, ns."""
    sequence: int
    payload: bytes
    schema: str

    def decode(self) -> Message:
        """The typed message.

        Raises:
            NotFoundError: the topic is not in the table.
            InputError: the payload is not valid for its topic.
        """
        topic = BY_NAME.get(self.topic)
        if topic is None or topic.schema_name != self.schema:
            raise NotFoundError(f"topic {self.topic!r} with schema {self.schema!r} is not one of ours")
        return wire.decode(topic, self.payload)


class LogReader:
    """Iterates over a log, once or again; a damaged file ends at its first error.

    Args:
        path: an MCAP file.

    Raises:
        NotFoundError: no such file.
        InputError: not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: str | None = None
        """After an iteration to the end: why messages are missing; None if none is known to be."""
        self.flaws: list[str] = []
        """What else an iteration to the end found damaged; it costs no message."""
        self.position = 0
        """Bytes an iteration has read so far, for progress bars."""
        self.log_offset = 0
        """The file's log times minus daemon times, ns, once an iteration has passed the metadata."""
        with open_file(path) as file:
            head = file.read(len(MAGIC))
        if not MAGIC.startswith(head):
            raise InputError(f"{path}: not an MCAP log")

    def __iter__(self) -> Iterator[LogMessage]:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for record in self.records():
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, McapMessage):
                channel = channels[record.channel_id]
                schema = schemas.get(channel.schema_id)
                yield LogMessage(
                    channel.topic,
                    record.log_time - self.log_offset,
                    record.publish_time,
                    record.sequence,
                    record.data,
                    schema.name if schema else "",
                )

    def records(self) -> Iterator[McapRecord]:
        """Every MCAP record before the index, up to the first error, chunks opened; channels precede their messages.

        Their times are as they are in the file; see ``log_offset``.
        """
        self.damage, self.flaws, self.log_offset = None, [], 0
        size = self.size
        with self.path.open("rb") as file:
            try:
                yield from self._records(file, size)
            except DAMAGE as error:
                why = str(error) if type(error) is McapError else type(error).__name__
                self.damage = f"ends or is damaged after byte {self.position} of {size} ({why})"

    def _records(self, file: BinaryIO, size: int) -> Iterator[McapRecord]:
        """The same, but raises one of ``DAMAGE`` at the first error, whose record begins at ``position``."""
        channels: set[int] = set()
        given: Counter[type[McapRecord]] = Counter()
        self.position = 0
        summed = zlib.crc32(file.read(len(MAGIC)))
        while True:
            self.position = file.tell()
            opcode, head, content = read_frame(file, size)
            if opcode == Opcode.DATA_END:
                self._end(file, size, content, summed, given)
                self.position = size
                return
            summed = zlib.crc32(content, zlib.crc32(head, summed))
            for record in self._opened(opcode, content):
                if isinstance(record, Channel):
                    channels.add(record.id)
                elif isinstance(record, McapMessage) and record.channel_id not in channels:
                    raise McapError(f"message of an unknown channel {record.channel_id}")
                elif isinstance(record, Metadata) and record.name == TIMES:
                    self.log_offset = int(record.metadata.get(LOG_OFFSET, "0"))
                given[type(record)] += 1
                yield record

    def _opened(self, opcode: int, content: bytes) -> Iterable[McapRecord]:
        """Records of one record of the data section (those of a chunk)."""
        stream = ReadDataStream(BytesIO(content))
        match opcode:
            case Opcode.CHUNK:
                return records_in(unpacked(Chunk.read(stream)))
            case Opcode.MESSAGE:
                return (McapMessage.read(stream, len(content)),)
            case Opcode.ATTACHMENT:
                return (self._checked(Attachment.read(stream), content),)
            case Opcode.HEADER | Opcode.SCHEMA | Opcode.CHANNEL | Opcode.METADATA:
                return (_PLAIN[opcode].read(stream),)
        if opcode == 0:  # no opcode: the zeros of a file that a power cut left without its content
            raise McapError("zeros")
        if opcode != Opcode.MESSAGE_INDEX and opcode < PRIVATE:
            self.flaws.append(f"holds a damaged record at byte {self.position}")
        return ()

    def _checked(self, record: Attachment, content: bytes) -> Attachment:
        checked = checked_attachment(record, content)
        if checked is not record:
            self.flaws.append(f"holds a damaged {record.name}")
        return checked

    def _end(
        self, file: BinaryIO, size: int, content: bytes, summed: int, given: Mapping[type[McapRecord], int]
    ) -> None:
        """Compare what was read with the end of the data section and the index after it."""
        (expected,) = CHECKSUM.unpack(content)  # of another length it was another record before its first byte flipped
        if expected not in (0, summed):
            raise McapError("checksum of the data section")
        begin = file.tell()
        if not index_is_sound(file):
            self.flaws.append("has a damaged index")
            return
        file.seek(begin)
        statistics = read_statistics(file, size)
        if statistics is None:
            return
        if given[McapMessage] != statistics.message_count:
            self.damage = f"holds {given[McapMessage]} of {statistics.message_count} messages"
        if (given[Attachment], given[Metadata]) != (statistics.attachment_count, statistics.metadata_count):
            self.flaws.append("lacks an attachment or metadata")

    def preamble(self) -> Iterator[McapRecord]:
        """The records before the first message: the recorder writes attachments and metadata there.

        What an iteration to the end found wrong stays known.
        """
        damage, flaws = self.damage, self.flaws
        try:
            yield from itertools.takewhile(lambda record: not isinstance(record, McapMessage), self.records())
        finally:
            self.damage, self.flaws = damage, flaws

    def config(self) -> dict[str, Any]:
        """The attached configuration as plain values; empty where there is none. Raises as ``attached_config`` does."""
        return attached_config(self.path, self.attachments()) or {}

    @property
    def fault(self) -> str | None:
        """Everything an iteration to the end found wrong, to follow the log's name; None for a sound log."""
        return ", ".join([*self.flaws, *([] if self.damage is None else [self.damage])]) or None

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self.path.stat().st_size

    def attachments(self) -> dict[str, bytes]:
        """Attached files of the preamble, by name."""
        return {record.name: record.data for record in self.preamble() if isinstance(record, Attachment)}

    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records of the preamble, by name."""
        return {record.name: dict(record.metadata) for record in self.preamble() if isinstance(record, Metadata)}


def attached_config(log: Path, attachments: Mapping[str, bytes]) -> dict[str, Any] | None:
    """The daemon's configuration among what is attached to ``log``; see ``attached_values``."""
    return attached_values(log, attachments, CONFIG)


def attached_values(log: Path, attachments: Mapping[str, bytes], name: str) -> dict[str, Any] | None:
    """Plain values of the JSON attachment ``name`` among those of ``log``; None where there is none.

    Raises:
        InputError: it is damaged.
        ConfigError: it is no JSON object.
    """
    if name + DAMAGED in attachments:
        raise InputError(f"{log}: {name} in it is damaged")
    data = attachments.get(name)
    if data is None:
        return None
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{log}: {name}: {error}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{log}: {name}: expected an object")
    return values


def open_log(log: str | Path | LogReader) -> LogReader:
    """Open a log for reading; see ``LogReader``, which stays itself."""
    return log if isinstance(log, LogReader) else LogReader(Path(log))
