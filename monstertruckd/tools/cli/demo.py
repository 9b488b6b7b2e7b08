"""Commands without a robot: the demo, the emulated robot, and `try`, which also serves its page."""

import itertools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_runtime.extras import needs_extra
from monstertruck_runtime.small_files import require_place
from monstertruckd.tools.cli.options import SimulatedOption, complete_config
from monstertruckd.tools.cli.output import (
    JsonOption,
    console,
    finish,
    on_terminal,
    print_json,
    print_table,
    print_words,
    remark,
    until_stopped,
)
from monstertruckd.tools.shipped import configuration, shipped

if TYPE_CHECKING:
    from monstertruck_runtime.clock import Clock, WallClock
    from monstertruckd.tools.demo.exploring import Report

DEMO_CONFIG = shipped("configs/room.yaml")
SIMULATED_CONFIG = shipped("configs/demo.yaml")


@needs_extra("sim")
def demo(
    fast: Annotated[
        bool,
        typer.Option("--fast/--real-time", help="Virtual clock (fast, reproducible) or real time, to watch."),
    ] = True,
    seed: Annotated[int | None, typer.Option(help="Seed of world and devices; default: the configuration's.")] = None,
    config: SimulatedOption = DEMO_CONFIG,
    output: Annotated[Path, typer.Option("--output", "-o", help="New folder for log, map and outputs.")] = Path(
        "runs/demo"
    ),
    film: Annotated[
        Path | None,
        typer.Option(help="On the virtual clock with engine mujoco: write an animation of the lap, FILE.gif."),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """The emulated truck maps an unknown room, finds a tag and drives home, using the real drivers, protocols and log.

    At the end it writes pictures of the map and the report of its log. `demo --config points` explores a whole flat. A
    configuration with a path is driven along it: `demo --config lap` drives a lap.
    """
    from monstertruck_runtime.clock import run_wall
    from monstertruck_schemas.reasons import Reason
    from monstertruckd.tools.demo.exploring import DONE, ExplorationSummary
    from monstertruckd.tools.demo.runs import (
        run_fast_demo,
        run_fast_exploration,
        run_wall_demo,
        run_wall_exploration,
    )
    from monstertruckd.tools.demo.summary import Summary
    from monstertruckd.tools.simulation.config import load_simulated

    simulated = load_simulated(config)
    explores = simulated.path is None and simulated.explorer is not None
    if simulated.path is None and not explores:
        raise ConfigError(
            f"{config}: path: expected a path to drive, or an explorer; `monstertruckd simulate --run "
            f"--config {config}` starts this robot without"
        )
    if film is not None and (not fast or simulated.sim.world.engine != "mujoco" or film.suffix.lower() != ".gif"):
        raise InputError(f"--film {film}: expected the virtual clock, engine mujoco, and a name.gif")
    if film is not None:
        require_place(film)
    folder = fresh(output)
    remark(f"starting the emulated robot and its daemon; log, map and outputs go to {folder}")
    screen = on_terminal(sys.stdout) and not json_output
    if not fast and (waiting := busy()):
        remark(
            f"{waiting}: late control ticks may stop the robot; `monstertruckd demo --fast` does not depend "
            "on real time"
        )
    summary: Summary | ExplorationSummary
    try:
        if explores:
            with _progress(screen=screen) as report:
                summary = (
                    run_fast_exploration(config, folder, seed, report)
                    if fast
                    else run_wall(lambda clock: run_wall_exploration(clock, config, folder, seed, report))
                )
        elif fast:
            summary = run_fast_demo(config, folder, seed, film)
        else:
            summary = run_wall(lambda clock: run_wall_demo(clock, config, folder, seed, screen=screen))
    except KeyboardInterrupt:
        remark(f"log and outputs so far: {folder}")
        raise
    if json_output:
        print_json(summary.as_json())
    else:
        _print(summary.rows(), summary.messages)
    if summary.outcome not in DONE:
        finish(summary.outcome, summary.text)
        finish(Reason.INTERNAL)


@contextmanager
def _progress(*, screen: bool) -> "Iterator[Report]":
    """Show the map of an exploration on a terminal, otherwise print lines."""
    from monstertruckd.tools.demo.picture import MapScreen

    if screen:
        with MapScreen(console()) as shown:
            yield shown
    else:
        yield lambda line, *_: remark(line)


def fresh(folder: Path) -> Path:
    """Return the first of ``folder``, ``folder-2``, ``folder-3`` ... that does not exist."""
    names = itertools.chain([folder], (folder.with_name(f"{folder.name}-{n}") for n in itertools.count(2)))
    return next(name for name in names if not name.exists())


def busy() -> str:
    """Describe the load of this computer if it exceeds its number of processors; empty otherwise."""
    load, processors = os.getloadavg()[0], os.cpu_count() or 1
    return f"this computer is busy: load {load:.1f} on {processors} processors" if load > processors else ""


def _print(rows: list[tuple[str, str]], messages: dict[str, int]) -> None:
    print_table(("topic", "messages"), [(name, str(n)) for name, n in sorted(messages.items())], right=("messages",))
    print()
    for name, value in rows:
        console().print(f"[bold]{name:20}[/bold] {value}", soft_wrap=True)


@needs_extra("sim")
def simulate(
    config: SimulatedOption = SIMULATED_CONFIG,
    robots: Annotated[
        str | None,
        typer.Option(
            metavar="A.yaml,B.yaml",
            help="Several robots in the world of the first, instead of --config.",
            show_default=False,
        ),
    ] = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="Write the simulated true poses (npz) at the end.")
    ] = None,
    run: Annotated[bool, typer.Option("--run", help="Also run the daemons of these configurations.")] = False,
    film: Annotated[
        Path | None,
        typer.Option(help="Record a run on the virtual clock instead, FILE.gif; engine mujoco.", show_default=False),
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="Length of the recording, in seconds of the run.")
    ] = 30.0,
) -> None:
    """Serve the devices of simulated robots on ptys: at their configured ports, or in a folder of this user.

    Faults are read from standard input as with `emulate`; each line starts with the role of the device, the name of the
    monitor, or `usb` (an unknown word lists the known ones). With several robots it starts with the robot's name. `room
    post X Y` puts an obstacle into the world, `room clear` removes all. `tape mark` and `tape` answer the questions of
    the calibration wizards: they measure the robot's true distance from a mark. With `--film` no device is served:
    robot and daemon run on the virtual clock for some seconds, the robot drives its path or explores, and an animation
    is written.
    """
    if film is not None:
        _film(config, film, seconds, alone=robots is None and truth is None and not run)
        return
    from monstertruckd.tools.simulation.config import load_simulated
    from monstertruckd.tools.simulation.fleet import as_fleet
    from monstertruckd.tools.simulation.simulate import serve

    if truth is not None:
        require_place(truth)

    names = [str(config)] if robots is None else robots.split(",")
    if "" in names:
        raise InputError(f"--robots {robots}: expected file names separated by commas")
    files = [configuration(Path(name)) for name in names]
    simulated = as_fleet([load_simulated(file) for file in files])
    code = 0

    async def main(clock: "Clock") -> None:
        nonlocal code
        code = await serve(clock, simulated, print_words, truth, files if run else ())

    until_stopped(main)
    if code:
        raise typer.Exit(code)


