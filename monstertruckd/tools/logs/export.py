"""Export of logs: CSV for spreadsheets, NPZ for numpy, and MCAP with all stamps in UNIX time.

In a recorded log only the log times are UNIX times; the messages are copies from the bus, stamped in daemon time. A
viewer that looks up transforms by message stamps needs log times and stamps of the same clock.
"""

import csv
import json
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar, get_args, get_type_hints

import numpy as np
from mcap.records import Attachment, Header, Metadata
from mcap.writer import Writer
from pydantic import BaseModel

from monstertruck_runtime import wire
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.small_files import whole_file
from monstertruck_schemas.base import Nanoseconds, Schema
from monstertruck_schemas.state import ClockOffset
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.log_file import TIMES, Channels
from monstertruckd.recorder.reader import LogReader, open_log
from monstertruckd.tools.logs.columns import Column, Spool
from monstertruckd.tools.logs.messages import ALL, Progress, Selection, real_offset


@contextmanager
def removed_on_failure() -> Iterator[list[Path]]:
    """Yield a list of files and folders that are removed if the body fails."""
    made: list[Path] = []
    try:
        yield made
    except BaseException:
        for path in made:
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        raise


LOG_TIME, REAL_TIME = "log_time", "real_time"
"""Columns of every table: daemon time and UNIX time (ns)."""


