"""Input of the doctor's checks, the computer and its configuration, and their output: findings."""

import os
import re
import shlex
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Final

from monstertruck_drivers.computer import ROOT, Computer
from monstertruck_drivers.config import AnyPort, CommandPortConfig, TcpPortConfig
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.tree import read_device
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import ConfigError
from monstertruck_runtime.small_files import text_of
from monstertruck_schemas.base import Schema
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_truck
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.install.files import Program
from monstertruckd.tools.install.plan import UNIT, below, installed_config

STATE = Path("/var/lib/monstertruckd")
"""Working folder of the service."""


@dataclass(frozen=True, slots=True)
class Account:
    """A user and all groups of that user."""

    name: str
    uid: int
    groups: dict[str, int]
    """Names and numbers."""

    def may_use(self, file: Path) -> bool:
        """Return whether the account may read and write the file; for a folder, whether it may create files in it."""
        try:
            status = file.stat()
        except OSError:
            return False
        needed = 0o7 if stat.S_ISDIR(status.st_mode) else 0o6
        return self.uid == 0 or self._allowed(status) & needed == needed

    def may_read(self, file: Path) -> bool:
        """Return whether the account may read the file; parent folders are not checked."""
        try:
            return self.uid == 0 or bool(self._allowed(file.stat()) & 0o4)
        except OSError:
            return False

    def _allowed(self, status: os.stat_result) -> int:
        if status.st_uid == self.uid:
            return status.st_mode >> 6 & 0o7
        if status.st_gid in self.groups.values():
            return status.st_mode >> 3 & 0o7
        return status.st_mode & 0o7


def account_of(root: Path, who: str | int) -> Account | None:
    """Return the user of that name or number in ``root/etc``; None if it does not exist."""
    users = [line.split(":") for line in (text_of(root / "etc/passwd") or "").splitlines()]
    user = next((u for u in users if len(u) > 3 and who in (u[0], int(u[2]))), None)
    if user is None:
        return None
    name, uid, gid = user[0], int(user[2]), int(user[3])
    groups = {}
    for line in (text_of(root / "etc/group") or "").splitlines():
        group, _, number, members = (*line.split(":"), "", "", "")[:4]
        if number.isdecimal() and (int(number) == gid or name in members.split(",")):
            groups[group] = int(number)
    return Account(name, uid, groups)


class Level(StrEnum):
    """Severity of a finding."""

    OK = "ok"
    WARN = "warn"
    """The truck drives, but worse than it could, or not for long."""
    FAIL = "fail"
    """The truck does not drive, or is not safe."""


class Finding(Schema):
    """Result of one check, and the command that fixes it."""

    check: str
    level: Level
    reason: Reason = Reason.OK
    seen: str
    fix: str | None = None
    """Command that fixes it; None if there is no fault, or no such command."""


def fine(check: str, seen: str, fix: str | None = None) -> Finding:
    """A passed check; ``fix`` may be a command that shows more."""
    return Finding(check=check, level=Level.OK, seen=seen, fix=fix)


def warn(check: str, reason: Reason, seen: str, fix: str | None = None) -> Finding:
    """A passed check with a warning."""
    return Finding(check=check, level=Level.WARN, reason=reason, seen=seen, fix=fix)


def fail(check: str, reason: Reason, seen: str, fix: str | None = None) -> Finding:
    """A failed check."""
    return Finding(check=check, level=Level.FAIL, reason=reason, seen=seen, fix=fix)


SAFE_PROGRAMS: Final = ("timedatectl", "chmod", "chown", "usermod", "modprobe")
"""Programs whose calls in findings affect only the reported item."""


def safe_fix(fix: str | None) -> list[str] | None:
    """Return the arguments of a finding's command that may run without review: no shell, no file name; else None."""
    if fix is None or any(sign in fix for sign in "|&;<>$`") or "FILE" in fix:
        return None
    words = shlex.split(fix)
    called = words[1:] if words[:1] == ["sudo"] else words
    ours = called[1:4] == ["-m", "monstertruckd", "install-service"]
    return words if ours or (called and called[0] in SAFE_PROGRAMS) else None


