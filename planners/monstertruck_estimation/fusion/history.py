"""Measurements in the order of their stamps, however late they come, and redone a few at a time."""

from bisect import bisect_left, bisect_right
from collections.abc import Callable

from monstertruck_estimation.fusion.beliefs import Belief
from monstertruck_estimation.fusion.operations import Operation, ScanMark, ScanWay

Advance = Callable[[Belief, Operation], Belief]


class History:
    """The belief after every operation of the last while; a late one is put in its place and what follows redone.

    What is to be redone waits for ``catch_up``, which is told how many operations it may spend. Until all are redone,
    ``newest`` goes on from the belief as it was, with every operation that is in time; then the redone one takes over.

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
        self._done = 0
        """The beliefs of so many rows are as they should be; those after them wait to be redone."""
        self.newest = start
        """The belief after all operations in time, and after all others that are redone."""

    @property
    def waiting(self) -> int:
        """Operations that wait to be redone."""
        return len(self._rows) - self._done

    def reaches(self, stamp: int) -> bool:
        """Whether an operation of this stamp (ns) can still be put in."""
        return stamp >= self._floor.stamp

    def scan_before(self, stamp: int) -> int | None:
        """Stamp of the last scan that is not later than ``stamp``, ns; None if there was none."""
        for operation, _ in reversed(self._rows[: self._place(stamp)]):
            if isinstance(operation, ScanMark | ScanWay):
                return operation.stamp
        return self._floor.scan

    def insert(self, operation: Operation) -> bool:
        """Put an operation in its place; False if that is forgotten already."""
        if not self.reaches(operation.stamp):
            return False
        row = self._place(operation.stamp)
        if row == len(self._rows):
            self.newest = self._advance(self.newest, operation)
            self._done += not self.waiting
        else:
            self._done = min(self._done, row)
        self._rows.insert(row, (operation, self.newest))
        self._forget()
        return True

    def rewrite(self, since: int, change: Callable[[Operation], Operation]) -> None:
        """Change the operations later than ``since``, ns; they wait to be redone."""
        first = self._place(since)
        self._rows[first:] = [(change(operation), belief) for operation, belief in self._rows[first:]]
        self._done = min(self._done, first)

    def catch_up(self, most: int) -> None:
        """Redo what waits, the oldest first, ``most`` operations at most."""
        if not self.waiting:
            return
        end = min(self._done + most, len(self._rows))
        belief = self._rows[self._done - 1][1] if self._done else self._floor
        for row in range(self._done, end):
            operation = self._rows[row][0]
            belief = self._advance(belief, operation)
            self._rows[row] = (operation, belief)
        self._done = end
        if not self.waiting:
            self.newest = belief
            self._forget()

    def _place(self, stamp: int) -> int:
        return bisect_right(self._rows, stamp, key=lambda row: row[0].stamp)

    def _forget(self) -> None:
        oldest = self._rows[-1][0].stamp - self._horizon
        kept = min(bisect_left(self._rows, oldest, key=lambda row: row[0].stamp), self._done)
        if kept:
            self._floor = self._rows[kept - 1][1]
            del self._rows[:kept]
            self._done -= kept
