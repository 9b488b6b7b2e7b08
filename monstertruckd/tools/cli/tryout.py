"""``monstertruckd try``: the whole system without a robot."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.extras import needs_extra
from monstertruckd.tools.cli.demo import busy, fresh
from monstertruckd.tools.cli.options import complete_config
from monstertruckd.tools.cli.output import print_words, remark, until_stopped

if TYPE_CHECKING:
    from monstertruck_runtime.clock import WallClock


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
        int, typer.Option("--port", "-p", min=1, max=65535, help="Port of the page; if it is taken, a free one.")
    ] = 8470,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="New folder for configuration, logs, state and map.")
    ] = Path("runs/try"),
) -> None:
    """Emulated robot, mapping, planner and the operator's page at once: click where it shall drive.

    The world has a room and a person who walks in it; the page adds obstacles and lets devices fail. A robot whose body
    no route planner can steer is driven by hand.
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
