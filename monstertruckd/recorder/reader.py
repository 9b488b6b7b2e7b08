"""Reading MCAP logs front to back, finished or not."""

import itertools
import json
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk

from monstertruck_runtime import wire
from monstertruck_runtime.errors import ConfigError, InputError, NotFoundError
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.framing import CHECKSUM, DAMAGE, MAGIC, index_is_sound, read_frame, read_statistics

CONFIG: Final = "config.json"
"""The attachment with the daemon's configuration."""
DAMAGED: Final = ".damaged"
"""Behind the name of an attachment whose checksum is wrong: nobody takes it for what it was, and nothing is lost."""

_PRIVATE: Final = 0x80
"""Opcodes from here on are anybody's; below, those that are no part of the data section come of damage."""
_PLAIN: Final[dict[int, Any]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
}


def spare_log(output: Path) -> None:
    """Make sure that what is to be written does not take the place of a log.

    Raises:
        InputError: there is a log under that name.
    """
    if output.is_file():
        with output.open("rb") as file:
            if file.read(len(MAGIC)) == MAGIC:
                msg = f"{output}: is a log, which is not overwritten; name another file"
                raise InputError(msg)


@dataclass(frozen=True, slots=True)
class LogMessage:
    """One message of a log."""

    topic: str
    """Name in the topic table, e.g. ``sensor/scan``."""
    log_time: int
    """Daemon time of recording, ns."""
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
            msg = f"topic {self.topic!r} with schema {self.schema!r} is not one of ours"
            raise NotFoundError(msg)
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
        """After an iteration to the end: why it did not give every message; None if it did, as far as can be told."""
        self.flaws: list[str] = []
        """What else an iteration to the end found damaged; it costs no message."""
        self.position = 0
        """Bytes an iteration has read so far, for progress bars."""
        try:
            with path.open("rb") as file:
                head = file.read(len(MAGIC))
        except FileNotFoundError:
            msg = f"{path}: no such log"
            raise NotFoundError(msg) from None
        except OSError as error:
            msg = f"{path}: cannot be read: {error.strerror}"
            raise InputError(msg) from None
        if not MAGIC.startswith(head):
            msg = f"{path}: not an MCAP log"
            raise InputError(msg)

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
                    record.log_time,
                    record.publish_time,
                    record.sequence,
                    record.data,
                    schema.name if schema else "",
                )

    def records(self) -> Iterator[McapRecord]:
        """Every MCAP record before the index, up to the first error, chunks opened; channels precede their messages."""
        self.damage, self.flaws = None, []
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
                given[type(record)] += 1
                yield record

    def _opened(self, opcode: int, content: bytes) -> Iterable[McapRecord]:
        """What a record of the data section holds."""
        stream = ReadDataStream(BytesIO(content))
        match opcode:
            case Opcode.CHUNK:
                return breakup_chunk(Chunk.read(stream), validate_crc=True)
            case Opcode.MESSAGE:
                return (McapMessage.read(stream, len(content)),)
            case Opcode.ATTACHMENT:
                return (self._checked(Attachment.read(stream), content),)
            case Opcode.HEADER | Opcode.SCHEMA | Opcode.CHANNEL | Opcode.METADATA:
                return (_PLAIN[opcode].read(stream),)
        if opcode != Opcode.MESSAGE_INDEX and opcode < _PRIVATE:
            self.flaws.append(f"holds a damaged record at byte {self.position}")
        return ()

    def _checked(self, record: Attachment, content: bytes) -> Attachment:
        """An attachment, by another name if its checksum, which mcap skips, is wrong."""
        (expected,) = CHECKSUM.unpack(content[-CHECKSUM.size :])
        if expected in (0, zlib.crc32(content[: -CHECKSUM.size])):
            return record
        self.flaws.append(f"holds a damaged {record.name}")
        return replace(record, name=record.name + DAMAGED, media_type="application/octet-stream")

    def _end(
        self, file: BinaryIO, size: int, content: bytes, summed: int, given: Mapping[type[McapRecord], int]
    ) -> None:
        """Hold what was given against the end of the data section and the index behind it."""
        (expected,) = CHECKSUM.unpack(content)  # of another length it was another record before its first byte flipped
        if expected not in (0, summed):
            raise McapError("checksum of the data section")
        begin = file.tell()
        if not index_is_sound(file):
            self.flaws.append("has a damaged index")
            return
        file.seek(begin)
        told = read_statistics(file, size)
        if told is None:
            return
        if given[McapMessage] != told.message_count:
            self.damage = f"holds {given[McapMessage]} of {told.message_count} messages"
        if (given[Attachment], given[Metadata]) != (told.attachment_count, told.metadata_count):
            self.flaws.append("lacks an attachment or metadata")

    def preamble(self) -> Iterator[McapRecord]:
        """The records before the first message: the recorder writes attachments and metadata there."""
        return itertools.takewhile(lambda record: not isinstance(record, McapMessage), self.records())

    def config(self) -> dict[str, Any]:
        """The attached configuration as plain values; empty where there is none. Raises as ``attached_config`` does."""
        return attached_config(self.path, self.attachments()) or {}

    @property
    def fault(self) -> str | None:
        """All that an iteration to the end found wrong, to be read behind the log's name; None for a sound log."""
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
    """The daemon's configuration among what is attached to ``log``, as plain values; None where there is none.

    Raises:
        InputError: it is damaged.
        ConfigError: it is no JSON object.
    """
    if CONFIG + DAMAGED in attachments:
        raise InputError(f"{log}: {CONFIG} in it is damaged")
    data = attachments.get(CONFIG)
    if data is None:
        return None
    try:
        values = json.loads(data)
    except ValueError as error:
        raise ConfigError(f"{log}: {CONFIG}: {error}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{log}: {CONFIG}: expected an object")
    return values


def open_log(path: str | Path) -> LogReader:
    """Open a log for reading; see ``LogReader``."""
    return LogReader(Path(path))
