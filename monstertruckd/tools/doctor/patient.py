"""The computer that is looked over, and what is known of it beforehand."""

import re
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from itertools import pairwise
from pathlib import Path

from monstertruck_drivers.computer import ROOT, Computer
from monstertruck_drivers.config import AnyPort
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.tree import read_device
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import ConfigError
from monstertruck_runtime.small_files import text_of
from monstertruckd.config.load import load_truck
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.doctor.accounts import Account, account_of
from monstertruckd.tools.install.plan import UNIT, below, installed_config
from monstertruckd.tools.install.unit import Program

STATE = Path("/var/lib/monstertruckd")
"""Working folder of the service."""


def version_of(package: str) -> str | None:
    """Version of an installed distribution; None if there is none."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@dataclass(frozen=True, slots=True)
class Patient:
    """A computer, real or emulated, in a system below a root.

    Everything the checks ask of it goes through here, so that a folder can stand for it.
    """

    system: Path
    """Folder with etc, var, run, proc."""
    computer: Computer
    """Its USB tree, device nodes and readings."""
    program: Program
    config_file: Path | None
    """Configuration that was named, else the installed one, else None."""
    config: TruckConfig | None
    """None where there is none, or a refused one."""
    complaint: str | None
    """Why it was refused."""
    account: Account | None
    """Whom the daemon runs as: the service's user, else whoever asks."""
    versions: Callable[[str], str | None] = version_of

    def at(self, path: Path) -> Path:
        """Where an absolute path of it is."""
        return below(self.system, path)

    def logs(self) -> Path:
        """Folder of the logs; relative ones are below where the service works, once it is installed."""
        recorder = self.config.recorder if self.config is not None else None
        directory = Path(recorder.directory if recorder is not None else "")
        if directory.is_absolute():
            return self.at(directory)
        return (self.at(STATE) if self.at(UNIT).is_file() else Path()) / directory

    def node(self, port: AnyPort, *, camera: bool = False) -> Path | None:
        """Device node of a port; None if nothing usable is plugged in."""
        if not isinstance(port, UsbPortConfig):
            path = self.at(port.path)
            return path if path.exists() else None
        device = read_device(self.computer.machine.sysfs, port.device)
        found = device.find("video4linux" if camera else "tty", port.interface) if device is not None else None
        return self.computer.machine.dev / found.name if found is not None else None

    def command(self, *arguments: str, sudo: bool = False) -> str:
        """Command line of this program, for the user to type."""
        return shlex.join([*(["sudo"] if sudo else []), str(self.program.python), "-m", "monstertruckd", *arguments])

    def install_command(self) -> str:
        """What installs the service anew."""
        named = ["--config", str(self.config_file)] if self.config_file is not None else ["--config", "FILE"]
        return self.command("install-service", *named, sudo=True)

    def find_port_command(self, role: str) -> str:
        """What finds the port of a cable and writes it down."""
        return self.command("find-port", role, "--write", str(self.config_file))

    def daemon(self) -> int | None:
        """Process of a running daemon; None if there is none."""
        return next((pid for pid, words in self._processes() if _runs_daemon(words)), None)

    def runs(self, name: str) -> bool:
        """Whether a process of that name runs."""
        return any(text_of(file) == name for file in (self.system / "proc").glob("[0-9]*/comm"))

    def _processes(self) -> Iterator[tuple[int, list[str]]]:
        for file in (self.system / "proc").glob("[0-9]*/cmdline"):
            yield int(file.parent.name), (text_of(file) or "").split("\0")


def admit(system: Path, program: Program, config_file: Path | None, uid: int, clock: Clock) -> Patient:
    """Take a computer in.

    Args:
        system: folder with its files; "/" is the real one.
        program: this one.
        config_file: named by the user; None = the one the service is started with.
        uid: of whoever asks.
        clock: time.
    """
    unit = text_of(below(system, UNIT)) or ""
    file = config_file or installed_config(system)
    config, complaint = None, None
    if file is not None:
        try:
            config = load_truck(file)[0]
        except ConfigError as error:
            complaint = str(error)
    user = re.search(r"^User=(.+)$", unit, re.MULTILINE)
    account = account_of(system, user[1] if user is not None else uid)
    machine = system if config is None or config.machine == ROOT else config.machine
    return Patient(system, Computer.at(machine, clock), program, file, config, complaint, account)


def _runs_daemon(words: list[str]) -> bool:
    return any(Path(program).name == "monstertruckd" and command == "run" for program, command in pairwise(words))
