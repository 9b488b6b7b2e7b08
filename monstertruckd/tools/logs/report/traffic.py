"""Bookkeeping of messages: counts, rates, what was lost on the way to the log, and silences."""

from dataclasses import dataclass, field
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.reader import LogMessage
from monstertruckd.tools.logs.trace import Trace

_SILENT_PERIODS: Final = 5
"""Nominal periods without a message that count as a silence, if the topic names no staleness limit."""
_SEQUENCES: Final = 1 << 32


@dataclass(slots=True)
class Traffic:
    """One topic of the log."""

    name: str
    messages: int = 0
    bytes: int = 0
    first: int = 0
    last: int = 0
    lost: int = 0
    """Messages the recorder counted but the log has not."""
    undecodable: int = 0
    silences: int = 0
    longest_silence: float = 0.0
    """Seconds between two messages, greatest; 0 for topics without a nominal rate."""
    rate: Trace = field(default_factory=Trace)
    """Messages of each whole second, in per cent of the nominal rate."""
    _sequence: int | None = None
    _second: int = 0
    _in_second: int = 0

    @property
    def nominal(self) -> float | None:
        """Rate of the topic table, Hz."""
        topic = BY_NAME.get(self.name)
        return None if topic is None else topic.rate

    @property
    def mean_rate(self) -> float | None:
        """Measured rate between first and last message, Hz."""
        return (self.messages - 1) * SECOND / (self.last - self.first) if self.last > self.first else None

    def take(self, message: LogMessage) -> None:
        """Count a message."""
        now = message.log_time
        if self.messages == 0:
            self.first = self.last = now
            self._second = now // SECOND
        self._count_lost(message.sequence)
        if self.nominal is not None:
            self._watch(now, self.nominal)
        self.messages += 1
        self.bytes += len(message.payload)
        self.last = max(self.last, now)

    def _count_lost(self, sequence: int) -> None:
        if self._sequence is not None:
            skipped = (sequence - self._sequence - 1) % _SEQUENCES
            self.lost += skipped if skipped < _SEQUENCES // 2 else 0  # else the count began anew
        self._sequence = sequence

    def _watch(self, now: int, nominal: float) -> None:
        silence = (now - self.last) / SECOND
        self.longest_silence = max(self.longest_silence, silence)
        limit = BY_NAME[self.name].stale_after or _SILENT_PERIODS / nominal
        self.silences += silence > limit
        self.count_to(now)
        self._in_second += 1

    def count_to(self, now: int) -> None:
        """Close every second that is over at ``now``."""
        while self.nominal is not None and self._second < now // SECOND:
            if self._second > self.first // SECOND:  # the first one is not whole
                self.rate.add(self._second * SECOND + SECOND // 2, 100.0 * self._in_second / self.nominal)
            self._second += 1
            self._in_second = 0
