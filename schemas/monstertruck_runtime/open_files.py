"""Processes of this computer that have a file, device or socket open, from the kernel's tables."""

from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

PROC: Final = Path("/proc")


def holders(targets: Collection[str], proc: Path = PROC) -> Iterator[str]:
    """Describe the processes that have one of ``targets`` open, by process id and command line.

    Blocks for milliseconds.

    Args:
        targets: targets in the format of links in ``/proc/PID/fd``: ``/dev/ttyUSB0``, ``socket:[4711]``.
        proc: the kernel's tables.

    Yields:
        For example ``process 4711 (monstertruckd run --config demo.yaml)``. Only root sees the processes of other
        users.
    """
    wanted = frozenset(targets)
    for folder in sorted(proc.glob("[0-9]*"), key=lambda folder: int(folder.name)):
        if not wanted.isdisjoint(_open_files(folder)):
            yield f"process {folder.name} ({_command_line(folder)})"


def _open_files(folder: Path) -> Iterator[str]:
    """Open files of a process; empty if it belongs to another user or has ended."""
    with suppress(OSError):
        for link in (folder / "fd").iterdir():
            with suppress(OSError):  # closed meanwhile
                yield str(link.readlink())


def _command_line(folder: Path) -> str:
    try:
        words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return "ended"
    return " ".join(words).strip()[:160]  # maximum number of command-line characters shown
