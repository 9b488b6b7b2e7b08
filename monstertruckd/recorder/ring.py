"""Ring of recent messages in memory, bounded by time and size; the source of black boxes.

Messages are stored contiguously in blocks: times, topic number, payload. Each block is a separate memory map, which
returns to the kernel immediately. Python objects would fragment the heap, and the daemon would grow for hours.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from heapq import merge
from mmap import mmap
from operator import attrgetter
from struct import Struct
from typing import Any, Final

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.topics import Topic
from monstertruckd.recorder.log_file import LogEntry

SHARE: Final = 32
"""A block takes at most the memory limit divided by this."""

_HEAD: Final = Struct("<qqqII")
"""Log time, stamp, sequence, topic number, payload length."""


PICTURES: Final = "foxglove.CompressedImage"
JOURNAL: Final = "event"
"""Group of topics that are kept longer than others, because their messages are small."""


@dataclass(frozen=True, slots=True)
class Retention:
    """Retention of each kind of message (s)."""

    everything: float
    journal: float
    """Retention of events and log records."""
    pictures: float
    """Retention of all pictures; older ones are sampled."""
    picture_period: float
    """Interval between the older pictures that are kept."""


class _Block:
    """Contiguous entries."""

    __slots__ = ("data", "used")

    def __init__(self, size: int) -> None:
        self.data = mmap(-1, size)
        self.used = 0

    def time(self, at: int) -> int:
        """Return the log time of the entry at offset ``at``."""
        return int(_HEAD.unpack_from(self.data, at)[0])

    def entry(self, at: int, topics: list[Topic[Any]]) -> LogEntry:
        """Return the entry at offset ``at``."""
        log_time, stamp, sequence, topic, length = _HEAD.unpack_from(self.data, at)
        begin = at + _HEAD.size
        return LogEntry(topics[topic], log_time, stamp, sequence, self.data[begin : begin + length])


def _length(entry: LogEntry) -> int:
    return _HEAD.size + len(entry.payload)


@dataclass(frozen=True, slots=True)
class _View:
    """Entries of one kind at one instant; later changes of the ring do not affect it."""

    topics: list[Topic[Any]]
    blocks: tuple[_Block, ...]
    at: int
    """Offset of the first entry in the first block."""
    count: int

    def __iter__(self) -> Iterator[LogEntry]:
        left, at = self.count, self.at
        for block in self.blocks:
            while left and at < block.used:
                entry = block.entry(at, self.topics)
                yield entry
                at += _length(entry)
                left -= 1
            at = 0


class RingSnapshot:
    """Contents of a ring at one instant, by log time; sorted only on iteration, in any thread.

    Args:
        heads: last messages of retained topics before the window; they get the log time of its start.
        views: views of the parts; the first non-empty view starts the window.
    """

    def __init__(self, heads: tuple[LogEntry, ...], views: tuple[_View, ...]) -> None:
        self._heads = heads
        self._views = views

    def __len__(self) -> int:
        return len(self._heads) + sum(view.count for view in self._views)

    def __iter__(self) -> Iterator[LogEntry]:
        begin = next((entry.log_time for view in self._views for entry in view), 0)
        heads = [head._replace(log_time=begin) for head in self._heads]
        return merge(heads, *self._views, key=attrgetter("log_time"))


class _Part:
    """Entries of one kind, oldest first.

    Args:
        seconds: retention time.
        block: block size (bytes); a larger entry gets a separate block.
    """

    def __init__(self, seconds: float, block: int) -> None:
        self.size = 0
        """Total size of the blocks (bytes)."""
        self.oldest = self.newest = 0
        """Log times of the first and the last entry; undefined without entries."""
        self._span = round(seconds * SECOND)
        self._block = block
        self._topics: list[Topic[Any]] = []
        self._numbers: dict[str, int] = {}
        self._blocks: deque[_Block] = deque()
        self._at = 0
        """Offset of the first entry in the first block."""
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, entry: LogEntry) -> bool:
        """Append an entry; return whether it needed a new block."""
        topic, log_time, stamp, sequence, payload = entry
        length = len(payload)
        grown = not self._blocks or self._blocks[-1].used + _HEAD.size + length > len(self._blocks[-1].data)
        if grown:
            self._blocks.append(_Block(max(self._block, _HEAD.size + length)))
            self.size += len(self._blocks[-1].data)
        block = self._blocks[-1]
        begin = block.used + _HEAD.size
        number = self._numbers.get(topic.name)
        if number is None:
            number = self._number(topic)
        _HEAD.pack_into(block.data, block.used, log_time, stamp, sequence, number, length)
        block.used = begin + length
        block.data[begin : block.used] = payload
        self.newest = log_time
        if not self._count:
            self.oldest = log_time
        self._count += 1
        return grown

    def popleft(self) -> LogEntry:
        """Remove and return the oldest entry."""
        entry = self._blocks[0].entry(self._at, self._topics)
        self._at += _length(entry)
        self._count -= 1
        if self._at == self._blocks[0].used:
            self.size -= len(self._blocks.popleft().data)
            self._at = 0
        if self._count:
            self.oldest = self._blocks[0].time(self._at)
        return entry

    def expired(self, now: int) -> bool:
        """Return whether the oldest entry is too old."""
        return self._count > 0 and now - self.oldest > self._span

    def view(self) -> _View:
        """Return a view of the current entries, without copying them."""
        return _View(self._topics, tuple(self._blocks), self._at, self._count)

    def _number(self, topic: Topic[Any]) -> int:
        number = self._numbers[topic.name] = len(self._topics)
        self._topics.append(topic)
        return number


class Ring:
    """Bounded memory of recent messages.

    Beyond the size limit, a journal that takes more than a quarter of it loses its oldest messages first, then the
    oldest pictures are dropped, then the oldest other messages; all are counted. The last message before the window is
    kept for every retained topic, so that the remaining messages are complete on their own.

    Args:
        span: retention of each kind of message.
        limit: total size of the blocks (bytes); the latest message of each kind stays even beyond it.
    """

    def __init__(self, span: Retention, limit: int) -> None:
        self._limit = limit
        block = min(256 * 1024, limit // SHARE)  # block size in bytes; a block is freed as a whole
        self._rest = _Part(span.everything, block)
        self._journal = _Part(span.journal, block)
        self._fresh = _Part(span.pictures, block)
        self._sampled = _Part(span.everything, block)
        self._part_of: dict[str, _Part] = {}
        self._period = round(span.picture_period * SECOND)
        self._heads: dict[str, LogEntry] = {}
        self._newest = 0
        """Log time of the latest message."""
        self._next_expiry = 0
        self.lost = 0
        """Number of messages removed early for lack of memory."""

    @property
    def size(self) -> int:
        """Size of the blocks (bytes), excluding the stored messages of retained topics."""
        return self._rest.size + self._journal.size + self._sampled.size + self._fresh.size

    def add(self, entry: LogEntry) -> None:
        """Add a message, and remove messages beyond the time and size limits."""
        part = self._part_of.get(entry.topic.name)
        if part is None:
            part = self._part(entry.topic)
        grown = part.append(entry)
        self._newest = entry.log_time
        if grown or entry.log_time >= self._next_expiry:
            self._trim()

    def snapshot(self) -> RingSnapshot:
        """Return a snapshot of the ring; only the list of blocks is copied, however many messages there are."""
        self._trim()
        parts = (self._rest, self._journal, self._sampled, self._fresh)
        return RingSnapshot(tuple(self._heads.values()), tuple(part.view() for part in parts))

    def _part(self, topic: Topic[Any]) -> _Part:
        part = self._journal if topic.group == JOURNAL else self._rest
        self._part_of[topic.name] = part = self._fresh if topic.foxglove == PICTURES else part
        return part

    def _trim(self) -> None:
        """Remove expired entries, then remove entries beyond the size limit and count them as lost."""
        # SECOND // 10: interval (ns) between removals of expired entries; removing many at a time is cheaper
        self._next_expiry = self._newest + (SECOND // 10)
        self._expire(self._newest)
        while self.size > self._limit and (crowded := self._fullest()) is not None:
            self._drop(crowded.popleft())
            self.lost += 1

    def _expire(self, now: int) -> None:
        for part in (self._rest, self._journal, self._sampled):
            while part.expired(now):
                self._drop(part.popleft())
        kept = self._sampled
        while self._fresh.expired(now):
            picture = self._fresh.popleft()
            if kept and picture.log_time - kept.newest < self._period:
                self._drop(picture)
            else:
                kept.append(picture)

    def _fullest(self) -> _Part | None:
        """Return the part to remove from, if any; the latest message of each kind stays."""
        # 0.25: maximum share of the memory for the journal; a flood of events must not displace measurements
        flooded = self._journal.size > 0.25 * self._limit
        first = (self._journal,) if flooded else ()
        parts = (*first, self._sampled, self._fresh, self._rest, self._journal)
        return next((part for part in parts if len(part) > 1), None)

    def _drop(self, entry: LogEntry) -> None:
        if entry.topic.retained:
            self._heads[entry.topic.name] = entry
