"""Replaces the service's version by another; the previous one is restored if the new one does not become ready."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from monstertruck_runtime.errors import BusyError, CommandFailedError, InputError, NotFoundError, TruckError
from monstertruck_runtime.small_files import replace_file
from monstertruck_schemas.state import GateMode
from monstertruckd.tools.install.apply import (
    Change,
    InstallReport,
    Run,
    as_permitted,
    install,
    place_of,
    run_command,
    runs_here,
)
from monstertruckd.tools.install.plan import AFTER_INSTALL, RESTART, SERVICE, UNIT, Command, InstallPlan

STATUS: Final[Command] = ("systemctl", "show", "--property=ActiveState,StatusText", SERVICE)
MODES: Final = {mode.value: mode for mode in GateMode}


def upgrade(plan: InstallPlan, root: Path, *, dry: bool = False, run: Run = run_command) -> InstallReport:
    """Install ``plan`` over the installed service and restart it; undo both unless it reports READY.

    The restart returns once the daemon has reported READY, as it does after its first control tick, or has failed to.

    Raises:
        InputError: the system below ``root`` is not running, or see ``install``.
        NotFoundError: no service is installed.
        BusyError: the truck is armed; nothing has been restarted.
        CommandFailedError: the new version did not become ready; the text states whether the previous one is restored.
        NotPermittedError: see ``install``.
    """
    if not runs_here(root):
        raise InputError(
            f"{root}: systemd does not run there, so the new version cannot be tested; install without --upgrade"
        )
    if not place_of(root, UNIT).is_file():
        raise NotFoundError(f"{UNIT}: no service is installed; start with install-service --config FILE --start")
    report = install(plan, root, dry=True, run=run)
    _refuse_armed(run)
    if not dry:
        changed = [path for path, change in report.changes.items() if change is not Change.SAME]
        report = _replace(plan, root, [_Before.of(place_of(root, path)) for path in changed], run)
    report.commands.append(RESTART)
    return report


@dataclass(frozen=True, slots=True)
class _Before:
    """Previous content of a file."""

    place: Path
    text: str | None
    target: Path | None

    @classmethod
    def of(cls, place: Path) -> "_Before":
        if place.is_symlink():
            return cls(place, None, place.readlink())
        return cls(place, place.read_text(encoding="utf-8") if place.exists() else None, None)

    def put_back(self) -> None:
        if self.text is not None:
            replace_file(self.place, self.text, follow_links=False)
            return
        self.place.unlink(missing_ok=True)
        if self.target is not None:
            self.place.symlink_to(self.target)


def _replace(plan: InstallPlan, root: Path, before: list[_Before], run: Run) -> InstallReport:
    try:
        report = install(plan, root, run=run)
        _refuse_armed(run)  # it may have been armed in the meantime
        run(RESTART)
    except BusyError:
        _put_back(before, run)
        raise
    except (CommandFailedError, KeyboardInterrupt) as error:
        raise CommandFailedError(f"{error}; {_go_back(before, run)}") from error
    return report


def _refuse_armed(run: Run) -> None:
    """Refuse an armed truck by the daemon's last status in systemd, at most a third of the watchdog period old.

    Raises:
        BusyError: the truck is armed, drives or is stopping.
    """
    status = dict(line.split("=", 1) for line in run(STATUS).splitlines() if "=" in line)
    mode = MODES.get(status.get("StatusText", "").split(";")[0])
    if status.get("ActiveState") == "active" and mode is not None and mode.active:
        raise BusyError(f"the robot is {mode.value}: an upgrade restarts the daemon; disarm it first")


def _put_back(before: list[_Before], run: Run) -> None:
    with as_permitted():
        for file in before:
            file.put_back()
    if before:
        for command in AFTER_INSTALL:
            run(command)


def _go_back(before: list[_Before], run: Run) -> str:
    """Run the previous version again; return the result in words."""
    if not before:
        return "no version to return to: the previous one was in the same folder"
    try:
        _put_back(before, run)
        run(RESTART)
    except TruckError as error:
        return f"the previous version does not run either: {error}"
    return "the previous version runs again"
