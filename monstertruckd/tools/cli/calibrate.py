"""``monstertruckd calibrate``: the wizards, what they found so far, and the way back."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, robot_on_host
from monstertruckd.tools.cli.connection import robot_config, with_robot
from monstertruckd.tools.cli.options import EndpointOption, RobotOption, complete_config, with_parameters
from monstertruckd.tools.cli.output import (
    JsonOption,
    command_group,
    needs_extra,
    on_terminal,
    print_json,
    print_table,
    remark,
    wrapped,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.config.calibration import CalibrationFile, CalibrationStore, Estimate, Result, WizardName
    from monstertruckd.config.truck import TruckConfig
    from monstertruckd.tools.calibrate.sequence import SequenceStep
    from monstertruckd.tools.calibrate.steps import Panel
    from monstertruckd.tools.calibrate.wizard import Wizard

app = command_group("Calibrate this robot: guided, step by step; Ctrl-C gives up at any step.")

TIMEOUT: Final = 10.0
"""Seconds to wait for the link and for answers."""

WIZARDS: "dict[str, Callable[..., Wizard]]" = {}
"""What makes each from the options of its command, by name."""

YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Answer yes wherever something is to be done.")]
AnswerOption = Annotated[
    list[str] | None,
    typer.Option("--answer", "-a", metavar="NAME=VALUE", help="Answer beforehand; repeated in the order of asking."),
]
UndoOption = Annotated[bool, typer.Option("--undo", help="Go back to what held before the last run; twice is redo.")]
FileOption = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help="With --undo and show: this configuration's files, without a daemon.",
        autocompletion=complete_config,
    ),
]  # fmt: skip


@dataclass(frozen=True)
class _Call:
    """Options of every wizard's command."""

    robot: str
    endpoint: str
    config: Path | None = None
    json_output: bool = False


def _wizard(make: "Callable[..., Wizard]") -> "Callable[..., Wizard]":
    """Add a command that has the wizard's own options, which ``make`` takes, and those that all share."""

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

        wizard, call = make(**own), _Call(robot, endpoint, config, json_output)
        if undo:
            _undo(wizard.name, call)
            return
        with TerminalPanel(answer or [], yes=yes) as panel:
            _run(wizard, call, panel)

    WIZARDS[make.__name__] = make
    app.command(make.__name__)(with_parameters(command, make, command))
    return make


@_wizard
def drive(
    runs: Annotated[int, typer.Option(min=3, max=50, help="Taped runs.")] = 4,
    metres: Annotated[float, typer.Option(min=0.5, max=20, help="Length of a run.")] = 2.0,
    tape_error: Annotated[float, typer.Option(min=0.1, max=50, help="Standard error of one tape reading, mm.")] = 2.0,
    sign_only: Annotated[bool, typer.Option("--sign-only", help="End once it is clear where forward is.")] = False,
) -> "Wizard":
    """Which way is forward, and how far a turn of the motor goes: runs along a tape.

    Asks `clear`, `forward` and, for each run, `mark` and `distance` (m), and without a compass `straight` (yes or no).
    """
    from monstertruckd.tools.calibrate.drive import DriveWizard

    return DriveWizard(runs, metres, tape_error / 1000, sign_only=sign_only)


@_wizard
def steering(
    rough: Annotated[
        bool, typer.Option("--rough", help="Directions and a first centre: before the compass is calibrated.")
    ] = False,
    strings: Annotated[int, typer.Option(min=0, max=20, help="Straight runs along a string; 0 = there is none.")] = 3,
    string_error: Annotated[
        float, typer.Option(min=0.5, max=50, help="Standard error of the string's direction, mm per m.")
    ] = 3.5,
) -> "Wizard":
    """Centre, direction, travel and pulse map of both axles: arcs, circles, and straights along a string.

    Asks `clear` and, for each string, `string` and `offset` (cm).
    """
    from monstertruckd.tools.calibrate.steering import SteeringWizard

    return SteeringWizard(rough, strings, string_error / 1000)


@_wizard
def compass() -> "Wizard":
    """The robot's own magnetism, hard and soft iron: a circle forward and back. Asks `clear`."""
    from monstertruckd.tools.calibrate.compass import CompassWizard

    return CompassWizard()


