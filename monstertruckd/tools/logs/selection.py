"""Which messages of a log are meant: topics and a piece of time."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError, TruckError
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.reader import LogMessage, LogReader

_EVERY = 1000
"""Messages between two calls of a progress function."""

Progress = Callable[[float], None]
"""Takes the bytes of the log read so far."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Some messages of a log; by default all of the topics in the table.

    Args:
        topics: names; empty = all.
        start: seconds after the log's first message.
        end: as ``start``, not included.

    Raises:
        NotFoundError: a topic is not in the table.
        InputError: the end is not after the start.
    """

    topics: tuple[str, ...] = ()
    start: float = 0.0
    end: float = math.inf

    def __post_init__(self) -> None:
        if unknown := set(self.topics) - BY_NAME.keys():
            msg = f"no topic {', '.join(sorted(unknown))}; known: {', '.join(BY_NAME)}"
            raise NotFoundError(msg)
        if not self.start < self.end:
            msg = f"from {self.start:g} s to {self.end:g} s: expected an end after the start"
            raise InputError(msg)

    def of(self, reader: LogReader, progress: Progress | None = None) -> Iterator[tuple[LogMessage, Message]]:
        """The selected messages with their decoded forms; foreign ones are passed over.

        Raises:
            InputError: a selected message is invalid; names file, message and field.
        """
        first: int | None = None
        for number, entry in enumerate(reader, start=1):
            if progress is not None and number % _EVERY == 0:
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
                msg = f"{reader.path}: message {number}: {error}"
                raise InputError(msg) from None


ALL = Selection()
