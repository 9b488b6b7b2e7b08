"""Recorded and recomputed outputs side by side, as they come."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import Topic
from monstertruckd.tools.replay_check.difference import Difference, Kind, differences, same_header

UNREADABLE: Final = "not readable"


@dataclass(frozen=True, slots=True)
class Greatest:
    """The greatest difference of a kind."""

    kind: Kind
    value: float
    """SI units; +inf for text."""
    field: str
    sequence: int
    at: float
    """Seconds after the log's begin."""


@dataclass(frozen=True, slots=True)
class First:
    """The first output that is off by more than the tolerance."""

    topic: str
    sequence: int
    at: float
    """Seconds after the log's begin."""
    fields: tuple[str, ...]
    """That are off by more than the tolerance; none = the header alone."""


@dataclass(frozen=True, slots=True)
class _Output:
    time: int
    """Daemon time at which it was handed over, ns."""
    payload: bytes


@dataclass(slots=True)
class TopicComparison:
    """Of one topic. The n-th recorded output is held against the n-th of the replay.

    Args:
        topic: its row of the table.
        tolerance: greatest difference of a field that agrees, SI units; 0 = equal bit for bit.
        begin: start of the log, ns.
        judged: whether a difference matters.
    """

    topic: Topic[Message]
    tolerance: float
    begin: int
    judged: bool = True
    compared: int = 0
    equal: int = 0
    differing: int = 0
    """Differ by more than the tolerance."""
    headers: int = 0
    """Differ in their stamps or number."""
    greatest: dict[Kind, Greatest] = field(default_factory=dict)
    first: First | None = None
    _count: int = 0
    _recorded: dict[int, _Output] = field(default_factory=dict)
    _again: dict[int, _Output] = field(default_factory=dict)

    def recorded(self, sequence: int, time: int, payload: bytes) -> None:
        """Take an output of the log: its number in the run, when (ns), its bytes."""
        output = _Output(time, payload)
        if (again := self._again.pop(sequence, None)) is not None:
            self._compare(sequence, output, again)
        else:
            self._recorded[sequence] = output

    def recomputed(self, time: int, payload: bytes) -> None:
        """Take the next output of the replay."""
        sequence, output = self._count, _Output(time, payload)
        self._count += 1
        if (recorded := self._recorded.pop(sequence, None)) is not None:
            self._compare(sequence, recorded, output)
        else:
            self._again[sequence] = output

    @property
    def missing(self) -> int:
        """Recorded outputs that the replay did not give."""
        return len(self._recorded)

    def surplus(self, end: int) -> int:
        """Outputs of the replay that were not recorded, until ``end``, ns."""
        return sum(output.time <= end for output in self._again.values())

    def agrees(self, end: int) -> bool:
        """Whether every output came again, until ``end``, ns, within the tolerance."""
        return not self.judged or self.differing == self.missing == self.surplus(end) == 0

    def within(self, end: int, limit: float) -> bool:
        """Whether it agrees or, with every output and header as recorded, no field is off by more than ``limit``."""
        close = self.headers == 0 and all(one.value <= limit for one in self.greatest.values())
        return self.agrees(end) or (close and self.missing == self.surplus(end) == 0)

    def _compare(self, sequence: int, recorded: _Output, again: _Output) -> None:
        self.compared += 1
        if recorded.payload == again.payload:
            self.equal += 1
            return
        try:
            before, after = wire.decode(self.topic, recorded.payload), wire.decode(self.topic, again.payload)
        except InputError:
            found = [Difference(Kind.TEXT, UNREADABLE, math.inf)]
        else:
            # Another version of the codec may give equal values other bytes.
            if wire.encode(self.topic, before) == wire.encode(self.topic, after):
                self.equal += 1
                return
            self.headers += not same_header(before, after)
            found = differences(before, after)
        at = (recorded.time - self.begin) / SECOND
        self._keep(found, sequence, at)
        off = tuple(one.field for one in found if one.value > self.tolerance)
        if self.tolerance > 0 and not off:
            return
        self.differing += 1
        if self.first is None or at < self.first.at:
            self.first = First(self.topic.name, sequence, at, off)

    def _keep(self, found: Iterable[Difference], sequence: int, at: float) -> None:
        for one in found:
            known = self.greatest.get(one.kind)
            if known is None or one.value > known.value:
                self.greatest[one.kind] = Greatest(one.kind, one.value, one.field, sequence, at)
