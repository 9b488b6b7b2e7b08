"""Damage to a log in figures and words, shared by the reader and the repair."""

from dataclasses import dataclass

from monstertruck_runtime.clock import SECOND
from monstertruckd.recorder.salvage import Salvage


@dataclass(frozen=True, slots=True)
class LogDamage:
    """Result of reading a damaged log to its end."""

    messages: int
    """Messages kept."""
    lost: int = 0
    """Messages lost."""
    counted: bool = True
    """Whether ``lost`` is exact; without a sound index more may be lost."""
    spans: tuple[tuple[float, float | None], ...] = ()
    """Start and end of each loss, relative to the first message (s); None: end of the log."""
    repeated: int = 0
    """Number of duplicate chunks."""
    damage: str | None = None
    """Description of the damage; None if the log is sound."""

    @property
    def costs(self) -> bool:
        """Whether messages are lost or may be lost."""
        return self.lost > 0 or not self.counted

    @property
    def losses(self) -> str:
        """Number and times of lost messages, e.g. ``at least 20 lost (2.9 to 4.0 s after its begin)``."""
        text = (
            f"{self.lost} lost"
            if self.counted
            else f"at least {self.lost} lost"
            if self.lost
            else "an unknown number lost"
        )
        return f"{text} ({self.times} after its start)" if self.spans else text

    @property
    def times(self) -> str:
        """Times of lost messages."""
        return ", ".join(_span_text(*span) for span in self.spans)


def _span_text(start: float, end: float | None) -> str:
    return f"from {start:.1f} s on" if end is None else f"{start:.1f} to {end:.1f} s"


def repetition(chunks: int) -> str:
    """Describe the damage to a log that contains this number of chunks twice."""
    return f"contains {chunks} chunk{'s' if chunks > 1 else ''} twice"


def judged(salvage: Salvage) -> LogDamage:
    """Return the damage found by a salvage once all records have been read."""
    spans = salvage.spans()
    begin = min((time for time in (salvage.first, *(span.start for span in spans)) if time is not None), default=0)
    damage = list(salvage.flaws)
    if salvage.gaps:
        damage.append(f"cannot be read in {salvage.gaps} place{'s' if salvage.gaps > 1 else ''}")
    if salvage.repeated:
        damage.append(repetition(salvage.repeated))
    if not salvage.ended:
        damage.append("has no end")
    elif not salvage.indexed:
        damage.append("has a damaged index")
    elif salvage.lost:
        damage.append(f"contains {salvage.messages} of {salvage.messages + salvage.lost} messages")
    elif salvage.lacking:
        damage.append("lacks an attachment or metadata")
    return LogDamage(
        salvage.messages,
        salvage.lost,
        salvage.counted,
        tuple((_seconds(span.start, begin) or 0.0, _seconds(span.end, begin)) for span in spans),
        salvage.repeated,
        ", ".join(damage) or None,
    )


def _seconds(time: int | None, begin: int) -> float | None:
    return None if time is None else (time - begin) / SECOND
