"""Messages of a log as Arrow tables, with a column per field, in batches of bounded size; and as Parquet files.

Fields of nested records have dotted column names, as in the other tables. Lists of records are lists of structs; a
mapping to numbers is a map, any other mapping is JSON text. Absent values are null.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from enum import Enum
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from pydantic import BaseModel

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.reader import LogMessage, LogReader, open_log
from monstertruckd.tools.logs.export import LOG_TIME, REAL_TIME, flat, made_folder, record_type, whole_tables
from monstertruckd.tools.logs.messages import ALL, Progress, Selection, real_offset

BATCH_BYTES: Final = 4_000_000
"""Encoded messages of a batch (bytes): a few hundred scans, whose rows take a few ten MB."""
BATCH_ROWS: Final = 16_384
"""Maximum number of rows in a batch: small messages take a hundred times their encoded size as rows."""


@cache
def schema_of(topic: str) -> pa.Schema:
    """Return the columns of a topic's table."""
    times = [(LOG_TIME, pa.int64()), (REAL_TIME, pa.timestamp("ns", tz="UTC"))]
    return pa.schema([*times, *_columns(BY_NAME[topic].model, "")])


def _columns(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, pa.DataType]]:
    for name, field in model.model_fields.items():
        nested = record_type(field.annotation)
        if nested is None:
            yield prefix + name, _type(field.annotation)
        else:
            yield from _columns(nested, f"{prefix}{name}.")


_PLAIN: Final = ((bool, pa.bool_()), (int, pa.int64()), (float, pa.float64()), (str, pa.string()), (bytes, pa.binary()))


def _type(annotation: Any) -> pa.DataType:
    origin, parts = get_origin(annotation), [part for part in get_args(annotation) if part is not type(None)]
    if origin in (Union, UnionType, Annotated):
        return _type(parts[0])
    if origin is Literal:
        return _type(type(parts[0]))
    if origin is np.ndarray:
        return pa.list_(pa.from_numpy_dtype(get_args(parts[1])[0]))
    if origin is tuple:
        return pa.list_(_type(parts[0]))
    if origin is dict:
        return pa.map_(pa.string(), pa.float64()) if parts[1] is float else pa.string()
    if issubclass(annotation, BaseModel):
        return pa.struct([(name, _type(field.annotation)) for name, field in annotation.model_fields.items()])
    return next(arrow for python, arrow in _PLAIN if issubclass(annotation, python))


def _value(value: Any, kind: pa.DataType) -> Any:
    """Convert a value for a column of this type."""
    if isinstance(value, dict):
        return list(value.items()) if pa.types.is_map(kind) else json.dumps(value)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, BaseModel):
        return {field.name: _value(getattr(value, field.name), field.type) for field in kind}
    if isinstance(value, tuple):
        return [_value(item, kind.value_type) for item in value]
    return value


class _Batch:
    """Rows of one topic, collected to a batch; only the selected columns are kept."""

    def __init__(self, topic: str, columns: Sequence[str]) -> None:
        full = schema_of(topic)
        unknown = sorted(set(columns) - set(full.names))
        if unknown:
            raise NotFoundError(f"{topic} has no column {unknown[0]}: expected some of {', '.join(full.names)}")
        self.schema = pa.schema([field for field in full if not columns or field.name in columns])
        self._columns: dict[str, list[Any]] = {name: [] for name in self.schema.names}
        self._bytes = self._rows = 0

    def add(self, row: dict[str, Any], size: int) -> bool:
        """Add a row of ``size`` encoded bytes; returns whether the batch is full."""
        for field in self.schema:
            self._columns[field.name].append(_value(row[field.name], field.type))
        self._bytes, self._rows = self._bytes + size, self._rows + 1
        return self._bytes >= BATCH_BYTES or self._rows >= BATCH_ROWS

    def take(self) -> pa.RecordBatch:
        """Return the rows so far and clear them.

        Raises:
            InputError: a number has more than 64 bits.
        """
        try:
            arrays = [pa.array(self._columns[field.name], field.type) for field in self.schema]
        except (pa.ArrowException, OverflowError) as error:
            raise InputError(f"a number with more than 64 bits: {error}") from None
        self._columns = {name: [] for name in self.schema.names}
        self._bytes = self._rows = 0
        return pa.RecordBatch.from_arrays(arrays, schema=self.schema)


