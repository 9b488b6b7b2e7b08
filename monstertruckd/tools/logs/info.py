"""Summary of a log."""

from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Message, Metadata, Schema

from monstertruck_runtime.clock import SECOND
from monstertruckd.recorder.reader import LogReader


def info(path: str | Path) -> dict[str, Any]:
    """What a log holds, as plain JSON-able values.

    Returns:
        ``path``, ``size`` (bytes), ``damage`` (text or None), ``messages``, ``start``/``end`` (ns or None),
        ``duration`` (s), ``topics`` (name to ``messages``, ``rate`` in Hz or None, ``bytes``, ``schema``,
        ``start``, ``end``), ``attachments`` (name to bytes), ``metadata`` (name to text values).

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
            row = channels[record.channel_id]
            row["messages"] += 1
            row["bytes"] += len(record.data)
            row["start"] = record.log_time if row["start"] is None else min(row["start"], record.log_time)
            row["end"] = record.log_time if row["end"] is None else max(row["end"], record.log_time)
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
    heard = [row for row in topics.values() if row["messages"]]
    start = min((row["start"] for row in heard), default=None)
    end = max((row["end"] for row in heard), default=None)
    return {
        "path": str(path),
        "size": Path(path).stat().st_size,
        "damage": reader.fault,
        "messages": sum(row["messages"] for row in heard),
        "start": start,
        "end": end,
        "duration": 0.0 if start is None or end is None else (end - start) / SECOND,
        "topics": dict(sorted(topics.items())),
        "attachments": attachments,
        "metadata": metadata,
    }
