"""The logs of a folder, without reading through them."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from mcap.reader import make_reader

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruckd.recorder.reader import DAMAGE, LogReader, index_is_sound, is_finished
from monstertruckd.recorder.repair import in_use
from monstertruckd.tools.logs.wall_time import is_plausible, real_offset, utc


class LogState(StrEnum):
    """How far a log is."""

    FINISHED = "finished"
    WRITING = "being written"
    UNFINISHED = "unfinished"
    """Nobody writes it any more: for ``recover``."""
    DAMAGED = "damaged"
    """Its index: for ``recover``, too."""
    UNREADABLE = "unreadable"
    """Not a log, or not ours to read."""


@dataclass(frozen=True, slots=True)
class Listed:
    """One log of a folder."""

    path: Path
    size: int
    """Bytes."""
    state: LogState
    started: str | None = None
    """UTC; None if nobody knew the date, or the log is not finished."""
    duration: float | None = None
    """Seconds; None if the log is not finished."""
    messages: int | None = None


def list_logs(folder: Path) -> list[Listed]:
    """All logs in ``folder`` and below, by name.

    Raises:
        NotFoundError: no such folder.
    """
    if not folder.is_dir():
        raise NotFoundError(f"{folder}: no such folder")
    return [_look(path) for path in sorted(folder.rglob("*.mcap")) if path.is_file()]


def _look(path: Path) -> Listed:
    size = path.stat().st_size
    try:
        reader = LogReader(path)
    except InputError:
        return Listed(path, size, LogState.UNREADABLE)
    if not is_finished(path):
        return Listed(path, size, LogState.WRITING if in_use(path) else LogState.UNFINISHED)
    try:
        with path.open("rb") as file:
            if not index_is_sound(file):
                return Listed(path, size, LogState.DAMAGED)
            file.seek(0)
            summary = make_reader(file).get_summary()
        statistics = None if summary is None else summary.statistics
        if statistics is None:
            return Listed(path, size, LogState.FINISHED)
        real = statistics.message_start_time + _offset(reader)
    except DAMAGE:
        return Listed(path, size, LogState.DAMAGED)
    return Listed(
        path,
        size,
        LogState.FINISHED,
        started=utc(real) if is_plausible(real) else None,
        duration=(statistics.message_end_time - statistics.message_start_time) / SECOND,
        messages=statistics.message_count,
    )


def _offset(reader: LogReader) -> int:
    try:
        return real_offset(reader)
    except InputError:
        return 0