def first_failure(findings: list[Finding]) -> Reason:
    """Return the reason of the first failure; OK if there is none."""
    return next((finding.reason for finding in findings if finding.level is Level.FAIL), Reason.OK)


def version_of(package: str) -> str | None:
    """Return the version of an installed distribution; None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@dataclass(frozen=True, slots=True)
class HostContext:
    """A computer, real or emulated, with its files below a root.

    All checks read through it, so that a folder can replace the computer.
    """

    system: Path
    """Folder with etc, var, run, proc."""
    computer: Computer
    """Its USB tree, device nodes and readings."""
    program: Program
    config_file: Path | None
    """Given configuration, else the installed one, else None."""
    config: TruckConfig | None
    """None where there is none, or a refused one."""
    refusal: str | None
    """Why it was refused."""
    account: Account | None
    """User of the daemon: of the service, else the caller."""
    versions: Callable[[str], str | None] = version_of

    def at(self, path: Path) -> Path:
        """Return the place of an absolute path of that computer."""
        return below(self.system, path)

    def logs(self) -> Path:
        """Folder of the logs; a relative one is below the installed service's working folder."""
        recorder = self.config.recorder if self.config is not None else None
        directory = Path(recorder.directory if recorder is not None else "")
        if directory.is_absolute():
            return self.at(directory)
        return (self.at(STATE) if self.at(UNIT).is_file() else Path()) / directory

    def node(self, port: AnyPort, *, camera: bool = False) -> Path | None:
        """Return the device node of a port; None for an empty port and for a network socket."""
        if isinstance(port, TcpPortConfig | CommandPortConfig):
            return None
        if not isinstance(port, UsbPortConfig):
            path = self.at(port.path)
            return path if path.exists() else None
        sysfs = self.computer.machine.sysfs
        device = read_device(sysfs, port.at_present(sysfs).device)
        found = device.find("video4linux" if camera else "tty", port.interface) if device is not None else None
        return self.computer.machine.dev / found.name if found is not None else None

    def command(self, *arguments: str, sudo: bool = False) -> str:
        """Return a command line of this program for the user."""
        return shlex.join([*(["sudo"] if sudo else []), str(self.program.python), "-m", "monstertruckd", *arguments])

    def install_command(self) -> str:
        """Return the command that installs the service again."""
        named = ["--config", str(self.config_file)] if self.config_file is not None else ["--config", "FILE"]
        return self.command("install-service", *named, sudo=True)

    def find_port_command(self, role: str) -> str:
        """Return the command that finds the port of a cable and writes it into the configuration."""
        return self.command("find-port", role, "--write", str(self.config_file))

    def daemon(self) -> int | None:
        """Return the process of a running daemon; None if none runs."""
        return next((pid for pid, words in self._processes() if _runs_daemon(words)), None)

    def runs(self, name: str) -> bool:
        """Return whether a process of that name runs."""
        return any(text_of(file) == name for file in (self.system / "proc").glob("[0-9]*/comm"))

    def _processes(self) -> Iterator[tuple[int, list[str]]]:
        for file in (self.system / "proc").glob("[0-9]*/cmdline"):
            yield int(file.parent.name), (text_of(file) or "").split("\0")


def inspect(system: Path, program: Program, config_file: Path | None, uid: int, clock: Clock) -> HostContext:
    """Return the context of a computer.

    Args:
        system: folder with its files; "/" is the real one.
        program: this program.
        config_file: named by the user; None: the service's.
        uid: user id of the caller.
        clock: source of time.
    """
    unit = text_of(below(system, UNIT)) or ""
    file = config_file or installed_config(system)
    config, refusal = None, None
    if file is not None:
        try:
            config = load_truck(file)[0]
        except ConfigError as error:
            refusal = str(error)
    user = re.search(r"^User=(.+)$", unit, re.MULTILINE)
    account = account_of(system, user[1] if user is not None else uid)
    machine = system if config is None or config.machine == ROOT else config.machine
    return HostContext(system, Computer.at(machine, clock), program, file, config, refusal, account)


def _runs_daemon(words: list[str]) -> bool:
    return any(Path(program).name == "monstertruckd" and command == "run" for program, command in pairwise(words))
