"""Summaries: of one log by reading it, of a folder's logs by their indexes."""

from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from operator import itemgetter
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema

from monstertruck_runtime.clock import SECOND, is_date
from monstertruck_runtime.errors import ConfigError, InputError, NotFoundError
from monstertruckd.recorder.frames import DAMAGE, index_is_sound, is_finished
from monstertruckd.recorder.reader import LogReader
from monstertruckd.recorder.repair import in_use
from monstertruckd.tools.logs.messages import first_offset, real_offset, utc


def info(path: str | Path) -> dict[str, Any]:
    """Return the contents of a log as JSON-compatible values.

    Returns:
        ``path``, ``size`` (bytes), ``damage`` (text or None), ``lost`` (messages known to be), ``spans`` (their times,
        s after the first message; None: to the end), ``messages``, ``start``/``end`` (ns of daemon time or None),
        ``duration`` (s), ``topics`` (name to ``messages``, ``rate`` in Hz or None, ``bytes``, ``schema``, ``start``,
        ``end``), ``attachments`` (name to bytes), ``metadata`` (name to text values).

    Raises:
        NotFoundError: no such file.
        InputError: not a log.
    """
    reader = LogReader(Path(path))
    schemas: dict[int, str] = {}
    channels: dict[int, dict[str, Any]] = {}
    topics: dict[str, dict[str, Any]] = {}
    attachments: dict[str, int] = {}
    metadata: dict[str, dict[str, str]] = {}
    for record in reader.records():
        if isinstance(record, Message):
            row, at = channels[record.channel_id], record.log_time - reader.log_offset
            row["messages"] += 1
            row["bytes"] += len(record.data)
            row["start"] = at if row["start"] is None else min(row["start"], at)
            row["end"] = at if row["end"] is None else max(row["end"], at)
        elif isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            channels[record.id] = topics.setdefault(
                record.topic,
                {"messages": 0, "rate": None, "bytes": 0, "schema": schemas.get(record.schema_id, "")}
                | {"start": None, "end": None},
            )
        elif isinstance(record, Attachment):
            attachments[record.name] = len(record.data)
        elif isinstance(record, Metadata):
            metadata[record.name] = dict(record.metadata)
    for row in topics.values():
        if row["messages"] > 1 and row["end"] > row["start"]:
            row["rate"] = (row["messages"] - 1) * SECOND / (row["end"] - row["start"])
    verdict = reader.verdict
    used = [row for row in topics.values() if row["messages"]]
    start = min((row["start"] for row in used), default=None)
    end = max((row["end"] for row in used), default=None)
    return {
        "path": str(path),
        "size": Path(path).stat().st_size,
        "damage": reader.fault,
        "lost": 0 if verdict is None else verdict.lost,
        "spans": [] if verdict is None else [list(span) for span in verdict.spans],
        "messages": sum(row["messages"] for row in used),
        "start": start,
        "end": end,
        "duration": 0.0 if start is None or end is None else (end - start) / SECOND,
        "topics": dict(sorted(topics.items())),
        "attachments": attachments,
        "metadata": metadata,
    }


class LogState(StrEnum):
    """State of a log."""

    FINISHED = "finished"
    WRITING = "being written"
    UNFINISHED = "unfinished"
    """Not finished, and not being written: repair it with ``recover``."""
    DAMAGED = "damaged"
    """The index is damaged: repair it with ``recover``."""
    UNREADABLE = "unreadable"
    """Not a log, or not readable."""


@dataclass(frozen=True, slots=True)
class LogSummary:
    """One log of a folder."""

    path: Path
    size: int
    """Size (bytes)."""
    state: LogState
    robot: str | None = None
    """Name of the robot; None if the log does not contain it."""
    started: str | None = None
    """Start time (UTC); None if the date is unknown."""
    duration: float | None = None
    """Duration (s); None if the log is not finished."""
    messages: int | None = None


def list_logs(folder: Path) -> list[LogSummary]:
    """List all logs in ``folder`` and below, the latest last; files removed meanwhile are skipped.

    They are sorted by start time, or by the file's last change if it is unknown.

    Raises:
        NotFoundError: no such folder.
    """
    if not folder.is_dir():
        raise NotFoundError(f"{folder}: no such folder")
    found: list[tuple[str, LogSummary]] = []
    for path in sorted(folder.rglob("*.mcap")):
        if path.is_file():
            with suppress(FileNotFoundError, NotFoundError):
                changed = utc(path.stat().st_mtime_ns)
                log = _summary_of(path)
                found.append((log.started or changed, log))
    return [log for _, log in sorted(found, key=itemgetter(0))]


def _summary_of(path: Path) -> LogSummary:
    known = LogSummary(path, path.stat().st_size, LogState.UNREADABLE)
    try:
        reader = LogReader(path)
    except InputError:
        return known
    known = replace(known, robot=_robot(reader))
    if not is_finished(path):
        state = LogState.WRITING if in_use(path) else LogState.UNFINISHED
        return replace(known, state=state, started=_first_date(reader))
    try:
        with path.open("rb") as file:
            if not index_is_sound(file):
                return replace(known, state=LogState.DAMAGED, started=_first_date(reader))
            file.seek(0)
            summary = make_reader(file).get_summary()
        statistics = None if summary is None else summary.statistics
        if statistics is None:
            return replace(known, state=LogState.FINISHED)
        real = statistics.message_start_time + _offset(reader)
    except DAMAGE:
        return replace(known, state=LogState.DAMAGED, started=_first_date(reader))
    return replace(
        known,
        state=LogState.FINISHED,
        started=utc(real) if is_date(real) else None,
        duration=(statistics.message_end_time - statistics.message_start_time) / SECOND,
        messages=statistics.message_count,
    )


def _robot(reader: LogReader) -> str | None:
    """Return the robot's name from the attached configuration."""
    with suppress(ConfigError, InputError):
        name = reader.config().get("robot")
        return name if isinstance(name, str) else None
    return None


def _first_date(reader: LogReader) -> str | None:
    """Return the date (UTC) of the first message of a log without an index, from its run's offset at the start."""
    first = next(iter(reader), None)
    if first is None:
        return None
    with suppress(InputError):
        real = first.log_time + first_offset(reader.path, reader.metadata().get("run", {}))
        return utc(real) if is_date(real) else None
    return None


def _offset(reader: LogReader) -> int:
    """Return real time minus the file's log time (ns)."""
    reader.metadata()  # reads the metadata that defines the clock of the log times
    try:
        return real_offset(reader) - reader.log_offset
    except InputError:
        return 0