def batches(
    path: str | Path | LogReader,
    selection: Selection = ALL,
    columns: Sequence[str] = (),
    progress: Progress | None = None,
) -> Iterator[tuple[str, pa.RecordBatch]]:
    """Yield topic and batch of rows, in log order within each topic, in bounded memory.

    Args:
        path: the log.
        selection: selected messages.
        columns: selected columns; empty: all.
        progress: called with the bytes read.

    Raises:
        NotFoundError: no such log, or a selected topic lacks a column.
        InputError: not a log, or a message in it is invalid.
    """
    reader = open_log(path)
    offset = real_offset(reader)
    waiting = {topic: _Batch(topic, columns) for topic in selection.topics}
    for entry, message in selection.of(reader, progress):
        if entry.topic not in waiting:
            waiting[entry.topic] = _Batch(entry.topic, columns)
        if waiting[entry.topic].add(_row(entry, message, offset), len(entry.payload)):
            yield entry.topic, waiting[entry.topic].take()
    for topic, batch in waiting.items():
        if last := batch.take():
            yield topic, last


def windows(
    path: str | Path | LogReader, selection: Selection, columns: Mapping[str, Sequence[str]], seconds: float
) -> Iterator[dict[str, pa.Table]]:
    """Yield the rows of each topic, window by window of a log; windows without a row are omitted.

    Args:
        path: the log.
        selection: selected messages, with the topics.
        columns: selected columns by topic; empty: all.
        seconds: length of a window, by log time; infinite = one window.

    Raises:
        NotFoundError: no such log, or a topic lacks a column.
        InputError: not a log, or a message in it is invalid.
    """
    reader = open_log(path)
    offset = real_offset(reader)
    waiting = {topic: _Batch(topic, columns[topic]) for topic in selection.topics}
    full: dict[str, list[pa.RecordBatch]] = {topic: [] for topic in selection.topics}

    def rows() -> dict[str, pa.Table]:
        found = {
            topic: pa.Table.from_batches([*full[topic], batch.take()], batch.schema) for topic, batch in waiting.items()
        }
        full.update({topic: [] for topic in full})
        return found

    begin: int | None = None
    for entry, message in selection.of(reader):
        begin = entry.log_time if begin is None else begin
        if entry.log_time - begin >= seconds * SECOND:
            yield rows()
            begin = entry.log_time
        if waiting[entry.topic].add(_row(entry, message, offset), len(entry.payload)):
            full[entry.topic].append(waiting[entry.topic].take())
    yield rows()


def _row(entry: LogMessage, message: Message, offset: int) -> dict[str, Any]:
    """Return the columns of a message; ``offset`` is real minus daemon time (ns)."""
    times = {LOG_TIME: entry.log_time, REAL_TIME: entry.log_time + offset}
    return {**times, **flat(message, type(message), "")}


def export_parquet(
    path: str | Path | LogReader, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> dict[str, Path]:
    """Write ``<group>_<name>.parquet`` for every topic that has messages; see the module for the columns.

    Pictures are binary columns. ``log_time`` is daemon time (ns); ``real_time`` UTC.

    Returns:
        The files by topic.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, a message in it is invalid, or the folder cannot be written.
    """
    directory = made_folder(output)
    files: dict[str, Path] = {}
    with whole_tables(directory, ".parquet", files) as place, ExitStack() as stack:
        writers: dict[str, Any] = {}
        for topic, batch in batches(path, selection, progress=progress):
            if topic not in writers:
                writers[topic] = stack.enter_context(pyarrow.parquet.ParquetWriter(place(topic), batch.schema))
            writers[topic].write_batch(batch)
    return files
