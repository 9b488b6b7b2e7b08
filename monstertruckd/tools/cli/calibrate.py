"""``monstertruckd calibrate``: the wizards, their results, and undo."""

import inspect
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, robot_on_host
from monstertruck_runtime.extras import needs_extra
from monstertruckd.config.wizards import WIZARDS, WizardKind, WizardOption, WizardRun
from monstertruckd.tools.cli.connection import robot_config, with_robot
from monstertruckd.tools.cli.options import EndpointOption, RobotOption, bundled, complete_config, with_parameters
from monstertruckd.tools.cli.output import (
    JsonOption,
    command_group,
    on_terminal,
    print_json,
    print_table,
    remark,
    wrapped,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.config.calibration import CalibrationFile, CalibrationStore, Estimate, Result
    from monstertruckd.config.truck import TruckConfig
    from monstertruckd.tools.calibrate.steps import Panel
    from monstertruckd.tools.calibrate.wizard import Wizard

app = command_group("Calibrate this robot with guided steps; Ctrl-C cancels any step.")

ANSWER_TIMEOUT: Final = 10.0
"""Timeout for the link and for answers (s)."""

YesOption = Annotated[
    bool, typer.Option("--yes", "-y", help="Answer yes to every question that asks whether something is done.")
]
AnswerOption = Annotated[
    list[str] | None,
    typer.Option(
        "--answer",
        "-a",
        metavar="NAME=VALUE",
        help="Answer a question in advance; repeat the option in the order of the questions.",
    ),
]
UndoOption = Annotated[
    bool, typer.Option("--undo", help="Restore the values from before the last run; a second undo redoes.")
]
FileOption = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help="With --undo and show: use this configuration's files, without a daemon.",
        autocompletion=complete_config, callback=bundled,
    ),
]  # fmt: skip


@dataclass(frozen=True)
class _Call:
    """Options common to all wizards."""

    robot: str
    endpoint: str
    config: Path | None = None
    json_output: bool = False


def _add_command(kind: WizardKind) -> None:
    """Add the command of a wizard, with its own and the common options."""

    def command(
        *,
        yes: YesOption = False,
        answer: AnswerOption = None,
        undo: UndoOption = False,
        robot: RobotOption = "truck",
        endpoint: EndpointOption = DEFAULT_ENDPOINT,
        config: FileOption = None,
        json_output: JsonOption = False,
        **own: Any,
    ) -> None:
        from monstertruckd.tools.cli.calibrate_panel import TerminalPanel

        call = _Call(robot, endpoint, config, json_output)
        if undo:
            _undo(kind.name, call)
            return
        wizard = _made(kind, own)
        with TerminalPanel(answer or [], yes=yes) as panel:
            _run(wizard, call, panel)

    def options(**_: Any) -> None:
        pass

    options.__doc__ = kind.doc
    options.__signature__ = inspect.Signature([_parameter(option) for option in kind.options])  # type: ignore[attr-defined]
    app.command(kind.name)(with_parameters(command, options, command))


def _parameter(option: WizardOption) -> inspect.Parameter:
    """Declare an option as a parameter of a command; a flag has no opposite."""
    name, kind = option.name, type(option.default)
    flags = (f"--{name.replace('_', '-')}",) if kind is bool else ()
    limits = {} if kind in (bool, str) else {"min": option.low, "max": option.high}
    annotation = Annotated[kind, typer.Option(*flags, help=option.help, **limits)]  # type: ignore[valid-type]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=option.default, annotation=annotation)


def _made(kind: WizardKind, given: "Mapping[str, Any]") -> "Wizard":
    """Create the wizard with these options.

    Raises:
        InputError: an option is not one of its choices, or options are inconsistent.
    """
    from monstertruck_runtime.errors import InputError

    for option in kind.options:
        if option.choices and given.get(option.name, option.default) not in option.choices:
            text = f"expected one of {', '.join(option.choices)}"
            raise InputError(f"--{option.name} {given[option.name]}: {text}")
    with needs_extra(kind.extra) if kind.extra is not None else nullcontext():
        wizard: Wizard = kind.make(**given)
    return wizard


for _kind in WIZARDS.values():
    _add_command(_kind)


