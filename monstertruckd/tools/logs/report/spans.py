"""States over time: bars of the report's timeline."""

from dataclasses import dataclass, field, replace
from enum import IntEnum

from monstertruck_runtime.clock import SECOND


class Tone(IntEnum):
    """How a state is coloured; greater is worse."""

    NONE = 0
    """Not drawn."""
    CALM = 1
    GOOD = 2
    BUSY = 3
    WARNING = 4
    BAD = 5


@dataclass(frozen=True, slots=True)
class Span:
    """A state that held from ``start`` to ``end``, ns."""

    start: int
    end: int
    text: str
    tone: Tone
    detail: str = ""

    @property
    def seconds(self) -> float:
        """How long it held."""
        return (self.end - self.start) / SECOND


@dataclass(slots=True)
class Track:
    """One row of the timeline."""

    name: str
    spans: list[Span] = field(default_factory=list)

    def set(self, time: int, text: str, tone: Tone, detail: str = "") -> None:
        """The state from ``time`` on."""
        if self.spans:
            last = self.spans[-1]
            if (last.text, last.tone, last.detail) == (text, tone, detail):
                return
            self.spans[-1] = replace(last, end=time)
        self.spans.append(Span(time, time, text, tone, detail))

    def close(self, end: int) -> None:
        """The newest state held to ``end``."""
        if self.spans:
            self.spans[-1] = replace(self.spans[-1], end=max(end, self.spans[-1].start))

    @property
    def worst(self) -> Tone:
        """Worst state there was."""
        return max((span.tone for span in self.spans), default=Tone.NONE)

    def seconds(self, text: str) -> float:
        """How long ``text`` held in all."""
        return sum(span.seconds for span in self.spans if span.text == text)


def drawn(spans: list[Span], shortest: int) -> list[Span]:
    """Spans worth a bar: neighbours that are both shorter than ``shortest`` ns become one, the worst of them."""
    merged: list[Span] = []
    for span in spans:
        if merged and span.end - span.start < shortest and merged[-1].end - merged[-1].start < shortest:
            worse = max(merged[-1], span, key=lambda s: s.tone)
            merged[-1] = replace(worse, start=merged[-1].start, end=span.end)
        else:
            merged.append(span)
    return [span for span in merged if span.tone is not Tone.NONE]
