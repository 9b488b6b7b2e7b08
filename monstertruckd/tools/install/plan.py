"""Contents of an installation: files, and programs to notify about them."""

import itertools
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from monstertruck_drivers.config import PortConfig
from monstertruck_drivers.usb.config import CycleMethod
from monstertruck_runtime.errors import ConfigError, InputError, NotFoundError
from monstertruck_runtime.map_files import files_of
from monstertruck_runtime.map_folders import MANIFEST, SAVES, numbered_saves
from monstertruck_runtime.small_files import text_of
from monstertruckd.config.load import load_truck
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.install.files import LINKS, Program, filled, rules_text, temporary, unit_text, user_name

FOLDER: Final = Path("/etc/monstertruckd")
USER: Final = "monstertruckd"
SERVICE: Final = "monstertruckd.service"
UNIT: Final = Path("/etc/systemd/system") / SERVICE
ENABLED: Final = Path("/etc/systemd/system/multi-user.target.wants") / SERVICE
SYSUSERS: Final = Path("/etc/sysusers.d/monstertruckd.conf")
TMPFILES: Final = Path("/etc/tmpfiles.d/monstertruckd.conf")
MODULES: Final = Path("/etc/modules-load.d/monstertruckd.conf")
RULES: Final = Path("/etc/udev/rules.d/70-monstertruckd.rules")
CONFIG: Final = FOLDER / "truck.yaml"
"""Used where neither the user nor an installed unit names one."""

Command = tuple[str, ...]

AFTER_INSTALL: Final[tuple[Command, ...]] = (
    ("systemd-sysusers", str(SYSUSERS)),
    ("systemd-tmpfiles", "--create", str(TMPFILES)),
    ("systemctl", "restart", "systemd-modules-load.service"),
    ("udevadm", "control", "--reload"),
    (
        *("udevadm", "trigger", "--settle"),
        *(f"--subsystem-match={name}" for name in ("usb", "usb-serial", "tty", "video4linux")),
    ),
    ("systemctl", "daemon-reload"),
)
BEFORE_REMOVAL: Final[tuple[Command, ...]] = (("systemctl", "stop", SERVICE),)
AFTER_REMOVAL: Final[tuple[Command, ...]] = (("systemctl", "daemon-reload"), ("udevadm", "control", "--reload"))
RESTART: Final[Command] = ("systemctl", "restart", SERVICE)


@dataclass(frozen=True, slots=True)
class PlannedFile:
    """One file, or a link if ``target`` is given."""

    path: Path
    text: str = ""
    data: bytes | None = None
    """Binary content."""
    target: Path | None = None
    keep_previous: bool = False
    """An operator may have edited it: the old one is kept next to the new one."""

    @property
    def content(self) -> bytes:
        """Content of the file."""
        return self.text.encode() if self.data is None else self.data


@dataclass(frozen=True, slots=True)
class InstallPlan:
    """A complete installation."""

    files: tuple[PlannedFile, ...]
    notes: tuple[str, ...]
    """What will not work, and why."""


def plan(config_file: Path | None, user: str | None, program: Program, root: Path) -> InstallPlan:
    """Return the files of a configuration's service.

    Args:
        config_file: copied to /etc; None: the file named by the installed unit, unchanged.
        user: user of the service; None: the installed unit's user, else ``USER``.
        program: command of the service.
        root: root of the target system.

    Raises:
        NotFoundError: no configuration was given and none is installed.
        ConfigError: the configuration is invalid.
        InputError: systemd could not use the user's name or one of the paths; or the service of the running system
            could not access the program.
    """
    user = user_name((installed_user(root) or USER) if user is None else user)
    hidden = temporary(program)
    if hidden is not None and root == Path("/"):
        raise InputError(hidden)
    source = config_file or installed_config(root) or below(root, CONFIG)
    if config_file is None and not source.is_file():
        raise NotFoundError(f"{source}: no configuration is installed; pass the robot's with --config FILE")
    config, tree = load_truck(source)
    if "sim" in tree.data:
        raise ConfigError(f"{source}: sim: is a simulated robot; a service drives a real one")
    installed, copies = _placed(tree.files, tree.maps, below(root, FOLDER))
    return InstallPlan(
        (
            *copies,
            PlannedFile(SYSUSERS, filled("sysusers.conf", {"user": user})),
            PlannedFile(TMPFILES, filled("tmpfiles.conf", {"user": user})),
            PlannedFile(MODULES, filled("modules-load.conf", {})),
            PlannedFile(RULES, rules_text(config)),
            PlannedFile(UNIT, unit_text(config, installed, user, program)),
            PlannedFile(ENABLED, target=UNIT),
        ),
        (*_notes(config), *([hidden] if hidden is not None else ())),
    )


