"""Salvage of intact records from a damaged log: every chunk with a valid checksum, anywhere in the file.

The file is read from start to end, record by record. After an invalid record, the reader searches for the next valid
record byte by byte: a chunk is valid if its checksum matches, any other record if its lengths are consistent. The bytes
skipped are a gap. Channels come from the chunks, the index, and the metadata that the recorder repeats (``CHANNELS``),
so a message can be read even if the chunk that introduced its channel is lost.
"""

import errno
import os
import re
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, BinaryIO, Final, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
    Statistics,
)

from monstertruck_runtime import wire
from monstertruck_runtime.outside import MOST_UNPACKED
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.chunks import records_in, unpacked
from monstertruckd.recorder.frames import (
    DAMAGE,
    HEAD,
    MAGIC,
    PRIVATE,
    READERS,
    checked_attachment,
    digest_of,
    index_is_sound,
)
from monstertruckd.recorder.log_file import CHANNELS

_CANDIDATE: Final = re.compile(rb"[\x01-\x0f].{5}\x00\x00\x00", re.DOTALL)
"""A known opcode, and a length below 1 TB."""
_CHUNK_CANDIDATE: Final = re.compile(rb"(?=\x06.{5}\x00\x00\x00)", re.DOTALL)
_CHUNK_HEAD: Final = struct.Struct("<QQQII")
"""First and last log time, uncompressed size, checksum, length of the compression name."""
_SIZE: Final = struct.Struct("<Q")
_INDEX_HEAD: Final = struct.Struct("<HI")
_INDEX_ENTRY: Final = 16
"""Size of an index entry (bytes): log time and offset of a message."""
_LENGTHS: Final[dict[int, int]] = {Opcode.DATA_END: 4, Opcode.FOOTER: 20, Opcode.SUMMARY_OFFSET: 17}
"""Content lengths of fixed-size records (bytes)."""
UNKNOWN: Final = "unknown/channel-{}"
"""Topic name for messages whose channel is lost."""


class Span(NamedTuple):
    """Log time interval with lost messages (ns); None as a limit means from the start, or to the end."""

    start: int | None
    end: int | None


class ChannelFacts(NamedTuple):
    """Channel description, without the numbers used in its file."""

    topic: str
    message_encoding: str
    metadata: tuple[tuple[str, str], ...]
    schema: tuple[str, str, bytes] | None
    """Schema name, encoding and data."""


