"""The computer the daemon runs on, real or emulated: its USB tree, kernel files and disk."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from monstertruck_drivers.host_health.readings import Disk, disk_of
from monstertruck_drivers.usb.machine import Machine
from monstertruck_drivers.usb.sysfs import Sysfs
from monstertruck_drivers.usb.watch import NoWatcher, Watcher, open_watcher
from monstertruck_runtime.clock import Clock

ROOT = Path("/")


@dataclass(frozen=True, slots=True)
class Computer:
    """The computer the daemon runs on; an emulated one stands in for it in simulations."""

    machine: Machine
    """Its USB tree."""
    root: Path = ROOT
    """Folder with its proc and sys."""
    watch: Callable[[], Watcher] = open_watcher
    """Opens the source of USB announcements."""
    disk: Callable[[Path], Disk] = disk_of
    """Its file system at a path."""

    @classmethod
    def at(cls, root: Path, clock: Clock) -> Self:
        """The real computer, or the one another process emulates in the folder ``root``, which announces nothing."""
        machine = Machine(clock, Sysfs(root / "sys"), root / "dev")
        return cls(machine, root, open_watcher if root == ROOT else NoWatcher)
