"""A drive to a goal or along a path, reported on a terminal."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from monstertruck_runtime.drives import DriveReport
from monstertruck_schemas.state import GateState
from monstertruckd.tools.cli.output import progress, remark, with_remedy


class TerminalReport(DriveReport):
    """Shows remarks, and a progress bar for each part of the drive, on standard error."""

    def __init__(self, shown: ExitStack) -> None:
        self._shown = shown
        self._what = ""
        self._show: Callable[[float], None] = lambda _: None

    def waiting(self, text: str, share: float) -> None:
        """Report the start of a part, with a bar."""
        if self._what != "the planner is starting":
            remark(f"waiting: {text}")
        self.under_way("the planner is starting", share)

    def under_way(self, what: str, share: float) -> None:
        """Move the bar."""
        if what != self._what:
            self._shown.close()
            self._what = what
            self._show = self._shown.enter_context(progress(what, 1.0))
        self._show(share)

    def stands(self, gate: GateState, why: str) -> None:
        """Print a remark."""
        remark(f"waiting: {with_remedy(gate.worst, why)}")


@contextmanager
def on_the_terminal() -> Iterator[TerminalReport]:
    """Create a report whose bars disappear at the end."""
    with ExitStack() as shown:
        yield TerminalReport(shown)