class _Bytes:
    """Bytes of a file; unreadable bytes are returned as zeros.

    Args:
        file: file opened for reading.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._descriptor = file.fileno()
        self.size = os.fstat(self._descriptor).st_size

    def at(self, begin: int, size: int) -> bytes:
        """Return ``size`` bytes from ``begin``, or fewer at the end of the file."""
        sector = 4096  # unit of unreadable data on a disk (bytes)
        try:
            return os.pread(self._descriptor, size, begin)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            if size <= sector:
                return bytes(min(size, self.size - begin))
            middle = (begin + size // 2) // sector * sector
            middle = middle if begin < middle < begin + size else begin + size // 2
            return self.at(begin, middle - begin) + self.at(middle, begin + size - middle)

    def is_magic(self, at: int) -> bool:
        """Return whether the magic bytes are at this offset."""
        return self.at(at, len(MAGIC)) == MAGIC

    def next_candidate(self, at: int) -> int:
        """Return the next possible start of a record at or after ``at``, or the end of the file."""
        window = 1 << 20  # bytes searched at once
        while at < self.size:
            found = _CANDIDATE.search(self.at(at, window + HEAD.size))
            if found is not None:
                return at + found.start()
            at += window
        return self.size


class Salvage:
    """Intact records of a log, in order, each chunk once.

    Args:
        file: log opened for reading; it must stay open.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._data = _Bytes(file)
        self.indexed = _is_indexed(file)
        """Whether the index at the end of the file is valid."""
        self.ended = self._data.size > len(MAGIC) and self._data.is_magic(self._data.size - len(MAGIC))
        """Whether the file ends like a finished log."""
        self.messages = 0
        """Number of messages yielded so far."""
        self.first: int | None = None
        """Minimum log time of the messages yielded so far (ns)."""
        self.flaws: list[str] = []
        """Damage found so far that loses no message."""
        self._spans: list[Span] = []
        self._newest: int | None = None
        """Maximum log time of the messages yielded so far (ns)."""
        self._gap = False
        """Whether nothing has been yielded since the last gap."""
        self._found = _Scan(self._data, trusted=self.indexed).run()

    @property
    def strange(self) -> bool:
        """Whether the file is not a log: no magic bytes at the start, and no records after it.

        A file of zeros is a log: a power cut leaves one if the log was never synced.
        """
        begin = self._data.at(0, len(MAGIC))
        return not (MAGIC.startswith(begin) or any(self._found.parts)) and any(begin)

    @property
    def gaps(self) -> int:
        """Number of unreadable places."""
        return self._found.parts.count(None)

    @property
    def repeated(self) -> int:
        """Number of duplicate chunks; each chunk is yielded once."""
        return self._found.repeated

    @property
    def counted(self) -> bool:
        """Whether ``lost`` is exact; without an index it is a lower bound."""
        return self._found.statistics is not None

    @property
    def lost(self) -> int:
        """Number of lost messages, as far as the file shows; valid after ``records``."""
        statistics = self._found.statistics
        return self._found.indexed if statistics is None else max(statistics.message_count - self.messages, 0)

    @property
    def lacking(self) -> bool:
        """Whether an attachment or metadata is lost, as far as the file shows."""
        statistics, kinds = self._found.statistics, [part.opcode for part in self._found.parts if part]
        return statistics is not None and (
            kinds.count(Opcode.ATTACHMENT) < statistics.attachment_count
            or kinds.count(Opcode.METADATA) < statistics.metadata_count
        )

    def spans(self) -> list[Span]:
        """Return the time spans of lost messages, in order; valid after ``records``."""
        if self._found.statistics is None:
            return self._spans
        return self._missing() if self.lost else []

    def _missing(self) -> list[Span]:
        """Return the spans of indexed chunks that are missing; adjacent ones are merged."""
        there = Counter(self._found.chunks)
        spans: list[Span] = []
        alone = True
        for index in sorted(self._found.expected, key=lambda index: index.message_start_time):
            key = (index.message_start_time, index.message_end_time, index.uncompressed_size)
            if there[key]:
                there[key] -= 1
                alone = True
            else:
                start = index.message_start_time if alone else spans.pop().start
                spans.append(Span(start, index.message_end_time))
                alone = False
        return spans

    def records(self, begin: int = 0) -> Iterator[tuple[Message, ChannelFacts] | Attachment | Metadata | Header]:
        """Yield headers, attachments, metadata, and messages with their channel, in the order of the file.

        Args:
            begin: offset (bytes) of the first record to yield; messages before it are only counted.
        """
        self._newest, self._gap = None, False
        for part in self._found.parts:
            if part is None:
                self._gap = True
                continue
            times = self._found.times.get(part.offset)
            if times is not None and part.offset < begin:
                self._count(times)
                continue
            for record in self._opened(part):
                if isinstance(record, Message):
                    at = record.log_time
                    self._count(_Times(1, at, at, at))
                    if part.offset >= begin:
                        yield record, self._facts(record.channel_id)
                elif isinstance(record, Header | Attachment | Metadata) and part.offset >= begin:
                    yield record
        if self._gap or not self.ended:
            self._spans.append(Span(self._newest, None))

    def _count(self, times: "_Times") -> None:
        """Count messages that are present."""
        if not times.messages:
            return
        if self._gap:
            self._spans.append(Span(self._newest, times.begin))
            self._gap = False
        self._newest = max(times.newest, self._newest or 0)
        self.first = times.first if self.first is None else min(self.first, times.first)
        self.messages += times.messages

    def _opened(self, part: "_WholeRecord") -> Iterator[McapRecord]:
        record = part.read(self._data)
        if isinstance(record, Chunk):
            yield from records_in(unpacked(record))
        elif isinstance(record, Attachment):
            checked = checked_attachment(record, part.content(self._data))
            if checked is not record:
                self.flaws.append(f"contains a damaged {record.name}")
            yield checked
        else:
            yield record

    def _facts(self, number: int) -> ChannelFacts:
        channel, name = self._found.sealed.channels.get(number), self._found.names.get(number)
        if channel is None and name not in BY_NAME:
            channel = self._found.spare.channels.get(number)
        topic = BY_NAME.get(name or "") if channel is None else BY_NAME.get(channel.topic)
        ours = None if topic is None else wire.schema(topic)
        if channel is not None:
            sealed, spare = (it.schemas.get(channel.schema_id) for it in (self._found.sealed, self._found.spare))
            found = sealed or spare or ours
            schema = (found.name, found.encoding, found.data) if found and channel.schema_id else None
            return ChannelFacts(channel.topic, channel.message_encoding, tuple(channel.metadata.items()), schema)
        if topic is None or ours is None:
            return ChannelFacts(UNKNOWN.format(number), "", (), None)
        metadata = (("encoding", wire.encoding(topic)),)
        return ChannelFacts(topic.name, ours.message_encoding, metadata, (ours.name, ours.encoding, ours.data))


