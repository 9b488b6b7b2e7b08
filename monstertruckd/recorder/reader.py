"""Sequential reading of MCAP logs, finished or not, with every checksum verified."""

import itertools
import json
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata, Schema
from mcap.records import Message as McapMessage

from monstertruck_runtime import wire
from monstertruck_runtime.errors import ConfigError, InputError, NotFoundError
from monstertruck_runtime.small_files import DAMAGED
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.chunks import records_in, unpacked
from monstertruckd.recorder.frames import (
    CHECKSUM,
    DAMAGE,
    MAGIC,
    PRIVATE,
    READERS,
    checked_attachment,
    digest_of,
    index_is_sound,
    open_file,
    read_frame,
    read_statistics,
)
from monstertruckd.recorder.log_damage import LogDamage, judged, repetition
from monstertruckd.recorder.log_file import LOG_OFFSET, TIMES
from monstertruckd.recorder.salvage import ChannelFacts, Salvage

CONFIG: Final = "config.json"
"""Attachment with the configuration of the daemon."""


def spare_log(output: Path) -> None:
    """Raise an error if ``output`` is a log, which must not be overwritten.

    Raises:
        InputError: ``output`` is a log.
    """
    if output.is_file():
        with output.open("rb") as file:
            if file.read(len(MAGIC)) == MAGIC:
                raise InputError(f"{output}: is a log, which is not overwritten; choose another file")


def joined(records: Iterable[McapRecord]) -> Iterator[tuple[McapMessage, Channel, Schema | None]]:
    """Yield the messages among MCAP records, each with its channel and schema."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for record in records:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, McapMessage):
            channel = channels[record.channel_id]
            yield record, channel, schemas.get(channel.schema_id)


@dataclass(frozen=True, slots=True)
class LogMessage:
    """Message of a log."""

    topic: str
    """Name in the topic table, e.g. ``sensor/scan``."""
    log_time: int
    """Daemon time of recording (ns), regardless of the clock of the file's log times."""
    stamp: int
    """Stamp of the message (ns)."""
    sequence: int
    payload: bytes
    schema: str

    def decode(self) -> Message:
        """Return the typed message.

        Raises:
            NotFoundError: the topic is not in the table.
            InputError: the payload is not valid for its topic.
        """
        topic = BY_NAME.get(self.topic)
        if topic is None or topic.schema_name != self.schema:
            raise NotFoundError(f"topic {self.topic!r} with schema {self.schema!r} is unknown")
        return wire.decode(topic, self.payload)


