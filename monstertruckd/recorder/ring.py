"""The newest messages in memory, by time and by size: what a black box is written from."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from heapq import merge
from itertools import chain, islice
from operator import attrgetter
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruckd.recorder.file import Entry

OVERHEAD: Final = 250
"""Bytes an entry takes beside its payload: itself, its numbers, the header of its bytes, its place in the ring."""

SEGMENT: Final = 64 * 1024
"""Bytes of entries that are freed together."""

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


@dataclass(frozen=True, slots=True)
class _View:
    """Entries of one sort at one instant; what the ring does afterwards does not change it."""

    segments: tuple[list[Entry], ...]
    skipped: int
    count: int

    def __iter__(self) -> Iterator[Entry]:
        return islice(chain.from_iterable(self.segments), self.skipped, self.skipped + self.count)


class Snapshot:
    """Everything a ring kept at one instant, by log time; put in order only when iterated over, in any thread.

    Args:
        heads: newest messages of retained topics from before the window; they stand at its begin.
        views: of the parts; the first one that is not empty begins the window.
    """

    def __init__(self, heads: tuple[Entry, ...], views: tuple[_View, ...]) -> None:
        self._heads = heads
        self._views = views

    def __len__(self) -> int:
        return len(self._heads) + sum(view.count for view in self._views)

    def __iter__(self) -> Iterator[Entry]:
        begin = next((entry.log_time for view in self._views for entry in view), 0)
        heads = [head._replace(log_time=begin) for head in self._heads]
        return merge(heads, *self._views, key=attrgetter("log_time"))


class _Part:
    """Entries of one sort, oldest first, in lists to which only the newest entries are added."""

    def __init__(self, seconds: float) -> None:
        self.span = round(seconds * SECOND)
        self._segments: deque[list[Entry]] = deque()
        self._skipped = 0
        """Entries of the first segment that are no longer kept."""
        self._room = 0
        """Bytes the last segment takes yet."""
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def first(self) -> Entry:
        """The oldest entry."""
        return self._segments[0][self._skipped]

    @property
    def last(self) -> Entry:
        """The newest entry."""
        return self._segments[-1][-1]

    def append(self, entry: Entry) -> None:
        """Add the newest entry."""
        if self._room <= 0 or not self._segments:
            self._segments.append([])
            self._room = SEGMENT
        self._segments[-1].append(entry)
        self._room -= _bytes(entry)
        self._count += 1

    def popleft(self) -> Entry:
        """Take out the oldest entry."""
        entry = self.first
        self._skipped += 1
        self._count -= 1
        if self._skipped == len(self._segments[0]):
            self._segments.popleft()
            self._skipped = 0
        return entry

    def expired(self, now: int) -> Iterator[Entry]:
        """Take out what is too old."""
        while self._count and now - self.first.log_time > self.span:
            yield self.popleft()

    def view(self) -> _View:
        """What is here now; copies no entries."""
        return _View(tuple(self._segments), self._skipped, self._count)


class Ring:
    """Bounded memory of the newest messages.

    When the bytes do not suffice, the oldest pictures go first, then the oldest of the rest; both are counted. Of every
    retained topic the newest message from before the window is kept, so that what is left stands alone.

    Args:
        span: how long what is kept.
        limit: bytes, ``OVERHEAD`` included; ``SEGMENT`` of each sort may be taken beside them.
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
        self._part(entry).append(entry)
        self.size += _bytes(entry)
        self._expire(entry.log_time)
        while self.size > self._limit and (crowded := self._fullest()) is not None:
            self._drop(crowded.popleft())
            self.lost += 1

    def snapshot(self) -> Snapshot:
        """Everything kept; takes no longer however much it is than a list of its segments."""
        parts = (self._rest, self._journal, self._thinned, self._fresh)
        return Snapshot(tuple(self._heads.values()), tuple(part.view() for part in parts))

    def _part(self, entry: Entry) -> _Part:
        if entry.topic.foxglove == PICTURES:
            return self._fresh
        return self._journal if entry.topic.group == JOURNAL else self._rest

    def _expire(self, now: int) -> None:
        for part in (self._rest, self._journal, self._thinned):
            for entry in part.expired(now):
                self._drop(entry)
        for picture in self._fresh.expired(now):
            kept = self._thinned
            if kept and picture.log_time - kept.last.log_time < self._period:
                self._drop(picture)
            else:
                kept.append(picture)

    def _fullest(self) -> _Part | None:
        """Where to make room; never the newest message of its sort."""
        parts = (self._thinned, self._fresh, self._rest, self._journal)
        return next((part for part in parts if len(part) > 1), None)

    def _drop(self, entry: Entry) -> None:
        self.size -= _bytes(entry)
        if entry.topic.retained:
            if (before := self._heads.get(entry.topic.name)) is not None:
                self.size -= _bytes(before)
            self._heads[entry.topic.name] = entry
            self.size += _bytes(entry)


def _bytes(entry: Entry) -> int:
    return len(entry.payload) + OVERHEAD
