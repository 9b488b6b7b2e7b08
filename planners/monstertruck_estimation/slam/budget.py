"""Long searches in pieces, with a budget per scan in units of work instead of time, so that runs are reproducible.

A search is a generator that yields the cost of every piece before it executes it. The unit is one look-up in a
likelihood grid, 2 to 3 ns; other work is converted to it.
"""

from collections.abc import Generator
from enum import Enum
from typing import Generic, TypeVar

T = TypeVar("T")
Pieces = Generator[float, None, T]
"""Search in pieces that returns its result at the end."""


class Work(float, Enum):
    """Work of one piece."""

    SCAN = 9e6
    """Maximum work on searches per scan, 20 to 25 ms."""
    ELEMENT = 100.0
    """Work of merging one element into a submap."""
    DRAWN = 1000.0
    """Work of drawing an element into a likelihood grid."""
    CELL = 0.2
    """Work of one cell on one level of a likelihood grid."""
    EDGE = 400.0
    """Work of one edge in bounding the pose graph's drift."""
    EDGE_OPTIMISED = 4000.0
    """Work of one edge in optimising the pose graph."""
    VERIFIED = 3e6
    """Work of verifying a match."""
    CROSSED = 2e5
    """Work of comparing a keyframe with those of another submap."""


class ScanBudget:
    """Work left for one scan. The first piece is always allowed, so that every search ends."""

    def __init__(self, units: float = Work.SCAN) -> None:
        self._left = units
        self._begun = False

    def allows(self, cost: float) -> bool:
        """Whether a piece of this ``cost`` fits in this scan; if so, deduct it."""
        if self._begun and cost > self._left:
            return False
        self._begun = True
        self._left -= cost
        return True


class PiecewiseSearch(Generic[T]):
    """Search that continues scan by scan."""

    def __init__(self, pieces: Pieces[T]) -> None:
        self._pieces = pieces
        self._cost = 0.0
        self.result: T | None = None
        """Result of the search once it has ended."""

    def run(self, budget: ScanBudget) -> bool:
        """Execute pieces within the budget; return whether the search has ended."""
        while budget.allows(self._cost):
            try:
                self._cost = next(self._pieces)
            except StopIteration as end:
                self.result = end.value
                return True
        return False


def finished(pieces: Pieces[T]) -> T:
    """Return the result of a search without a limit."""
    while True:
        try:
            next(pieces)
        except StopIteration as end:
            result: T = end.value
            return result