def _is_indexed(file: BinaryIO) -> bool:
    try:
        return index_is_sound(file)
    except OSError:
        return False


class _WholeRecord(NamedTuple):
    """Intact record."""

    offset: int
    opcode: int
    length: int
    """Length of the content (bytes)."""

    @property
    def end(self) -> int:
        """Offset of the next record."""
        return self.offset + HEAD.size + self.length

    def content(self, data: _Bytes) -> bytes:
        """Return the content of the record."""
        return data.at(self.offset + HEAD.size, self.length)

    def read(self, data: _Bytes) -> Any:
        """Return the record, whose lengths are consistent.

        Raises:
            McapError: the lengths are inconsistent. Any error in ``DAMAGE`` may also be raised.
        """
        content = self.content(data)
        stream = ReadDataStream(BytesIO(content))
        if self.opcode == Opcode.MESSAGE:
            return Message.read(stream, self.length)
        record = READERS[self.opcode].read(stream)
        if stream.count != self.length:
            raise McapError("inconsistent lengths")
        return record


class _Times(NamedTuple):
    """Log times of messages (ns)."""

    messages: int
    begin: int
    """Log time of the first message in the file."""
    first: int
    """Minimum log time."""
    newest: int
    """Maximum log time."""

    @classmethod
    def of(cls, times: Sequence[int]) -> "_Times":
        """Return the times of messages in file order."""
        return cls(len(times), times[0], min(times), max(times)) if times else cls(0, 0, 0, 0)