def _film(config: Path, film: Path, seconds: float, *, alone: bool) -> None:
    """Record one robot.

    Raises:
        InputError: an option cannot be combined with ``--film``.
    """
    from monstertruckd.tools.demo.runs import run_film
    from monstertruckd.tools.simulation.config import load_simulated

    if not alone or load_simulated(config).sim.world.engine != "mujoco" or film.suffix.lower() != ".gif":
        raise InputError(f"--film {film}: expected engine mujoco, a name.gif, and no --robots, --truth or --run")
    require_place(film)
    run_film(config, film, seconds)
    remark(f"wrote {seconds:g} s to {film}")


@needs_extra("sim")
@needs_extra("slam")
def try_out(
    robot: Annotated[
        Path,
        typer.Argument(
            help="Emulated robot: a bundled configuration such as mecanum or tricycle, or a file.",
            autocompletion=complete_config,
        ),
    ] = Path("explore"),
    port: Annotated[
        int, typer.Option("--port", "-p", min=1, max=65535, help="Port of the page; a free port if it is taken.")
    ] = 8470,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="New folder for configuration, logs, state and map.")
    ] = Path("runs/try"),
) -> None:
    """Start an emulated robot, mapping, planner and the operator's page; click on the map to drive.

    The world contains a room and a walking person; the page adds obstacles and device faults. If no route planner
    supports the robot's body, it is driven by hand.
    """
    with needs_extra("planning"), needs_extra("station"):
        from monstertruckd.tools.cli.calibrate_page import PageCalibrator
        from monstertruckd.tools.demo.tryout import free_port, robot_file, run_tryout

    file, folder = robot_file(robot), fresh(output)
    remark(f"starting {robot}, its daemon and the page; logs and map go to {folder}")
    if waiting := busy():
        remark(f"{waiting}: late control ticks may stop the robot; `monstertruckd demo` explores on the virtual clock")
    code = 0

    async def main(clock: "WallClock") -> None:
        nonlocal code
        calibrator = PageCalibrator(clock)
        code = await run_tryout(
            clock, file, folder, free_port(port), print_words, browser=browser, calibrator=calibrator
        )

    until_stopped(main)
    if code:
        raise typer.Exit(code)
