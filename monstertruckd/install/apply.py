"""Puts a plan into a system, or takes it out; what is already so is left alone."""

import os
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Final

from monstertruck_runtime.errors import CommandFailedError, NotFoundError, NotPermittedError
from monstertruck_runtime.small_files import replace_file
from monstertruckd.install.configuration import FOLDER
from monstertruckd.install.plan import (
    AFTER_INSTALL,
    AFTER_REMOVAL,
    BEFORE_REMOVAL,
    ENABLED,
    MODULES,
    RULES,
    SYSUSERS,
    TMPFILES,
    UNIT,
    Command,
    Plan,
    Planned,
    below,
)

UNFINISHED: Final = FOLDER / ".unfinished"
"""There while an installation is under way: if it breaks off, the next one tells the programs all the same."""
BOOTED: Final = Path("/run/systemd/system")
"""There while systemd runs, see sd_booted(3)."""
FILES: Final = (ENABLED, UNIT, RULES, MODULES, TMPFILES, SYSUSERS)
"""What is taken out; configuration, logs, state and the user stay."""


class Change(StrEnum):
    """What becomes of a file."""

    NEW = "new"
    CHANGED = "changed"
    SAME = "same"
    REMOVED = "removed"


@dataclass(slots=True)
class Report:
    """What was done, or would be."""

    changes: dict[Path, Change] = field(default_factory=dict)
    commands: list[Command] = field(default_factory=list)
    previous: list[Path] = field(default_factory=list)
    """Where replaced configurations went."""

    @property
    def changed(self) -> bool:
        """Whether anything is or would be different."""
        return bool(self.commands) or any(change is not Change.SAME for change in self.changes.values())


Run = Callable[[Sequence[str]], None]


def run_command(arguments: Sequence[str]) -> None:
    """Run a program of the system without a shell.

    Raises:
        NotFoundError: there is none.
        CommandFailedError: it failed; the text is its own.
    """
    try:
        done = subprocess.run(arguments, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)  # noqa: S603
    except FileNotFoundError:
        raise NotFoundError(f"{arguments[0]}: no such program; a service needs systemd and udev") from None
    if done.returncode:
        said = (done.stderr or done.stdout).strip() or f"ended with {done.returncode}"
        raise CommandFailedError(f"{' '.join(arguments)}: {said}")


def runs_here(root: Path) -> bool:
    """Whether the system below ``root`` is the one that runs, by systemd: not an image, a chroot or a container."""
    return root == Path("/") and below(root, BOOTED).is_dir()


def install(plan: Plan, root: Path, *, dry: bool = False, run: Run = run_command) -> Report:
    """Write what differs, then tell the running system; one that does not run is only written.

    Raises:
        NotPermittedError: not allowed to write there.
        NotFoundError, CommandFailedError: see ``run_command``; running it again goes on from there.
    """
    report = Report({file.path: _change(root, file) for file in plan.files})
    unfinished = below(root, UNFINISHED)
    here = runs_here(root)
    if here and (unfinished.exists() or report.changed):
        report.commands += AFTER_INSTALL
    if dry or not report.changed:
        return report
    with _permission():
        if here:
            unfinished.parent.mkdir(parents=True, exist_ok=True)
            replace_file(unfinished, "")
        for file in plan.files:
            if report.changes[file.path] is not Change.SAME:
                _write(root, file, report)
        for command in report.commands:
            run(command)
        unfinished.unlink(missing_ok=True)
    return report


def uninstall(root: Path, *, dry: bool = False, run: Run = run_command) -> Report:
    """Stop the service and take its files away.

    Raises:
        NotPermittedError: not allowed to.
        NotFoundError, CommandFailedError: see ``run_command``.
    """
    report = Report({path: Change.REMOVED for path in FILES if os.path.lexists(below(root, path))})
    here = runs_here(root) and report.changed
    before = BEFORE_REMOVAL if here and UNIT in report.changes else ()
    after = AFTER_REMOVAL if here else ()
    report.commands = [*before, *after]
    if dry:
        return report
    with _permission():
        for command in before:
            run(command)
        for path in report.changes:
            below(root, path).unlink()
        for command in after:
            run(command)
    return report


def _change(root: Path, file: Planned) -> Change:
    place = below(root, file.path)
    if not os.path.lexists(place):
        return Change.NEW
    if file.target is not None:
        return Change.SAME if place.is_symlink() and place.readlink() == file.target else Change.CHANGED
    return Change.SAME if not place.is_symlink() and place.read_text(errors="replace") == file.text else Change.CHANGED


def _write(root: Path, file: Planned, report: Report) -> None:
    place = below(root, file.path)
    place.parent.mkdir(parents=True, exist_ok=True)
    if file.target is not None:
        place.unlink(missing_ok=True)
        place.symlink_to(file.target)
        return
    if file.keep_previous and report.changes[file.path] is Change.CHANGED:
        previous = place.with_name(f"{place.name}~")
        place.replace(previous)
        report.previous.append(file.path.with_name(previous.name))
    replace_file(place, file.text)


@contextmanager
def _permission() -> Iterator[None]:
    try:
        yield
    except PermissionError as error:
        raise NotPermittedError(f"{error.filename}: {error.strerror}") from error
