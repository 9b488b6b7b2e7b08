"""The newest messages in memory, by time and by size: what a black box is written from."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from heapq import merge
from operator import attrgetter
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruckd.recorder.file import Entry

OVERHEAD: Final = 250
"""Bytes an entry takes beside its payload: itself, its numbers, the header of its bytes, its place in the ring."""

PICTURES: Final = "foxglove.CompressedImage"
JOURNAL: Final = "event"
"""Group of topics that are kept longer than the others: they tell how it came about, and are small."""


@dataclass(frozen=True, slots=True)
class Span:
    """How long what is kept, s."""

    everything: float
    journal: float
    """Events and log records."""
    pictures: float
    """All pictures; older ones thinned out."""
    picture_period: float
    """Between two pictures that are left of the older ones."""


class _Part:
    """Entries of one sort, oldest first."""

    def __init__(self, seconds: float) -> None:
        self.span = round(seconds * SECOND)
        self.entries: deque[Entry] = deque()

    def expired(self, now: int) -> Iterator[Entry]:
        """Take out what is too old."""
        while self.entries and now - self.entries[0].log_time > self.span:
            yield self.entries.popleft()


class Ring:
    """Bounded memory of the newest messages.

    When the bytes do not suffice, the oldest pictures go first, then the oldest of the rest; both are counted. Of every
    retained topic the newest message from before the window is kept, so that what is left stands alone.

    Args:
        span: how long what is kept.
        limit: bytes, ``OVERHEAD`` included.
    """

    def __init__(self, span: Span, limit: int) -> None:
        self._limit = limit
        self._rest = _Part(span.everything)
        self._journal = _Part(span.journal)
        self._fresh = _Part(span.pictures)
        self._thinned = _Part(span.everything)
        self._period = round(span.picture_period * SECOND)
        self._heads: dict[str, Entry] = {}
        self.size = 0
        """Bytes taken, ``OVERHEAD`` included."""
        self.lost = 0
        """Messages that had to go before their time."""

    def add(self, entry: Entry) -> None:
        """Take the newest message, and let go what is too old or too much."""
        self._part(entry).entries.append(entry)
        self.size += _bytes(entry)
        self._expire(entry.log_time)
        while self.size > self._limit and (crowded := self._fullest()) is not None:
            self._drop(crowded.entries.popleft())
            self.lost += 1

    def snapshot(self) -> list[Entry]:
        """Everything kept, by log time; what is from before the window stands at its begin."""
        parts = (self._rest, self._journal, self._thinned, self._fresh)
        begin = next((part.entries[0].log_time for part in parts if part.entries), 0)
        heads = [head._replace(log_time=begin) for head in self._heads.values()]
        return list(merge(heads, *(part.entries for part in parts), key=attrgetter("log_time")))

    def _part(self, entry: Entry) -> _Part:
        if entry.topic.foxglove == PICTURES:
            return self._fresh
        return self._journal if entry.topic.group == JOURNAL else self._rest

    def _expire(self, now: int) -> None:
        for part in (self._rest, self._journal, self._thinned):
            for entry in part.expired(now):
                self._drop(entry)
        for picture in self._fresh.expired(now):
            kept = self._thinned.entries
            if kept and picture.log_time - kept[-1].log_time < self._period:
                self._drop(picture)
            else:
                kept.append(picture)

    def _fullest(self) -> _Part | None:
        """Where to make room; never the newest message of its sort."""
        parts = (self._thinned, self._fresh, self._rest, self._journal)
        return next((part for part in parts if len(part.entries) > 1), None)

    def _drop(self, entry: Entry) -> None:
        self.size -= _bytes(entry)
        if entry.topic.retained:
            if (before := self._heads.get(entry.topic.name)) is not None:
                self.size -= _bytes(before)
            self._heads[entry.topic.name] = entry
            self.size += _bytes(entry)


def _bytes(entry: Entry) -> int:
    return len(entry.payload) + OVERHEAD
