"""Commands of the service: install it into systemd and udev, and remove it."""

import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from monstertruck_runtime.errors import NotPermittedError
from monstertruckd.tools.cli.options import bundled, complete_config
from monstertruckd.tools.cli.output import JsonOption, print_json, remark

if TYPE_CHECKING:
    from monstertruckd.tools.install.apply import InstallReport

T = TypeVar("T")

RootOption = Annotated[
    Path, typer.Option("--root", help="Root folder to install into instead of this system; then no program is run.")
]
DryOption = Annotated[bool, typer.Option("--dry-run", help="Only print the actions.")]


def install_service(
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            "-c",
            help="Configuration of the robot, copied to /etc/monstertruckd; default: the installed one.",
            autocompletion=complete_config,
            callback=bundled,
        ),
    ] = None,
    user: Annotated[
        str | None,
        typer.Option(
            help="User that runs the service, created if missing. Default: the installed service's, or monstertruckd."
        ),
    ] = None,
    start: Annotated[bool, typer.Option("--start", help="Also start or restart the service.")] = False,
    upgrade: Annotated[
        bool,
        typer.Option(
            "--upgrade",
            help="Install this version; the installed one is restored if it does not become ready. Refused "
            "while the robot is armed.",
        ),
    ] = False,
    dry_run: DryOption = False,
    root: RootOption = Path("/"),
    json_output: JsonOption = False,
) -> None:
    """Make the daemon a service: unit, user, udev rules and configuration; again as often as you like.

    Needs root, and no network. The service starts with the computer from then on.
    """
    from monstertruckd.tools.install.apply import install, run_command, runs_here
    from monstertruckd.tools.install.files import Program
    from monstertruckd.tools.install.plan import RESTART, plan
    from monstertruckd.tools.install.upgrade import upgrade as upgrade_service

    planned = plan(config, user, Program.present(), root)
    if upgrade:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a lost connection of the operator's must not leave it half done
        report = _as_root(lambda: upgrade_service(planned, root, dry=dry_run))
    else:
        report = _as_root(lambda: install(planned, root, dry=dry_run))
    if start and not upgrade:
        report.commands.append(RESTART)
        if not dry_run:
            _as_root(lambda: run_command(RESTART))
    _print(report, planned.notes, dry=dry_run, json_output=json_output)
    if not (start or upgrade or dry_run) and report.changed and runs_here(root):
        remark(f"to use it now: sudo {shlex.join(RESTART)}")


def uninstall_service(
    dry_run: DryOption = False, root: RootOption = Path("/"), json_output: JsonOption = False
) -> None:
    """Stop and remove the service; configuration, logs, state and the user stay."""
    from monstertruckd.tools.install.apply import uninstall

    report = _as_root(lambda: uninstall(root, dry=dry_run))
    _print(report, (), dry=dry_run, json_output=json_output)


def _as_root(action: Callable[[], T]) -> T:
    """Do it, or print the command for a user with the rights."""
    try:
        return action()
    except NotPermittedError as error:
        again = shlex.join(["sudo", sys.executable, "-m", "monstertruckd", *sys.argv[1:]])
        raise NotPermittedError(f"{error}; needs root: {again}") from error


def _print(report: "InstallReport", notes: tuple[str, ...], *, dry: bool, json_output: bool) -> None:
    if json_output:
        value = {"dry_run": dry, "changed": report.changed, "notes": notes}
        files = {str(path): change for path, change in report.changes.items()}
        print_json(value | {"files": files, "previous": report.previous, "commands": report.commands})
        return
    for path, change in report.changes.items():
        print(f"{change:8} {path}")
    for path in report.previous:
        print(f"kept     {path}")
    for command in report.commands:
        print(f"run      {shlex.join(command)}")
    for note in notes:
        remark(f"note: {note}")
    if not report.changed:
        print("nothing to change")
