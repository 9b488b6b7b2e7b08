"""Measurements in the order of their stamps, however late they come."""

from bisect import bisect_left, bisect_right
from collections.abc import Callable

from monstertruck_estimation.fusion.beliefs import Belief
from monstertruck_estimation.fusion.operations import Operation

Advance = Callable[[Belief, Operation], Belief]


class History:
    """The belief after every operation of the last while; a late one is put in its place and what follows redone.

    Args:
        start: the belief before everything.
        advance: the belief after an operation.
        horizon: ns for which operations are remembered.
    """

    def __init__(self, start: Belief, advance: Advance, horizon: int) -> None:
        self._floor = start
        self._advance = advance
        self._horizon = horizon
        self._rows: list[tuple[Operation, Belief]] = []

    @property
    def newest(self) -> Belief:
        """The belief after all operations."""
        return self._rows[-1][1] if self._rows else self._floor

    def reaches(self, stamp: int) -> bool:
        """Whether an operation of this stamp (ns) can still be put in."""
        return stamp >= self._floor.stamp

    def before(self, stamp: int) -> Belief:
        """The belief after the last operation that is not later than ``stamp``, ns."""
        row = bisect_right(self._rows, stamp, key=lambda row: row[0].stamp)
        return self._rows[row - 1][1] if row else self._floor

    def insert(self, operation: Operation) -> bool:
        """Put an operation in its place; False if that is forgotten already."""
        if not self.reaches(operation.stamp):
            return False
        row = bisect_right(self._rows, operation.stamp, key=lambda row: row[0].stamp)
        self._rows.insert(row, (operation, self._floor))
        self._redo(row)
        self._forget()
        return True

    def rewrite(self, since: int, change: Callable[[Operation], Operation]) -> None:
        """Change the operations later than ``since``, ns, and redo them."""
        first = bisect_right(self._rows, since, key=lambda row: row[0].stamp)
        self._rows[first:] = [(change(operation), belief) for operation, belief in self._rows[first:]]
        self._redo(first)

    def _redo(self, first: int) -> None:
        belief = self._rows[first - 1][1] if first else self._floor
        for row in range(first, len(self._rows)):
            operation = self._rows[row][0]
            belief = self._advance(belief, operation)
            self._rows[row] = (operation, belief)

    def _forget(self) -> None:
        oldest = self._rows[-1][0].stamp - self._horizon
        kept = bisect_left(self._rows, oldest, key=lambda row: row[0].stamp)
        if kept:
            self._floor = self._rows[kept - 1][1]
            del self._rows[:kept]