@dataclass(slots=True)
class _KnownChannels:
    """Schemas and channels by number; the first of each number is kept."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)

    def learn(self, record: McapRecord) -> None:
        """Add a schema or channel."""
        if isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)


@dataclass(slots=True)
class _Found:
    """Results of the first pass over a file."""

    parts: list[_WholeRecord | None] = field(default_factory=list)
    """Intact records of the data section; None for a gap."""
    sealed: _KnownChannels = field(default_factory=_KnownChannels)
    """Channels of intact chunks and of a valid index."""
    spare: _KnownChannels = field(default_factory=_KnownChannels)
    """Channels of records without a checksum."""
    names: dict[int, str] = field(default_factory=dict)
    """Topics by channel number, from the metadata of the recorder."""
    times: dict[int, _Times] = field(default_factory=dict)
    """Message times of each intact chunk, by chunk offset."""
    chunks: list[tuple[int, int, int]] = field(default_factory=list)
    """First and last log time, and size, of intact chunks."""
    expected: list[ChunkIndex] = field(default_factory=list)
    """Chunks listed in a valid index."""
    statistics: Statistics | None = None
    """Statistics of a valid index."""
    indexed: int = 0
    """Number of messages listed in the message indexes of lost chunks."""
    repeated: int = 0


class _Scan:
    """First pass over a file.

    Args:
        data: bytes of the file.
        trusted: whether its index is valid.
    """

    def __init__(self, data: _Bytes, *, trusted: bool) -> None:
        self._data, self._trusted = data, trusted
        self._found = _Found()
        self._seen: set[bytes] = set()
        self._behind = False
        """Whether the scan is past the data section, where damage loses no message."""
        self._sure = True
        """Whether there is no gap since the start or the last chunk, so a message index belongs to this chunk."""
        self._broken = False
        """Whether there is a gap, possibly in the index."""
        self._loose = False
        """Whether the log has messages outside chunks before any gap."""

    def run(self) -> _Found:
        """Find all intact records."""
        at, in_step = 0, True
        while at < self._data.size:
            if self._data.is_magic(at):
                at += len(MAGIC)
            elif (part := self._part(at, in_step=in_step)) is None:
                if in_step:
                    self._note_gap()
                in_step, at = False, self._data.next_candidate(at + 1)
            elif self._is_sealed(part):
                self._take(part)
                in_step, at = True, part.end
            else:
                in_step, at = self._take_unsealed(part)
        found, parts = self._found, self._found.parts
        loose = found.statistics is not None and not found.statistics.chunk_count
        if self._broken and not (loose or self._loose):  # apparent messages are inside broken chunks
            self._found.parts = [part for part in parts if part is None or part.opcode != Opcode.MESSAGE]
        return self._found

    def _take_unsealed(self, part: _WholeRecord) -> tuple[bool, int]:
        """Add a record without a valid checksum, which may be truncated or overwritten by a chunk.

        Returns:
            Whether the following data is in step, and its offset.
        """
        content = part.content(self._data)
        for found in _CHUNK_CANDIDATE.finditer(content):
            chunk = self._part(part.offset + HEAD.size + found.start(), in_step=False)
            if chunk is not None and self._is_sealed(chunk):
                self._note_gap()
                return False, chunk.offset
        self._take(part)
        if self._is_followed(part):
            return True, part.end
        self._note_gap()
        return False, part.offset + HEAD.size

    def _note_gap(self) -> None:
        self._sure, self._broken = False, True
        if not self._behind and self._found.parts[-1:] != [None]:
            self._found.parts.append(None)

    def _part(self, at: int, *, in_step: bool) -> _WholeRecord | None:
        """Return the record at offset ``at`` if it is intact."""
        head = self._data.at(at, HEAD.size)
        if len(head) < HEAD.size:
            return None
        part = _WholeRecord(at, *HEAD.unpack(head))
        if part.end > self._data.size or part.length > MOST_UNPACKED:
            return None
        match part.opcode:
            case Opcode.MESSAGE_INDEX:
                whole = self._is_message_index(part) and self._is_followed(part)
            case Opcode.MESSAGE:
                whole = part.length >= 22 and self._is_followed(part)  # bytes of a message without its data
            case opcode if opcode in _LENGTHS:
                whole = part.length == _LENGTHS[opcode]
            case Opcode.CHUNK:
                whole = self._adds_up(part) and self._is_whole(part, in_step=in_step)
            case opcode if opcode in READERS:
                whole = self._is_whole(part, in_step=in_step)
            case opcode:
                whole = opcode >= PRIVATE and in_step and self._is_followed(part)
        return part if whole else None

    def _is_message_index(self, part: _WholeRecord) -> bool:
        if part.length < _INDEX_HEAD.size:
            return False
        _, size = _INDEX_HEAD.unpack(self._data.at(part.offset + HEAD.size, _INDEX_HEAD.size))
        return bool(size == part.length - _INDEX_HEAD.size and size % _INDEX_ENTRY == 0)

    def _adds_up(self, part: _WholeRecord) -> bool:
        """Return whether the lengths of a chunk are consistent; checked before reading all of it."""
        head = self._data.at(part.offset + HEAD.size, _CHUNK_HEAD.size)
        if len(head) < _CHUNK_HEAD.size:
            return False
        _, _, _, _, named = _CHUNK_HEAD.unpack(head)
        size = self._data.at(part.offset + HEAD.size + _CHUNK_HEAD.size + named, _SIZE.size)
        return len(size) == _SIZE.size and _CHUNK_HEAD.size + named + _SIZE.size + _SIZE.unpack(size)[0] == part.length

    def _is_followed(self, part: _WholeRecord) -> bool:
        """Return whether the end of the file or a record head follows the record."""
        rest = self._data.size - part.end
        if rest == 0 or self._data.is_magic(part.end):
            return True
        if rest < HEAD.size:
            return False
        opcode, length = HEAD.unpack(self._data.at(part.end, HEAD.size))
        return bool(0 < opcode <= Opcode.DATA_END or opcode >= PRIVATE) and length <= rest - HEAD.size

    def _is_whole(self, part: _WholeRecord, *, in_step: bool) -> bool:
        try:
            record = part.read(self._data)
            if isinstance(record, Chunk):
                content = unpacked(record)
                if not record.uncompressed_crc:
                    for _ in records_in(content):
                        pass
        except DAMAGE:
            return False
        return in_step or part.opcode != Opcode.ATTACHMENT or self._is_sealed(part)

    def _is_sealed(self, part: _WholeRecord) -> bool:
        """Return whether an intact record has a matching checksum."""
        if part.opcode != Opcode.ATTACHMENT:
            return part.opcode == Opcode.CHUNK
        record = part.read(self._data)
        return checked_attachment(record, part.content(self._data)) is record

    def _take(self, part: _WholeRecord) -> None:
        """Add an intact record."""
        found = self._found
        match part.opcode:
            case Opcode.DATA_END:
                self._behind = True
            case Opcode.STATISTICS | Opcode.CHUNK_INDEX:
                self._behind = True
                self._take_index(part.read(self._data))
            case Opcode.SCHEMA | Opcode.CHANNEL:
                (found.sealed if self._behind and self._trusted else found.spare).learn(part.read(self._data))
            case Opcode.MESSAGE_INDEX:
                if not self._sure:
                    found.indexed += (part.length - _INDEX_HEAD.size) // _INDEX_ENTRY
            case Opcode.CHUNK:
                self._behind, self._sure = False, True
                self._take_chunk(part)
            case Opcode.MESSAGE:
                self._behind = False
                self._loose |= not self._broken
                found.parts.append(part)
            case Opcode.HEADER | Opcode.METADATA | Opcode.ATTACHMENT:
                self._behind = False
                self._take_once(part)

    def _take_index(self, record: McapRecord) -> None:
        """Add an index record."""
        if isinstance(record, Statistics) and self._trusted:
            self._found.statistics = record
        elif isinstance(record, ChunkIndex) and self._trusted:
            self._found.expected.append(record)

    def _take_once(self, part: _WholeRecord) -> None:
        if not self._is_new(part):
            return
        self._found.parts.append(part)
        record = part.read(self._data)
        if isinstance(record, Metadata) and record.name == CHANNELS:
            self._found.names |= {int(number): topic for number, topic in record.metadata.items() if number.isdecimal()}

    def _take_chunk(self, part: _WholeRecord) -> None:
        if not self._is_new(part):
            self._found.repeated += 1
            return
        self._found.parts.append(part)
        chunk = part.read(self._data)
        self._found.chunks.append((chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size))
        times = list[int]()
        for record in records_in(unpacked(chunk)):
            self._found.sealed.learn(record)
            if isinstance(record, Message):
                times.append(record.log_time)
        self._found.times[part.offset] = _Times.of(times)

    def _is_new(self, part: _WholeRecord) -> bool:
        digest = digest_of(part.opcode, part.content(self._data))
        new = digest not in self._seen
        self._seen.add(digest)
        return new
