"""Parts of the navigation benchmark: each a module with ``run(options) -> Part``."""

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Options:
    """Command-line options."""

    data: Path | None
    """Folder with ``maps`` and ``planning``; None: only what needs no data."""
    out: Path
    """Folder for plots."""
    quick: bool = False
    runs: int = 2000
    """Number of runs of the harness."""


@dataclass
class Part:
    """Result of a part: every goal is an upper bound of the figure of the same name."""

    figures: dict[str, float] = field(default_factory=dict)
    goals: dict[str, float] = field(default_factory=dict)

    def add(self, name: str, figure: float, goal: float | None = None) -> None:
        """Add a figure, with its goal if it has one."""
        self.figures[name] = round(figure, 6)
        if goal is not None:
            self.goals[name] = goal

    @property
    def met(self) -> bool:
        """Whether every goal is met."""
        return all(self.figures[name] <= goal for name, goal in self.goals.items())
