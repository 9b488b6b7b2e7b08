"""Small reads and writes in sysfs, and the machine they belong to."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

from monstertruck_drivers.link import Port, SerialPort
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.threads import in_thread

T = TypeVar("T")


class Sysfs:
    """Attributes below ``root``; what cannot be read is absent.

    Some attributes wait for the device (strings, ``authorized``), so nothing of this belongs on the event loop.
    """

    def __init__(self, root: Path = Path("/sys")) -> None:
        self.root = root

    def text(self, path: str) -> str | None:
        """Content of an attribute without surrounding blanks; None if it is not there or cannot be read."""
        try:
            return (self.root / path).read_text(errors="replace").strip()
        except OSError:
            return None

    def number(self, path: str, base: int = 10) -> int | None:
        """Content as an integer; None if it is none."""
        try:
            return int(self.text(path) or "", base)
        except ValueError:
            return None

    def names(self, path: str) -> list[str]:
        """Entries of a folder, sorted; none if it is not there."""
        try:
            return sorted(entry.name for entry in (self.root / path).iterdir())
        except OSError:
            return []

    def write(self, path: str, text: str) -> None:
        """Set an attribute.

        Raises:
            OSError: it is not there, not permitted, or refused.
        """
        with (self.root / path).open("r+") as attribute:  # an attribute is never created
            attribute.write(text)


class Beside(Protocol):
    """Runs a blocking function where it does not hold up the loop."""

    def __call__(self, function: Callable[[], T], /) -> Awaitable[T]:
        """Result of ``function()``."""
        ...


async def run_command(arguments: Sequence[str]) -> tuple[int, str]:
    """Run a program without a shell.

    Returns:
        Its exit code and what it printed.

    Raises:
        OSError: it cannot be started.
    """
    process = await asyncio.create_subprocess_exec(
        *arguments, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    try:
        output, _ = await process.communicate()
    except asyncio.CancelledError:
        process.kill()
        await process.wait()
        raise
    return process.returncode or 0, output.decode(errors="replace").strip()


@dataclass(frozen=True, slots=True)
class Machine:
    """The computer the hubs are plugged into; an emulated one stands in for it in tests."""

    clock: Clock
    sysfs: Sysfs = field(default_factory=Sysfs)
    dev: Path = Path("/dev")
    beside: Beside = in_thread
    run: Callable[[Sequence[str]], Awaitable[tuple[int, str]]] = run_command
    serial: Callable[[Path, int], Port] = SerialPort
    """A serial node and a baud rate to a port."""
