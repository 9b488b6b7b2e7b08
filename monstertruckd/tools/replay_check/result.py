"""Result of a check of a log."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.replay_check.comparison import FirstDifference, TopicComparison

ROUND_OFF: Final = 1e-6
"""SI units: what another processor's maths routines, which round otherwise, are off by is far less."""


@dataclass(frozen=True, slots=True)
class Unreadable:
    """A sensor's message with bytes invalid for its topic."""

    topic: str
    sequence: int
    at: float
    """Seconds after the log's begin."""
    error: str


@dataclass(frozen=True, slots=True)
class CheckedReplay:
    """Result of a check."""

    log: Path
    parts: tuple[Path, ...]
    """The files of its run."""
    config: Path | None
    """The other configuration; None: the log's own."""
    duration: float
    """Duration of the log, s."""
    end: int
    """Last instant of recorded outputs, ns."""
    topics: tuple[TopicComparison, ...]
    unreadable: tuple[Unreadable, ...]
    lost: dict[str, int]
    """Messages that never reached the log, by topic."""
    damage: str | None
    left_out: str | None = None
    """Why planner and tracker were not computed; None if they were, or there are none."""

    @property
    def compared(self) -> int:
        """Number of recorded outputs that were reproduced."""
        return sum(comparison.compared for comparison in self.topics)

    @property
    def equal(self) -> int:
        """Number of them that are equal bit for bit."""
        return sum(comparison.equal for comparison in self.topics)

    @property
    def first(self) -> FirstDifference | None:
        """The first output that differs by more than its topic's tolerance."""
        return min(
            (comparison.first for comparison in self.topics if comparison.first),
            key=lambda first: first.at,
            default=None,
        )

    @property
    def agrees(self) -> bool:
        """Whether everything was reproduced within the tolerance."""
        return all(comparison.agrees(self.end) for comparison in self.topics) and not self.unreadable

    @property
    def rounded(self) -> bool:
        """Whether it does not agree, but nothing differs by more than ``ROUND_OFF``."""
        close = all(comparison.within(self.end, ROUND_OFF) for comparison in self.topics) and not self.unreadable
        return close and not self.agrees

    @property
    def sufficient(self) -> float:
        """Tolerance (SI units) with which a ``rounded`` check agrees."""
        return max([ROUND_OFF, *(comparison.tolerance for comparison in self.topics if comparison.judged)])

    @property
    def reason(self) -> Reason:
        """Outcome of the check; with another configuration any difference is permitted."""
        if self.damage is not None:
            return Reason.LOG_DAMAGED
        return Reason.OK if self.agrees or self.config is not None else Reason.REPLAY_DIFFERS

    def figures(self) -> dict[str, Any]:
        """Return everything as plain values for JSON: non-finite numbers become null."""
        return {
            "log": str(self.log),
            "parts": [str(part) for part in self.parts],
            "config": None if self.config is None else str(self.config),
            "reason": self.reason,
            "agrees": self.agrees,
            "rounded": self.rounded,
            "duration": self.duration,
            "compared": self.compared,
            "equal": self.equal,
            "first_difference": None if self.first is None else asdict(self.first),
            "topics": {comparison.topic.name: self._comparison(comparison) for comparison in self.topics},
            "unreadable": [asdict(message) for message in self.unreadable],
            "lost": self.lost,
            "damage": self.damage,
            "left_out": self.left_out,
        }

    def _comparison(self, comparison: TopicComparison) -> dict[str, Any]:
        return {
            "tolerance": comparison.tolerance,
            "judged": comparison.judged,
            "compared": comparison.compared,
            "equal": comparison.equal,
            "differing": comparison.differing,
            "missing": comparison.missing,
            "extra": comparison.surplus(self.end),
            "greatest": {str(one.kind): asdict(one) for one in comparison.greatest.values()},
            "first_difference": None if comparison.first is None else asdict(comparison.first),
        }
