"""``monstertruckd doctor``."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruckd.tools.cli.options import complete_config
from monstertruckd.tools.cli.output import JsonOption, console, finish, print_json, remark

if TYPE_CHECKING:
    from monstertruckd.tools.doctor.context import Finding

STYLES = {"ok": "green", "warn": "yellow", "fail": "bold red"}


def doctor(
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            "-c",
            help="Configuration of the truck; default: the installed service's.",
            autocompletion=complete_config,
        ),
    ] = None,
    root: Annotated[Path, typer.Option("--root", help="Look at the system in this folder instead.")] = Path("/"),
    fix: Annotated[
        bool, typer.Option("--fix", help="Run the safe ones of the commands that fix something, each after asking.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="With --fix: without asking.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Check the computer: software, service, rights, cables, devices, clock, disk, network.

    Every finding comes with the command that fixes it. Ends with the code of the first failure; warnings end with 0.
    """
    from monstertruck_runtime.clock import run_wall
    from monstertruckd.tools.doctor.checks import examine
    from monstertruckd.tools.doctor.context import first_failure, inspect
    from monstertruckd.tools.install.files import Program

    findings = run_wall(lambda clock: examine(inspect(root, Program.present(), config, os.getuid(), clock)))
    reason = first_failure(findings)
    if json_output:
        print_json({"reason": reason, "findings": findings})
    else:
        _print(findings)
    if fix:
        _mend(findings, yes=yes)
    finish(reason, f"not ready to drive: {reason.text}")


def _mend(findings: "Sequence[Finding]", *, yes: bool) -> None:
    """Run what mends something and can break nothing, one after the other."""
    import subprocess

    from monstertruckd.tools.doctor.context import Level, safe_fix

    for finding in findings:
        if finding.level is Level.OK or (arguments := safe_fix(finding.fix)) is None:
            continue
        if not (yes or typer.confirm(f"{finding.check}: run {finding.fix}?", err=True)):
            continue
        code = subprocess.run(arguments, check=False).returncode  # noqa: S603  # from a list of our own commands
        remark(f"{finding.check}: {'done' if code == 0 else f'ended with {code}'}; run `monstertruckd doctor` again")


def _print(findings: "Sequence[Finding]") -> None:
    from rich.text import Text

    width = max(len(finding.check) for finding in findings)
    out = console()
    for finding in findings:
        level = finding.level.value
        out.print(Text(f"{level:5}", style=STYLES[level]) + Text(f"{finding.check:{width}}  {finding.seen}", style=""))
        if finding.fix is not None and level != "ok":
            out.print(Text(f"{'':5}{'':{width}}  > {finding.fix}", style="dim"))
    counts = {level: sum(finding.level.value == level for finding in findings) for level in STYLES}
    out.print(f"{counts['ok']} fine, {counts['warn']} warnings, {counts['fail']} failures")