class LogReader:
    """Iterates over a log, any number of times; in a damaged file, over every intact chunk, as ``recover`` does.

    Args:
        path: MCAP file.

    Raises:
        NotFoundError: the file does not exist.
        InputError: the file is not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: str | None = None
        """Reason, number and times of missing messages, after a complete iteration; None if none are known to be
        missing.
        """
        self.flaws: list[str] = []
        """Other damage found by a complete iteration, which loses no message."""
        self.verdict: LogDamage | None = None
        """Figures of the damage; None if the last iteration found none before the index."""
        self.position = 0
        """Bytes read so far by an iteration, for progress bars."""
        self.log_offset = 0
        """Log times minus daemon times (ns), known after an iteration has passed the metadata."""
        with open_file(path) as file:
            head = file.read(32)  # bytes that tell the formats apart
            magic = head[: len(MAGIC)]
            if not MAGIC.startswith(magic) and (not _resembles(magic) or Salvage(file).strange):
                other = next((f" but {text}" for begin, text in OTHERS.items() if head.startswith(begin)), "")
                raise InputError(f"{path}: not an MCAP log{other}")

    def __iter__(self) -> Iterator[LogMessage]:
        return self._messages(self.records())

    def before_damage(self) -> Iterator[LogMessage]:
        """Yield the messages up to the first error, for evaluations that a gap would invalidate."""
        return self._messages(self.records(past_damage=False))

    def _messages(self, records: Iterator[McapRecord]) -> Iterator[LogMessage]:
        for record, channel, schema in joined(records):
            yield LogMessage(
                channel.topic,
                record.log_time - self.log_offset,
                record.publish_time,
                record.sequence,
                record.data,
                schema.name if schema else "",
            )

    def records(self, *, past_damage: bool = True) -> Iterator[McapRecord]:
        """Yield every intact MCAP record before the index, with chunks unpacked; channels precede their messages.

        Times are as in the file; see ``log_offset``.

        Args:
            past_damage: whether to continue after an error.
        """
        self.damage, self.flaws, self.verdict, self.log_offset = None, [], None, 0
        size = self.size
        with self.path.open("rb") as file:
            try:
                yield from self._sound(file, size)
            except DAMAGE as error:
                why = str(error) if type(error) is McapError else type(error).__name__
                text = f"is damaged at byte {self.position} of {size} ({why})"
                if past_damage:
                    yield from self._salvaged(file, text)
                else:
                    self.damage = text
            self.position = size

    def _sound(self, file: BinaryIO, size: int) -> Iterator[McapRecord]:
        """Yield the records; raise one of ``DAMAGE`` at the first error, with the record offset in ``position``."""
        channels, seen = set[int](), set[bytes]()
        given: Counter[type[McapRecord]] = Counter()
        self.position, repeated = 0, 0
        begin = file.read(len(MAGIC))
        if begin != MAGIC:
            raise McapError("zeros" if begin and not any(begin) else "no start of a log")
        summed = zlib.crc32(begin)
        while True:
            self.position = file.tell()
            opcode, head, content = read_frame(file, size)
            if opcode == Opcode.DATA_END:
                self._end(file, size, content, summed, given)
                if repeated:
                    self.flaws.append(repetition(repeated))
                return
            summed = zlib.crc32(content, zlib.crc32(head, summed))
            if opcode == Opcode.CHUNK:
                digest = digest_of(opcode, content)
                if digest in seen:
                    repeated += 1
                    continue
                seen.add(digest)
            for record in self._opened(opcode, content):
                if isinstance(record, Channel):
                    channels.add(record.id)
                elif isinstance(record, McapMessage) and record.channel_id not in channels:
                    raise McapError(f"message of an unknown channel {record.channel_id}")
                self._learn(record)
                given[type(record)] += 1
                yield record

    def _learn(self, record: McapRecord) -> None:
        """Store the offset between log times and daemon times.

        Raises:
            ValueError: the offset is not a number.
        """
        if isinstance(record, Metadata) and record.name == TIMES:
            self.log_offset = int(record.metadata.get(LOG_OFFSET, "0"))

    def _opened(self, opcode: int, content: bytes) -> Iterable[McapRecord]:
        """Return the records in a record of the data section: the content of a chunk, or the record itself."""
        stream = ReadDataStream(BytesIO(content))
        match opcode:
            case Opcode.CHUNK:
                return records_in(unpacked(Chunk.read(stream)))
            case Opcode.MESSAGE:
                return (McapMessage.read(stream, len(content)),)
            case Opcode.ATTACHMENT:
                return (self._checked(Attachment.read(stream), content),)
            case Opcode.HEADER | Opcode.SCHEMA | Opcode.CHANNEL | Opcode.METADATA:
                return (READERS[opcode].read(stream),)
        if opcode == 0:  # not an opcode: zeros of a file that lost its content in a power cut
            raise McapError("zeros")
        if opcode != Opcode.MESSAGE_INDEX and opcode < PRIVATE:
            raise McapError(f"not a record of the data section: {opcode}")
        return ()

    def _checked(self, record: Attachment, content: bytes) -> Attachment:
        checked = checked_attachment(record, content)
        if checked is not record:
            self.flaws.append(f"contains a damaged {record.name}")
        return checked

    def _end(
        self, file: BinaryIO, size: int, content: bytes, summed: int, given: Mapping[type[McapRecord], int]
    ) -> None:
        """Compare the records read with the end of the data section and the index after it."""
        (expected,) = CHECKSUM.unpack(content)  # a wrong length means another record with a flipped first byte
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
            raise McapError(f"{given[McapMessage]} of {statistics.message_count} messages")
        if (given[Attachment], given[Metadata]) != (statistics.attachment_count, statistics.metadata_count):
            self.flaws.append("lacks an attachment or metadata")

    def _salvaged(self, file: BinaryIO, first: str) -> Iterator[McapRecord]:
        """Yield the intact records starting at ``position``; the damage is known after the last record.

        Args:
            file: the log.
            first: damage at ``position``.
        """
        salvage = Salvage(file)
        introduced: set[int] = set()
        for record in salvage.records(self.position):
            if isinstance(record, tuple):
                message, facts = record
                if message.channel_id not in introduced:
                    introduced.add(message.channel_id)
                    yield from _introduction(message.channel_id, facts)
                yield message
            else:
                with suppress(ValueError):
                    self._learn(record)
                yield record
        self.verdict = judged(salvage)
        self.flaws = []
        text = f"{first}, {self.verdict.damage or 'is sound'}"
        if self.verdict.costs:
            self.damage = f"{text}: {self.verdict.losses}"
        else:
            self.flaws.append(text)

    def preamble(self) -> Iterator[McapRecord]:
        """Yield the records before the first message, where the recorder writes attachments and metadata.

        Keeps the damage found by a complete iteration.
        """
        known = self.damage, self.flaws, self.verdict
        try:
            yield from itertools.takewhile(lambda record: not isinstance(record, McapMessage), self.records())
        finally:
            self.damage, self.flaws, self.verdict = known

    def config(self) -> dict[str, Any]:
        """Return the attached configuration as plain values, or an empty dict. Raises as ``attached_config`` does."""
        return attached_config(self.path, self.attachments()) or {}

    @property
    def fault(self) -> str | None:
        """All damage found by a complete iteration, as text that follows the log's name; None for an undamaged log."""
        return ", ".join([*self.flaws, *([] if self.damage is None else [self.damage])]) or None

    @property
    def size(self) -> int:
        """File size (bytes)."""
        return self.path.stat().st_size

    def attachments(self) -> dict[str, bytes]:
        """Return the attached files of the preamble, by name."""
        return {record.name: record.data for record in self.preamble() if isinstance(record, Attachment)}

    def metadata(self) -> dict[str, dict[str, str]]:
        """Return the metadata records of the preamble, by name."""
        return {record.name: dict(record.metadata) for record in self.preamble() if isinstance(record, Metadata)}