@_wizard
def battery(
    meter_error: Annotated[float, typer.Option(min=0, max=10, help="Proportional error of the meter, percent.")] = 0.5,
    meter_digits: Annotated[float, typer.Option(min=0, max=1, help="Constant error of the meter, V.")] = 0.02,
    fresh: Annotated[bool, typer.Option("--fresh", help="Forget the readings of earlier runs.")] = False,
) -> "Wizard":
    """Scale of the battery voltage from a multimeter; nothing moves.

    Asks `meter` (V) and `another` (yes or no), until that is no.
    """
    from monstertruckd.tools.calibrate.battery import BatteryWizard

    return BatteryWizard(meter_error / 100, meter_digits, fresh=fresh)


@_wizard
def odometry(
    rounds: Annotated[int, typer.Option(min=1, max=10, help="Squares to each side.")] = 1,
    side: Annotated[float, typer.Option(min=0.5, max=10, help="Straight part of a side, m.")] = 1.5,
    tape_error: Annotated[float, typer.Option(min=0.1, max=50, help="Standard error of one tape reading, mm.")] = 2.0,
    string_error: Annotated[
        float, typer.Option(min=0.5, max=50, help="Standard error of the string's direction, mm per m.")
    ] = 3.5,
) -> "Wizard":
    """Distance scale, wheelbase and steering offset of dead reckoning: squares driven to both sides.

    Asks `clear` and, for each square, `mark`, `side` (m), `ahead` and `left` (cm).
    """
    from monstertruckd.tools.calibrate.odometry import OdometryWizard

    return OdometryWizard(rounds, side, tape_error / 1000, string_error / 1000)


@_wizard
def lidar(
    rounds: Annotated[int, typer.Option(min=1, max=10, help="Full circles to each side, in quarters.")] = 1,
    heights: Annotated[bool, typer.Option("--heights", help="Ask for the beam's heights: pitch and roll.")] = False,
    tape_error: Annotated[float, typer.Option(min=0.1, max=50, help="Standard error of a height, mm.")] = 2.0,
) -> "Wizard":
    """Where the lidar sits on the body, and its clock against odometry's: quarter circles and straights.

    Asks with heights `centre`, `ahead` and `left` (cm), and `clear`.
    """
    from monstertruckd.tools.calibrate.lidar import LidarWizard

    return LidarWizard(rounds, heights, tape_error / 1000)


@_wizard
def imu(
    rounds: Annotated[int, typer.Option(min=1, max=10, help="Full circles to each side.")] = 2,
    still: Annotated[bool, typer.Option("--still", help="Biases only: nothing moves, the scale stays.")] = False,
) -> "Wizard":
    """Biases of the inertial unit at rest, and the scale of its yaw rate from full circles. Asks `clear`."""
    from monstertruckd.tools.calibrate.imu import ImuWizard

    return ImuWizard(rounds, turns=not still)


@_wizard
def slip(
    by: Annotated[str, typer.Option(help="What says where the robot is: stand, or pose (in its map).")] = "stand",
    rounds: Annotated[int, typer.Option(min=1, max=20, help="Times that each arc is driven to and fro.")] = 2,
) -> "Wizard":
    """Turning centres and wheels of a skid-steer body: arcs seen by a test stand, or in the map. Asks `clear`."""
    from monstertruck_runtime.errors import InputError
    from monstertruckd.tools.calibrate.slip import OBSERVERS, SlipWizard

    if by not in OBSERVERS:
        raise InputError(f"--by {by}: expected one of {', '.join(OBSERVERS)}")
    return SlipWizard("pose" if by == "pose" else "stand", rounds)


@_wizard
def sonar(
    turn: Annotated[float, typer.Option(min=190, max=720, help="Turn of each arc, degrees.")] = 360.0,
    tape_error: Annotated[float, typer.Option(min=0.1, max=50, help="Standard error of the distance, mm.")] = 2.0,
) -> "Wizard":
    """Where the sonars sit and look, their cones, and the speed of sound: arcs beside a flat wall.

    Asks `park`, `wall` (m) and `clear`.
    """
    import math

    from monstertruckd.tools.calibrate.sonar import SonarWizard

    return SonarWizard(math.radians(turn), tape_error=tape_error / 1000)


