"""The same log on the calendar: every instant in it is real time, for viewers that show dates.

The recorder cannot write it so: a robot without a real-time clock learns the date after its first messages, and a
viewer looks up transforms by the stamps inside them, so that log times and stamps must speak of one clock.
"""

from pathlib import Path
from typing import Any, Final, TypeVar

from mcap.records import Attachment, Header, Metadata
from mcap.writer import Writer

from monstertruck_runtime import wire
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Schema
from monstertruck_schemas.state import ClockOffset
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.log_file import Channels
from monstertruckd.recorder.reader import LogReader
from monstertruckd.tools.logs.selection import ALL, Progress, Selection
from monstertruckd.tools.logs.unfinished import removed_on_failure
from monstertruckd.tools.logs.wall_time import real_offset

S = TypeVar("S", bound=Schema)

_INSTANTS: Final = {"stamp", "received", "since", "gate_stamp"}
"""Fields that hold an instant of daemon time, in messages and the records inside them."""


def export_mcap(
    path: str | Path, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> dict[str, Path]:
    """Write the selected messages to a new file with log times, stamps and headers in UNIX time.

    Returns:
        The file by topic.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, a message in it is invalid, or the file exists or cannot be written.
    """
    reader = LogReader(Path(path))
    offset = real_offset(reader)
    topics: dict[str, Path] = {}
    file = Path(output)
    try:
        with removed_on_failure() as made, file.open("xb") as stream:
            made.append(file)
            writer = Writer(stream)
            _begin(writer, reader, offset)
            channels = Channels(writer)
            for entry, message in selection.of(reader, progress):
                topic = BY_NAME[entry.topic]
                topics[entry.topic] = file
                payload = wire.encode(topic, on_the_calendar(message, offset))
                at, stamp = entry.log_time + offset, max(0, message.stamp + offset)
                writer.add_message(channels.of(topic), at, payload, stamp, entry.sequence)
            writer.finish()  # type: ignore[no-untyped-call]
    except FileExistsError:
        msg = f"{file}: is there already"
        raise InputError(msg) from None
    except OSError as error:
        msg = f"{file}: cannot be written: {error.strerror}"
        raise InputError(msg) from error
    return topics


def on_the_calendar(record: S, offset: int) -> S:
    """The record with every instant in it moved by ``offset`` ns; that of the clock itself becomes the rest."""
    changes: dict[str, Any] = {}
    for name in type(record).model_fields:
        value = getattr(record, name)
        if name in _INSTANTS and value is not None:
            changes[name] = value + offset
        elif isinstance(value, Schema):
            changes[name] = on_the_calendar(value, offset)
        elif isinstance(value, tuple) and value and isinstance(value[0], Schema):
            changes[name] = tuple(on_the_calendar(item, offset) for item in value)
    if isinstance(record, ClockOffset):
        changes["offset"] = record.offset - offset
    return record.model_copy(update=changes)


def _begin(writer: Writer, reader: LogReader, offset: int) -> None:
    """Header, attachments and what is known of the run."""
    library = ""
    records: list[Attachment | Metadata] = []
    for record in reader.preamble():
        if isinstance(record, Header):
            library = record.library
        elif isinstance(record, Attachment | Metadata):
            records.append(record)
    writer.start(library=library)
    for record in records:
        if isinstance(record, Metadata):
            writer.add_metadata(record.name, dict(record.metadata) | {"real_offset_ns": "0", "moved_ns": str(offset)})
        else:
            at = record.log_time + offset
            writer.add_attachment(at, at, record.name, record.media_type, record.data)