STRANGERS: Final = {
    b"version https://git-lfs": "a git-LFS pointer, not the file itself: fetch it with `git lfs pull`",
    b"\x1f\x8b": "compressed with gzip: decompress it first (CARMEN and URG text may stay compressed as NAME.gz)",
    b"BZh": "compressed with bzip2: decompress it first",
    b"\xfd7zXZ": "compressed with xz: decompress it first",
    b"\x28\xb5\x2f\xfd": "compressed with zstd: decompress it first",
    b"7z\xbc\xaf": "a 7z archive: unpack it first",
}
"""Formats that every reader of logs rejects, by their first bytes."""
OTHERS: Final = STRANGERS | {
    b"#ROSBAG": "a ROS 1 bag; `monstertruckd map build` reads its scans",
    b"SQLite format 3": "the database of a ROS 2 bag; `monstertruckd map build` reads its scans",
    b"PAR1": "a Parquet table",
    b"PK\x03\x04": "a zip archive, as npz files are",
}
"""Formats that are not MCAP, by their first bytes, as the end of an error message."""


def _resembles(head: bytes) -> bool:
    """Return whether these first bytes may be from a damaged log: part of the magic remains, or all bytes are zero."""
    return not any(head) or any(one == other for one, other in zip(head, MAGIC, strict=False))


def _introduction(number: int, facts: ChannelFacts) -> Iterator[Schema | Channel]:
    """Yield a channel that may not have been introduced yet, and its schema with a number that no file uses."""
    schema = 0
    if facts.schema is not None:
        schema = (1 << 16) + number  # schema numbers in a file are lower
        name, encoding, data = facts.schema
        yield Schema(id=schema, name=name, encoding=encoding, data=data)
    yield Channel(
        id=number,
        topic=facts.topic,
        message_encoding=facts.message_encoding,
        metadata=dict(facts.metadata),
        schema_id=schema,
    )


def attached_config(log: Path, attachments: Mapping[str, bytes]) -> dict[str, Any] | None:
    """Return the daemon configuration among the attachments of ``log``; see ``attached_values``."""
    return attached_values(log, attachments, CONFIG)


def attached_values(log: Path, attachments: Mapping[str, bytes], name: str) -> dict[str, Any] | None:
    """Return the plain values of the JSON attachment ``name`` of ``log``, or None without it.

    Raises:
        InputError: the attachment is damaged.
        ConfigError: the attachment is not a JSON object.
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
    """Open a log for reading; return a ``LogReader`` unchanged."""
    return log if isinstance(log, LogReader) else LogReader(Path(log))
