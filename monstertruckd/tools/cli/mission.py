"""``monstertruckd mission``: run lists of steps, check and list them."""

from collections.abc import Callable
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
    from monstertruck_planners.missions.check import Abilities, Key, Mistake
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruck_schemas.mission import Mission
    from monstertruckd.tools.cli.runs import RunEnd

app = command_group("Missions: sequences of steps for the robot.")

WITHOUT = "does no missions"
MISSIONS = shipped("configs/missions")
FileArgument = Annotated[Path, typer.Argument(help="Mission or Nav2 waypoints (YAML).", show_default=False)]


@app.command("run")
def run_command(
    file: Annotated[Path | None, typer.Argument(help="Mission or Nav2 waypoints (YAML).", show_default=False)] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume the mission that a restart interrupted.")] = False,
    moved: Annotated[
        bool, typer.Option("--moved", help="Resume even though the robot was moved; its pose is known to be right.")
    ] = False,
    arm: Annotated[
        bool, typer.Option("--arm", help="Arm the robot first; the robot starts to drive immediately.")
    ] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Check a mission, start it and follow it to its end; the exit code is the reason of the end. Ctrl-C stops it."""
    from monstertruckd.tools.cli.runs import run_mission

    if (file is None) is not resume:
        raise InputError("pass a mission file or --resume")
    if moved and not resume:
        raise InputError("--moved is valid with --resume only")
    mission = None if file is None else load(file)

    async def main(client: "TruckClient", _: "Clock") -> "RunEnd":
        await require_section(client, "planner", WITHOUT)
        return await run_mission(client, mission, arm=arm, moved=moved, report=None if json_output else print_words)

    end = with_robot(main, robot, endpoint)
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)


@app.command("check")
def check_command(
    file: FileArgument,
    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", help="Also check that this robot supports every step.", show_default=False),
    ] = None,
    map_folder: Annotated[
        Path | None,
        typer.Option("--map", help="Also check points of interest against this saved map.", show_default=False),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Check a mission file: report every error with its line, and unreachable steps. Print its steps."""
    from monstertruck_planners.missions.check import lacking, steps_of

    mission, line_of = read(file)
    if config is not None or map_folder is not None:
        require_none(lacking(mission, abilities(config, map_folder)), line_of)
    if json_output:
        print_json(mission.model_dump(mode="json"))
        return
    from monstertruck_planners.missions.outline import in_words

    rows = [
        (
            place.number,
            str(place.step.retries),
            "-" if place.step.limit is None else f"{place.step.limit:g}",
            place.step.on_failure or (mission.on_failure if "." not in place.number else "abort"),
            "  " * place.number.count(".") + in_words(place.step),
        )
        for place in steps_of(mission)
    ]
    print_table(("step", "retries", "limit s", "on failure", "what"), rows, right=("retries", "limit s"))


@app.command("list")
def list_command(
    folder: Annotated[Path, typer.Argument(help="Folder with missions.")] = MISSIONS,
    json_output: JsonOption = False,
) -> None:
    """Print the missions in a folder, and the errors in invalid ones."""
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
    """End the running mission; the robot brakes and stands."""
    from monstertruck_schemas.req import MissionOrder

    async def main(client: "TruckClient", _: "Clock") -> None:
        await require_section(client, "planner", WITHOUT)
        await client.mission(MissionOrder.STOP)

    with_robot(main, robot, endpoint)


def load(file: Path) -> "Mission":
    """Read a mission, see ``read``."""
    return read(file)[0]


def read(file: Path) -> "tuple[Mission, Callable[[Key], str]]":
    """Read a mission, or a file of waypoints as a mission that drives to each of them.

    Returns:
        The mission, and a function that returns file and line of a key.

    Raises:
        ConfigError: one line per mistake, with file, line, key and expectation.
        InputError: a waypoint is invalid, or the file cannot be read.
    """
    from monstertruck_planners.missions.check import dead_ends
    from monstertruck_runtime.outside import text_of
    from monstertruck_runtime.path_files import has_waypoints, mission_from
    from monstertruck_runtime.yaml_files import LARGEST_YAML
    from monstertruck_schemas.mission import Mission
    from monstertruckd.config.load import load_config

    if file.is_file() and has_waypoints(text := text_of(file, "a mission", LARGEST_YAML, ConfigError)):
        return mission_from(text, file), lambda _: str(file)
    mission, tree = load_config(file, Mission)

    def line_of(key: "Key") -> str:
        return str(tree.origin(key) or file)

    require_none(dead_ends(mission), line_of)
    return mission, line_of


def require_none(mistakes: "list[Mistake]", line_of: "Callable[[Key], str]") -> None:
    """Require a mission without errors.

    Raises:
        ConfigError: one line per mistake, with file, line and step.
    """
    if mistakes:
        raise ConfigError("\n".join(f"{line_of(one.key)}: step {one.number}: {one.text}" for one in mistakes))


def abilities(config: Path | None, map_folder: Path | None) -> "Abilities":
    """Return the capabilities of the configured robot, and the points of a saved map.

    Raises:
        ConfigError: the configuration is invalid.
        NotFoundError: the map has no points.
    """
    from dataclasses import replace

    from monstertruck_planners.missions.check import Abilities

    able = Abilities()
    if config is not None:
        from monstertruckd.config.device_safety import packs
        from monstertruckd.config.load import load_truck

        robot, _ = load_truck(config)
        names = robot.all_behaviours.keys()

        def behaviour(name: str, _: object) -> None:
            if name not in names:
                raise NotFoundError(f"no behaviour {name!r}: expected one of {', '.join(sorted(names))}")

        able = Abilities(
            explorer=robot.explorer is not None,
            points=robot.points is not None,
            charge=bool(list(packs(robot.devices, robot.monitors))),
            lidar=robot.devices.lidar is not None,
            zones=robot.zones is not None,
            docks=robot.docks,
            behaviour=behaviour if names else None,
        )
    if map_folder is not None:
        from monstertruck_estimation.points.files import load as load_points

        able = replace(able, known=frozenset(point.name for point, _ in load_points(map_folder)))
    return able
