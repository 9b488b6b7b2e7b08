"""``goto``, ``track``, ``path``, ``explore``, ``dock``, ``undock``: drive the robot and follow its progress.

Also ``convert-path``, which needs no robot.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.path_forms import PathForm
from monstertruckd.tools.cli.connection import require_section, robot_config, with_robot
from monstertruckd.tools.cli.model_options import ModelCommand, field_parameters
from monstertruckd.tools.cli.options import (
    HEADING,
    EndpointOption,
    RobotOption,
    ViaOption,
    parse_heading,
    parse_pose,
    require_finite,
)
from monstertruckd.tools.cli.output import JsonOption, print_end, print_json, print_words, remark

if TYPE_CHECKING:
    import inspect

    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruck_runtime.drives import Arrival
    from monstertruck_schemas.mission import DockStep, UndockStep
    from monstertruck_schemas.plan import Path as PathMessage
    from monstertruckd.tools.cli.runs import RunEnd

ROUTE_TIMEOUT: Final = 6.0
"""Timeout for the first route (s)."""

ArmOption = Annotated[bool, typer.Option("--arm", help="Also arm the robot; the robot starts to drive immediately.")]


PathArgument = Annotated[
    Path,
    typer.Argument(help="Table (CSV) of a path or raceline, or Nav2 waypoints (YAML).", show_default=False),
]
ClosedOption = Annotated[bool, typer.Option("--closed", help="The path is a closed lap.")]
ColumnsOption = Annotated[
    str | None, typer.Option(help="Names of the table's columns, e.g. x,y,yaw,speed.", show_default=False)
]


def goto(
    x: Annotated[float, typer.Argument(help="Metres.", show_default=False)],
    y: Annotated[float, typer.Argument(help="Metres.", show_default=False)],
    yaw: Annotated[float, typer.Argument(parser=parse_heading, help=HEADING, show_default=False)],
    via: ViaOption = None,
    arm: ArmOption = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Drive to a pose in the map: the robot plans a route, follows it and recovers from failures.

    Ends when the robot reaches the goal or gives up; the exit code is the reason. Ctrl-C cancels the goal.
    """
    from monstertruck_runtime.drives import drive_to
    from monstertruckd.tools.cli.goto_session import on_the_terminal

    places = [parse_pose(text, yaw_needed=False) for text in via or ()]
    require_finite((x, y, yaw), *places)

    async def main(client: "TruckClient", clock: "Clock") -> "Arrival":
        await require_section(client, "planner", "has no planner")
        with on_the_terminal() as report:
            return await drive_to(client, clock, (x, y, yaw), places, arm=arm, report=report)

    end = with_robot(main, robot, endpoint, ROUTE_TIMEOUT)
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)