def export_csv(
    path: str | Path | LogReader, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> dict[str, Path]:
    """Write ``<group>_<name>.csv`` for every topic that has messages.

    Nested records get dotted columns; arrays and lists are JSON in one cell; absent values are empty. Pictures are
    saved as files in a folder next to the table, which names them. ``log_time`` is daemon time (ns); ``real_time`` UTC.

    Returns:
        The files by topic.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, a message in it is invalid, or the folder cannot be written.
    """
    directory = made_folder(output)
    files: dict[str, Path] = {}
    with whole_tables(directory, ".csv", files) as place, ExitStack() as stack:
        writers: dict[str, Any] = {}
        for topic, row in _rows(path, directory, selection, progress):
            if topic not in writers:
                writers[topic] = csv.writer(stack.enter_context(place(topic).open("w", newline="")))
                writers[topic].writerow(row)
            row[REAL_TIME] = f"{np.datetime64(row[REAL_TIME], 'ns')}Z"
            writers[topic].writerow(_cell(value) for value in row.values())
    return files


def export_npz(
    path: str | Path | LogReader, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> dict[str, Path]:
    """Write ``<group>_<name>.npz`` for every topic that has messages: one array per column.

    Absent numbers are NaN. Arrays of equal length are stacked to shape (messages, length); others are
    concatenated, with their lengths in ``<column>.lengths``. Text, lists and mappings are strings (lists as JSON).
    Pictures are saved as files in a folder next to the table, which names them. ``log_time`` is daemon time,
    ``real_time`` UNIX time, both in ns.

    Returns:
        The files by topic.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, a message in it is invalid, or the folder cannot be written.
    """
    directory = made_folder(output)
    tables: dict[str, dict[str, Column]] = {}
    files: dict[str, Path] = {}
    with tempfile.TemporaryFile(dir=directory) as file, whole_tables(directory, ".npz", files) as place:
        spool = Spool(file)
        for topic, row in _rows(path, directory, selection, progress):
            if topic not in tables:
                tables[topic] = {name: spool.column(_text) for name in row}
            for name, value in row.items():
                tables[topic][name].add(value)
        for topic, table in tables.items():
            _write_npz(place(topic), table)
    return files


def _write_npz(file: Path, table: Mapping[str, Column]) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, column in table.items():
            column.write(archive, name)


@contextmanager
def whole_tables(directory: Path, suffix: str, files: dict[str, Path]) -> Iterator[Callable[[str], Path]]:
    """Yield a function from topic to output file; all files get their final names, in ``files``, at the end."""
    with ExitStack() as whole:

        def place(topic: str) -> Path:
            files[topic] = directory / f"{_stem(topic)}{suffix}"
            return whole.enter_context(whole_file(files[topic]))

        yield place


def made_folder(directory: str | Path) -> Path:
    """Return the folder; it is created if missing.

    Raises:
        InputError: it cannot be created.
    """
    directory = Path(directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot be created: {error.strerror}") from None
    return directory


def _stem(topic: str) -> str:
    return topic.replace("/", "_")


def _rows(
    path: str | Path | LogReader, directory: Path, selection: Selection, progress: Progress | None
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield (topic, column to value) of every selected message; pictures are saved to files."""
    reader = open_log(path)
    offset = real_offset(reader)
    for entry, message in selection.of(reader, progress):
        row = flat(message, type(message), "")
        for name, value in row.items():
            if isinstance(value, bytes):
                row[name] = _save(value, directory, f"{_stem(entry.topic)}/{entry.log_time}.{row.get('format', 'bin')}")
        yield entry.topic, {LOG_TIME: entry.log_time, REAL_TIME: entry.log_time + offset, **row}


def _save(data: bytes, directory: Path, name: str) -> str:
    file = directory / name
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(data)
    return name


def flat(record: BaseModel | None, model: type[BaseModel], prefix: str) -> dict[str, Any]:
    """Return the columns of a record; they are the same for all messages of a model."""
    row: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        value = None if record is None else getattr(record, name)
        nested = record_type(field.annotation)
        row |= {prefix + name: value} if nested is None else flat(value, nested, f"{prefix}{name}.")
    return row


def record_type(annotation: Any) -> type[BaseModel] | None:
    """Return the model of a field that is a record or an optional record; None for other fields."""
    for option in (annotation, *get_args(annotation)):
        if isinstance(option, type) and issubclass(option, BaseModel) and _is_plain(annotation):
            return option
    return None


def _is_plain(annotation: Any) -> bool:
    """Return whether a type is a record or an optional record, not a list of records."""
    return all(option is type(None) or isinstance(option, type) for option in (get_args(annotation) or (annotation,)))


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.value if isinstance(value, Enum) else value


def _text(value: Any) -> str:
    return "" if value is None else str(_cell(value))


def _cell(value: Any) -> Any:
    value = [_plain(item) for item in value] if isinstance(value, tuple) else _plain(value)
    return json.dumps(value) if isinstance(value, list | dict) else value


S = TypeVar("S", bound=Schema)

_DIFFERENCES: Final = {"offset", "stepped"}
"""Fields in ns that are not instants."""


@cache
def _instants(model: type[Schema]) -> frozenset[str]:
    """Fields of a message or nested record that hold daemon time."""
    hints = get_type_hints(model, include_extras=True)
    fields = {name for name, hint in hints.items() if Nanoseconds in (hint, *get_args(hint))}
    return frozenset(fields - _DIFFERENCES)


def export_mcap(
    path: str | Path | LogReader, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> dict[str, Path]:
    """Write the selected messages to a new file with log times, stamps and headers in UNIX time.

    Returns:
        The file by topic; it is not created if no message is selected.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, a message in it is invalid, or the file exists or cannot be written.
    """
    reader = open_log(path)
    offset = real_offset(reader)
    topics: dict[str, Path] = {}
    file = Path(output)
    try:
        with removed_on_failure() as made, file.open("xb") as stream:
            made.append(file)
            writer = Writer(stream)
            _copy_preamble(writer, reader, offset)
            channels = Channels(writer)
            for entry, message in selection.of(reader, progress):
                topic = BY_NAME[entry.topic]
                topics[entry.topic] = file
                payload = wire.encode(topic, in_unix_time(message, offset))
                at, stamp = entry.log_time + offset, max(0, message.stamp + offset)
                writer.add_message(channels.of(topic), at, payload, stamp, entry.sequence)
            writer.finish()  # type: ignore[no-untyped-call]
        if not topics:
            file.unlink()
    except FileExistsError:
        raise InputError(f"{file}: already exists") from None
    except OSError as error:
        raise InputError(f"{file}: cannot be written: {error.strerror}") from error
    return topics


def in_unix_time(record: S, offset: int) -> S:
    """Return the record with all timestamps shifted by ``offset`` ns; a clock offset keeps only the difference."""
    changes: dict[str, Any] = {}
    for name in type(record).model_fields:
        value = getattr(record, name)
        if name in _instants(type(record)) and value is not None:
            changes[name] = value + offset
        elif isinstance(value, Schema):
            changes[name] = in_unix_time(value, offset)
        elif isinstance(value, tuple) and value and isinstance(value[0], Schema):
            changes[name] = tuple(in_unix_time(item, offset) for item in value)
    if isinstance(record, ClockOffset):
        changes["offset"] = record.offset - offset
    return record.model_copy(update=changes)


def _copy_preamble(writer: Writer, reader: LogReader, offset: int) -> None:
    """Copy header, attachments and metadata."""
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
            if record.name == TIMES:
                continue
            writer.add_metadata(record.name, dict(record.metadata) | {"real_offset_ns": "0", "moved_ns": str(offset)})
        else:
            at = record.log_time - reader.log_offset + offset
            writer.add_attachment(at, at, record.name, record.media_type, record.data)
