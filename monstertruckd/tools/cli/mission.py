"""``monstertruckd mission``: run lists of steps, check and list them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import ConfigError, InputError, NotFoundError
from monstertruckd.tools.cli.connection import require_section, with_robot
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, command_group, print_end, print_json, print_table, print_words
from monstertruckd.tools.shipped import shipped

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruck_schemas.mission import Mission
    from monstertruckd.tools.cli.runs import RunEnd

app = command_group("Missions: steps that the robot does one after the other.")

WITHOUT = "does no missions"
MISSIONS = shipped("configs/missions")
FileArgument = Annotated[Path, typer.Argument(help="Mission or waypoints of Nav2 (YAML).", show_default=False)]


@app.command("run")
def run_command(
    file: Annotated[
        Path | None, typer.Argument(help="Mission or waypoints of Nav2 (YAML).", show_default=False)
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume the mission that a restart interrupted.")] = False,
    moved: Annotated[
        bool, typer.Option("--moved", help="Resume although the robot is not where it was: its pose is right.")
    ] = False,
    arm: Annotated[bool, typer.Option("--arm", help="Arm the robot first; it drives off at once.")] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Check a mission, start it and follow it to its end, whose reason is the exit code. Ctrl-C stops it."""
    from monstertruckd.tools.cli.runs import run_mission

    if (file is None) is not resume:
        raise InputError("expected a mission's file, or --resume")
    if moved and not resume:
        raise InputError("--moved: expected with --resume only")
    mission = None if file is None else load(file)

    async def main(client: "TruckClient", _: "Clock") -> "RunEnd":
        await require_section(client, "planner", WITHOUT)
        return await run_mission(client, mission, arm=arm, moved=moved, report=None if json_output else print_words)

    end = with_robot(main, robot, endpoint)
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)


@app.command("check")
def check_command(file: FileArgument, json_output: JsonOption = False) -> None:
    """Check a mission's file: every mistake with its line. Prints its steps."""
    from monstertruck_planners.missions.progress import in_words

    mission = load(file)
    if json_output:
        print_json(mission.model_dump(mode="json"))
        return
    rows = [
        (
            str(number),
            str(step.retries),
            "-" if step.limit is None else f"{step.limit:g}",
            step.on_failure or mission.on_failure,
            in_words(step),
        )
        for number, step in enumerate(mission.steps, 1)
    ]
    numbers = ("step", "retries", "limit s")
    print_table((*numbers, "on failure", "what"), rows, right=numbers)


@app.command("list")
def list_command(
    folder: Annotated[Path, typer.Argument(help="Folder with missions.")] = MISSIONS,
    json_output: JsonOption = False,
) -> None:
    """Print the missions of a folder, and what is wrong with those that cannot be run."""
    if not folder.is_dir():
        raise NotFoundError(f"{folder}: no such folder")
    rows = []
    for file in sorted(folder.glob("*.yaml")):
        try:
            mission = load(file)
        except ConfigError as error:
            rows.append((file.name, "", 0, str(error).partition("\n")[0]))
        else:
            rows.append((file.name, mission.name, len(mission.steps), ""))
    if json_output:
        print_json([dict(zip(("file", "name", "steps", "error"), row, strict=True)) for row in rows])
    elif rows:
        cells = [
            (file, name, str(steps or ""), mistake.replace(f"{folder / file}:", "line ", 1))
            for file, name, steps, mistake in rows
        ]
        print_table(("file", "name", "steps", "first mistake"), cells, right=("steps",))
    else:
        print(f"none: no *.yaml in {folder}")


@app.command("stop")
def stop_command(robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT) -> None:
    """End the mission that runs; the robot brakes and stands."""
    from monstertruck_schemas.req import MissionOrder

    async def main(client: "TruckClient", _: "Clock") -> None:
        await require_section(client, "planner", WITHOUT)
        await client.mission(MissionOrder.STOP)

    with_robot(main, robot, endpoint)


def load(file: Path) -> "Mission":
    """Read a mission, or a file of waypoints as one that drives to each of them.

    Raises:
        ConfigError: one line per mistake, each naming file, line, key and what was expected.
        InputError: a waypoint is invalid, or the file cannot be read.
    """
    from monstertruck_runtime.outside import text_of
    from monstertruck_runtime.path_files import has_waypoints, mission_from
    from monstertruck_runtime.yaml_files import LARGEST_YAML
    from monstertruck_schemas.mission import Mission
    from monstertruckd.config.load import load_config

    if file.is_file() and has_waypoints(text := text_of(file, "a mission", LARGEST_YAML, ConfigError)):
        return mission_from(text, file)
    return load_config(file, Mission)[0]
