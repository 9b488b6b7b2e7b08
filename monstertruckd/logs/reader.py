"""Reading MCAP logs front to back, finished or not."""

import itertools
import json
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, McapRecord, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader

from monstertruck_runtime import wire
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import BY_NAME

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


def index_is_sound(path: Path) -> bool:
    """Whether a log is finished, and its index at the end, if it has one, is what the checksum says."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(-min(size, _END.size), os.SEEK_END)
        end = file.read()
        if len(end) < _END.size:
            return False
        opcode, length, start, _, checksum, magic = _END.unpack(end)
        if (opcode, length, magic) != (Opcode.FOOTER, _FOOTER_LENGTH, MAGIC) or start > size:
            return False
        if not (start and checksum):
            return True
        file.seek(start)
        return zlib.crc32(file.read(size - start - _UNSUMMED)) == int(checksum)


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
        """After an iteration to the end: why it ended early; None for a finished, sound log."""
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
        """Every MCAP record up to the first error, chunks opened; channels always precede their messages."""
        self.damage = None
        channels: set[int] = set()
        size = self.size
        with self.path.open("rb") as file:
            stream = StreamReader(file, validate_crcs=True, record_size_limit=size).records
            while True:
                self.position = at = file.tell()
                try:
                    record = next(stream, None)
                except DAMAGE as error:
                    self.damage = f"ends or is damaged after byte {at} of {size} ({type(error).__name__})"
                    return
                if record is None:
                    self.position = size
                    if not index_is_sound(self.path):
                        self.damage = "its index is damaged, what stands before it is sound"
                    return
                if isinstance(record, Channel):
                    channels.add(record.id)
                elif isinstance(record, McapMessage) and record.channel_id not in channels:
                    self.damage = f"message of an unknown channel before byte {at} of {size}"
                    return
                yield record

    def preamble(self) -> Iterator[McapRecord]:
        """The records before the first message: the recorder writes attachments and metadata there."""
        return itertools.takewhile(lambda record: not isinstance(record, McapMessage), self.records())

    def config(self) -> dict[str, Any]:
        """The attached configuration as plain values; empty where there is none, or its bytes are no JSON object."""
        found = (r.data for r in self.preamble() if isinstance(r, Attachment) and r.name == "config.json")
        try:
            values = json.loads(next(found, b"{}"))
        except ValueError:
            return {}
        return values if isinstance(values, dict) else {}

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self.path.stat().st_size

    def attachments(self) -> dict[str, bytes]:
        """Attached files by name."""
        return {record.name: record.data for record in self.records() if isinstance(record, Attachment)}

    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name."""
        return {record.name: dict(record.metadata) for record in self.records() if isinstance(record, Metadata)}


def open_log(path: str | Path) -> LogReader:
    """Open a log for reading; see ``LogReader``."""
    return LogReader(Path(path))