def installed_config(root: Path) -> Path | None:
    """Return the installed unit's configuration, or the default one without a unit; None if that is missing too.

    A file named by the unit is returned even if it does not exist.
    """
    unit = text_of(below(root, UNIT)) or ""
    named = re.search(r"^ExecStart=.* --config (/\S+)$", unit, re.MULTILINE)
    file = below(root, Path(named[1]) if named is not None else CONFIG)
    return file if named is not None or file.is_file() else None


def installed_user(root: Path) -> str | None:
    """Return the user of the installed unit."""
    named = re.search(r"^User=(\S+)$", text_of(below(root, UNIT)) or "", re.MULTILINE)
    return None if named is None else named[1]


def below(root: Path, path: Path) -> Path:
    """Return the place of an absolute path in the system below ``root``."""
    return root / path.relative_to("/")


def _placed(files: Sequence[Path], maps: Sequence[Path], folder: Path) -> tuple[Path, tuple[PlannedFile, ...]]:
    """Return the place of the configuration, and the files to copy there; relative places stay the same.

    Args:
        files: files of the configuration, its own first; files with absolute paths stay in place.
        maps: maps that it names.
        folder: folder of installed configurations.

    Raises:
        InputError: a map cannot be read.
    """
    source = files[0]
    if source.is_relative_to(folder.resolve()):
        return FOLDER / source.relative_to(folder.resolve()), ()
    of_maps = {place: files_of(place) for place in maps}
    common = Path(os.path.commonpath([file.parent for file in (*files, *maps, *itertools.chain(*of_maps.values()))]))
    copies = [
        PlannedFile(FOLDER / file.relative_to(common), file.read_text(encoding="utf-8"), keep_previous=True)
        for file in dict.fromkeys(files)
    ]
    for place, parts in of_maps.items():
        saved = parts[0].parent
        numbered = saved.parent.name == SAVES and saved.is_relative_to(place)
        there = _save_name(saved, folder / place.relative_to(common) / SAVES) if numbered else ""
        for file in parts:
            name = place / SAVES / there / file.name if numbered else file
            copies.append(PlannedFile(FOLDER / name.relative_to(common), data=file.read_bytes()))
    return copies[0].path, tuple(copies)


def _save_name(saved: Path, saves: Path) -> str:
    """Return the number of a save at its installation: above the installed numbers, because the latest is read."""
    newest = next(iter(numbered_saves(saves)), None) if saves.is_dir() else None
    if newest is None:
        return saved.name
    manifest = newest / MANIFEST
    if manifest.is_file() and manifest.read_bytes() == (saved / MANIFEST).read_bytes():
        return newest.name
    return f"{max(int(newest.name) + 1, int(saved.name)):06d}"


def _notes(config: TruckConfig) -> list[str]:
    notes = [
        f"devices.{role}.port: {device.port.path} is not created by any udev rule; set hub and port: "
        f"monstertruckd find-port {role}"
        for role, device in config.devices.present().items()
        if isinstance(device.port, PortConfig) and device.port.path.is_relative_to(LINKS)
    ]
    if config.usb.power.method is CycleMethod.UHUBCTL:
        notes.append(
            "usb.power.method: uhubctl needs raw access to the hubs, which the service does not have; use port"
        )
    return notes