@app.command("all")
def all_(
    *,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only print the remaining wizards.")] = False,
    yes: YesOption = False,
    answer: AnswerOption = None,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
) -> None:
    """Run every wizard that this robot still needs, in order; valid results are skipped.

    On a robot without a stabiliser the lidar wizard also asks for the heights of the beam.

    Restart the daemon after each wizard: this command waits for it and continues. If interrupted, it resumes with the
    remaining wizards.
    """
    from monstertruck_runtime.clock import run_wall
    from monstertruckd.tools.cli.calibrate_panel import TerminalPanel

    call = _Call(robot, endpoint)
    with TerminalPanel(answer or [], yes=yes) as panel:
        while True:
            steps, waiting = run_wall(lambda clock: _steps_left(call, clock))
            if dry_run or not steps:
                names = ", ".join(f"{run.name}{' (first look)' if run.step.rough else ''}" for run in steps)
                print(f"still to be calibrated: {names}" if names else "everything is calibrated, nothing expired")
                return
            if waiting:
                remark("restart the daemon to apply the measurement; this command then continues (Ctrl-C ends it)")
                run_wall(lambda clock: _until_restarted(call, clock))
                continue
            _run(wizard_of(steps[0]), call, panel)


def wizard_of(run: WizardRun, given: "Mapping[str, Any]" = MappingProxyType({})) -> "Wizard":
    """Create the wizard of a run of ``calibrate all``, with its own defaults for missing options."""
    return _made(run.wizard, {**run.step.options, **given})


async def _steps_left(call: _Call, clock: "Clock") -> "tuple[list[WizardRun], bool]":
    """Return the remaining steps, and whether the daemon uses an older calibration than the latest one."""
    from monstertruck_schemas.topics import CALIBRATION
    from monstertruckd.config.calibration_rpc import SHOW
    from monstertruckd.tools.calibrate.wizard import missing

    async with _client(call.robot, call.endpoint, clock) as client:
        config = await robot_config(client)
        state = await client.call(SHOW)
        health = await client.get_retained(CALIBRATION)
    file = file_in(state)
    results = {} if file is None else file.results
    dates = {row.wizard: row.date for row in health.wizards if row.expired} if health is not None else {}
    expired = {name for name, date in dates.items() if name in results and results[name].date == date}
    return missing(config, results, expired), state["loaded"] != state["newest"]


async def _until_restarted(call: _Call, clock: "Clock") -> None:
    from monstertruck_runtime.errors import NoAnswerError, NotFoundError

    while True:
        try:
            if not (await _steps_left(call, clock))[1]:
                return
        except (NoAnswerError, NotFoundError):
            pass  # the daemon is being restarted
        await clock.sleep(1.0)


@app.command()
def show(
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    config: FileOption = None,
    json_output: JsonOption = False,
) -> None:
    """Print all calibrations with date and quality, and the daemon's calibration file."""
    from monstertruckd.config.calibration import unused
    from monstertruckd.config.calibration_rpc import SHOW

    if config is not None:
        loaded, store = _store(config)
        newest, file = store.newest(), store.current()
        left = [] if file is None else unused(loaded, file.results.values())
        state: dict[str, Any] = {"folder": str(store.folder), "newest": newest, "content": file, "unused": left}
    else:
        state = with_robot(lambda client, _: client.call(SHOW), robot, endpoint, ANSWER_TIMEOUT, named=False)
        file = file_in(state)
    if json_output:
        print_json(state)
        return
    if (proposed := _proposed(state)) is not None:
        _print(proposed)
        remark(f"proposed, not used: {proposed.measured}; `monstertruckd calibrate accept` saves it")
    if file is None:
        remark(f"nothing calibrated yet: no file in {state['folder']}")
        return
    for result in file.results.values():
        _print(result)
    remark(f"file: {state['newest']} ({file.change})")
    if keys := state.get("unused"):
        remark(f"ignored, because the configuration has no such part: {', '.join(keys)}")
    if "loaded" in state and state["loaded"] != state["newest"]:
        remark(f"the daemon still uses {state['loaded'] or 'no calibration'}: restart it")


@app.command()
def accept(
    robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT, json_output: JsonOption = False
) -> None:
    """Save the tracker's estimate of the steering as a calibration; `calibrate show` prints it.

    The robot must be disarmed. `calibrate steering --undo` reverts it.
    """
    from monstertruck_runtime.errors import NotFoundError
    from monstertruckd.config.calibration_rpc import SAVE, SHOW

    async def save(client: "TruckClient", _: "Clock") -> "tuple[Result, str]":
        proposed = _proposed(await client.call(SHOW))
        if proposed is None:
            raise NotFoundError("no calibration is proposed: the tracker has found no significant difference")
        payload = {"result": proposed.model_dump(mode="json"), "source": client.source}
        return proposed, (await client.call(SAVE, payload))["file"]

    result, file = with_robot(save, robot, endpoint, ANSWER_TIMEOUT)
    if json_output:
        print_json({"result": result, "file": file})
    else:
        _print(result)
    remark(f"saved in {file}; the daemon applies it at its next start")


