"""Selection of a log's messages for the tools, decoded and with their real time.

The tools use the daemon's monotonic time, because a robot without a real-time clock receives the date late, and its
clock then jumps by hours. The latest offset in a log gives the real time of all its messages.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError, TruckError
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import BY_NAME, CLOCK
from monstertruckd.recorder.frames import DAMAGE, index_is_sound
from monstertruckd.recorder.reader import LogMessage, LogReader

Progress = Callable[[float], None]
"""Called with the number of log bytes read so far."""


def require_topics(*names: str) -> None:
    """Check that all names are in the topic table.

    Raises:
        NotFoundError: a name is unknown; the text suggests similar ones.
    """
    for name in sorted(set(names) - BY_NAME.keys()):
        close = [topic for topic in BY_NAME if name in topic.split("/")] or get_close_matches(name, BY_NAME)
        meant = f" (did you mean {', '.join(close)}?)" if close else ""
        raise NotFoundError(f"no topic {name}{meant}; `monstertruckd topics` lists all")


@dataclass(frozen=True, slots=True)
class Selection:
    """Selection of a log's messages; by default all messages of known topics.

    Args:
        topics: topic names; empty: all.
        start: start time after the log's first message (s).
        end: end time after the log's first message (s), exclusive.

    Raises:
        NotFoundError: a topic is not in the table.
        InputError: the end is not after the start.
    """

    topics: tuple[str, ...] = ()
    start: float = 0.0
    end: float = math.inf

    def __post_init__(self) -> None:
        require_topics(*self.topics)
        if not self.start < self.end:
            raise InputError(f"from {self.start:g} s to {self.end:g} s: expected an end after the start")

    @property
    def nothing(self) -> str:
        """Message for a log without a selected message."""
        every = not self.topics and self.start == 0.0 and self.end == math.inf
        return "no message of a topic known to this version" if every else "no message of these topics and times"

    def of(self, reader: LogReader, progress: Progress | None = None) -> Iterator[tuple[LogMessage, Message]]:
        """Yield the selected messages with their decoded forms; other schemas are skipped.

        Raises:
            InputError: a selected message is invalid; the text names file, message and field.
        """
        first: int | None = None
        for number, entry in enumerate(reader, start=1):
            if progress is not None and number % 1000 == 0:  # messages between two calls of a progress function
                progress(reader.position)
            first = entry.log_time if first is None else first
            topic = BY_NAME.get(entry.topic)
            if topic is None or (self.topics and entry.topic not in self.topics):
                continue
            if not self.start <= (entry.log_time - first) / SECOND < self.end:
                continue
            try:
                yield entry, entry.decode()
            except NotFoundError:
                continue
            except TruckError as error:
                raise InputError(f"{reader.path}: message {number}: {error}") from None


ALL = Selection()


def real_offset(reader: LogReader) -> int:
    """Return real (UNIX) minus daemon time (ns) from the log's latest clock message; 0 without one.

    Raises:
        InputError: the offset in the log's metadata is not a number.
    """
    newest = _newest_clock(reader)
    if newest is not None:
        return wire.decode(CLOCK, newest).offset
    return first_offset(reader.path, reader.metadata().get("run", {}))


def first_offset(log: Path, metadata: Mapping[str, str]) -> int:
    """Return real minus daemon time (ns) at the start of a run, from its metadata; 0 without it.

    Raises:
        InputError: the metadata is not a number.
    """
    text = metadata.get("real_offset_ns", "0")
    try:
        return int(text)
    except ValueError:
        raise InputError(f"{log}: metadata run: real_offset_ns is {text!r}, expected a whole number") from None


def _newest_clock(reader: LogReader) -> bytes | None:
    """Return the payload of the last clock message, by the index or, if that is invalid, by reading the whole log."""
    with reader.path.open("rb") as file, suppress(*DAMAGE):
        sound = index_is_sound(file)
        file.seek(0)
        log = make_reader(file, validate_crcs=True)
        if sound and (summary := log.get_summary()) is not None and summary.chunk_indexes:
            last = next(log.iter_messages(topics=CLOCK.name, reverse=True), None)
            return None if last is None else last[2].data
    newest: bytes | None = None
    for message in reader:
        newest = message.payload if message.topic == CLOCK.name else newest
    return newest


def utc(real: int) -> str:
    """Format a real time (ns) as ``YYYY-MM-DD hh:mm:ss`` UTC."""
    return str(np.datetime64(real // SECOND, "s")).replace("T", " ")
