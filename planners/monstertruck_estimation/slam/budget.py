"""Long searches in pieces: what one scan may spend on them is counted as work, not as time, so that runs repeat.

A search is a generator that yields the cost of every piece before it does it. The unit is one look-up in a likelihood
grid, 2 to 3 ns; other work is counted as so many of them.
"""

from collections.abc import Generator
from typing import Final, Generic, TypeVar

T = TypeVar("T")
Pieces = Generator[float, None, T]
"""A search in pieces, with its result at the end."""

BUDGET: Final = 9e6
"""Work on searches at one scan, 20 to 25 ms."""
ELEMENT: Final = 100.0
"""Work of merging one element into a submap."""
DRAWN: Final = 1000.0
"""Work of drawing an element into a likelihood grid."""
CELL: Final = 0.2
"""Work per cell of one level of a likelihood grid."""
EDGE: Final = 400.0
"""Work per edge of the pose graph of bounding its drift."""
EDGE_OPTIMISED: Final = 4000.0
"""Work per edge of optimising the pose graph."""
VERIFIED: Final = 3e6
"""Work of verifying a match."""
CROSSED: Final = 2e5
"""Work of comparing a keyframe with those of another submap."""


class ScanBudget:
    """Work left at one scan. The first piece is always done, so that every search ends."""

    def __init__(self, units: float = BUDGET) -> None:
        self._left = units
        self._begun = False

    def allows(self, cost: float) -> bool:
        """Whether a piece of this ``cost`` is to be done at this scan; if so, it is taken off."""
        if self._begun and cost > self._left:
            return False
        self._begun = True
        self._left -= cost
        return True


class PiecewiseSearch(Generic[T]):
    """A search that is continued scan by scan."""

    def __init__(self, pieces: Pieces[T]) -> None:
        self._pieces = pieces
        self._cost = 0.0
        self.result: T | None = None
        """Its result once it has ended."""

    def run(self, budget: ScanBudget) -> bool:
        """Do pieces while the budget allows it; True when the search has ended."""
        while budget.allows(self._cost):
            try:
                self._cost = next(self._pieces)
            except StopIteration as end:
                self.result = end.value
                return True
        return False


def finished(pieces: Pieces[T]) -> T:
    """The result of a search without any limit."""
    while True:
        try:
            next(pieces)
        except StopIteration as end:
            result: T = end.value
            return result