@_wizard
def stabiliser(
    tape_error: Annotated[float, typer.Option(min=0.1, max=50, help="Standard error of a height, mm.")] = 2.0,
) -> "Wizard":
    """Zero and direction of both servos below the lidar: heights of its beam, then blocks under the wheels.

    Nothing drives. Asks `level`, `centre`, `ahead`, `left` (cm), `nose` and `side`.
    """
    from monstertruckd.tools.calibrate.stabiliser import StabiliserWizard

    return StabiliserWizard(tape_error / 1000)


@_wizard
def camera(
    columns: Annotated[int, typer.Option(min=4, max=30, help="Squares of the board, across.")] = 8,
    rows: Annotated[int, typer.Option(min=4, max=30, help="Squares of the board, down.")] = 6,
    square: Annotated[float, typer.Option(min=5, max=1000, help="Side of a square as printed, mm.")] = 40.0,
    marker: Annotated[float, typer.Option(min=4, max=1000, help="Side of a marker as printed, mm.")] = 30.0,
    lens_only: Annotated[bool, typer.Option("--lens-only", help="Calibrate the lens only, not the mount.")] = False,
    patience: Annotated[float, typer.Option(min=5, max=3600, help="Seconds without anything new that end it.")] = 60.0,
) -> "Wizard":
    """Lens of the camera, and where it sits against the lidar: a printed board held before both.

    Nothing drives. Asks `board`; `stand print` makes the board.
    """
    from monstertruck_runtime.errors import InputError
    from monstertruck_schemas.board import BoardConfig

    if marker >= square:
        raise InputError(f"--marker {marker:g}: expected less than --square {square:g}, in which it lies")
    with needs_extra("vision"):
        from monstertruckd.tools.calibrate.camera import CameraWizard

    board = BoardConfig(columns=columns, rows=rows, square=square / 1000, marker=marker / 1000)
    return CameraWizard(board, lidar=not lens_only, patience=patience)


@app.command("all")
def all_(
    *,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only print what is still to be done.")] = False,
    yes: YesOption = False,
    answer: AnswerOption = None,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
) -> None:
    """Every wizard that this robot still needs, in order; what is fresh is skipped.

    Without a stabiliser, which has its own wizard, the lidar's asks the heights of the beam, too.

    After each, restart the daemon: this command waits for it and goes on. Ended half-way, it begins with what is left.
    """
    from monstertruck_runtime.clock import run_wall
    from monstertruckd.tools.cli.calibrate_panel import TerminalPanel

    call = _Call(robot, endpoint)
    with TerminalPanel(answer or [], yes=yes) as panel:
        while True:
            steps, waiting = run_wall(lambda clock: _steps_left(call, clock))
            if dry_run or not steps:
                names = ", ".join(f"{step.name}{' (first look)' if step.rough else ''}" for step in steps)
                print(f"still to be calibrated: {names}" if names else "everything is calibrated, nothing expired")
                return
            if waiting:
                remark(
                    "restart the daemon, so that what was measured counts; this command goes on then (Ctrl-C ends it)"
                )
                run_wall(lambda clock: _until_restarted(call, clock))
                continue
            _run(wizard_of(steps[0]), call, panel)


def wizard_of(step: "SequenceStep") -> "Wizard":
    """The wizard of a step of ``calibrate all``, with its own defaults."""
    if step.name == "drive":
        return drive(sign_only=step.rough)
    if step.name == "steering":
        return steering(rough=step.rough)
    if step.name == "lidar":
        return lidar(heights=step.heights)
    return WIZARDS[step.name]()


async def _steps_left(call: _Call, clock: "Clock") -> "tuple[list[SequenceStep], bool]":
    """Steps that are still to be done, and whether the daemon runs on an older calibration than there is."""
    from monstertruck_schemas.topics import CALIBRATION
    from monstertruckd.config.calibration_rpc import SHOW
    from monstertruckd.tools.calibrate.sequence import missing

    async with _client(call.robot, call.endpoint, clock) as client:
        config = await robot_config(client)
        state = await client.call(SHOW)
        health = await client.get_retained(CALIBRATION)
    file = _file(state)
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
            pass  # it is being restarted
        await clock.sleep(1.0)