def _run(wizard: "Wizard", call: _Call, panel: "Panel") -> None:
    from monstertruck_runtime.clock import run_wall

    result, file = run_wall(lambda clock: _run_wizard(wizard, call, clock, panel))
    if call.json_output:
        print_json({"result": result, "file": file})
    else:
        _print(result)
    remark(f"saved in {file}; the daemon applies it at its next start")
    if result.again is not None:
        remark(f"next: {result.again}")


async def _run_wizard(wizard: "Wizard", call: _Call, clock: "Clock", panel: "Panel") -> "tuple[Result, str]":
    from monstertruckd.config.calibration_rpc import SHOW
    from monstertruckd.tools.calibrate.wizard import calibrate

    async with _client(call.robot, call.endpoint, clock) as client:
        remark(f"robot: {robot_on_host(call.robot, call.endpoint)}")
        config = await robot_config(client)
        file = file_in(await client.call(SHOW))
        known = {} if file is None else file.results
        return await calibrate(wizard, client, panel, clock, config, known)


def _undo(name: str, call: _Call) -> None:
    from monstertruck_runtime.clock import WallClock
    from monstertruckd.config.calibration_rpc import UNDO

    if call.config is not None:
        clock = WallClock()
        file = str(_store(call.config)[1].undo(name, clock.now() + clock.real_offset()))
    else:
        file = with_robot(
            lambda client, _: client.call(UNDO, {"wizard": name, "source": client.source}),
            call.robot,
            call.endpoint,
            ANSWER_TIMEOUT,
        )["file"]
    if call.json_output:
        print_json({"file": file})
    remark(f"{name}: previous values restored in {file}; the daemon applies them at its next start")


def _client(robot: str, endpoint: str, clock: "Clock") -> "TruckClient":
    from monstertruck_runtime.client import TruckClient

    return TruckClient(robot, endpoint, clock=clock, timeout=ANSWER_TIMEOUT)


def _store(config: Path) -> "tuple[TruckConfig, CalibrationStore]":
    """Return the uncalibrated configuration, and the folder of its robot's calibration."""
    from monstertruckd.config.calibration import CalibrationStore
    from monstertruckd.config.load import load_config
    from monstertruckd.config.truck import TruckConfig

    loaded, _ = load_config(config, TruckConfig)
    return loaded, CalibrationStore(loaded.calibration_folder, loaded.robot)


def file_in(state: dict[str, Any]) -> "CalibrationFile | None":
    """Return the latest file of a robot that answered with ``state``."""
    import json

    from monstertruckd.config.calibration import CalibrationFile

    content = state["content"]
    return None if content is None else CalibrationFile.model_validate_json(json.dumps(content))


def _proposed(state: dict[str, Any]) -> "Result | None":
    """Return the calibration proposed by a robot's tracker; older robots and files have none."""
    import json

    from monstertruckd.config.calibration import Result

    content = state.get("proposed")
    return None if content is None else Result.model_validate_json(json.dumps(content))


def _print(result: "Result") -> None:
    """Print a table in a pipe; on a terminal one line per value, with its meaning below."""
    if on_terminal(sys.stdout):
        for e in result.estimates:
            grade = f", {e.grade}" if e.grade else ""
            until = "" if e.valid_until is None else f", valid until {e.valid_until.date[:10]}"
            print(f"{result.wizard}.{e.name}: {' '.join(filter(None, (_number(e), e.unit)))}{grade}")
            text = f"{e.meaning}; {e.samples} samples, {e.date.replace('T', ' ')[:16]}{until}"
            print(wrapped(text, indent="  "))
    else:
        _print_table(result)
    for missing in result.unobserved:
        remark(f"not covered: {missing}")


def _print_table(result: "Result") -> None:
    rows = [
        (
            f"{result.wizard}.{e.name}",
            _number(e),
            e.unit,
            e.grade or "",
            str(e.samples),
            e.date.replace("T", " "),
            "" if e.valid_until is None else e.valid_until.date[:10],
            e.meaning,
        )
        for e in result.estimates
    ]
    headings = ("what", "value", "unit", "grade", "samples", "measured", "until", "meaning")
    print_table(headings, rows, right=("value", "samples"))


def _number(estimate: "Estimate") -> str:
    """Format the value with half its interval, rounded to two digits of the interval."""
    value, low, high = estimate.value, estimate.low, estimate.high
    if isinstance(value, bool) or low is None or high is None:
        return f"{value:.5g}" if isinstance(value, float) else str(value).lower()
    import math

    half = (high - low) / 2
    digits = max(0, 1 - math.floor(math.log10(half))) if half > 0 else 3
    return f"{value:.{digits}f} ± {half:.{digits}f}"
