"""Installs a plan into a system, or removes it; steps already done are skipped."""

import os
import shlex
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Final

from monstertruck_runtime.errors import CommandFailedError, InputError, NotFoundError, NotPermittedError
from monstertruck_runtime.small_files import make_folder, remove_file, replace_file
from monstertruckd.tools.install.plan import (
    AFTER_INSTALL,
    AFTER_REMOVAL,
    BEFORE_REMOVAL,
    ENABLED,
    FOLDER,
    MODULES,
    RULES,
    SERVICE,
    SYSUSERS,
    TMPFILES,
    UNIT,
    Command,
    InstallPlan,
    PlannedFile,
    below,
)

UNFINISHED: Final = FOLDER / ".unfinished"
"""There while an installation is under way: if it breaks off, the next one notifies the programs all the same."""
BOOTED: Final = Path("/run/systemd/system")
"""There while systemd runs, see sd_booted(3)."""
FILES: Final = (ENABLED, UNIT, RULES, MODULES, TMPFILES, SYSUSERS)
"""Removed files; configuration, logs, state and the user stay."""


class Change(StrEnum):
    """Action on a file."""

    NEW = "new"
    CHANGED = "changed"
    SAME = "same"
    REMOVED = "removed"
    MASKED = "masked"
    """A link to /dev/null is in its place: it was masked."""


@dataclass(slots=True)
class InstallReport:
    """Actions done or planned."""

    changes: dict[Path, Change] = field(default_factory=dict)
    commands: list[Command] = field(default_factory=list)
    previous: list[Path] = field(default_factory=list)
    """Copies of replaced configurations."""

    @property
    def changed(self) -> bool:
        """Whether anything is or would be different."""
        return bool(self.commands) or any(change is not Change.SAME for change in self.changes.values())


Run = Callable[[Sequence[str]], str]


def run_command(arguments: Sequence[str]) -> str:
    """Run a system program without a shell; return its standard output.

    Raises:
        NotFoundError: it does not exist.
        CommandFailedError: the program failed; the error contains its output.
    """
    try:
        done = subprocess.run(arguments, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)  # noqa: S603
    except FileNotFoundError:
        raise NotFoundError(f"{arguments[0]}: no such program; a service needs systemd and udev") from None
    if done.returncode:
        said = (done.stderr or done.stdout).strip() or f"ended with {done.returncode}"
        raise CommandFailedError(f"{' '.join(arguments)}: {said}")
    return done.stdout


def runs_here(root: Path) -> bool:
    """Return whether systemd runs the system below ``root``: it is not an image, a chroot or a container."""
    return root == Path("/") and below(root, BOOTED).is_dir()


def install(plan: InstallPlan, root: Path, *, dry: bool = False, run: Run = run_command) -> InstallReport:
    """Write changed files, then notify the running system; an image that is not running is only written.

    Raises:
        InputError: a file is masked, not a regular file, or behind a link out of ``root``; nothing has been written.
        NotPermittedError: no permission to write there.
        NotFoundError, CommandFailedError: see ``run_command``; running it again continues from there.
    """
    report = InstallReport({file.path: _change(root, file) for file in plan.files})
    unfinished = below(root, UNFINISHED)
    here = runs_here(root)
    if here and (unfinished.exists() or report.changed):
        report.commands += AFTER_INSTALL
    if dry or not report.changed:
        return report
    _refuse_masked(root, report)
    with as_permitted():
        if here:
            make_folder(unfinished.parent)
            replace_file(unfinished, "", follow_links=False)
        for file in plan.files:
            if report.changes[file.path] is not Change.SAME:
                _write(root, file, report)
        for command in report.commands:
            run(command)
        remove_file(unfinished)
    return report


def uninstall(root: Path, *, dry: bool = False, run: Run = run_command) -> InstallReport:
    """Stop the service and remove its files.

    Raises:
        InputError: a file is behind a link out of ``root``.
        NotPermittedError: no permission.
        NotFoundError, CommandFailedError: see ``run_command``.
    """
    report = InstallReport({path: Change.REMOVED for path in FILES if os.path.lexists(place_of(root, path))})
    here = runs_here(root) and report.changed
    before = BEFORE_REMOVAL if here and UNIT in report.changes else ()
    after = AFTER_REMOVAL if here else ()
    report.commands = [*before, *after]
    if dry:
        return report
    with as_permitted():
        for command in before:
            run(command)
        for path in report.changes:
            below(root, path).unlink()
        for command in after:
            run(command)
    return report


def place_of(root: Path, path: Path) -> Path:
    """Path of a system file below ``root``.

    Raises:
        InputError: a link on the way there leads out of ``root``.
    """
    place = below(root, path)
    folder = place.parent.resolve()
    if not folder.is_relative_to(root.resolve()):
        raise InputError(
            f"{place}: would be in {folder}, outside {root}; replace the link on its path by a relative one"
        )
    return place


def _change(root: Path, file: PlannedFile) -> Change:
    place = place_of(root, file.path)
    if not os.path.lexists(place):
        return Change.NEW
    if place.is_symlink() and os.path.normpath(file.path.parent / place.readlink()) == os.devnull:
        return Change.MASKED
    if not (place.is_symlink() or place.is_file()):
        raise InputError(f"{place}: expected a file; move the existing one away")
    if file.target is not None:
        return Change.SAME if place.is_symlink() and place.readlink() == file.target else Change.CHANGED
    return Change.SAME if not place.is_symlink() and place.read_bytes() == file.content else Change.CHANGED


def _refuse_masked(root: Path, report: InstallReport) -> None:
    for path, change in report.changes.items():
        if change is Change.MASKED:
            elsewhere = [] if root == Path("/") else [f"--root={root}"]
            unit = path == UNIT
            mend = ["systemctl", *elsewhere, "unmask", SERVICE] if unit else ["rm", str(below(root, path))]
            raise InputError(f"{path}: is masked by a link to {os.devnull}; unmask it: {shlex.join(mend)}")


def _write(root: Path, file: PlannedFile, report: InstallReport) -> None:
    place = place_of(root, file.path)
    make_folder(place.parent)
    if file.target is not None:
        place.unlink(missing_ok=True)
        place.symlink_to(file.target)
        return
    # The file behind a link stays where it is anyway.
    if file.keep_previous and report.changes[file.path] is Change.CHANGED and not place.is_symlink():
        report.previous.append(file.path.with_name(_keep(place).name))
    replace_file(place, file.content, follow_links=False)


def _keep(place: Path) -> Path:
    """Add a second name, with a ~, under which the file remains when it is replaced; the first name always exists."""
    previous = place.with_name(f"{place.name}~")
    if previous.is_symlink() or not previous.is_file() or previous.read_bytes() != place.read_bytes():
        previous.unlink(missing_ok=True)
        previous.hardlink_to(place)
    return previous


@contextmanager
def as_permitted() -> Iterator[None]:
    """Convert a refused write.

    Raises:
        NotPermittedError: no permission to write there.
    """
    try:
        yield
    except PermissionError as error:
        raise NotPermittedError(f"{error.filename}: {error.strerror}") from error
