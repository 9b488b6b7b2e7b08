"""``monstertruckd doctor``."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, robot_on_host
from monstertruckd.tools.cli.connection import robot_config
from monstertruckd.tools.cli.options import EndpointOption, RobotOption, bundled, complete_config
from monstertruckd.tools.cli.output import JsonOption, console, finish, print_json, remark

if TYPE_CHECKING:
    from collections.abc import Callable

    from monstertruck_runtime.clock import Clock
    from monstertruckd.tools.doctor.context import Finding

CLEAR = (
    "The robot is about to drive 20 cm ahead and back. Is there half a metre of free space all around, and a "
    "person at the switch?"
)
STYLES = {"ok": "green", "warn": "yellow", "fail": "bold red"}


def doctor(
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            "-c",
            help="Configuration of the robot; default: the installed service's.",
            autocompletion=complete_config,
            callback=bundled,
        ),
    ] = None,
    root: Annotated[Path, typer.Option("--root", help="Check the system below this folder instead.")] = Path("/"),
    fix: Annotated[bool, typer.Option("--fix", help="Run the safe repair commands, asking before each.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="With --fix and --drive: do not ask.")] = False,
    drive: Annotated[
        bool,
        typer.Option("--drive", help="Drive 20 cm ahead and back, after asking, to find sensors with a wrong sign."),
    ] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Check the computer: software, service, rights, cables, devices, clock, disk, network.

    Every finding names the command that fixes it. The exit code is that of the first failure; warnings give 0. With
    --drive the daemon must be running, because the drive goes through its gate.
    """
    from monstertruck_runtime.clock import run_wall
    from monstertruckd.tools.doctor import examine
    from monstertruckd.tools.doctor.context import first_failure, inspect
    from monstertruckd.tools.install.files import Program

    async def all_findings(clock: "Clock") -> "list[Finding]":
        context = inspect(root, Program.present(), config, os.getuid(), clock)
        found = await examine(context)
        return found + (await _drive(robot, endpoint, clock, context.command) if drive else [])

    if drive:
        remark(f"robot: {robot_on_host(robot, endpoint)}")
    if drive and not (yes or typer.confirm(CLEAR, err=True)):
        drive = False
    findings = run_wall(all_findings)
    reason = first_failure(findings)
    if json_output:
        print_json({"reason": reason, "findings": findings})
    else:
        _print(findings)
    if fix:
        _mend(findings, yes=yes)
    finish(reason, f"not ready to drive: {reason.text}")


async def _drive(robot: str, endpoint: str, clock: "Clock", command: "Callable[..., str]") -> "list[Finding]":
    """Findings of a test drive through the daemon's gate."""
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.errors import TruckError
    from monstertruckd.tools.calibrate.motion import Mover
    from monstertruckd.tools.doctor.context import fail
    from monstertruckd.tools.doctor.drive import signs

    try:
        async with TruckClient(robot, endpoint, clock=clock, timeout=10.0) as client:
            config = await robot_config(client)
            mover = Mover(client, clock, config.chassis())
            return await signs(lambda step: mover.move(step, lambda *_: None), config, command)
    except TruckError as error:
        return [fail("signs", error.reason, str(error))]


def _mend(findings: "Sequence[Finding]", *, yes: bool) -> None:
    """Run the safe repair commands one by one."""
    import subprocess

    from monstertruckd.tools.doctor.context import Level, safe_fix

    for finding in findings:
        if finding.level is Level.OK or (arguments := safe_fix(finding.fix)) is None:
            continue
        if not (yes or typer.confirm(f"{finding.check}: run {finding.fix}?", err=True)):
            continue
        code = subprocess.run(arguments, check=False).returncode  # noqa: S603  # from our list of commands
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
