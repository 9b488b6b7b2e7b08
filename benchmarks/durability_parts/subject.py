"""Subjects of kills and power cuts.

To add one, write a module with two functions and a ``SUBJECT``:

``write(folder, seed)`` is a generator that runs in a separate process, in an empty folder, with the project's own code
for saving (the function that the daemon calls, not a copy of it). It makes one change after the other and yields a line
of text when each is acknowledged, e.g. ``"setting gate.speed 0.4"``; it need not end. The line is recorded before the
next change begins. Nothing outside of ``folder`` is written.

``check(folder, acknowledged, death)`` receives the remaining content and the acknowledged lines, and reads the content
with the project's own code, as the next start does (it may repair; the folder is discarded afterwards). It returns
None, or the fault: an acknowledged change is lost, two saves are mixed, a file cannot be read. The last change, made
but not acknowledged, may be present or not. An exception is a fault as well.
"""

from collections.abc import Callable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple


class Death(StrEnum):
    """End of the writer."""

    KILL = "kill"
    """The process alone: the kernel has all that was written."""
    CUT = "cut"
    """The power: the disk has what was synced, and any part of the rest."""


class Subject(NamedTuple):
    """Data that is written and acknowledged."""

    name: str
    write: Callable[[Path, int], Iterator[str]]
    check: Callable[[Path, list[str], Death], str | None]
    seconds: float = 0.3
    """A writer is killed within this time of its first change (s)."""
    changes: int = 30
    """Acknowledged changes of one traced run, whose power is cut at any point."""