@app.command()
def show(
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    config: FileOption = None,
    json_output: JsonOption = False,
) -> None:
    """Print what was calibrated, when, how well, and which file the daemon runs on."""
    from monstertruckd.config.calibration import unused
    from monstertruckd.config.calibration_rpc import SHOW

    if config is not None:
        loaded, store = _store(config)
        newest, file = store.newest(), store.current()
        left = [] if file is None else unused(loaded, file.results.values())
        state: dict[str, Any] = {"folder": str(store.folder), "newest": newest, "content": file, "unused": left}
    else:
        state = with_robot(lambda client, _: client.call(SHOW), robot, endpoint, TIMEOUT)
        file = _file(state)
    if json_output:
        print_json(state)
        return
    if file is None:
        remark(f"nothing calibrated yet: no file in {state['folder']}")
        return
    for result in file.results.values():
        _print(result)
    remark(f"file: {state['newest']} ({file.change})")
    if keys := state.get("unused"):
        remark(f"not used, as the configuration has no such part: {', '.join(keys)}")
    if "loaded" in state and state["loaded"] != state["newest"]:
        remark(f"the daemon still runs on {state['loaded'] or 'no calibration'}: restart it")


def _run(wizard: "Wizard", call: _Call, panel: "Panel") -> None:
    from monstertruck_runtime.clock import run_wall

    result, file = run_wall(lambda clock: _run_wizard(wizard, call, clock, panel))
    if call.json_output:
        print_json({"result": result, "file": file})
    else:
        _print(result)
    remark(f"saved in {file}; it counts from the next start of the daemon")
    if result.again is not None:
        remark(f"next: {result.again}")


async def _run_wizard(wizard: "Wizard", call: _Call, clock: "Clock", panel: "Panel") -> "tuple[Result, str]":
    from monstertruckd.config.calibration_rpc import SHOW
    from monstertruckd.tools.calibrate.wizard import calibrate

    async with _client(call.robot, call.endpoint, clock) as client:
        remark(f"robot: {robot_on_host(call.robot, call.endpoint)}")
        config = await robot_config(client)
        file = _file(await client.call(SHOW))
        known = {} if file is None else file.results
        return await calibrate(wizard, client, panel, clock, config, known)


def _undo(name: "WizardName", call: _Call) -> None:
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
            TIMEOUT,
        )["file"]
    if call.json_output:
        print_json({"file": file})
    remark(f"{name}: as before, in {file}; it counts from the next start of the daemon")


def _client(robot: str, endpoint: str, clock: "Clock") -> "TruckClient":
    from monstertruck_runtime.client import TruckClient

    return TruckClient(robot, endpoint, clock=clock, timeout=TIMEOUT)


def _store(config: Path) -> "tuple[TruckConfig, CalibrationStore]":
    """The configuration without calibration, and where its robot's calibration is."""
    from monstertruckd.config.calibration import CalibrationStore
    from monstertruckd.config.load import load_config
    from monstertruckd.config.truck import TruckConfig

    loaded, _ = load_config(config, TruckConfig)
    return loaded, CalibrationStore(loaded.calibration_folder, loaded.robot)


def _file(state: dict[str, Any]) -> "CalibrationFile | None":
    """The newest file of a robot that answers with ``state``."""
    import json

    from monstertruckd.config.calibration import CalibrationFile

    content = state["content"]
    return None if content is None else CalibrationFile.model_validate_json(json.dumps(content))


def _print(result: "Result") -> None:
    """A table in a pipe; on a terminal a line for each value, and what it means below."""
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
        remark(f"not seen: {missing}")


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
    """The value with half its interval, to two digits of that."""
    value, low, high = estimate.value, estimate.low, estimate.high
    if isinstance(value, bool) or low is None or high is None:
        return f"{value:.5g}" if isinstance(value, float) else str(value).lower()
    import math

    half = (high - low) / 2
    digits = max(0, 1 - math.floor(math.log10(half))) if half > 0 else 3
    return f"{value:.{digits}f} ± {half:.{digits}f}"
