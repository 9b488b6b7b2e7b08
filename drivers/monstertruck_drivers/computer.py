"""The computer that runs the daemon, real or emulated: its USB tree, kernel files, programs and disk."""

import asyncio
import logging
import os
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol, Self

from monstertruck_drivers.tty import OpenSerial, SerialPort
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import DeviceError
from monstertruck_runtime.threads import Offload, in_daemon_thread


class Sysfs:
    """Sysfs attributes below ``root``; unreadable ones are absent.

    Some attributes wait for the device (strings, ``authorized``), so they must not be read on the event loop.
    """

    def __init__(self, root: Path = Path("/sys")) -> None:
        self.root = root

    def text(self, path: str) -> str | None:
        """Attribute text without surrounding whitespace; None if it is missing or unreadable."""
        try:
            return (self.root / path).read_text(errors="backslashreplace").strip()
        except OSError:
            return None

    def number(self, path: str, base: int = 10) -> int | None:
        """Attribute value as an integer; None if it is not an integer."""
        try:
            return int(self.text(path) or "", base)
        except ValueError:
            return None

    def names(self, path: str) -> list[str]:
        """Entries of a folder, sorted; empty if it is missing."""
        try:
            return sorted(entry.name for entry in (self.root / path).iterdir())
        except OSError:
            return []

    def write(self, path: str, text: str) -> None:
        """Set an attribute.

        Raises:
            OSError: the attribute is missing, not writable, or rejects the value.
        """
        with (self.root / path).open("r+") as attribute:  # an attribute is never created
            attribute.write(text)


log = logging.getLogger(__name__)

SUBSYSTEMS: Final = ("usb", "tty", "video4linux")


class Watcher(Protocol):
    """Source of change notifications; it may miss changes, so callers also poll."""

    def start(self, hint: Callable[[], None]) -> None:
        """Call ``hint`` on the running loop whenever something may have changed, until ``stop``."""

    def stop(self) -> None:
        """Stop the notifications; may be called repeatedly."""


class NoWatcher:
    """Watcher for machines without udev, where the tree is only polled."""

    def start(self, hint: Callable[[], None]) -> None:
        """Do nothing."""

    def stop(self) -> None:
        """Do nothing."""


class UdevWatcher:
    """Listens to udev events, which arrive after the udev rules have run, so links and permissions are up to date.

    Args:
        monitor: a ``pyudev.Monitor``, or an object with its interface.
    """

    def __init__(self, monitor: Any) -> None:
        self._monitor = monitor
        self._loop: asyncio.AbstractEventLoop | None = None
        self._hint: Callable[[], None] = lambda: None

    def start(self, hint: Callable[[], None]) -> None:
        """Start listening on the running loop."""
        self._hint = hint
        self._monitor.start()
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._monitor.fileno(), self._drain)

    def stop(self) -> None:
        """Stop listening."""
        if self._loop is not None:
            self._loop.remove_reader(self._monitor.fileno())
            self._loop = None

    def _drain(self) -> None:
        try:
            while self._monitor.poll(timeout=0) is not None:
                pass
        except OSError as error:  # the kernel's queue overflowed: announcements are lost
            log.debug("udev: %s", error)
            if self._loop is not None:  # uvloop calls the reader of a file with an error once, then never again
                self._loop.remove_reader(self._monitor.fileno())
                self._loop.add_reader(self._monitor.fileno(), self._drain)
        self._hint()


def open_watcher() -> Watcher:
    """Return a udev watcher if the machine has udev, otherwise one that reports nothing."""
    try:
        # LGPL, for robots only, and it loads a system library.
        import pyudev  # noqa: PLC0415

        monitor = pyudev.Monitor.from_netlink(pyudev.Context(), "udev")
        for subsystem in SUBSYSTEMS:
            monitor.filter_by(subsystem)
    except (ImportError, OSError) as error:
        log.warning("no udev announcements (%s): the USB tree is polled every few seconds instead", error)
        return NoWatcher()
    return UdevWatcher(monitor)


async def run_command(arguments: Sequence[str]) -> tuple[int, str]:
    """Run a program without a shell.

    Returns:
        Exit code and output.

    Raises:
        OSError: the program cannot be started.
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
    return process.returncode or 0, output.decode(errors="backslashreplace").strip()


@dataclass(frozen=True, slots=True)
class Machine:
    """Files, device nodes and programs; tests replace them with an emulated machine."""

    clock: Clock
    sysfs: Sysfs = field(default_factory=Sysfs)
    dev: Path = Path("/dev")
    offload: Offload = in_daemon_thread
    """Runs reads and writes of its files in threads. A hung device blocks its attributes, some for half a minute; other
    reads and the end of a driver must not wait for them.
    """
    run: Callable[[Sequence[str]], Awaitable[tuple[int, str]]] = run_command
    serial: OpenSerial = SerialPort
    """Creates the port of a serial node."""


@dataclass(frozen=True, slots=True)
class Disk:
    """A file system."""

    total: int
    """Total size (bytes)."""
    free: int
    """Free space for ordinary users (bytes)."""


def disk_of(path: Path) -> Disk:
    """The file system that contains ``path`` or its nearest existing parent.

    Raises:
        DeviceError: the size of the file system cannot be determined.
    """
    while not path.exists() and path != path.parent:
        path = path.parent
    try:
        found = os.statvfs(path)
    except OSError as error:
        raise DeviceError(f"{path}: {error.strerror}") from error
    return Disk(found.f_frsize * found.f_blocks, found.f_frsize * found.f_bavail)


ROOT = Path("/")


@dataclass(frozen=True, slots=True)
class Computer:
    """The computer that runs the daemon; simulations replace it with an emulated one."""

    machine: Machine
    """Its USB tree."""
    root: Path = ROOT
    """Folder with its proc and sys."""
    watch: Callable[[], Watcher] = open_watcher
    """Creates the source of USB announcements."""
    disk: Callable[[Path], Disk] = disk_of
    """File system of the computer."""

    @classmethod
    def at(cls, root: Path, clock: Clock) -> Self:
        """Return the real computer, or the one another process emulates in ``root``, without change notifications."""
        machine = Machine(clock, Sysfs(root / "sys"), root / "dev")
        return cls(machine, root, open_watcher if root == ROOT else NoWatcher)
