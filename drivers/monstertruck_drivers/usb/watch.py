"""Tells when something may have changed on the buses. Only a hint: what did change is read from sysfs."""

import asyncio
import logging
from collections.abc import Callable
from typing import Any, Final, Protocol

log = logging.getLogger(__name__)

SUBSYSTEMS: Final = ("usb", "tty", "video4linux")


class Watcher(Protocol):
    """Source of hints; may miss some, so its user looks by itself now and then."""

    def start(self, hint: Callable[[], None]) -> None:
        """Call ``hint`` on the running loop whenever something may have changed, until ``stop``."""
        ...

    def stop(self) -> None:
        """No more hints; may be called again."""
        ...


class NoWatcher:
    """For machines that announce nothing: the tree is only looked at now and then."""

    def start(self, hint: Callable[[], None]) -> None:
        """Nothing will come."""

    def stop(self) -> None:
        """Nothing came."""


class UdevWatcher:
    """Listens to udev, that is after its rules ran: links and permissions are in place.

    Args:
        monitor: a ``pyudev.Monitor``, or what looks like one.
    """

    def __init__(self, monitor: Any) -> None:
        self._monitor = monitor
        self._loop: asyncio.AbstractEventLoop | None = None
        self._hint: Callable[[], None] = _ignore

    def start(self, hint: Callable[[], None]) -> None:
        """Listen on the running loop."""
        self._hint = hint
        self._monitor.start()
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._monitor.fileno(), self._drain)

    def stop(self) -> None:
        """Listen no more."""
        if self._loop is not None:
            self._loop.remove_reader(self._monitor.fileno())
            self._loop = None

    def _drain(self) -> None:
        try:
            while self._monitor.poll(timeout=0) is not None:
                pass
        except OSError as error:  # the kernel's queue overflowed: announcements are lost
            log.debug("udev: %s", error)
            if self._loop is not None:  # uvloop calls the reader of a file with an error once, and then no more
                self._loop.remove_reader(self._monitor.fileno())
                self._loop.add_reader(self._monitor.fileno(), self._drain)
        self._hint()


def open_watcher() -> Watcher:
    """Udev's announcements where the machine has them, none otherwise."""
    try:
        # LGPL, for robots only, and it loads a system library.
        import pyudev  # noqa: PLC0415

        monitor = pyudev.Monitor.from_netlink(pyudev.Context(), "udev")
        for subsystem in SUBSYSTEMS:
            monitor.filter_by(subsystem)
    except (ImportError, OSError) as error:
        log.warning("no udev announcements (%s): the USB tree is looked at every few seconds only", error)
        return NoWatcher()
    return UdevWatcher(monitor)


def _ignore() -> None:
    return None
