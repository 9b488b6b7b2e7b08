"""``monstertruckd study``: the skid-steer robot's open-loop runs and their analysis."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.cli.connection import robot_config, with_robot
from monstertruckd.tools.cli.logs import finish_log
from monstertruckd.tools.cli.model_options import ModelCommand, field_parameters
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, command_group, print_json, print_table, remark

if TYPE_CHECKING:
    import inspect
    from collections.abc import Callable, Iterator

    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.config.truck import TruckConfig
    from monstertruckd.tools.study.log import Run
    from monstertruckd.tools.study.report import Result
    from monstertruckd.tools.study.runs import Stretch

app = command_group("The skid-steer study: circles and straight passes by wheel speeds, open loop, and their analysis.")


class CircleCommand(ModelCommand):
    """Command with the numbers of a circle as options."""

    def added(self) -> "Iterator[inspect.Parameter]":
        """Yield the numbers."""
        from monstertruckd.tools.study.runs import CircleRun

        return field_parameters(CircleRun, *CircleRun.model_fields, defaults=True)


class StraightCommand(ModelCommand):
    """Command with the numbers of passes to and fro as options."""

    def added(self) -> "Iterator[inspect.Parameter]":
        """Yield the numbers."""
        from monstertruckd.tools.study.runs import StraightRun

        return field_parameters(StraightRun, *StraightRun.model_fields, defaults=True)


@app.command("circle", cls=CircleCommand)
def circle_command(
    context: typer.Context, robot: RobotOption = "skid_stand", endpoint: EndpointOption = DEFAULT_ENDPOINT
) -> None:
    """Arm and drive a circle to the left, open loop; the daemon's log has the run. Takes the role engineer."""
    from monstertruckd.tools.study.runs import CircleRun

    _drive(CircleRun.model_validate(context.obj).plan, robot, endpoint)


@app.command("straight", cls=StraightCommand)
def straight_command(
    context: typer.Context, robot: RobotOption = "skid_stand", endpoint: EndpointOption = DEFAULT_ENDPOINT
) -> None:
    """Arm and drive to and fro along a line, open loop; the daemon's log has the run. Takes the role engineer."""
    from monstertruckd.tools.study.runs import StraightRun

    _drive(StraightRun.model_validate(context.obj).plan, robot, endpoint)


@app.command("analyse")
def analyse_command(
    logs: Annotated[list[Path], typer.Argument(help="Logs with runs of the study.", show_default=False)],
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the figures 6 to 15.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Print radii, speeds, drifts, spread, bend and turns next to the paper's values, and draw its figures."""
    from monstertruckd.recorder.reader import open_log
    from monstertruckd.tools.logs.geometry import recorded_geometry
    from monstertruckd.tools.study import report
    from monstertruckd.tools.study.log import read_runs

    runs: list[Run] = []
    robots: list[tuple[Path, Any]] = []
    readers = [open_log(log) for log in logs]
    for reader in readers:
        found, config = read_runs(reader)
        if "geometry" not in config:
            raise InputError(f"{reader.path}: config.json is not attached: expected a log that the daemon recorded")
        robots.append((reader.path, recorded_geometry(reader.path, config)))
        if robots[-1][1] != robots[0][1]:
            raise InputError(f"{reader.path}: is of another robot than {robots[0][0]}: their geometry differs")
        runs += found
    results = _results(runs)
    geometry = robots[0][1]
    values = report.as_values(results, geometry.wheel_radius, geometry.track / 2)
    if out is not None:
        from monstertruckd.tools.study.plots import draw

        for path in draw(results, out):
            remark(f"wrote {path}")
    if json_output:
        print_json(values)
    else:
        print_table(report.HEADINGS, list(report.rows(values)), right=report.HEADINGS[2:7])
        for slip in values["slips_of_the_paper"]:
            typer.echo(f"the paper: {slip}")
    for reader in readers:
        finish_log(reader.path, reader.fault)


def _results(runs: "list[Run]") -> "list[Result]":
    """Results of the runs; runs without a result, such as one stopped immediately, are reported and skipped.

    Raises:
        InputError: no run has a result.
    """
    from monstertruckd.tools.study.report import analyse

    results: list[Result] = []
    wrong: list[InputError] = []
    for run in runs:
        try:
            results += analyse([run])
        except InputError as error:
            wrong.append(error)
    if not results:
        raise wrong[0]
    for why in wrong:
        remark(f"skipped: {why}")
    return results


def _drive(plan: "Callable[[TruckConfig], list[Stretch]]", robot: str, endpoint: str) -> None:
    from monstertruckd.tools.study.runs import drive

    async def main(client: "TruckClient", clock: "Clock") -> float:
        config = await robot_config(client)
        stretches = plan(config)
        remark(f"drives for {sum(stretch.seconds for stretch in stretches):.0f} s; Ctrl-C stops the robot")
        return await drive(client, clock, config, stretches)

    seconds = with_robot(main, robot, endpoint)
    remark(f"done in {seconds:.0f} s; analyse the log with `monstertruckd study analyse`")