def track(
    file: PathArgument,
    closed: ClosedOption = False,
    columns: ColumnsOption = None,
    repair: Annotated[
        bool, typer.Option("--repair", help="Reverse in turns where the robot cannot follow the path forwards.")
    ] = False,
    arm: ArmOption = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Send a path to the robot and follow its progress.

    The robot refuses a path that it cannot drive and names the place. The command ends at the end of the path or when
    the robot loses it; the exit code is the reason. Ctrl-C stops the robot; armed later, it does not resume the path.
    """
    from monstertruck_planners.track.paths import load_path
    from monstertruck_runtime.drives import follow
    from monstertruck_runtime.path_files import names_of
    from monstertruckd.tools.cli.goto_session import on_the_terminal

    path = load_path(file, closed=closed, columns=names_of(columns))

    async def main(client: "TruckClient", clock: "Clock") -> "Arrival":
        localised = (await client.call("config")).get("slam") is not None
        there = path.model_copy(update={"frame": "map" if localised else "odom"})
        if repair:
            there = await _repaired(client, there)
        with on_the_terminal() as report:
            return await follow(client, clock, there, arm=arm, report=report)

    end = with_robot(main, robot, endpoint, ROUTE_TIMEOUT)
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)


async def _repaired(client: "TruckClient", path: "PathMessage") -> "PathMessage":
    """Return a path that the robot can drive, and print the changes.

    Raises:
        InputError: a bend has no collision-free replacement on the robot's map.
        NotFoundError: the robot has no tracker.
    """
    from monstertruck_planners.collision import DistanceField, Footprint
    from monstertruck_planners.route.repair import repaired
    from monstertruck_schemas.topics import MAP

    await require_section(client, "tracker", "follows no paths")
    config = await robot_config(client)
    assert config.tracker is not None
    chassis, grid = config.chassis(), await client.get_retained(MAP)
    tracker = config.tracker.model_copy(update={"angle": min(config.tracker.angle, chassis.reached_angle)})
    free = None
    if grid is not None and path.frame == "map":
        field = DistanceField.from_grid(grid, unknown_blocks=False)
        free = partial(field.free, Footprint(config.geometry.length, config.geometry.width))
    path, texts = repaired(path, tracker, chassis.bicycle, free)
    checked = "" if free is not None else " (not compared with a map)"
    for text in texts:
        remark(f"repaired{checked}: {text}")
    return path


def path(
    name: Annotated[
        str | None, typer.Argument(help="Name of the configured path; omit it to print the path.", show_default=False)
    ] = None,
    arm: ArmOption = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Start a path of the robot's configuration by its name, and follow its progress.

    A robot with real ports starts it only by this command or the page's button, never by `arm` alone. The command ends
    at the end of the path, when the robot loses it, or when it is disarmed; the exit code is the reason. Ctrl-C stops
    the robot.
    """
    from monstertruck_runtime.drives import drive_configured
    from monstertruckd.tools.cli.goto_session import on_the_terminal

    async def main(client: "TruckClient", clock: "Clock") -> "Arrival | str":
        configured = Path((await require_section(client, "path", "has no path"))["file"]).stem
        if name is None:
            return configured
        with on_the_terminal() as report:
            return await drive_configured(client, clock, name, arm=arm, report=report)

    end = with_robot(main, robot, endpoint, ROUTE_TIMEOUT)
    if isinstance(end, str):
        print_json({"path": end}) if json_output else typer.echo(end)
    else:
        print_end(end.reason, end.text, end.as_json(), json_output=json_output)


def convert_path(
    file: PathArgument,
    output: Annotated[Path, typer.Argument(help="File to write.", show_default=False)],
    form: Annotated[PathForm, typer.Option("--format", "-f", help="Output format.")] = PathForm.CSV,
    closed: ClosedOption = False,
    columns: ColumnsOption = None,
    speed: Annotated[
        float | None, typer.Option(min=0.0, help="Speed for a raceline without speeds, m/s.", show_default=False)
    ] = None,
    width: Annotated[
        float | None, typer.Option(min=0.0, help="Free width on each side of a centreline, m.", show_default=False)
    ] = None,
) -> None:
    """Convert a path to another format: racelines of F1TENTH and TUM, centrelines, waypoints of Nav2."""
    from monstertruck_planners.track.paths import load_path
    from monstertruck_runtime.path_files import names_of, path_text
    from monstertruck_runtime.small_files import replace_file

    path = load_path(file, closed=closed, columns=names_of(columns))
    replace_file(output, path_text(path, form, speed=speed, width=width).encode())
    typer.echo(f"{output}: {len(path.poses) // 3} poses")


class DockCommand(ModelCommand):
    """Command with the name of a dock as argument."""

    def added(self) -> Iterator["inspect.Parameter"]:
        """Yield the name."""
        from monstertruck_schemas.mission import DockStep

        return field_parameters(DockStep, "dock", arguments=True)


def dock(
    context: typer.Context,
    arm: ArmOption = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Drive to a dock and charge. Ctrl-C stops the robot."""
    from monstertruck_schemas.mission import DockStep

    _dock_or_undock(DockStep(do="dock", **context.obj), robot, endpoint, arm=arm, json_output=json_output)


def undock(
    context: typer.Context,
    arm: ArmOption = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Leave a dock, back to its staging pose. Ctrl-C stops the robot."""
    from monstertruck_schemas.mission import UndockStep

    _dock_or_undock(UndockStep(do="undock", **context.obj), robot, endpoint, arm=arm, json_output=json_output)


def _dock_or_undock(step: "DockStep | UndockStep", robot: str, endpoint: str, *, arm: bool, json_output: bool) -> None:
    from monstertruck_schemas.mission import Mission
    from monstertruckd.tools.cli.runs import run_mission

    mission = Mission(version=2, name=step.do, steps=(step,))

    async def main(client: "TruckClient", _: "Clock") -> "RunEnd":
        await require_section(client, "docks", "has no docks")
        return await run_mission(client, mission, arm=arm, report=None if json_output else print_words)

    end = with_robot(main, robot, endpoint)
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)


class ExploreCommand(ModelCommand):
    """Command with the settings of an exploration as options."""

    def added(self) -> Iterator["inspect.Parameter"]:
        """Yield the options of an order to explore."""
        from monstertruck_schemas.req import ExploreRequest

        return field_parameters(ExploreRequest, "home", "budget", "find", switches={"home": "--home/--stay"})


def explore(
    context: typer.Context,
    stop: Annotated[bool, typer.Option("--stop", help="End the exploration that runs.")] = False,
    arm: ArmOption = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Explore: drive to the frontiers of the map until no unknown ground is left, then home, and save the map.

    Prints the progress until the end; the exit code is the reason of the end. Ctrl-C stops it.
    """
    from monstertruck_schemas.req import ExploreOrder
    from monstertruckd.tools.cli.runs import run_exploration

    async def main(client: "TruckClient", _: "Clock") -> "RunEnd | None":
        await require_section(client, "explorer", "does not explore")
        if stop:
            await client.explore(ExploreOrder.STOP)
            return None
        report = None if json_output else print_words
        return await run_exploration(client, arm=arm, report=report, **context.obj)

    end = with_robot(main, robot, endpoint)
    if end is None:
        return
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)
